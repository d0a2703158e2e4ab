"""The simulated robot on its topics, between real processes."""

import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
from bag_editing import topic_counts
from graph_probes import RELIABLE, StatusProbe, descriptors, parameter, set_parameters
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from symbid_ros.bags import read_streams
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import rotation_from_xyzw
from symbid_ros.model.tree import RobotModel
from symbid_ros.package_paths import config_file
from symbid_ros.ros import mujoco_bridge
from symbid_ros.signals.streams import Streams
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

MOVES = 1
ALL_TOPICS = (
    "[joint_states, imu/data, left_foot/wrench, right_foot/wrench, /clock, "
    "ground_truth/joints, ground_truth/odom, ground_truth/base_accel]"
)


@pytest.fixture
def recorded(graph, tmp_path: Path) -> tuple[Path, dict, dict]:
    """A bag of the bridge's topics with the output of bridge and recorder."""
    recorder = graph.start("recorder", bag=tmp_path / "live", topics=ALL_TOPICS)
    bridge = graph.start("mujoco_bridge", moves=MOVES, wait_for_subscribers=True, motion_seed=3)
    sent = bridge.ended()
    recorder.send(signal.SIGINT)
    written = recorder.ended()
    assert (sent.status, sent.err) == (0, "")
    assert (written.status, written.err) == (0, "")
    return tmp_path / "live", json.loads(sent.out), json.loads(written.out)


def supporting_force(robot: RobotModel, streams: Streams, part: slice) -> np.ndarray:
    """Return the mean force of the feet in the world frame, computed from the topics.

    Each force is in the axes of its sole; the joint positions rotate it to the base and the IMU's
    orientation to the world.
    """
    (imu,) = streams.imus
    mount = robot.frame(imu.frame_id)
    assert mount.link == 0
    base_in_world = rotation_from_xyzw(imu.orientation[part]) @ mount.rotation.T
    order = [streams.joints.names.index(joint.name) for joint in robot.joints]
    poses = link_poses(robot, streams.joints.position[part][:, order])
    total = np.zeros(3)
    for wrench in streams.wrenches:
        sole = robot.frame(wrench.frame_id)
        sole_in_world = base_in_world @ poses.rotation[:, sole.link] @ sole.rotation
        total += np.einsum("nij,nj->ni", sole_in_world, wrench.force[part]).mean(axis=0)
    return total


