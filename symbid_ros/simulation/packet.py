"""The datagrams of the UDP loop: 24 bytes of header, then doubles, all little-endian.

docs/udp.md tables every field for those who speak it from elsewhere.
"""

import struct
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Rejection
from symbid_ros.simulation.sensors import Instant

HEADER = struct.Struct("<IHHIIII")  # magic, version, kind, sequence, seconds, nanoseconds, count
MAGIC = 0x44424D53  # the bytes "SMBD"
VERSION = 1
MEASUREMENT, COMMAND = 1, 2
HELLO = 0  # a command's sequence number that answers no measurement
MAX_SEQUENCE = 2**32 - 1
MAX_DATAGRAM_BYTES = 65507  # bytes of a UDP datagram's payload
NANOSECONDS_PER_SECOND = 1_000_000_000


class PacketError(SimulationError):
    """A datagram that is none of ours.

    Parameters
    ----------
    reason : Rejection
        What is wrong with it.
    """

    def __init__(self, reason: Rejection) -> None:
        super().__init__(f"datagram refused for its {reason}; see docs/udp.md")
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Packet:
    """A datagram's content.

    Attributes
    ----------
    kind : int
        ``MEASUREMENT`` or ``COMMAND``.
    sequence : int
        Number of the measurement, or of the one that the command answers.
    stamp : int
        Of that measurement, ns.
    values : (count,) float64
        In the units of the kind.
    """

    kind: int
    sequence: int
    stamp: int
    values: FloatArray


@dataclass(frozen=True)
class Measurement:
    """What the sensors say, as in `Instant`."""

    stamp: int
    joint_position: FloatArray
    joint_velocity: FloatArray
    joint_effort: FloatArray
    imu_orientation: FloatArray
    imu_angular_velocity: FloatArray
    imu_linear_acceleration: FloatArray
    wrenches: FloatArray


def encode(packet: Packet) -> bytes:
    """Return a packet as a datagram."""
    seconds, nanoseconds = divmod(packet.stamp, NANOSECONDS_PER_SECOND)
    values = np.ascontiguousarray(packet.values, dtype="<f8")
    header = (MAGIC, VERSION, packet.kind, packet.sequence, seconds, nanoseconds, len(values))
    return HEADER.pack(*header) + values.tobytes()


def decode(datagram: bytes, kind: int) -> Packet:
    """Return the content of a datagram of one kind.

    Raises
    ------
    PacketError
        When length, magic, version or kind are wrong; values may be anything.
    """
    if len(datagram) < HEADER.size:
        raise PacketError(Rejection.LENGTH)
    magic, version, its_kind, sequence, seconds, nanoseconds, count = HEADER.unpack_from(datagram)
    if magic != MAGIC:
        raise PacketError(Rejection.MAGIC)
    if version != VERSION:
        raise PacketError(Rejection.VERSION)
    if its_kind != kind:
        raise PacketError(Rejection.KIND)
    if len(datagram) != HEADER.size + 8 * count:
        raise PacketError(Rejection.LENGTH)
    values = np.frombuffer(datagram, dtype="<f8", offset=HEADER.size).astype(np.float64)
    return Packet(kind, sequence, NANOSECONDS_PER_SECOND * seconds + nanoseconds, values)


def encode_measurement(sequence: int, instant: Instant) -> Packet:
    """Return what the sensors say at one instant as a packet."""
    values = [
        instant.joint_position,
        instant.joint_velocity,
        instant.joint_effort,
        instant.imu_orientation,
        instant.imu_angular_velocity,
        instant.imu_linear_acceleration,
        instant.wrenches.ravel(),
    ]
    return Packet(MEASUREMENT, sequence, instant.stamp, np.concatenate(values))


def measurement(packet: Packet, joints: int) -> Measurement:
    """Return the measurement of a robot of so many joints that a packet holds.

    Raises
    ------
    PacketError
        When it is no measurement of such a robot, or not all numbers.
    """
    fixed = [joints, joints, joints, 4, 3, 3]
    ends = np.cumsum(fixed).tolist()
    values = packet.values
    if len(values) < ends[-1] or (len(values) - ends[-1]) % 6:
        raise PacketError(Rejection.LENGTH)
    if not np.all(np.isfinite(values)):
        raise PacketError(Rejection.NOT_FINITE)
    position, rate, effort, orientation, gyroscope, accelerometer, wrenches = np.split(values, ends)
    return Measurement(
        stamp=packet.stamp,
        joint_position=position,
        joint_velocity=rate,
        joint_effort=effort,
        imu_orientation=orientation,
        imu_angular_velocity=gyroscope,
        imu_linear_acceleration=accelerometer,
        wrenches=wrenches.reshape(-1, 6),
    )


def next_sequence(sequence: int) -> int:
    """Return the number after one, from 1 again after the largest."""
    return sequence % MAX_SEQUENCE + 1


def is_before(sequence: int, other: int) -> bool:
    """Tell whether a number was given before another one, less than half of all numbers ago."""
    return 0 < (other - sequence) % MAX_SEQUENCE < MAX_SEQUENCE // 2
