"""The recorder among publishers of every kind."""

import json
import signal
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from std_msgs.msg import String

RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


def joint_state(milliseconds: int) -> JointState:
    message = JointState(name=["knee"], position=[float(milliseconds)])
    message.header.stamp.sec, rest = divmod(milliseconds, 1000)
    message.header.stamp.nanosec = rest * 1_000_000
    return message


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_bag(graph, tmp_path: Path, number: signal.Signals) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="[joint_states]")
    graph.wait_until(publisher.get_subscription_count)
    sent = [joint_state(n) for n in range(500)]
    for message in sent:
        publisher.publish(message)
    assert publisher.wait_for_all_acked()
    recorder.send(number)
    ended = recorder.ended()
    assert (ended.status, ended.err) == (0, "")
    summary = json.loads(ended.out)
    assert summary["recorded"] == {"/joint_states": 500}
    assert summary["gaps"]["/joint_states"]["missing"] == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert [message.position[0] for message in read] == list(range(500))
    assert (tmp_path / "bag" / "metadata.yaml").is_file()


def test_gaps_are_counted_and_silence_ends_the_recording(graph, tmp_path: Path) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    recorder = graph.start(
        "recorder", bag=tmp_path / "bag", topics="[joint_states]", stop_when_silent=2.0
    )
    graph.wait_until(publisher.get_subscription_count)
    for n in [*range(40), *range(43, 80), *range(81, 100)]:
        publisher.publish(joint_state(n))
    ended = recorder.ended()
    assert ended.status == 0
    gaps = json.loads(ended.out)["gaps"]["/joint_states"]
    assert (gaps["gaps"], gaps["missing"], gaps["longest"]) == (2, 4, 4_000_000)


def test_every_quality_of_service_is_met_and_written_down(graph, tmp_path: Path) -> None:
    best_effort = graph.node.create_publisher(JointState, "fast", BEST_EFFORT)
    latched = graph.node.create_publisher(String, "robot/description", LATCHED)
    latched.publish(String(data="<robot/>"))
    recorder = graph.start(
        "recorder",
        bag=tmp_path / "bag",
        topics="[/fast, robot/description, absent]",
        stop_when_silent=1.0,
    )
    graph.wait_until(best_effort.get_subscription_count)
    best_effort.publish(joint_state(1))
    ended = recorder.ended()
    assert ended.status == 0
    assert ended.err == "recorder: /absent: never published\n"
    assert json.loads(ended.out)["recorded"]["/robot/description"] == 1
    (file,) = (tmp_path / "bag").glob("*.mcap")
    with file.open("rb") as stream:
        channels = make_reader(stream).get_summary().channels.values()
    qos = {channel.topic: channel.metadata["offered_qos_profiles"] for channel in channels}
    assert "reliability: best_effort" in qos["/fast"]
    assert "durability: transient_local" in qos["/robot/description"]


def test_relative_topics_follow_the_namespace(graph, tmp_path: Path) -> None:
    publisher = graph.node.create_publisher(JointState, "/robot/joint_states", RELIABLE)
    recorder = graph.start(
        "recorder",
        namespace="/robot",
        bag=tmp_path / "bag",
        topics="[joint_states]",
        stop_when_silent=0.5,
    )
    graph.wait_until(publisher.get_subscription_count)
    publisher.publish(joint_state(1))
    assert json.loads(recorder.ended().out)["recorded"] == {"/robot/joint_states": 1}


def test_nothing_received_is_an_error_and_leaves_nothing(graph, tmp_path: Path) -> None:
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="[joint_states]")
    graph.wait_for_node("recorder")
    recorder.send(signal.SIGINT)
    ended = recorder.ended()
    assert ended.status == 2
    assert "no message received, nothing recorded" in ended.err
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"queue_depth": 0}, "recorder: parameter queue_depth: not a valid value; give an integer"),
        ({"flush_period": 99.0}, "recorder: parameter flush_period: not a valid value; give a num"),
        ({"topics": 3}, "recorder: parameter topics: not a valid value; give a list of texts"),
        ({"bag": "/"}, "recorder: /: exists already; choose another name or remove it"),
    ],
)
def test_bad_parameters_end_with_one_line(graph, parameters: dict, line: str) -> None:
    ended = graph.start("recorder", **parameters).ended()
    assert ended.status == 2
    assert ended.err.startswith(line)
    assert ended.err.count("\n") == 1
