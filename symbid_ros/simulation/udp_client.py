"""UDP client of the simulator: receives measurements and sends torques."""

import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from threading import Event

import numpy as np

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.packet import (
    COMMAND,
    HELLO,
    MAX_DATAGRAM_BYTES,
    MEASUREMENT,
    Packet,
    PacketError,
    decode,
    decode_measurement,
    encode,
    is_before,
)
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.sensors import Measurement
from symbid_ros.simulation.standing_controller import StandingController

HELLO_PERIOD = 0.1  # s without measurements after which the client sends a hello


@dataclass
class ClientCounts:
    """Counts of sent and ignored datagrams.

    Attributes
    ----------
    answered : int
        Measurements answered, each counted once.
    repeated : int
        Commands sent again because their measurement arrived again.
    hellos : int
        Hellos sent.
    ignored : int
        Invalid datagrams, and measurements older than the last.
    unanswered : int
        Measurements for which the controller found no torques.
    """

    answered: int = 0
    repeated: int = 0
    hellos: int = 0
    ignored: int = 0
    unanswered: int = 0


class UdpClient:
    """Answers the measurements of a UDP server with the torques of a controller.

    The client sends hellos until measurements arrive, and again after `HELLO_PERIOD` without any.
    The next measurement may then have any sequence number, as the server may have restarted. If a
    measurement arrives again, its command was lost: the client sends the same command again
    without calling the controller.

    Parameters
    ----------
    host, port : str, int
        Address of the server.
    controller : StandingController
        Computes the torques.
    between : callable or None
        Called after each datagram has been answered, for example to look for a better model.

    Attributes
    ----------
    counts : ClientCounts
        Counts since the start.

    Raises
    ------
    SimulationError
        When the address cannot be resolved.
    """

    def __init__(
        self,
        host: str,
        port: int,
        controller: StandingController,
        between: Callable[[], object] | None = None,
    ) -> None:
        self._where = f"udp {host}:{port}"
        self._controller, self._between = controller, between
        self._hello = encode(Packet(COMMAND, HELLO, 0, np.zeros(len(controller.drive_names))))
        self._last: tuple[int, int] | None = None  # sequence and stamp of the last measurement
        self._command: bytes | None = None
        self.counts = ClientCounts()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # A connected socket receives datagrams from the server only.
            self._socket.connect((host, port))
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise SimulationError(
                f"{self._where}: no such address ({error}); set --host and --port to the "
                "simulator's address",
                "E616",
            ) from error
        self._socket.setblocking(False)

    def __enter__(self) -> "UdpClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def run(self, stop: Event, timeout: float) -> None:
        """Answer measurements until ``stop`` is set.

        Raises
        ------
        SimulationError
            When no datagram arrives for ``timeout`` seconds.
        """
        received_at = time.monotonic()
        hello_due = received_at
        while not stop.is_set():
            now = time.monotonic()
            datagram = self._receive()
            if datagram is not None:
                received_at, hello_due = now, now + HELLO_PERIOD
                self._process(datagram)
                if self._between is not None:
                    self._between()
                continue
            if now - received_at > timeout:
                raise SimulationError(
                    f"{self._where}: no measurement for {timeout:g} s; start the simulator there "
                    "or increase --timeout",
                    "E617",
                )
            if now >= hello_due:
                self._send_hello()
                hello_due = now + HELLO_PERIOD
            select.select([self._socket], [], [], hello_due - now)

    def _send_hello(self) -> None:
        self._last = None
        self.counts.hellos += 1
        self._send(self._hello)

    def _process(self, datagram: bytes) -> None:
        try:
            packet = decode(datagram, MEASUREMENT)
            measurement = decode_measurement(packet, len(self._controller.joint_names))
        except PacketError:
            self.counts.ignored += 1
            return
        number = packet.sequence, packet.stamp
        if number == self._last:
            self.counts.repeated += 1
        elif self._last is not None and is_before(packet.sequence, self._last[0]):
            self.counts.ignored += 1
            return
        else:
            self._last, self._command = number, self._compute_command(packet, measurement)
        if self._command is not None:
            self._send(self._command)

    def _compute_command(self, packet: Packet, measurement: Measurement) -> bytes | None:
        try:
            torques = self._controller.torques(measurement)
        except RobotFailureError:
            # The server brakes the robot when no command arrives, and may restart the motion.
            self.counts.unanswered += 1
            return None
        self.counts.answered += 1
        return encode(Packet(COMMAND, packet.sequence, packet.stamp, torques))

    def _send(self, datagram: bytes) -> None:
        # Fails while no server listens; any other failure is equivalent to a lost datagram.
        with suppress(OSError):
            self._socket.send(datagram)

    def _receive(self) -> bytes | None:
        try:
            return self._socket.recv(MAX_DATAGRAM_BYTES)
        except (BlockingIOError, ConnectionRefusedError):
            return None
