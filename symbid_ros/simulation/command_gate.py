"""Which datagrams may move the robot: the state of the UDP loop, without its socket."""

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.command import CommandCounts, Drives, Rejection
from symbid_ros.simulation.measurement import Instant
from symbid_ros.simulation.packet import (
    COMMAND,
    HELLO,
    Packet,
    PacketError,
    decode,
    encode,
    is_before,
    measurement_packet,
    next_sequence,
)

Address = tuple[str, int]
TARDY = frozenset({Rejection.OLD, Rejection.DUPLICATE})


class CommandGate:
    """Lets the one command pass that answers the measurement last sent, from one controller.

    In control is who last said hello or answered. As long as it does, nobody else is listened
    to; once it has been given up (`release`), the first who speaks is.

    Parameters
    ----------
    drives : Drives
        Of the robot.

    Attributes
    ----------
    counts : CommandCounts
        Of all that was offered.
    controller : tuple of str and int or None
        Host and port of who is in control, or was last.
    is_controlled : bool
        Whether it still is.
    """

    def __init__(self, drives: Drives) -> None:
        self._drives = drives
        self._sequence = 0
        self._stamp = 0
        self._accepted = 0
        self.counts = CommandCounts()
        self.controller: Address | None = None
        self.is_controlled = False

    def expect(self, instant: Instant) -> bytes:
        """Return the datagram of an instant, whose answer is awaited from now on."""
        self._sequence, self._stamp = next_sequence(self._sequence), instant.stamp
        return encode(measurement_packet(self._sequence, instant))

    def release(self) -> None:
        """Give up who is in control: it, or anybody else, may begin anew."""
        self.is_controlled = False

    def offer(self, datagram: bytes, address: Address) -> FloatArray | None:
        """Return the torques (n_actuated,), Nm, if a datagram is the answer, and count it.

        Raises nothing, whatever the datagram holds.
        """
        if self.is_controlled and address != self.controller:
            self._reject(Rejection.STRANGER)
            return None
        try:
            packet = self._decode(datagram)
        except PacketError as error:
            self._reject(error.reason)
            return None
        if packet.sequence == HELLO:
            self.counts.hellos += 1
            self._hand_over(address)
            return None
        objection = self._objection(packet)
        if objection is not None:
            if objection in TARDY and address == self.controller:
                # Too late, but alive: it is worth waiting for again.
                self.is_controlled = True
            self._reject(objection)
            return None
        self._accepted = packet.sequence
        self.counts.accepted += 1
        self._hand_over(address)
        return packet.values

    def _decode(self, datagram: bytes) -> Packet:
        packet = decode(datagram, COMMAND)
        if len(packet.values) != len(self._drives):
            raise PacketError(Rejection.LENGTH)
        return packet

    def _objection(self, packet: Packet) -> Rejection | None:
        if packet.sequence == self._accepted:
            return Rejection.DUPLICATE
        if packet.sequence != self._sequence:
            is_old = is_before(packet.sequence, self._sequence)
            return Rejection.OLD if is_old else Rejection.FUTURE
        if packet.stamp != self._stamp:
            return Rejection.STAMP
        return self._drives.objection(packet.values)

    def _hand_over(self, address: Address) -> None:
        self.controller, self.is_controlled = address, True

    def _reject(self, reason: Rejection) -> None:
        self.counts.rejected[reason] += 1
