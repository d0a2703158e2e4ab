"""A relay between two local sockets that drops, duplicates and reorders datagrams."""

import random
import select
import socket
import threading
from types import TracebackType


class LossyRelay:
    """Relays datagrams to ``target`` and back with random faults in both directions.

    A fraction ``share`` of all datagrams is dropped, another one is duplicated, and a third one is
    held back until the next datagram has passed.
    """

    def __init__(self, target: tuple[str, int], *, share: float = 0.05, seed: int = 0) -> None:
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.connect(target)
        self._wake, self._stop = socket.socketpair()
        self._share, self._random = share, random.Random(seed)
        self._client: tuple[str, int] | None = None
        self._held: dict[socket.socket, bytes] = {}
        self.faults = {"dropped": 0, "doubled": 0, "swapped": 0}
        self._thread = threading.Thread(target=self._run)

    @property
    def port(self) -> int:
        return int(self._near.getsockname()[1])

    def __enter__(self) -> "LossyRelay":
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stop.send(b"x")
        self._thread.join()
        for end in (self._near, self._far, self._wake, self._stop):
            end.close()

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._near, self._far, self._wake], [], [])
            if self._wake in ready:
                return
            if self._near in ready:
                datagram, self._client = self._near.recvfrom(65507)
                self._pass_on(self._far, datagram)
            if self._far in ready:
                try:
                    # What made it ready may have been an error that sending has met since.
                    answer = self._far.recv(65507, socket.MSG_DONTWAIT)
                except (ConnectionRefusedError, BlockingIOError):
                    continue  # the target does not listen yet, or any more
                self._pass_on(self._near, answer)

    def _pass_on(self, to: socket.socket, datagram: bytes) -> None:
        lot = self._random.random()
        if lot < self._share:
            self.faults["dropped"] += 1
            return
        if lot < 2 * self._share:
            self.faults["doubled"] += 1
            self._send(to, datagram)
        elif lot < 3 * self._share and to not in self._held:
            self.faults["swapped"] += 1
            self._held[to] = datagram
            return
        self._send(to, datagram)
        if to in self._held:
            self._send(to, self._held.pop(to))

    def _send(self, to: socket.socket, datagram: bytes) -> None:
        try:
            if to is self._far:
                to.send(datagram)
            elif self._client is not None:
                to.sendto(datagram, self._client)
        except ConnectionRefusedError:
            return
