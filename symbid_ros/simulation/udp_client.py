"""The controller's end of the UDP loop: measurements in, torques out."""

import select
import socket
import time
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
    Measurement,
    Packet,
    PacketError,
    decode,
    encode,
    is_before,
    measurement,
)
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.standing_controller import StandingController

HELLO_PERIOD = 0.1  # s of silence after which the client says hello, again and again


@dataclass
class ClientCounts:
    """What the client has done.

    Attributes
    ----------
    answered : int
        Measurements, each counted once.
    repeated : int
        Answers given once more to a measurement that came once more.
    hellos : int
        Sent.
    passed_over : int
        Datagrams that are no measurement of this robot, or older than the last.
    unanswered : int
        Measurements to which the controller had no torques.
    """

    answered: int = 0
    repeated: int = 0
    hellos: int = 0
    passed_over: int = 0
    unanswered: int = 0


class UdpClient:
    """Answers a plant's measurements with the torques of a controller.

    It says hello until the plant sends measurements, and again whenever it has been silent for
    `HELLO_PERIOD`; the measurement after that may have any number, as another plant may be
    there. A measurement that comes again, because it or its answer was lost, gets the same
    answer again; the controller is asked once.

    Parameters
    ----------
    host : str
        Where the plant listens.
    port : int
        Its UDP port.
    controller : StandingController
        Who answers.

    Attributes
    ----------
    counts : ClientCounts
        What it has done so far.

    Raises
    ------
    SimulationError
        When the host has no such address.
    """

    def __init__(self, host: str, port: int, controller: StandingController) -> None:
        self._where = f"udp {host}:{port}"
        self._controller = controller
        self._hello = encode(Packet(COMMAND, HELLO, 0, np.zeros(len(controller.drive_names))))
        self._last: tuple[int, int] | None = None  # number and stamp of the last measurement
        self._answer: bytes | None = None
        self.counts = ClientCounts()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # Connected, it hears nobody but the plant.
            self._socket.connect((host, port))
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise SimulationError(
                f"{self._where}: no such address ({error}); name where the plant listens"
            ) from error
        self._socket.setblocking(False)

    def __enter__(self) -> "UdpClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def run(self, stop: Event, timeout: float) -> None:
        """Answer measurements until stopped.

        Raises
        ------
        SimulationError
            When nothing comes from the plant for ``timeout`` seconds.
        """
        heard = time.monotonic()
        due = heard
        while not stop.is_set():
            now = time.monotonic()
            datagram = self._receive()
            if datagram is not None:
                heard, due = now, now + HELLO_PERIOD
                self._take(datagram)
                continue
            if now - heard > timeout:
                raise SimulationError(
                    f"{self._where}: no measurement for {timeout:g} s; "
                    "start the plant there, or give --timeout more"
                )
            if now >= due:
                self._say_hello()
                due = now + HELLO_PERIOD
            select.select([self._socket], [], [], due - now)

    def _say_hello(self) -> None:
        self._last = None
        self.counts.hellos += 1
        self._send(self._hello)

    def _take(self, datagram: bytes) -> None:
        try:
            packet = decode(datagram, MEASUREMENT)
            readings = measurement(packet, len(self._controller.joint_names))
        except PacketError:
            self.counts.passed_over += 1
            return
        number = packet.sequence, packet.stamp
        if number == self._last:
            self.counts.repeated += 1
        elif self._last is not None and is_before(packet.sequence, self._last[0]):
            self.counts.passed_over += 1
            return
        else:
            self._last, self._answer = number, self._answered(packet, readings)
        if self._answer is not None:
            self._send(self._answer)

    def _answered(self, packet: Packet, readings: Measurement) -> bytes | None:
        try:
            torques = self._controller.torques(readings)
        except RobotFailureError:
            # The plant knows what to do without an answer, and may well start again.
            self.counts.unanswered += 1
            return None
        self.counts.answered += 1
        return encode(Packet(COMMAND, packet.sequence, packet.stamp, torques))

    def _send(self, datagram: bytes) -> None:
        # Refused where no plant listens yet; otherwise as good as lost on its way.
        with suppress(OSError):
            self._socket.send(datagram)

    def _receive(self) -> bytes | None:
        try:
            return self._socket.recv(MAX_DATAGRAM_BYTES)
        except (BlockingIOError, ConnectionRefusedError):
            return None
