"""The bridge commanded by datagrams, among processes and over a bad network.

test/simulation has the loop for itself, and lets it stand for longer.
"""

import json
import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from graph_probes import RELIABLE, StatusProbe
from lossy_relay import LossyRelay
from nav_msgs.msg import Odometry
from udp_packets import DRIVES, command, hello, measurement, sequence_and_stamp

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.learning.model_file import read_model
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file

COMMANDS, SIMULATION = "/mujoco_bridge: commands", "/mujoco_bridge: simulation"
SECONDS = 4
DEADLINE = 300.0  # s; only a hang takes longer
# On a busy machine a process may wait longer than the default timeout.
PATIENT = {
    "command_source": "udp",
    "udp_port": 0,
    "command_timeout": 60.0,
    "real_time_factor": 100.0,
}

Client = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def client() -> Iterator[Client]:
    """Start ``symbid udp-client`` on a port and end it with the test."""
    started: list[subprocess.Popen[str]] = []

    def start(port: int, *options: str) -> "subprocess.Popen[str]":
        words = ["udp-client", "--port", str(port), "--timeout", "300", *options]
        started.append(
            subprocess.Popen(
                [Path(sys.executable).parent / "symbid", *words],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def listening(graph, statuses: StatusProbe) -> int:
    """Wait until the bridge listens and return its port."""
    graph.wait_until(lambda: statuses.value(COMMANDS, "source"))
    return int(statuses.value(COMMANDS, "source").rpartition(":")[2])


def test_balance_survives_a_network_that_loses_duplicates_and_reorders(
    graph, client: Client
) -> None:
    heights: list[float] = []
    statuses = StatusProbe(graph)
    graph.node.create_subscription(
        Odometry,
        "ground_truth/odom",
        lambda message: heights.append(message.pose.pose.position.z),
        RELIABLE,
    )
    bridge = graph.start("mujoco_bridge", clock_rate=0.0, ground_truth_rate=5.0, **PATIENT)
    with LossyRelay(("127.0.0.1", listening(graph, statuses)), share=0.05, seed=1) as relay:
        balancer = client(relay.port)
        for second in range(1, SECONDS + 1):  # on a slow machine each second has its own deadline
            graph.wait_until(lambda s=second: float(statuses.value(SIMULATION, "time")) > s)
        balancer.send_signal(signal.SIGINT)
        assert balancer.wait(DEADLINE) == 0
        bridge.send(signal.SIGINT)
    ended = bridge.ended()
    assert ended.status == 0
    assert "Traceback" not in ended.err
    commands = json.loads(ended.out)["commands"]
    assert commands["falls"] == 0
    assert commands["accepted"] >= 1000 * SECONDS
    assert all(count > 100 for count in relay.faults.values())
    assert commands["rejected/duplicate"] > 100
    assert max(heights) - min(heights) < 0.1


def test_another_client_takes_over_after_a_kill(graph, client: Client) -> None:
    statuses = StatusProbe(graph)
    bridge = graph.start("mujoco_bridge", **PATIENT | {"command_timeout": 1.0})
    port = listening(graph, statuses)
    first = client(port)
    graph.wait_until(lambda: statuses.count(COMMANDS, "accepted") > 100)
    first.kill()
    graph.wait_until(lambda: statuses.count(SIMULATION, "falls") == 1)
    graph.wait_until(lambda: statuses.message(COMMANDS) == "waiting for a controller")
    assert statuses.count(COMMANDS, "safe_steps") > 10
    accepted = statuses.count(COMMANDS, "accepted")
    second = client(port)
    graph.wait_until(lambda: statuses.count(COMMANDS, "accepted") > accepted + 100)
    assert statuses.message(COMMANDS) == "commands are obeyed"
    second.terminate()
    bridge.send(signal.SIGTERM)
    assert second.wait(DEADLINE) == 0
    assert bridge.ended().status == 0


def test_a_client_takes_models_from_an_identifier(graph, client: Client, tmp_path) -> None:
    """A client whose file is wrong by up to 25 % stands, also after its identifier has died."""
    statuses = StatusProbe(graph)
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    wrong = parameters.apply(draw_prior(parameters, "percent", 25.0, 2).mean)
    model, source = tmp_path / "wrong.xml", tmp_path / "live.json"
    model.write_text(mjcf_text(wrong, config_file("symbitron.xml")))
    source.write_text("{}")  # a file that the identifier must not replace
    refused = graph.start("identifier", model=str(model), live_model=str(source))
    assert "live.json: not the file of an identifier" in refused.ended().err
    source.unlink()
    bridge = graph.start("mujoco_bridge", **PATIENT | {"real_time_factor": 1.0})
    identifier = graph.start("identifier", model=str(model), live_model=str(source))
    words = ("--model", str(model), "--model-source", str(source))
    balancer = client(listening(graph, statuses), *words)
    assert balancer.stderr is not None
    graph.wait_until(lambda: select.select([balancer.stderr], [], [], 0.0)[0])
    assert balancer.stderr.readline().startswith("waiting for measurements")
    # The first estimates of a busy machine may be from too few data.
    line = balancer.stderr.readline()
    while line.startswith("the identified model is not used: "):
        line = balancer.stderr.readline()
    assert line.startswith("model identified until ")
    identifier.kill()  # the robot stands on with the last model
    time = float(statuses.value(SIMULATION, "time"))
    graph.wait_until(lambda: float(statuses.value(SIMULATION, "time")) > time + 1.5)
    balancer.send_signal(signal.SIGINT)
    summary = balancer.communicate(timeout=DEADLINE)[0]
    assert re.search(r"models: [1-9] accepted, \d+ refused, \d+ withdrawn", summary)
    bridge.send(signal.SIGINT)
    assert json.loads(bridge.ended().out)["commands"]["falls"] == 0
    found, _ = read_model(source)
    assert found.mass_std is not None
    truth = parameters.model.phi[:, 0].sum()
    assert abs(found.phi[:, 0].sum() - truth) < 5 * found.mass_std


def test_bad_datagrams_are_reported_and_ignored(graph) -> None:
    statuses = StatusProbe(graph)
    bridge = graph.start("mujoco_bridge", **PATIENT)
    to = ("127.0.0.1", listening(graph, statuses))
    still = [0.0] * DRIVES
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as controller,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        controller.settimeout(DEADLINE)
        controller.sendto(b"", to)
        controller.sendto(hello()[:-1], to)
        controller.sendto(hello(), to)
        datagram = controller.recv(65507)
        sequence, stamp = sequence_and_stamp(datagram)
        for bad in (
            command(sequence, stamp, still, magic=7),
            command(sequence, stamp, still, version=9),
            command(sequence, stamp, [*still, 0.0]),
            command(sequence, stamp, [float("nan"), *still[1:]]),
            command(sequence, stamp, [1e6, *still[1:]]),
            command(sequence + 1, stamp, still),
            command(sequence, stamp + 1, still),
        ):
            controller.sendto(bad, to)
        stranger.sendto(command(sequence, stamp, still), to)
        expected = {
            "length": 3,
            "magic": 1,
            "version": 1,
            "not_finite": 1,
            "beyond_limit": 1,
            "future": 1,
            "stamp": 1,
            "stranger": 1,
        }
        graph.wait_until(
            lambda: all(
                statuses.count(COMMANDS, f"rejected/{reason}") == number
                for reason, number in expected.items()
            )
        )
        assert statuses.count(COMMANDS, "accepted") == 0
        assert statuses.value(SIMULATION, "time") == "0.001", "the robot waits where it stood"
        controller.sendto(command(sequence, stamp, still), to)
        while sequence_and_stamp(datagram)[1] == stamp:
            datagram = controller.recv(65507)
        assert sequence_and_stamp(datagram) == (sequence + 1, stamp + 1_000_000)
        # With zero torque, the measured efforts are sensor noise.
        assert max(map(abs, measurement(datagram)["joint_effort"])) < 1.0
    bridge.send(signal.SIGINT)
    assert bridge.ended().status == 0
