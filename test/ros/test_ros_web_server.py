"""The server of a live page: who may open it, its events and its actions."""

import http.client
import json
import socket
from collections.abc import Iterator

import pytest

from symbid_ros.errors import SymbidError
from symbid_ros.ros import web_server
from symbid_ros.ros.web_server import LOOPBACK, TOKEN_HEADER, WebServer


@pytest.fixture
def calls() -> list[str]:
    return []


@pytest.fixture
def server(calls) -> Iterator[WebServer]:
    def save() -> tuple[bool, str]:
        calls.append("save")
        return True, "written"

    server = WebServer(
        LOOPBACK,
        0,
        lambda nonce: f"<script nonce={nonce}></script>",
        lambda: {"history": [1, 2]},
        {"save": save},
    )
    yield server
    server.close()


def request(
    server: WebServer, method: str, path: str, headers: dict[str, str] | None = None
) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=60)
    connection.request(method, path, headers=headers or {})
    return connection.getresponse()


def test_the_address_opens_the_page(server) -> None:
    assert server.address == f"http://127.0.0.1:{server.port}/?token={server.token}"
    answer = request(server, "GET", f"/?token={server.token}")
    assert answer.status == 200
    policy = answer.getheader("Content-Security-Policy")
    body = answer.read().decode()
    nonce = body.partition("nonce=")[2].partition(">")[0]
    assert f"script-src 'nonce-{nonce}'" in policy
    assert "default-src 'none'" in policy
    assert answer.getheader("Referrer-Policy") == "no-referrer"
    again = request(server, "GET", f"/?token={server.token}").read().decode()
    assert nonce not in again


@pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/events", "/events?token=é"])
def test_nobody_reads_without_the_token(server, path) -> None:
    answer = request(server, "GET", path.replace("é", "%C3%A9"))
    assert answer.status == 403
    assert server.token not in answer.read().decode()


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", ""])
def test_other_names_of_this_machine_are_refused(server, host) -> None:
    # As after DNS rebinding.
    answer = request(server, "GET", f"/?token={server.token}", {"Host": host})
    assert answer.status == 403


def test_on_all_addresses_only_foreign_names_are_refused() -> None:
    server = WebServer("0.0.0.0", 0, str, dict, {})
    try:
        assert server.address.startswith(f"http://127.0.0.1:{server.port}/")
        for host, allowed in (
            ("192.168.1.5", True),
            ("localhost", True),
            (socket.gethostname(), True),
            ("evil.example", False),
        ):
            assert server.is_own_name(f"{host}:{server.port}") is allowed
            assert not server.is_own_name(f"{host}:{server.port + 1}")
    finally:
        server.close()


def test_actions_need_token_and_own_origin(server, calls) -> None:
    own = {TOKEN_HEADER: server.token, "Origin": f"http://127.0.0.1:{server.port}"}
    for headers in (
        {},
        own | {TOKEN_HEADER: "wrong"},
        own | {"Origin": "http://evil.example"},
        own | {"Origin": "null"},
        own | {"Host": "evil.example"},
    ):
        assert request(server, "POST", "/save", headers).status == 403
    # The address's own token is not enough: links and forms cannot set a header.
    assert request(server, "POST", f"/save?token={server.token}").status == 403
    assert calls == []
    answer = request(server, "POST", "/save", own)
    assert json.loads(answer.read()) == {"success": True, "message": "written"}
    assert calls == ["save"]
    assert request(server, "POST", "/shutdown", own).status == 404


def test_events_begin_with_a_greeting(server) -> None:
    answer = request(server, "GET", f"/events?token={server.token}")
    assert answer.getheader("Content-Type") == "text/event-stream"

    def event() -> tuple[str, object]:
        name = answer.readline().decode().strip().partition(": ")[2]
        data = json.loads(answer.readline().decode().partition(": ")[2])
        assert answer.readline() == b"\n"
        return name, data

    assert event() == ("history", [1, 2])
    assert server.listeners == 1
    server.publish("estimate", {"mass": 3.5})
    assert event() == ("estimate", {"mass": 3.5})


def test_too_many_pages_are_refused(server, monkeypatch) -> None:
    monkeypatch.setattr(web_server, "MOST_LISTENERS", 1)
    first = request(server, "GET", f"/events?token={server.token}")
    assert first.status == 200
    assert request(server, "GET", f"/events?token={server.token}").status == 503


def test_a_slow_page_is_disconnected(server, monkeypatch) -> None:
    monkeypatch.setattr(web_server, "BACKLOG", 3)
    queue = server.listen()
    for number in range(5):
        server.publish("estimate", number)
    assert not server.is_listening(queue)
    assert server.listeners == 0


def test_a_port_in_use_is_named() -> None:
    with socket.create_server((LOOPBACK, 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(
            SymbidError,
            match=f"127.0.0.1:{port}: Address already in use; choose another `host` or `port`",
        ) as raised:
            WebServer(LOOPBACK, port, str, dict, {})
    assert raised.value.code == "E885"


def test_it_listens_on_loopback_alone(server) -> None:
    assert server._server.server_address[0] == LOOPBACK
