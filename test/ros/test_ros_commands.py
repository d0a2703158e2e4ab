"""Which commands on the topic the robot obeys."""

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

from symbid_ros.messages.types import JOINT_STATE
from symbid_ros.ros.commands import CommandPublisher, TopicCommands
from symbid_ros.ros.raw_subscription import wait_for_any
from symbid_ros.simulation.command import Drives
from symbid_ros.simulation.sensors import Instant

JOINTS = ("hip", "knee", "ankle")
DRIVES = ("knee", "hip")
LIMITS = np.array([[-10.0, 10.0], [-20.0, 30.0]])
RATES = np.array([1.0, -2.0, 3.0])
MILLISECOND = 1_000_000


def instant(milliseconds: int) -> Instant:
    nothing = np.zeros(0)
    fields = dict.fromkeys(Instant.__dataclass_fields__, nothing)
    return Instant(**fields | {"stamp": milliseconds * MILLISECOND, "joint_velocity": RATES})


def command(milliseconds: int, **efforts: float) -> JointState:
    message = JointState(name=list(efforts), effort=list(efforts.values()))
    message.header.stamp.sec, rest = divmod(milliseconds, 1000)
    message.header.stamp.nanosec = rest * MILLISECOND
    return message


class Bench:
    """The robot's and the controller's end of the topic in one process."""

    def __init__(self, node: Node, timeout: float) -> None:
        self.node = node
        self.publisher = node.create_publisher(JointState, "joint_command", 100)
        drives = Drives(JOINTS, DRIVES, LIMITS)
        self.repeated: list[int] = []
        self.commands = TopicCommands(
            node,
            drives,
            DRIVES,
            subscriber_counts=lambda: (1, 1),
            republish=lambda instant: self.repeated.append(instant.stamp),
            timeout=timeout,
        )
        self.stop = threading.Event()

    def send(self, *messages: JointState) -> None:
        for message in messages:
            self.publisher.publish(message)

    def answer(self, milliseconds: int) -> list[float] | None:
        found = self.commands.exchange(instant(milliseconds), self.stop)
        if found.is_safe:
            # Damping opposite to the rates of knee and hip only.
            np.testing.assert_array_equal(found.torques, [4.0, -2.0])
            return None
        return found.torques.tolist()

    def wait(self) -> None:
        """Wait until the sent messages are in the queue."""
        wait_for_any(self.node, [self.commands._subscription], 300.0)

    @property
    def rejected(self) -> dict[str, int]:
        return {reason: n for reason, n in self.commands.counts.rejected.items() if n}


@pytest.fixture
def bench(domain: int) -> Iterator[Callable[..., Bench]]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("bench", context=context)

    def made(timeout: float = 300.0) -> Bench:
        bench = Bench(node, timeout)
        assert bench.commands.await_controller(bench.stop)
        return bench

    yield made
    node.destroy_node()
    context.try_shutdown()


def test_efforts_are_read_by_name(bench) -> None:
    loop = bench()
    loop.send(command(1, hip=2.0, knee=-3.0))
    assert loop.answer(1) == [-3.0, 2.0]
    loop.send(command(2, knee=-4.0, hip=5.0))
    assert loop.answer(2) == [-4.0, 5.0]
    loop.send(command(3, hip=6.0, knee=7.0))
    assert loop.answer(3) == [7.0, 6.0]
    assert (loop.commands.counts.accepted, loop.rejected) == (3, {})


def test_bytes_of_any_serialiser_are_read(bench) -> None:
    """Fast CDR may pad behind the last field, and others write big-endian."""
    loop = bench()
    loop.publisher.publish(serialize_message(command(1, hip=2.0, knee=-3.0)))
    assert loop.answer(1) == [-3.0, 2.0]
    store = get_typestore(Stores.ROS2_JAZZY)
    types, nothing = store.types, np.zeros(0)
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=2 * MILLISECOND)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    efforts = np.array([4.0, 5.0])
    message = types[JOINT_STATE](header, ["hip", "knee"], nothing, nothing, efforts)
    loop.publisher.publish(bytes(store.serialize_cdr(message, JOINT_STATE, little_endian=False)))
    assert loop.answer(2) == [5.0, 4.0]


