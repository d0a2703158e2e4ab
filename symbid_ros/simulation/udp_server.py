"""UDP server of the simulator: sends measurements and receives commands, in lockstep."""

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
RETRY_PERIOD = 0.002  # s; a few times the response time of a controller on the same machine
COMMAND_TIMEOUT = 0.1  # s
STOP_CHECK_PERIOD = 0.05  # s


class CommandValidator:
    """Accepts the one command that answers the last measurement, from one controller.

    A controller takes control by a hello or a valid command. Datagrams of others are rejected
    until `release`; the next sender then takes control.

    Parameters
    ----------
    drives : Drives
        Number and limits of the torques.

    Attributes
    ----------
    counts : CommandCounts
        Counts of all received datagrams.
    controller : tuple of str and int or None
        Host and port of the current or last controller.
    is_controlled : bool
        Whether a controller is in control.
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
        """Return the datagram of an instant and expect its command from now on."""
        self._sequence, self._stamp = next_sequence(self._sequence), instant.stamp
        return encode(encode_measurement(self._sequence, instant))

    def release(self) -> None:
        """Take control from the controller; any sender may then take control."""
        self.is_controlled = False

    def process(self, datagram: bytes, address: Address) -> FloatArray | None:
        """Count a datagram; return its torques (n_actuated,), Nm, if it is the expected command.

        Invalid datagrams are counted by reason; none raises an error.
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
            self._give_control(address)
            return None
        rejection = self._rejection(packet)
        if rejection is not None:
            if rejection in LATE and address == self.controller:
                # The controller is slow but responds: the next measurement waits for it again.
                self.is_controlled = True
            self._reject(rejection)
            return None
        self._accepted = packet.sequence
        self.counts.accepted += 1
        self._give_control(address)
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

    def _give_control(self, address: Address) -> None:
        self.controller, self.is_controlled = address, True

    def _reject(self, reason: Rejection) -> None:
        self.counts.rejected[reason] += 1


class UdpServer:
    """Exchanges measurements and commands with an external controller, one instant at a time.

    The server sends each measurement to the controller, repeatedly until the command arrives, as
    datagrams can get lost. If none arrives within ``command_timeout``, the controller loses
    control. The server then returns the safe torques of `Drives` without waiting, until a
    controller sends a hello.

    Parameters
    ----------
    host : str
        Address to listen on; 127.0.0.1 accepts datagrams from this machine only.
    port : int
        UDP port; 0 for any free port.
    drives : Drives
        Limits and safe torques.
    command_timeout : float
        s of wall time.
    retry_period : float
        s until a measurement is sent for the second time; each further wait is twice as long, so
        that the queue of a slow controller does not fill up.
    reply_port : int
        Port of the controller's host to which measurements are sent; 0 for the port that it sends
        from. Simulink's blocks send and receive on different ports.

    Attributes
    ----------
    address : tuple of str and int
        Host and port that the server listens on.

    Raises
    ------
    SimulationError
        When the server cannot listen on this address.
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
        if not host:  # sockets would listen on all addresses of the machine
            raise SimulationError(
                "udp: no host to listen on; give 127.0.0.1 or another address", "E616"
            )
        self._drives, self._validator = drives, CommandValidator(drives)
        self._timeout, self._retry = command_timeout, retry_period
        self._reply_port = reply_port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise SimulationError(
                f"udp {host}:{port}: cannot listen ({error}); choose another host or port", "E616"
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
        """Counts of received datagrams, retries and timeouts."""
        return self._validator.counts

    @property
    def controller(self) -> Address | None:
        """Host and port of the controller, or None while none is connected."""
        return self._validator.controller if self._validator.is_controlled else None

    def await_controller(self, stop: Event) -> bool:
        """Wait for a controller's hello; return False if ``stop`` was set before."""
        self._validator.release()
        while not self._validator.is_controlled and not stop.is_set():
            received = self._receive()
            if received is None:
                self._wait(STOP_CHECK_PERIOD)
            else:
                self._validator.process(*received)
        return self._validator.is_controlled

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Send the measurement of an instant and return its command, or safe torques.

        Returns within ``command_timeout``, and immediately if there is no controller or ``stop``
        is set.
        """
        torques = self._request(self._validator.expect(instant), stop)
        if torques is not None:
            return Command(torques, is_safe=False)
        return Command(self._drives.safe_torques(instant.joint_velocity), is_safe=True)

    def _request(self, datagram: bytes, stop: Event) -> FloatArray | None:
        validator = self._validator
        now = due = time.monotonic()
        deadline, sent = now + self._timeout, 0
        while now < deadline and not stop.is_set():
            if now >= due:
                self._send(datagram)
                validator.counts.resent += sent > 0
                due, sent = now + self._retry * 2**sent, sent + 1
            received = self._receive()
            if received is not None:
                torques = validator.process(*received)
                if torques is not None:
                    return torques
            elif validator.is_controlled:
                self._wait(min(due, deadline) - now)
            else:
                return None
            now = time.monotonic()
        if validator.is_controlled and not stop.is_set():
            validator.counts.timeouts += 1
            validator.release()
        return None

    def _send(self, datagram: bytes) -> None:
        if self._validator.controller is not None:
            host, port = self._validator.controller
            # A failure is equivalent to a lost datagram, which is sent again.
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
