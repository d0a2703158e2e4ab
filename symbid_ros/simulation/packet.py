"""Datagrams of the UDP loop: a header of 24 bytes, then doubles, all little-endian.

docs/udp.md documents every field.
"""

import struct
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Rejection
from symbid_ros.simulation.sensors import Instant, Measurement

HEADER = struct.Struct("<IHHIIII")  # magic, version, kind, sequence, seconds, nanoseconds, count
MAGIC = 0x44424D53  # the bytes "SMBD"
VERSION = 1
MEASUREMENT, COMMAND = 1, 2
HELLO = 0  # sequence number of a command that does not answer a measurement
MAX_SEQUENCE = 2**32 - 1
MAX_DATAGRAM_BYTES = 65507  # bytes of a UDP datagram's payload
NANOSECONDS_PER_SECOND = 1_000_000_000


class PacketError(SimulationError):
    """A datagram that does not follow the protocol.

    Parameters
    ----------
    reason : Rejection
        The violated rule.
    """

    def __init__(self, reason: Rejection) -> None:
        super().__init__(f"datagram rejected ({reason}); see docs/udp.md", "E618")
        self.reason = reason


@dataclass(frozen=True, slots=True)
class Packet:
    """Content of a datagram.

    Attributes
    ----------
    kind : int
        ``MEASUREMENT`` or ``COMMAND``.
    sequence : int
        Number of the measurement, or of the measurement that the command answers.
    stamp : int
        Stamp of that measurement, ns.
    values : (count,) float64
        Measured values or torques, in SI units.
    """

    kind: int
    sequence: int
    stamp: int
    values: FloatArray


def encode(packet: Packet) -> bytes:
    """Encode a packet as a datagram."""
    seconds, nanoseconds = divmod(packet.stamp, NANOSECONDS_PER_SECOND)
    values = np.ascontiguousarray(packet.values, dtype="<f8")
    header = (MAGIC, VERSION, packet.kind, packet.sequence, seconds, nanoseconds, len(values))
    return HEADER.pack(*header) + values.tobytes()


def decode(datagram: bytes, kind: int) -> Packet:
    """Decode a datagram of the given kind; its values are not checked.

    Raises
    ------
    PacketError
        When length, magic, version or kind are wrong.
    """
    if len(datagram) < HEADER.size:
        raise PacketError(Rejection.LENGTH)
    magic, version, received, sequence, seconds, nanoseconds, count = HEADER.unpack_from(datagram)
    if magic != MAGIC:
        raise PacketError(Rejection.MAGIC)
    if version != VERSION:
        raise PacketError(Rejection.VERSION)
    if received != kind:
        raise PacketError(Rejection.KIND)
    if len(datagram) != HEADER.size + 8 * count:
        raise PacketError(Rejection.LENGTH)
    values = np.frombuffer(datagram, dtype="<f8", offset=HEADER.size).astype(np.float64)
    return Packet(kind, sequence, NANOSECONDS_PER_SECOND * seconds + nanoseconds, values)


def encode_measurement(sequence: int, instant: Instant) -> Packet:
    """Return the sensor readings of one instant as a packet."""
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


def decode_measurement(packet: Packet, joints: int) -> Measurement:
    """Return the measurement in a packet, for a robot with ``joints`` joints.

    Raises
    ------
    PacketError
        When the number of values does not match the robot, or a value is NaN or infinite.
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
    """Return the next sequence number; after the largest comes 1."""
    return sequence % MAX_SEQUENCE + 1


def is_before(sequence: int, other: int) -> bool:
    """Tell whether ``sequence`` precedes ``other`` by less than half of all numbers."""
    return 0 < (other - sequence) % MAX_SEQUENCE < MAX_SEQUENCE // 2
