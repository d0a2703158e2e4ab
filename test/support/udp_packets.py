"""Packets of the UDP loop as documented in docs/udp.md, built with ``struct``."""

import struct

HEADER = "<IHHIIII"
MAGIC, VERSION, MEASUREMENT, COMMAND = 0x44424D53, 1, 1, 2
JOINTS, DRIVES, PLATES = 10, 8, 2
FIELDS = {
    "joint_position": JOINTS,
    "joint_velocity": JOINTS,
    "joint_effort": JOINTS,
    "imu_orientation": 4,
    "imu_angular_velocity": 3,
    "imu_linear_acceleration": 3,
    "wrenches": 6 * PLATES,
}


def command(
    sequence: int,
    stamp: int,
    torques: list[float],
    *,
    magic: int = MAGIC,
    version: int = VERSION,
    kind: int = COMMAND,
    count: int | None = None,
) -> bytes:
    count = len(torques) if count is None else count
    header = (magic, version, kind, sequence, stamp // 10**9, stamp % 10**9, count)
    return struct.pack(f"{HEADER}{len(torques)}d", *header, *torques)


def hello() -> bytes:
    return command(0, 0, [0.0] * DRIVES)


def sequence_and_stamp(datagram: bytes) -> tuple[int, int]:
    magic, version, kind, sequence, seconds, nanoseconds, count = struct.unpack_from(
        HEADER, datagram
    )
    assert (magic, version, kind) == (MAGIC, VERSION, MEASUREMENT)
    assert len(datagram) == 24 + 8 * count
    return sequence, 10**9 * seconds + nanoseconds


def measurement(datagram: bytes) -> dict[str, tuple[float, ...]]:
    values = struct.unpack_from(f"<{sum(FIELDS.values())}d", datagram, 24)
    assert len(datagram) == 24 + 8 * len(values)
    fields, start = {}, 0
    for name, size in FIELDS.items():
        fields[name] = values[start : start + size]
        start += size
    return fields
