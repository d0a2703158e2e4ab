"""The plant's end of the UDP loop: measurements out, torques in, in lockstep."""

import select
import socket
import time
from contextlib import suppress
from threading import Event

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Command, CommandCounts, Drives
from symbid_ros.simulation.command_gate import Address, CommandGate
from symbid_ros.simulation.measurement import Instant
from symbid_ros.simulation.packet import LONGEST

RETRY_PERIOD = 0.002  # s; a few times what an answer takes on one machine
COMMAND_TIMEOUT = 0.1  # s
LOOK_PERIOD = 0.05  # s between two looks at whether to stop


class UdpCommands:
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
        self._drives, self._gate = drives, CommandGate(drives)
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

    def __enter__(self) -> "UdpCommands":
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
            datagram, address = self._socket.recvfrom(LONGEST)
        except BlockingIOError:
            return None
        return datagram, address

    def _wait(self, seconds: float) -> None:
        select.select([self._socket], [], [], max(seconds, 0.0))
