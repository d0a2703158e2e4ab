"""The recorder with publishers of every quality of service."""

import json
import random
import re
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from graph_probes import StatusProbe
from mcap.reader import make_reader
from nav_msgs.msg import Goals
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from small_disks import small_disk
from std_msgs.msg import String
from whole_bags import whole_messages

RELIABLE = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk") as folder:
        yield folder


def joint_state(milliseconds: int) -> JointState:
    message = JointState(name=["knee"], position=[float(milliseconds)])
    message.header.stamp.sec, rest = divmod(milliseconds, 1000)
    message.header.stamp.nanosec = rest * 1_000_000
    return message


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_completes_the_bag(graph, tmp_path: Path, number: signal.Signals) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    recorder = graph.execute("recorder", bag=tmp_path / "bag", topics="[joint_states]")
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


def test_every_quality_of_service_is_matched_and_recorded(graph, tmp_path: Path) -> None:
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


def test_a_driver_that_restarts_with_another_quality_of_service_is_recorded(
    graph, tmp_path: Path
) -> None:
    health = StatusProbe(graph)
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="[joint_states]")

    def recorded() -> int:
        return health.count("/recorder: recording", "messages")

    for qos in (RELIABLE, BEST_EFFORT):
        before = recorded()
        publisher = graph.node.create_publisher(JointState, "joint_states", qos)
        graph.wait_until(publisher.get_subscription_count)
        for n in range(before, before + 50):
            publisher.publish(joint_state(n))
        graph.wait_until(lambda expected=before + 50: recorded() == expected)
        graph.node.destroy_publisher(publisher)
    recorder.send(signal.SIGINT)
    assert json.loads(recorder.ended().out)["recorded"] == {"/joint_states": 100}


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


def test_no_message_is_an_error_and_leaves_no_bag(graph, tmp_path: Path) -> None:
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="[joint_states]")
    graph.wait_for_node("recorder")
    recorder.send(signal.SIGINT)
    ended = recorder.ended()
    assert ended.status == 2
    assert "no message received, nothing recorded" in ended.err
    assert not (tmp_path / "bag").exists()


def test_topics_that_match_an_expression_are_recorded_whenever_they_appear(
    graph, tmp_path: Path
) -> None:
    node = graph.node
    early = [node.create_publisher(JointState, name, RELIABLE) for name in ("arm/left", "leg")]
    recorder = graph.start(
        "recorder",
        bag=tmp_path / "bag",
        topics="[leg]",
        topics_regex="^/arm/",
        exclude_regex="secret$",
    )
    graph.wait_until(lambda: all(each.get_subscription_count() for each in early))
    late = [
        node.create_publisher(JointState, name, RELIABLE)
        for name in ("arm/secret", "arm/_hidden", "head", "arm/right")
    ]
    graph.wait_until(late[-1].get_subscription_count)
    for publisher in [*early, *late]:
        publisher.publish(joint_state(1))
        assert publisher.wait_for_all_acked()
    recorder.send(signal.SIGINT)
    ended = recorder.ended()
    assert (ended.status, ended.err) == (0, "")
    recorded = json.loads(ended.out)["recorded"]
    assert recorded == {"/leg": 1, "/arm/left": 1, "/arm/right": 1}


def test_all_topics_skips_unknown_types(graph, tmp_path: Path) -> None:
    installed = graph.node.create_publisher(Goals, "goals", RELIABLE)
    unknown = graph.node.create_publisher(GetParameters.Request, "odd", RELIABLE)
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="['']", all_topics=True)
    health = StatusProbe(graph)
    graph.wait_until(installed.get_subscription_count)
    installed.publish(Goals(goals=[PoseStamped()]))
    graph.wait_until(lambda: health.count("/recorder: recording", "messages"))
    recorder.send(signal.SIGINT)
    ended = recorder.ended()
    assert ended.status == 0
    (line,) = ended.err.splitlines()
    assert line.startswith("recorder: /odd: not recorded: message type rcl_interfaces/srv/GetPara")
    recorded = json.loads(ended.out)["recorded"]
    assert recorded["/goals"] == 1
    assert "/rosout" in recorded
    assert "/odd" not in recorded
    assert unknown.get_subscription_count() == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, raw),) = reader.messages([c for c in reader.connections if "goal" in c[1]])
        assert len(reader.deserialize(raw, connection.msgtype).goals) == 1


