"""``symbid udp-client`` as a user runs it; test/simulation tests the protocol."""

import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from udp_packets import DRIVES, command


def test_an_interrupted_client_prints_a_summary():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant:
        plant.bind(("127.0.0.1", 0))
        plant.settimeout(300.0)
        port = plant.getsockname()[1]
        with subprocess.Popen(
            [Path(sys.executable).parent / "symbid", "udp-client", "--port", str(port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as client:
            datagram, address = plant.recvfrom(65507)
            assert datagram == command(0, 0, [0.0] * DRIVES)
            plant.sendto(b"no measurement", address)
            plant.recvfrom(65507)  # says hello again
            client.send_signal(signal.SIGINT)
            said, errors = client.communicate(timeout=300)
    waits = f"waiting for measurements of a simulator at 127.0.0.1:{port}\n"
    assert (client.returncode, errors) == (0, waits)
    assert said.startswith(f"127.0.0.1:{port}: answered 0 measurements")
    assert "1 datagrams ignored" in said


def test_a_silent_simulator_ends_the_client(symbid_here):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        port = silent.getsockname()[1]
        done = symbid_here("udp-client", "--port", port, "--timeout", 0.2)
    assert done.returncode == 2
    assert done.stderr == (
        f"waiting for measurements of a simulator at 127.0.0.1:{port}\n"
        f"symbid: udp 127.0.0.1:{port}: no measurement for 0.2 s; "
        "start the simulator there or increase --timeout (SYMBID-E617)\n"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--port", 70000), "--port"),
        (("--scenario", "tare"), "'tare' is not one of"),
        (("--host", "no.such.host.invalid"), "no such address"),
        (("--model", "absent.xml"), "absent.xml"),
        (("--motion-seed", -1), "--motion-seed"),
    ],
)
def test_bad_options_end_with_one_line(symbid_here, options, message):
    done = symbid_here("udp-client", *options)
    assert done.returncode == 2
    assert done.stderr.startswith("symbid: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_help_names_its_options(symbid_here):
    shown = symbid_here("udp-client", "--help")
    assert shown.returncode == 0
    for option in ("--host", "--port", "--moves", "--motion-seed", "--model", "--timeout"):
        assert option in shown.stdout
