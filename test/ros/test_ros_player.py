"""Replay of bags between real processes."""

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from foreign_bags import STORE, TYPES
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from symbid_ros.bags import BagWriter, Recording
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.messages.types import (
    CLOCK,
    IMU,
    JOINT_STATE,
    clock_layout,
    fill_message,
    fill_stamp,
    imu_layout,
    joint_state_layout,
)
from symbid_ros.ros.raw_subscription import PolledGroup

MILLISECOND = 1_000_000
RECORDED = 1_700_000_000 * 10**9  # time of the recording; the robot's clock started at 0
DEEP = QoSProfile(depth=10_000)
LATCHED = OfferedQos(1, "keep_last", "reliable", "transient_local")
STRING = "std_msgs/msg/String"


def write_log(
    path: Path, milliseconds: int, *, period: int = 1, extra: Sequence[tuple[str, str]] = ()
) -> Path:
    """Write joint states every period, an IMU every other, a clock, and a latched note first."""
    text = TYPES[STRING](data="first of all")
    stamps = MILLISECOND * np.arange(0, milliseconds, period)
    draw = np.random.default_rng(0)
    joints, gyro = joint_state_layout(("knee",)), imu_layout("imu_link")
    clock = clock_layout()
    joint_states, imus = joints.records(len(stamps)), gyro.records(len(stamps))
    clocks = clock.records(len(stamps))
    position, velocity, effort = draw.standard_normal((3, len(stamps), 1))
    fill_message(
        joints.columns(joint_states), stamps, position=position, velocity=velocity, effort=effort
    )
    fill_stamp(gyro.columns(imus), stamps)
    fill_stamp(clock.columns(clocks), stamps, "clock")
    with BagWriter(path) as bag:
        note = bag.add_topic("/note", STRING, [LATCHED])
        bag.write(note, RECORDED, bytes(STORE.serialize_cdr(text, STRING)))
        blocks = [
            (bag.add_topic("/joint_states", JOINT_STATE), joint_states, 1),
            (bag.add_topic("/imu/data", IMU), imus, 2),
            (bag.add_topic("/clock", CLOCK), clocks, 100),
        ]
        for step, stamp in enumerate(stamps.tolist()):
            for channel, records, every in blocks:
                if step % every == 0:
                    bag.write(channel, RECORDED + stamp, records[step].tobytes())
        for name, kind in extra:
            bag.write(bag.add_topic(name, kind), RECORDED, b"\0\1\0\0")
    return path


def payloads(bag: Path, topic: str) -> list[bytes]:
    """Return a topic's messages, padded to whole words as on the network (RTPS 2.5, 10.2)."""
    recording = Recording.of([bag])
    messages = recording.messages({topic}, recording.start, recording.end + 1)
    return [m.payload + bytes(-len(m.payload) % 4) for m in messages]


def stamp_of(message: JointState) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


class Reports:
    """The statuses of the player."""

    def __init__(self, graph: Any) -> None:
        self._received: list[tuple[str, dict[str, str]]] = []
        self._graph = graph
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive, 10)

    def _receive(self, message: DiagnosticArray) -> None:
        (status,) = message.status
        assert status.name == "/player: replay"
        values = {pair.key: pair.value for pair in status.values}
        self._received.append((status.message, values))

    def next(self, count: int) -> list[tuple[str, dict[str, str]]]:
        """Return the next statuses: message and values."""
        known = len(self._received)
        self._graph.wait_until(lambda: len(self._received) >= known + count)
        return self._received[known:]