def test_a_named_topic_must_have_a_known_type(graph, tmp_path: Path) -> None:
    graph.node.create_publisher(GetParameters.Request, "odd", RELIABLE)
    ended = graph.start("recorder", bag=tmp_path / "bag", topics="[odd]").ended()
    assert ended.status == 2
    assert ended.err.startswith("recorder: message type rcl_interfaces/srv/GetParameters_Request")
    assert list(tmp_path.glob("bag*")) == []


def test_files_are_split_without_losing_messages(graph, tmp_path: Path) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics="[joint_states]", split_size=1)
    graph.wait_until(publisher.get_subscription_count)
    draw = random.Random(0)
    for n in range(320):  # two files and a half
        message = joint_state(n)
        message.effort = [draw.random() for _ in range(1000)]
        publisher.publish(message)
    assert publisher.wait_for_all_acked()
    recorder.send(signal.SIGTERM)
    summary = json.loads(recorder.ended().out)
    assert summary["files"] == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"]
    assert (summary["recorded"], summary["lost"]) == ({"/joint_states": 320}, {})
    sizes = [(tmp_path / "bag" / name).stat().st_size for name in summary["files"]]
    assert summary["bytes"] == sum(sizes)
    with AnyReader([tmp_path / "bag"]) as reader:
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert [message.position[0] for message in read] == list(range(320))


def test_full_disk_ends_the_recording_with_a_valid_bag(graph, disk: Path) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    bag = disk / "bag"
    recorder = graph.start("recorder", bag=bag, topics="[joint_states]")
    graph.wait_until(publisher.get_subscription_count)
    draw = random.Random(0)
    sent = 0
    while publisher.get_subscription_count():
        message = joint_state(sent)
        message.effort = [draw.random() for _ in range(1000)]
        publisher.publish(message)
        time.sleep(0.001)  # at the rate of a robot, not at full speed
        sent += 1
    ended = recorder.ended()
    assert ended.status == 2
    (line,) = ended.err.splitlines()
    counted = re.fullmatch(
        rf"recorder: {bag}/bag_0.mcap: cannot write: No space left on device; the bag is "
        r"incomplete: (\d+) messages from \S+ to \S+ are missing \(/joint_states (\d+)\) "
        r"\(SYMBID-E\d+\)",
        line,
    )
    summary = json.loads(ended.out)
    recorded = summary["recorded"]["/joint_states"]
    assert int(counted[1]) == int(counted[2]) == summary["lost"]["/joint_states"] > 0
    found = whole_messages(bag)
    with AnyReader([bag]) as reader:
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()]
    assert [message.position[0] for message in read] == list(range(recorded))
    assert len(found) == recorded <= sent - summary["lost"]["/joint_states"]


def test_folder_deleted_while_recording_ends_with_status_2(graph, tmp_path: Path) -> None:
    publisher = graph.node.create_publisher(JointState, "joint_states", RELIABLE)
    bag = tmp_path / "bag"
    recorder = graph.start("recorder", bag=bag, topics="[joint_states]")
    graph.wait_until(publisher.get_subscription_count)
    publisher.publish(joint_state(1))
    assert publisher.wait_for_all_acked()
    shutil.rmtree(bag)
    ended = recorder.ended()
    assert ended.status == 2
    (line,) = ended.err.splitlines()
    assert line.startswith(f"recorder: {bag}/bag_0.mcap: the file or its folder was deleted while ")
    summary = json.loads(ended.out)
    assert (summary["recorded"], summary["lost"]) == ({"/joint_states": 0}, {"/joint_states": 1})
    assert not bag.exists()


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"topics_regex": "("}, "recorder: parameter topics_regex: invalid regular expression (m"),
        ({"queue_depth": 0}, "recorder: parameter queue_depth: not a valid value; give an integer"),
        ({"flush_period": 99.0}, "recorder: parameter flush_period: not a valid value; give a num"),
        (
            {"topics": 3},
            "recorder: parameter topics: [3] is not valid; give a text or a list of texts",
        ),
        ({"bag": "x" * 300}, f"recorder: {'x' * 300}: File name too long; check the path"),
        ({"bag": "/"}, "recorder: /: exists already; choose another name or remove it"),
    ],
)
def test_bad_parameters_end_with_one_line(graph, parameters: dict, line: str) -> None:
    ended = graph.start("recorder", **parameters).ended()
    assert ended.status == 2
    assert ended.err.startswith(line)
    assert ended.err.count("\n") == 1