def test_commands_of_the_own_publisher_are_accepted(bench) -> None:
    loop = bench()
    received: list[JointState] = []
    loop.node.create_subscription(JointState, "joint_command", received.append, 10)
    CommandPublisher(loop.node, DRIVES).publish(7 * MILLISECOND, np.array([1.5, -2.5]))
    assert loop.answer(7) == [1.5, -2.5]
    executor = rclpy.executors.SingleThreadedExecutor(context=loop.node.context)
    executor.add_node(loop.node)
    while not received:
        executor.spin_once(timeout_sec=1.0)
    assert (received[0].name, list(received[0].effort)) == (["knee", "hip"], [1.5, -2.5])
    assert len(received[0].position) == len(received[0].velocity) == 0


BAD = {
    "joints": [
        command(5, knee=1.0),
        command(5, knee=1.0, hip=1.0, ankle=1.0),
        command(5, knee=1.0, toe=1.0),
        JointState(name=["knee", "knee"], effort=[1.0, 1.0]),
        JointState(),
    ],
    "length": [
        JointState(name=["knee", "hip"], effort=[1.0]),
        JointState(name=["knee", "hip"], position=[1.0, 1.0]),
    ],
    "not_finite": [command(5, knee=float("nan"), hip=0.0), command(5, knee=0.0, hip=float("-inf"))],
    "beyond_limit": [command(5, knee=10.001, hip=0.0), command(5, knee=0.0, hip=-20.5)],
    "old": [command(4, knee=1.0, hip=1.0), command(0, knee=1.0, hip=1.0)],
    "future": [command(6, knee=1.0, hip=1.0), command(10_000, knee=1.0, hip=1.0)],
}


@pytest.mark.parametrize("reason", BAD)
def test_invalid_commands_are_counted_and_ignored(bench, reason: str) -> None:
    loop = bench()
    loop.send(*BAD[reason], command(5, knee=0.25, hip=0.5))
    assert loop.answer(5) == [0.25, 0.5]
    assert loop.rejected == {reason: len(BAD[reason])}
    assert loop.commands.counts.accepted == 1


def test_an_instant_is_answered_once(bench) -> None:
    loop = bench()
    loop.send(command(5, knee=1.0, hip=1.0), command(5, knee=2.0, hip=2.0))
    assert loop.answer(5) == [1.0, 1.0]
    loop.send(command(5, knee=3.0, hip=3.0), command(6, knee=4.0, hip=4.0))
    assert loop.answer(6) == [4.0, 4.0]
    assert loop.rejected == {"old": 2}


def test_a_timeout_gives_safe_torques_until_a_late_command(bench) -> None:
    loop = bench(timeout=0.2)
    loop.send(command(4, knee=1.0, hip=1.0))
    assert loop.answer(4) == [1.0, 1.0]
    assert loop.answer(5) is None
    assert (loop.commands.counts.timeouts, loop.commands.is_controlled) == (1, False)
    assert loop.answer(6) is None
    assert loop.commands.counts.timeouts == 1, "nobody is waited for any more"
    loop.send(command(5, knee=1.0, hip=1.0))
    loop.wait()
    # A late command makes the robot wait again: the next answer may be on its way.
    assert loop.answer(7) is None
    assert (loop.commands.counts.timeouts, loop.rejected) == (2, {"old": 1})
    loop.send(command(7, knee=2.0, hip=2.0), command(8, knee=3.0, hip=3.0))
    loop.wait()
    assert loop.answer(8) == [3.0, 3.0]


def test_commands_for_an_earlier_run_are_discarded(bench) -> None:
    loop = bench()
    loop.send(command(5000, knee=1.0, hip=1.0))
    assert loop.answer(5000) == [1.0, 1.0]
    loop.send(command(5001, knee=2.0, hip=2.0), command(1, knee=2.0, hip=2.0))
    loop.wait()
    assert loop.commands.await_controller(loop.stop)
    loop.send(command(1, knee=3.0, hip=3.0))
    assert loop.answer(1) == [3.0, 3.0]
    assert loop.rejected == {}


def test_a_node_that_joins_before_the_first_command_also_gets_the_instant(bench) -> None:
    loop = bench(timeout=1000.0)
    late = loop.node.create_publisher(JointState, "joint_command", 100)
    assert loop.answer(1) is None
    assert loop.commands.counts.timeouts == 0
    assert loop.commands.await_controller(loop.stop)
    late.publish(command(1, knee=1.0, hip=1.0))
    assert loop.answer(1) == [1.0, 1.0]
    assert loop.repeated == [1 * MILLISECOND]


def test_a_stop_ends_the_wait(bench) -> None:
    loop = bench(timeout=1000.0)
    stopper = threading.Timer(0.1, loop.stop.set)
    stopper.start()
    assert loop.answer(1) is None
    assert loop.commands.counts.timeouts == 0
    stopper.join()
    assert not loop.commands.await_controller(loop.stop)