def test_the_recorder_gets_all_messages_that_the_bridge_counts(
    recorded: tuple[Path, dict, dict], tmp_path: Path
) -> None:
    bag, sent, written = recorded
    steps = sent["steps"]
    assert steps == Simulator(SimulateOptions("smooth", moves=MOVES, motion_seed=3)).steps
    assert sent["published"]["/joint_states"] == steps
    assert sent["published"]["/ground_truth/odom"] == -(-steps // 10)
    assert written["recorded"] == sent["published"] == topic_counts(bag)
    assert all(gaps["missing"] == 0 for gaps in written["gaps"].values())
    with AnyReader([bag]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections} == sent["published"]

    record(Simulator(SimulateOptions("smooth", moves=MOVES, motion_seed=3)), tmp_path / "direct")
    live, direct = read_streams([bag]), read_streams([tmp_path / "direct"])
    assert live.joints.names == direct.joints.names
    for field in ("stamp", "position", "velocity", "effort"):
        assert np.array_equal(getattr(live.joints, field), getattr(direct.joints, field))
    for field in ("stamp", "orientation", "angular_velocity", "linear_acceleration"):
        assert np.array_equal(getattr(live.imus[0], field), getattr(direct.imus[0], field))
    for over_topics, computed in zip(live.wrenches, direct.wrenches, strict=True):
        assert over_topics.frame_id == computed.frame_id
        assert np.array_equal(over_topics.force, computed.force)
        assert np.array_equal(over_topics.torque, computed.torque)

    robot = load_model(config_file("symbitron.xml"))
    parameters = ParameterSet(robot)
    weight = parameters.link_phi(parameters.values)[:, 0].sum() * np.linalg.norm(robot.gravity)
    force = supporting_force(
        robot, live, slice(0, 400)
    )  # the motion starts with half a second of rest
    np.testing.assert_allclose(force, [0, 0, weight], atol=1e-3 * weight)


def test_robot_with_friction_and_errors_is_the_same_over_topics(graph, tmp_path: Path) -> None:
    topics = "[joint_states, imu/data, left_foot/wrench, right_foot/wrench, suspension/wrench]"
    robot = {"friction": True, "errors": "typical,sample_rates", "error_seed": 3, "moves": 1}
    recorder = graph.start("recorder", bag=tmp_path / "live", topics=topics)
    bridge = graph.start("mujoco_bridge", scenario="tare", wait_for_subscribers=True, **robot)
    sent = bridge.ended()
    recorder.send(signal.SIGINT)
    written = recorder.ended()
    assert (sent.status, sent.err) == (0, "")
    assert (written.status, written.err) == (0, "")

    live = read_streams([tmp_path / "live"])
    simulator = Simulator(
        SimulateOptions("tare", friction=True, errors=robot["errors"], error_seed=3)
    )
    first = [simulator.step() for _ in range(300)]
    plates = live.wrenches[:2]
    for read, field, every in (
        (live.joints.position, "joint_position", 1),
        (live.imus[0].angular_velocity, "imu_angular_velocity", 2),
        (np.hstack([plates[0].force, plates[1].torque]), "wrenches", 3),
    ):
        expected = np.array([getattr(instant, field) for instant in first[::every]])
        if field == "wrenches":
            expected = np.hstack([expected[:, 0, :3], expected[:, 1, 3:]])
        assert len(read) == -(-simulator.steps // every)
        assert np.array_equal(read[: len(expected)], expected)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_bridge_cleanly(graph, number: signal.Signals) -> None:
    stamps: list[int] = []
    graph.node.create_subscription(
        Clock,
        "/clock",
        lambda message: stamps.append(message.clock.sec * 10**9 + message.clock.nanosec),
        100,
    )
    bridge = graph.execute("mujoco_bridge", clock_rate=50.0)
    graph.wait_until(lambda: len(stamps) > 5)
    bridge.send(number)
    ended = bridge.ended()
    assert (ended.status, ended.err) == (0, "")
    summary = json.loads(ended.out)
    assert 0 < summary["steps"] < Simulator(SimulateOptions("smooth")).steps
    assert summary["published"]["/joint_states"] == summary["steps"]
    assert set(np.diff(stamps)) == {20_000_000}


def test_rates_of_zero_publish_nothing(graph) -> None:
    states: list[JointState] = []
    graph.node.create_subscription(JointState, "joint_states", states.append, 100)
    bridge = graph.start("mujoco_bridge", clock_rate=0.0, ground_truth_rate=0.0)
    graph.wait_until(lambda: states)
    topics = {name for name, _ in graph.node.get_topic_names_and_types()}
    bridge.send(signal.SIGTERM)
    published = json.loads(bridge.ended().out)["published"]
    sensors = {"/joint_states", "/imu/data", "/left_foot/wrench", "/right_foot/wrench"}
    assert set(published) == sensors
    assert sensors <= topics
    assert not any(name == "/clock" or "ground_truth" in name for name in topics)


def test_parameters_are_described_and_only_the_payload_can_change(graph) -> None:
    bridge = graph.start("mujoco_bridge", wait_for_subscribers=True)
    statuses = StatusProbe(graph)
    graph.wait_until(lambda: statuses.received)
    names = [parameter.name for parameter in mujoco_bridge.PARAMETERS]
    found = {each.name: each for each in descriptors(graph, "/mujoco_bridge", names)}
    assert all(each.description for each in found.values())
    live = {"payload_link", "payload_mass", "payload_position"}
    assert {name for name, each in found.items() if not each.read_only} == live
    assert "smooth" in found["scenario"].additional_constraints
    assert found["real_time_factor"].floating_point_range[0].to_value == 100.0
    assert found["moves"].integer_range[0].from_value == 1

    refused = set_parameters(
        graph,
        "/mujoco_bridge",
        moves=3,
        payload_mass=-1.0,
        payload_link="tail",
        payload_position=[0.0, 0.0],
    )
    assert not any(each.successful for each in refused)
    for each, says in zip(
        refused, ("read-only", "out of range", "'tail'", "3 numbers"), strict=True
    ):
        assert says in each.reason
        assert "\n" not in each.reason
    assert "R_thigh" in refused[2].reason, "what there is instead"
    for value in ("heavy", 2, float("nan"), 1000.0):
        assert not set_parameters(graph, "/mujoco_bridge", payload_mass=value)[0].successful
    assert parameter(graph, "/mujoco_bridge", "payload_mass").double_value == 0.0
    bridge.send(signal.SIGINT)
    ended = bridge.ended()
    assert (ended.status, ended.err) == (0, "")


def test_a_payload_set_while_moving_loads_the_feet(graph, tmp_path: Path) -> None:
    """At rest at the end, the feet also carry the weight of the payload."""
    clock: list[int] = []
    graph.node.create_subscription(Clock, "/clock", lambda m: clock.append(m.clock.sec), RELIABLE)
    statuses = StatusProbe(graph)
    recorder = graph.start("recorder", bag=tmp_path / "live", topics=ALL_TOPICS)
    bridge = graph.start(
        "mujoco_bridge", moves=1, motion_seed=3, ideal=True, wait_for_subscribers=True
    )
    graph.wait_until(lambda: clock)
    results = set_parameters(
        graph, "/mujoco_bridge", payload_link="R_thigh", payload_position=[0.2, 0.0, 0.0]
    )
    assert all(each.successful for each in results)
    assert set_parameters(graph, "/mujoco_bridge", payload_mass=2.0)[0].successful
    simulation = "/mujoco_bridge: simulation"
    graph.wait_until(lambda: "2 kg on R_thigh" in statuses.value(simulation, "payload"))
    sent = bridge.ended()
    recorder.send(signal.SIGINT)
    assert recorder.ended().status == sent.status == 0
    assert re.search(r"payload from [\d.]+ s on: 2 kg on R_thigh at \(0\.2, 0, 0\) m\n", sent.err)

    record(
        Simulator(SimulateOptions("smooth", moves=1, motion_seed=3, ideal=True)),
        tmp_path / "without",
    )
    robot = load_model(config_file("symbitron.xml"))
    live, without = read_streams([tmp_path / "live"]), read_streams([tmp_path / "without"])
    last = slice(-300, None)
    more = supporting_force(robot, live, last) - supporting_force(robot, without, last)
    np.testing.assert_allclose(more, [0, 0, 2.0 * 9.81], atol=0.02 * 2.0 * 9.81)


def test_a_payload_given_at_the_start_is_attached_at_its_time(graph, tmp_path: Path) -> None:
    topics = "[joint_states, imu/data, left_foot/wrench, right_foot/wrench, suspension/wrench]"
    recorder = graph.start("recorder", bag=tmp_path / "live", topics=topics)
    bridge = graph.start(
        "mujoco_bridge",
        scenario="tare",
        ideal=True,
        payload_mass=3.0,
        payload_time=1.5,
        wait_for_subscribers=True,
    )
    sent = bridge.ended()
    recorder.send(signal.SIGINT)
    assert recorder.ended().status == sent.status == 0
    assert "payload from 1.501 s on: 3 kg on base_link at (0, 0, 0) m" in sent.err
    hook = read_streams([tmp_path / "live"]).wrenches[-1]
    assert hook.frame_id == "suspension"
    pull = np.linalg.norm(hook.force, axis=1)
    before, after = pull[hook.stamp <= 1_500_000_000], pull[-500:]
    np.testing.assert_allclose(before, before[0], rtol=1e-3)
    assert after.mean() - before.mean() == pytest.approx(3.0 * 9.81, rel=0.01)


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        (
            {"scenario": "dance"},
            "parameter scenario: 'dance' is not valid; give one of smooth, wide, squat, v",
        ),
        ({"moves": 0}, "parameter moves: not a valid value; give an integer at least 1"),
        ({"moves": "many"}, "parameter moves: not a valid value; give an integer at least 1"),
        ({"real_time_factor": 0.0}, "parameter real_time_factor: not a valid value; give a number"),
        ({"clock_rate": 300.0}, "parameter clock_rate: 300 Hz does not divide the simulation rate"),
        ({"ground_truth_rate": 4000.0}, "parameter ground_truth_rate: 4000 Hz does not divide"),
        ({"model": "/nowhere.xml"}, "/nowhere.xml"),
        ({"payload_link": "tail"}, "no link 'tail' for a payload; name one of base_link, "),
        ({"payload_position": "[0.0, 3.0, 0.0]"}, "parameter payload_position: [0.0, 3.0, 0.0]"),
        (
            {"command_source": "udp", "udp_host": "192.0.2.1"},
            "udp 192.0.2.1:5005: cannot listen",
        ),
        ({"errors": "rust"}, "no systematic error 'rust'; give typical or any of wrench_gain, "),
        ({"friction_file": "/nowhere.yaml"}, "/nowhere.yaml: cannot be read"),
    ],
)
def test_bad_parameters_end_with_one_line(graph, parameters: dict, line: str) -> None:
    ended = graph.start("mujoco_bridge", **parameters).ended()
    assert ended.status == 2
    assert ended.err.startswith(f"mujoco_bridge: {line}")
    assert ended.err.count("\n") == 1
    assert ended.out == ""