def received_stamps(graph: Any) -> list[int]:
    """Return the growing list of joint state stamps that an observer receives, ms."""
    stamps: list[int] = []
    graph.node.create_subscription(
        JointState, "joint_states", lambda m: stamps.append(stamp_of(m) // MILLISECOND), DEEP
    )
    return stamps


def call(graph: Any, kind: type, service: str, request: Any) -> Any:
    client = graph.node.create_client(kind, service)
    graph.wait_until(client.service_is_ready)
    answer = client.call_async(request)
    graph.wait_until(answer.done)
    return answer.result()


@pytest.mark.parametrize("rate", [0.0, 3.0])
def test_recorder_gets_the_recorded_bytes(graph, tmp_path: Path, rate: float) -> None:
    log = write_log(tmp_path / "bag", 3000)
    topics = "[joint_states, imu/data, note]"
    recorder = graph.start("recorder", bag=tmp_path / "again", topics=topics)
    player = graph.start("player", bag=f"[{log}]", rate=rate, wait_for_subscribers=True)
    ended = player.ended()
    recorder.send(signal.SIGINT)
    recorded = recorder.ended()
    assert (ended.status, ended.err) == (0, "")
    assert (recorded.status, recorded.err) == (0, "")
    summary = json.loads(ended.out)
    assert summary["published"] == {"/note": 1, "/joint_states": 3000, "/imu/data": 1500}
    assert summary["passes"] == 1
    assert json.loads(recorded.out)["recorded"] == summary["published"]
    for topic in summary["published"]:
        assert payloads(tmp_path / "again", topic) == payloads(log, topic)
    again = Recording.of([tmp_path / "again"])
    assert again.topics["/note"].qos[0].durability == "transient_local"


def test_rate_0_waits_for_a_subscriber_that_keeps_all(graph, tmp_path: Path) -> None:
    """The bag exceeds all queues, and no message is taken before the player has to wait."""
    count = 20_000
    log = write_log(tmp_path / "bag", count)
    reports = Reports(graph)
    subscription = graph.node.create_subscription(
        JointState,
        "joint_states",
        lambda _: None,
        QoSProfile(history=QoSHistoryPolicy.KEEP_ALL, depth=1),
        callback_group=PolledGroup(),
        raw=True,
    )
    player = graph.start(
        "player",
        bag=f"[{log}]",
        rate=0.0,
        topics="[joint_states]",
        wait_for_subscribers=True,
    )
    published = [0, 1]
    while published[-1] == 0 or published[-1] != published[-2]:
        published += [int(values["published"]) for _, values in reports.next(1)]
    assert published[-1] < count
    taken: list[bytes] = []

    def drain() -> bool:
        while (found := subscription.handle.take_message(JointState, True)) is not None:
            taken.append(found[0])
        return len(taken) >= count

    graph.wait_until(drain)
    ended = player.ended()
    assert (ended.status, ended.err) == (0, "")
    assert json.loads(ended.out)["published"] == {"/joint_states": count}
    assert taken == payloads(log, "/joint_states")


def test_a_part_of_the_bag(graph, tmp_path: Path) -> None:
    log = write_log(tmp_path / "bag", 2000)
    stamps = received_stamps(graph)
    player = graph.start(
        "player",
        bag=f"[{log}]",
        topics="[joint_states]",
        rate=0.0,
        start=0.5,
        duration=0.25,
        wait_for_subscribers=True,
    )
    ended = player.ended()
    assert (ended.status, ended.err) == (0, "")
    assert json.loads(ended.out)["published"] == {"/joint_states": 250}
    graph.wait_until(lambda: len(stamps) >= 250)
    assert stamps == list(range(500, 750))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_loop_jumps_back_until_a_signal(graph, tmp_path: Path, number: signal.Signals) -> None:
    log = write_log(tmp_path / "bag", 400)
    stamps = received_stamps(graph)
    player = graph.execute(
        "player",
        bag=f"[{log}]",
        rate=2.0,
        loop=True,
        topics="[/joint_states]",
        wait_for_subscribers=True,
    )
    graph.wait_until(lambda: len(stamps) > 1000)
    player.send(number)
    ended = player.ended()
    assert (ended.status, ended.err) == (0, "")
    summary = json.loads(ended.out)
    published = summary["published"]["/joint_states"]
    assert summary["passes"] == published // 400
    graph.wait_until(lambda: len(stamps) >= published)
    assert stamps == [index % 400 for index in range(published)]


def test_pause_and_restart(graph, tmp_path: Path) -> None:
    log = write_log(tmp_path / "bag", 60_000, period=10)
    reports, stamps = Reports(graph), received_stamps(graph)
    player = graph.start("player", bag=f"[{log}]", topics="[joint_states]", start=20.0)
    graph.wait_until(lambda: len(stamps) > 20)
    assert call(graph, SetBool, "/player/pause", SetBool.Request(data=True)).success

    (state, before), _, (_, after) = reports.next(3)
    assert state == "paused"
    assert before == after
    graph.wait_until(lambda: stamps[-1] == round(1000 * float(after["position"])))
    last = stamps[-1]

    call(graph, SetBool, "/player/pause", SetBool.Request(data=False))
    graph.wait_until(lambda: stamps[-1] > last + 100)
    assert reports.next(1)[0][0] == "playing"
    assert list(np.unique(np.diff(stamps))) == [10]

    call(graph, Trigger, "/player/restart", Trigger.Request())
    graph.wait_until(lambda: min(np.diff(stamps)) < 0)
    jump = int(np.argmin(np.diff(stamps))) + 1
    assert stamps[jump] == 20_000
    player.send(signal.SIGINT)
    assert player.ended().status == 0


@pytest.mark.parametrize("source", ["header", "log"])
def test_clock_shows_stamps_or_the_time_of_recording(graph, tmp_path: Path, source: str) -> None:
    log = write_log(tmp_path / "bag", 1000)
    shown: list[int] = []
    graph.node.create_subscription(
        Clock, "/clock", lambda m: shown.append(m.clock.sec * 10**9 + m.clock.nanosec), DEEP
    )
    stamps = received_stamps(graph)
    player = graph.start(
        "player",
        bag=f"[{log}]",
        topics="[joint_states]",
        rate=0.0,
        wait_for_subscribers=True,
        publish_clock=True,
        clock_rate=50.0,
        clock_source=source,
    )
    assert player.ended().status == 0
    graph.wait_until(lambda: len(stamps) == 1000)
    # /clock is published before the message of the same time, so it shows the stamp before.
    expected = {
        "header": [(step - 1) * MILLISECOND for step in range(20, 1000, 20)],
        "log": [RECORDED + step * MILLISECOND for step in range(0, 1000, 20)],
    }[source]
    graph.wait_until(lambda: len(shown) >= len(expected))
    assert shown == expected


def test_latched_messages_reach_late_subscribers(graph, tmp_path: Path) -> None:
    log = write_log(tmp_path / "bag", 60_000, period=10)
    stamps, notes = received_stamps(graph), []
    player = graph.start("player", bag=f"[{log}]")
    graph.wait_until(lambda: stamps)
    latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
    graph.node.create_subscription(String, "note", lambda m: notes.append(m.data), latched)
    graph.wait_until(lambda: notes)
    assert notes == ["first of all"]
    player.send(signal.SIGTERM)
    assert player.ended().status == 0


def test_sqlite_replay_skips_excluded_topics_and_types_not_installed(graph, tmp_path: Path) -> None:
    log = tmp_path / "old"
    uninstalled = "stereo_msgs/msg/DisparityImage"
    with RosbagsWriter(log, version=9) as writer:
        links = {
            name: writer.add_connection(name, kind, typestore=STORE)
            for name, kind in (("/a", STRING), ("/b", STRING), ("/disparity", uninstalled))
        }
        for n in range(10):
            text = bytes(STORE.serialize_cdr(TYPES[STRING](data=str(n)), STRING))
            for link in links.values():
                writer.write(link, RECORDED + n, text)
    received: list[str] = []
    graph.node.create_subscription(String, "a", lambda message: received.append(message.data), DEEP)
    player = graph.start(
        "player", bag=f"[{log}]", exclude="[b]", rate=0.0, wait_for_subscribers=True
    )
    graph.wait_until(lambda: len(received) == 10)
    assert received == [str(n) for n in range(10)]
    ended = player.ended()
    assert ended.status == 0
    assert json.loads(ended.out)["published"] == {"/a": 10}
    (line,) = ended.err.splitlines()
    assert line.startswith(f"player: /disparity: not replayed: message type {uninstalled}: not ")


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"bag": "['']"}, "parameter bag: empty; give at least one bag"),
        ({"bag": "[/nowhere]"}, "/nowhere: no such bag; give a bag's folder or an .mcap file"),
        ({"topics": "[imu]"}, "LOG: no topic imu, it holds /clock (rosgraph_msgs/msg/Clock), "),
        (
            {"topics": "[disparity]"},
            "message type stereo_msgs/msg/DisparityImage: not installed; install its package or ",
        ),
        ({"exclude": "[imu]"}, "LOG: no topic imu, it holds /clock (rosgraph_msgs/msg/Clock), "),
        (
            {"topics": "[note]", "exclude": "[/note]"},
            "LOG: no topic left to replay; name topics of the bag in topics, or ",
        ),
        ({"start": 9.0}, "parameter start: 9 s is beyond the end of LOG; give less than 0.009"),
        ({"rate": -1.0}, "parameter rate: not a valid value; give a number with a decimal point "),
        ({"clock_source": "sun"}, "parameter clock_source: 'sun' is not valid; give one of header"),
        (
            {"topics": "[clock]", "publish_clock": True},
            "parameter topics: publish_clock also publishes /clock; remove /clock from topics or ",
        ),
    ],
)
def test_bad_parameters_end_with_one_line(
    graph, tmp_path: Path, parameters: dict, line: str
) -> None:
    uninstalled = [("/disparity", "stereo_msgs/msg/DisparityImage")]
    log = write_log(tmp_path / "bag", 10, extra=uninstalled)
    ended = graph.start("player", **({"bag": f"[{log}]"} | parameters)).ended()
    assert ended.status == 2
    assert ended.err.startswith(f"player: {line.replace('LOG', str(log))}")
    assert ended.err.count("\n") == 1
    assert ended.out == ""
