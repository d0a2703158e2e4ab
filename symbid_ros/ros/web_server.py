"""A page on this machine that is updated by server-sent events and offers buttons.

Anyone who can reach the page could save and reset, and other web sites that the user visits can
send requests to 127.0.0.1. Therefore every request needs the token of the page's address, the
name of this machine in ``Host`` (against DNS rebinding), and no foreign ``Origin``.
"""

import json
import secrets
import socket
import sys
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from queue import Empty, Full, Queue
from threading import Lock, Thread
from urllib.parse import parse_qs, urlencode, urlsplit

from symbid_ros.errors import SymbidError

LOOPBACK = "127.0.0.1"
WILDCARDS = "", "0.0.0.0"  # all addresses of the machine
TOKEN_HEADER = "X-Symbid-Token"
MOST_LISTENERS = 16
# Events that wait for a slow browser; when they are full, it is disconnected and connects anew.
BACKLOG = 200
HEARTBEAT = 10.0  # s without an event until a comment shows that the connection lives
TIMEOUT = 30.0  # s for a request

Answer = tuple[bool, str]


class WebServer:
    """Serves one page, its events and its actions in threads of its own.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int
        Port; 0 takes any that is free.
    page : callable
        Returns the HTML for a nonce, which its scripts must have.
    greeting : callable
        Returns the events, by name, that bring a new listener up to date.
    actions : mapping of str to callable
        What a POST to ``/<name>`` does. It returns success and a message.

    Raises
    ------
    SymbidError
        When the address does not exist or is in use.
    """

    def __init__(
        self,
        host: str,
        port: int,
        page: Callable[[str], str],
        greeting: Callable[[], Mapping[str, object]],
        actions: Mapping[str, Callable[[], Answer]],
    ) -> None:
        self.token = secrets.token_urlsafe(18)
        self.page, self.greeting, self.actions = page, greeting, actions
        self.is_closed = False
        self._listeners: set[Queue[bytes]] = set()
        self._lock = Lock()
        try:
            self._server = _Server((host, port), _handler_of(self))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SymbidError(
                f"web page at {host}:{port}: {reason}; choose another `host` or `port`", "E885"
            ) from None
        self.host, self.port = host, int(self._server.server_address[1])
        self._thread = Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """The address to open, with its token."""
        name = LOOPBACK if self.host in WILDCARDS else self.host
        return f"http://{name}:{self.port}/?{urlencode({'token': self.token})}"

    def is_own_name(self, host: str) -> bool:
        """Return whether a ``Host`` header means this server.

        If it listens on all addresses, so does every address: only a name can be rebound.
        """
        name, _, port = host.rpartition(":")
        if port != str(self.port):
            return False
        if name in (self.host, LOOPBACK, "localhost"):
            return True
        return self.host in WILDCARDS and (name == socket.gethostname() or _is_address(name))

    def publish(self, event: str, document: object) -> None:
        """Send an event to all listeners."""
        message = encoded(event, document)
        with self._lock:
            for listener in tuple(self._listeners):
                try:
                    listener.put_nowait(message)
                except Full:
                    self._listeners.discard(listener)

    def listen(self) -> "Queue[bytes] | None":
        """Return a new listener's queue, greeted; None if there are too many."""
        queue: Queue[bytes] = Queue(BACKLOG)
        with self._lock:
            if len(self._listeners) >= MOST_LISTENERS:
                return None
            for event, document in self.greeting().items():
                queue.put_nowait(encoded(event, document))
            self._listeners.add(queue)
        return queue

    def is_listening(self, queue: "Queue[bytes]") -> bool:
        """Return whether a listener still gets events."""
        with self._lock:
            return queue in self._listeners and not self.is_closed

    def leave(self, queue: "Queue[bytes]") -> None:
        """Forget a listener."""
        with self._lock:
            self._listeners.discard(queue)

    @property
    def listeners(self) -> int:
        """Number of open pages."""
        with self._lock:
            return len(self._listeners)

    def close(self) -> None:
        """End all connections."""
        self.is_closed = True
        self._server.shutdown()
        self._server.server_close()


def encoded(event: str, document: object) -> bytes:
    """Return a server-sent event (HTML Standard, 9.2.6)."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    return f"event: {event}\ndata: {text}\n\n".encode()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore connections that browsers close; report anything else as usual."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


def _handler_of(owner: WebServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        server_version, sys_version = "symbid", ""
        timeout = TIMEOUT

        def do_GET(self) -> None:
            address = urlsplit(self.path)
            given = parse_qs(address.query).get("token", [""])[0]
            if self._refuses(given):
                return
            if address.path == "/":
                self._send_page()
            elif address.path == "/events":
                self._send_events()
            else:
                self._answer(HTTPStatus.NOT_FOUND, "no such page")

        def do_POST(self) -> None:
            # A body is not expected; reading none of it requires to close the connection.
            self.close_connection = True
            if self._refuses(self.headers.get(TOKEN_HEADER, "")):
                return
            action = owner.actions.get(urlsplit(self.path).path.removeprefix("/"))
            if action is None:
                self._answer(HTTPStatus.NOT_FOUND, "no such action")
                return
            success, message = action()
            self._answer(HTTPStatus.OK, message, success=success)

        def _refuses(self, given: str) -> bool:
            """Answer a request that may come from another site; return whether it did."""
            host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
            is_own = owner.is_own_name(host) and origin in (None, f"http://{host}")
            # A comparison in constant time accepts only bytes for texts beyond ASCII.
            if is_own and secrets.compare_digest(given.encode(), owner.token.encode()):
                return False
            self._answer(HTTPStatus.FORBIDDEN, "open the address that the command printed")
            return True

        def _send_page(self) -> None:
            nonce = secrets.token_urlsafe(12)
            body = owner.page(nonce).encode()
            policy = (
                f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'unsafe-inline'; "
                "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; "
                "frame-ancestors 'none'"
            )
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Security-Policy", policy)
            self._end_headers(len(body))
            self.wfile.write(body)

        def _send_events(self) -> None:
            queue = owner.listen()
            if queue is None:
                self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open")
                return
            self.close_connection = True
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/event-stream")
            self._end_headers(None)
            try:
                while owner.is_listening(queue):
                    try:
                        message = queue.get(timeout=HEARTBEAT)
                    except Empty:
                        message = b":\n\n"
                    self.wfile.write(message)
                    self.wfile.flush()
            finally:
                owner.leave(queue)

        def _answer(self, status: HTTPStatus, message: str, *, success: bool = False) -> None:
            body = json.dumps({"success": success, "message": message}).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self._end_headers(len(body))
            self.wfile.write(body)

        def _end_headers(self, length: int | None) -> None:
            if length is not None:
                self.send_header("Content-Length", str(length))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            """Keep requests, which contain the token, out of the log."""

    return Handler


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
