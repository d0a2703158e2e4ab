"""An identifier reports missing, mistyped or unstamped topics and keeps waiting for them."""

import re
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as Given
from sensor_msgs.msg import JointState

from symbid_ros.errors import SymbidError
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection
from symbid_ros.messages.types import IMU, JOINT_STATE
from symbid_ros.model.load import load_model
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.online.message_intake import MessageIntake
from symbid_ros.package_paths import config_file
from symbid_ros.ros.identifier_diagnostics import StreamMonitor
from symbid_ros.ros.identifier_parameters import PARAMETERS
from symbid_ros.ros.online_identifier import OnlineIdentifier
from symbid_ros.ros.parameters import declare
from symbid_ros.ros.reporting import forward_python_logs
from symbid_ros.ros.sensor_topics import missing_topics

DEADLINE = 240.0  # s; only a hang takes longer
ARM = """<robot name="arm"><link name="world"/><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 0.3"/><mass value="1.5"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="bolt" type="fixed"><parent link="world"/><child link="base"/></joint>
<joint name="elbow" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
</joint></robot>"""


class Robot:
    """An identifier in a thread, with its log messages."""

    def __init__(self, domain: int, model: Path, **given: Any) -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        overrides = [Given(name, value=value) for name, value in given.items()]
        overrides.append(Given("model", value=str(model)))
        self.node = Node("identifier", context=self._context, parameter_overrides=overrides)
        self.log: list[str] = []
        self._said = threading.Condition()
        self.node.create_subscription(Log, "/rosout", self._hear, 1000)
        values = declare(self.node, PARAMETERS)
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self.node)
        self._executor = executor
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=executor.spin),
            threading.Thread(target=self._identify, args=(values,)),
        ]
        for thread in self._threads:
            thread.start()

    def _identify(self, values: dict[str, Any]) -> None:
        # Stopping without an estimate may raise an error.
        with forward_python_logs(self.node), suppress(SymbidError):
            OnlineIdentifier(self.node, values).run(self._stop)

    def _hear(self, message: Log) -> None:
        with self._said:
            self.log.append(message.msg)
            self._said.notify()

    def wait_for(self, *words: str, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Wait until one log message contains all words; call ``meanwhile`` repeatedly."""
        with self._said:
            for _ in range(int(DEADLINE / 0.02)):
                if any(all(word in one for word in words) for one in self.log):
                    return
                meanwhile()
                self._said.wait(0.02)
        raise AssertionError(f"nobody says {words}: {self.log}")

    @property
    def is_alive(self) -> bool:
        return self._threads[1].is_alive()

    def close(self) -> None:
        self._stop.set()
        self._threads[1].join()
        self._executor.shutdown()
        self._threads[0].join()
        self.node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def arm(domain: int, tmp_path: Path) -> Iterator[Robot]:
    (tmp_path / "arm.urdf").write_text(ARM)
    robot = Robot(
        domain, tmp_path / "arm.urdf", joint_topic=["/arm/joint_states"], settle=0.0, lag=0.1
    )
    yield robot
    robot.close()


def test_faults_and_their_end_are_reported_while_the_node_runs(arm: Robot) -> None:
    mistyped = arm.node.create_publisher(JointState, "/arm/joint_state", 100)
    arm.wait_for("waiting for topic /arm/joint_states (`joint_topic`)", "/arm/joint_state;")
    cured = arm.node.create_publisher(JointState, "/arm/joint_states", 100)
    arm.wait_for("identifying arm from /arm/joint_states")
    arm.wait_for("/arm/joint_states: resolved")

    message = JointState(name=["elbow"], position=[0.1], velocity=[0.0], effort=[1.0])
    arm.wait_for(
        "/arm/joint_states: header.stamp is zero", meanwhile=lambda: cured.publish(message)
    )
    wrong = JointState(name=["wrist"], position=[0.1], velocity=[0.0], effort=[1.0])

    def publish(message: JointState, clock: list[int]) -> None:
        for _ in range(50):  # 10 ms apart, so that blocks of 4 s are soon complete
            clock[0] += 10_000_000
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(clock[0], 10**9)
            cured.publish(message)

    clock = [100 * 10**9]
    arm.wait_for("none of the model's joints (wrist)", meanwhile=lambda: publish(wrong, clock))
    assert not any("bag" in one or "silent" in one for one in arm.log)
    assert arm.is_alive
    arm.node.destroy_publisher(mistyped)


GRAPH = {
    "/robot/joint_states": [JOINT_STATE],
    "/imu/data": [IMU],
    "/chatter": ["std_msgs/msg/String"],
    "/identifier_2/effort_residual": [JOINT_STATE],  # of another identifier
}


@pytest.mark.parametrize(
    ("selection", "found", "floating", "says"),
    [
        (TopicSelection(joints=("/robot/joint_states",)), ["/robot/joint_states"], False, {}),
        (
            TopicSelection(joints=("/joints",)),
            [],
            False,
            {"/joints": "`joint_topic`., which has no publisher; .* /robot/joint_states;"},
        ),
        (
            TopicSelection(joints=("/chatter",), wrenches=("/foot",)),
            [],
            False,
            {
                "/chatter": "/chatter is of type std_msgs/msg/String, not sensor_msgs/msg/JointSt",
                "/foot": "`wrench_topic`.* topics of that type: none",
            },
        ),
        (
            TopicSelection(),
            [],
            True,
            {
                "joint states": "/robot/joint_states; start .* give `joint_topic`",
                "IMU": "/imu/data; start .* give `imu_topic`, or `base` fixed",
            },
        ),
        (TopicSelection(), ["/robot/joint_states"], False, {}),
    ],
)
def test_messages_about_missing_topics_name_the_parameter(selection, found, floating, says) -> None:
    topics = [Topic(name, GRAPH[name][0]) for name in found]
    missing = missing_topics(selection, topics, GRAPH, floating=floating)
    assert set(missing) == set(says)
    for key, pattern in says.items():
        assert re.search(pattern, missing[key]), missing[key]
        assert "residual" not in missing[key]


def test_stamps_of_another_clock_differ_from_leftovers_of_a_jump() -> None:
    joints, imu = Topic("/joint_states", JOINT_STATE), Topic("/imu", IMU)
    streams, faults = LiveStreams(SelectedTopics((joints,), (imu,), ()), "live"), StreamMonitor()
    checks = {
        topic: MessageCheck(topic, load_model(config_file("symbitron.xml")))
        for topic in (joints, imu)
    }

    def faults_after(joint_stamp: float, imu_stamp: float) -> dict[str, str]:
        for topic, stamp in ((joints, joint_stamp), (imu, imu_stamp)):
            streams.add(topic, round(stamp * 1e9), b"")
        return faults.check(streams, checks)

    assert faults_after(100.0, 5.0) == {}  # one stale check may be left from before a jump
    (fault,) = faults_after(100.1, 5.1).values()
    assert fault.startswith(
        "/imu: stamps are at 5.100 s, other topics at 100.100 s, and these mess"
    )
    assert faults_after(100.2, 100.2) == {}
    assert set(faults_after(100.3, 100.2)) == {"/imu"}  # the stamp does not advance
    assert "header.stamp is zero" in faults_after(100.4, 0.0)["/imu"]
    # A topic that falls silent keeps this fault, and loses it with valid stamps.
    assert "header.stamp is zero in 1 message, " in faults.check(streams, checks)["/imu"]
    assert faults_after(100.5, 100.5) == {}


def test_a_log_that_starts_at_zero_and_loops_has_stamps() -> None:
    joints = Topic("/joint_states", JOINT_STATE)
    model = load_model(config_file("symbitron.xml"))
    streams, faults = LiveStreams(SelectedTopics((joints,), (), ()), "live"), StreamMonitor()
    intake = MessageIntake(streams.selected, model, streams, streams.restart)

    def faults_after(*stamps: float) -> dict[str, str]:
        for stamp in stamps:
            intake._feed(joints, round(stamp * 1e9), b"")
        return faults.check(streams, intake.checks)

    assert faults_after(0.0, 1.0) == {}
    for end in (0.5, 0.6, 0.7):  # the time at which the faults are looked for
        assert faults_after(1.5, 2.0, 0.0, end) == {}
    assert intake.clock_jumps == 3
    assert (
        "header.stamp is zero in 5 messages, " in faults_after(0.8, 0.0, 0.9, 0.0)["/joint_states"]
    )


def test_the_reason_why_all_messages_are_dropped_lasts_in_silence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joints = Topic("/joint_states", JOINT_STATE)
    streams, faults = LiveStreams(SelectedTopics((joints,), (), ()), "live"), StreamMonitor()
    check = MessageCheck(joints, load_model(config_file("symbitron.xml")))

    def found() -> dict[str, str]:
        return faults.check(streams, {joints: check})

    streams.add(joints, 10**9, b"")
    assert found() == {}
    for _ in range(3):
        check.take(b"no message")
    monkeypatch.setattr("symbid_ros.ros.identifier_diagnostics.SILENCE", -1.0)
    for _ in range(2):
        (fault,) = found().values()
        assert fault.startswith("/joint_states: none of 3 messages is used: ")
    streams.add(joints, 2 * 10**9, b"")
    assert found() == {}
    assert "no message for over" in found()["/joint_states"]
