"""The loop over real topics: bridge → recorder → identifier, and the command on the same bag."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from symbid_ros.bags.reader import topic_counts
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.share import config_file
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

SENSORS = "[joint_states, imu/data, left_foot/wrench, right_foot/wrench]"
LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


def recorded(graph, bag: Path) -> Path:
    """Let bridge and recorder make a bag of the sensor topics alone."""
    recorder = graph.start("recorder", bag=bag, topics=SENSORS)
    bridge = graph.start("mujoco_bridge", moves=1, motion_seed=7, wait_for_subscribers=True)
    played = json.loads(bridge.ended().out)
    recorder.send(signal.SIGINT)
    assert recorder.ended().status == 0
    counts = topic_counts(bag)
    assert len(counts) == 4
    assert counts == {topic: played["published"][topic] for topic in counts}
    return bag


def test_the_loop_over_topics_gives_what_the_command_gives(graph, tmp_path: Path) -> None:
    bag = recorded(graph, tmp_path / "bag")
    record(Simulator("smooth", moves=1, motion_seed=8, ideal=True), tmp_path / "validation")
    model = config_file("symbitron.xml")
    parameters = ParameterSet(load_model(model))
    draw_prior(parameters, "percent", 25, 4).write(tmp_path / "prior.json")
    given = {
        "model": model,
        "prior": tmp_path / "prior.json",
        "validate": tmp_path / "validation",
        "method": "wls_rc",
    }

    heard: dict[str, object] = {}
    links = [link.name for link in parameters.model.links]
    topics = {
        "estimate": DiagnosticArray,
        "effort_residual": JointState,
        "wrench_residual": WrenchStamped,
        "robot_description": String,
        **{f"inertia/{link}": InertiaStamped for link in links},
        **{f"inertia_stddev/{link}": InertiaStamped for link in links},
    }
    identifier = graph.start("identifier", bag=f"['{bag}']", out=tmp_path / "node", **given)
    for topic, kind in topics.items():
        graph.node.create_subscription(
            kind,
            f"/identifier/{topic}",
            lambda message, topic=topic: heard.__setitem__(topic, message),
            LATCHED,
        )
    graph.wait_until(lambda: len(heard) == len(topics))
    identifier.send(signal.SIGINT)
    assert identifier.ended().status == 0

    options = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    subprocess.run(
        [
            Path(sys.executable).parent / "symbid",
            *("identify", bag, *options, "--out", tmp_path / "command"),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    node, command = (
        json.loads((tmp_path / name / "estimate.json").read_text()) for name in ("node", "command")
    )
    assert node == command
    for name in ("model.urdf", "model.xml"):
        text = (tmp_path / "node" / name).read_text()
        assert text == (tmp_path / "command" / name).read_text()
    assert heard["robot_description"].data == (tmp_path / "node" / "model.urdf").read_text()

    told = {
        f"{status.name}/{entry.key}": float(entry.value)
        for status in heard["estimate"].status
        for entry in status.values
    }
    for name, entry in command["parameters"].items():
        assert told[name] == entry["value"]
        assert told[f"{name}/std"] == entry["std"]
    values = {name: entry["value"] for name, entry in command["parameters"].items()}
    for link in links:
        inertia = heard[f"inertia/{link}"].inertia
        assert inertia.m == values[f"{link}/m"]
        moment = [values[f"{link}/mc_{axis}"] for axis in "xyz"]
        com = np.array([inertia.com.x, inertia.com.y, inertia.com.z])
        np.testing.assert_allclose(com * inertia.m, moment, rtol=1e-12)
        # Steiner: about the link's origin again.
        at_origin = inertia.izz + inertia.m * (com[0] ** 2 + com[1] ** 2)
        assert at_origin == pytest.approx(values[f"{link}/Izz"], rel=1e-9, abs=1e-12)
    residual = command["residual_rmse"]
    efforts = dict(zip(heard["effort_residual"].name, heard["effort_residual"].effort, strict=True))
    assert efforts == {name: residual[name] for name in efforts}
    assert heard["wrench_residual"].wrench.force.z == residual["base/force_z"]
