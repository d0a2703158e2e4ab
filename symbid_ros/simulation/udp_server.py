"""The plant's end of the UDP loop: measurements out, torques in, in lockstep."""

import select
import socket
import time
from contextlib import suppress
from threading import Event

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Command, CommandCounts, Drives, Rejection
from symbid_ros.simulation.packet import (
    COMMAND,
    HELLO,
    MAX_DATAGRAM_BYTES,
    Packet,
    PacketError,
    decode,
    encode,
    encode_measurement,
    is_before,
    next_sequence,
)
from symbid_ros.simulation.sensors import Instant

Address = tuple[str, int]
LATE = frozenset({Rejection.OLD, Rejection.DUPLICATE})


class CommandValidator:
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
        return encode(encode_measurement(self._sequence, instant))

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
        rejection = self._rejection(packet)
        if rejection is not None:
            if rejection in LATE and address == self.controller:
                # Too late, but alive: it is worth waiting for again.
                self.is_controlled = True
            self._reject(rejection)
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

    def _rejection(self, packet: Packet) -> Rejection | None:
        if packet.sequence == self._accepted:
            return Rejection.DUPLICATE
        if packet.sequence != self._sequence:
            is_old = is_before(packet.sequence, self._sequence)
            return Rejection.OLD if is_old else Rejection.FUTURE
        if packet.stamp != self._stamp:
            return Rejection.STAMP
        return self._drives.validate(packet.values)

    def _hand_over(self, address: Address) -> None:
        self.controller, self.is_controlled = address, True

    def _reject(self, reason: Rejection) -> None:
        self.counts.rejected[reason] += 1


RETRY_PERIOD = 0.002  # s; a few times what an answer takes on one machine
COMMAND_TIMEOUT = 0.1  # s
LOOK_PERIOD = 0.05  # s between two looks at whether to stop


class UdpServer:
    """Asks a controller elsewhere for torques, an instant at a time.

    An instant's measurement is sent to who is in control, and again until answered: datagrams
    get lost. Without an answer within ``command_timeout`` the controller
    loses control; torques are the safe ones of `Drives`, at once and not waited for, until it or
    another one says hello.

    Parameters
    ----------
    host : str
        Address to listen at; 127.0.0.1 keeps everybody outside this machine out.
    port : int
        UDP port; 0 for any free one.
    drives : Drives
        Limits and safe torques.
    command_timeout : float
        s of wall time.
    retry_period : float
        s from the first to the second time that a measurement is sent; each wait after that is
        twice as long, lest a slow controller's queue fill up.
    reply_port : int
        Port of the controller's host that measurements go to; 0 for the one that it sends
        from. Simulink's blocks send and receive by different ports.

    Attributes
    ----------
    address : tuple of str and int
        Host and port it listens at.

    Raises
    ------
    SimulationError
        When it cannot listen there.
    """

    def __init__(
        self,
        host: str,
        port: int,
        drives: Drives,
        *,
        command_timeout: float = COMMAND_TIMEOUT,
        retry_period: float = RETRY_PERIOD,
        reply_port: int = 0,
    ) -> None:
        if not host:  # which sockets take for every address of the machine
            raise SimulationError("udp: no host to listen at; give 127.0.0.1 or another address")
        self._drives, self._gate = drives, CommandValidator(drives)
        self._timeout, self._retry = command_timeout, retry_period
        self._reply_port = reply_port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise SimulationError(
                f"udp {host}:{port}: cannot listen ({error}); choose another host or port"
            ) from error
        self._socket.setblocking(False)
        self.address: Address = self._socket.getsockname()

    def __enter__(self) -> "UdpServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()

    @property
    def counts(self) -> CommandCounts:
        """What has come in so far."""
        return self._gate.counts

    @property
    def controller(self) -> Address | None:
        """Host and port of who is in control, if somebody is."""
        return self._gate.controller if self._gate.is_controlled else None

    def await_controller(self, stop: Event) -> bool:
        """Wait until somebody says hello and tell whether it came to that before the stop."""
        self._gate.release()
        while not self._gate.is_controlled and not stop.is_set():
            received = self._receive()
            if received is None:
                self._wait(LOOK_PERIOD)
            else:
                self._gate.offer(*received)
        return self._gate.is_controlled

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Send an instant's measurement and return the command that answers it, or a safe one.

        Returns within ``command_timeout``, and at once when nobody is in control or the stop
        is set.
        """
        torques = self._ask(self._gate.expect(instant), stop)
        if torques is not None:
            return Command(torques, is_safe=False)
        return Command(self._drives.safe_torques(instant.joint_velocity), is_safe=True)

    def _ask(self, datagram: bytes, stop: Event) -> FloatArray | None:
        gate = self._gate
        now = due = time.monotonic()
        deadline, sent = now + self._timeout, 0
        while now < deadline and not stop.is_set():
            if now >= due:
                self._send(datagram)
                gate.counts.resent += sent > 0
                due, sent = now + self._retry * 2**sent, sent + 1
            received = self._receive()
            if received is not None:
                torques = gate.offer(*received)
                if torques is not None:
                    return torques
            elif gate.is_controlled:
                self._wait(min(due, deadline) - now)
            else:
                return None
            now = time.monotonic()
        if gate.is_controlled and not stop.is_set():
            gate.counts.timeouts += 1
            gate.release()
        return None

    def _send(self, datagram: bytes) -> None:
        if self._gate.controller is not None:
            host, port = self._gate.controller
            # What cannot be sent is as good as lost on its way, and will be sent again.
            with suppress(OSError):
                self._socket.sendto(datagram, (host, self._reply_port or port))

    def _receive(self) -> tuple[bytes, Address] | None:
        try:
            datagram, address = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except BlockingIOError:
            return None
        return datagram, address

    def _wait(self, seconds: float) -> None:
        select.select([self._socket], [], [], max(seconds, 0.0))
