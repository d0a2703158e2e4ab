"""Commands for the simulated drives from an external controller: a topic or UDP datagrams."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from threading import Event

import numpy as np
from rclpy.node import Node

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.types import JOINT_STATE, fill_stamp, message_layout
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.endpoints import await_settled, message_class, reliable_qos
from symbid_ros.ros.parameters import ParameterError, Values
from symbid_ros.ros.raw_subscription import DecodedMessage, DecodedSubscription, wait_for_any
from symbid_ros.simulation.command import Command, CommandCounts, Drives
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import UdpServer

INTERNAL, TOPIC, UDP = "internal", "topic", "udp"  # sources of commands
JOINT_COMMAND = "joint_command"
DEPTH = 100  # length of the queue, commands; at most one answers the newest measurement
FIRST_TIMEOUT = 5.0  # s to wait for a controller's first command
STOP_POLL = 0.05  # s; longest delay until a stop signal is noticed
WARNING_PERIOD = 5.0  # s between two warnings
REASONS = ("malformed", "joints", "length", "not_finite", "beyond_limit", "old", "future")


class CommandPublisher:
    """Publishes torques on the topic ``joint_command`` by patching serialised bytes in place."""

    def __init__(self, node: Node, drive_names: Sequence[str]) -> None:
        layout = effort_layout(tuple(drive_names))
        self._record = layout.records(1)
        self._columns = layout.columns(self._record)
        self._publisher = node.create_publisher(
            message_class(JOINT_STATE), JOINT_COMMAND, reliable_qos(DEPTH)
        )

    def publish(self, stamp: int, torques: FloatArray) -> None:
        """Publish torques (n_actuated,), Nm, in answer to the measurement with a stamp, ns."""
        fill_stamp(self._columns, stamp)
        self._columns["effort"][0] = torques
        self._publisher.publish(self._record.tobytes())


def effort_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a JointState that has names and efforts only."""
    return message_layout(JOINT_STATE, name=list(names), effort=np.zeros(len(names)))


class InvalidCommandError(DataError):
    """A command that the robot must not obey; the message is one of `REASONS`."""


@dataclass
class TopicCommandCounts:
    """Counts of received commands.

    Attributes
    ----------
    accepted : int
        Commands obeyed.
    timeouts : int
        Number of times a controller stopped answering.
    rejected : dict of str to int
        Invalid commands by reason: ``malformed`` bytes; ``joints`` that are missing, unknown or
        repeated; wrong ``length`` of the efforts; ``not_finite``; ``beyond_limit``; ``old`` or
        ``future`` stamps, which differ from that of the measurement.
    """

    accepted: int = 0
    timeouts: int = 0
    rejected: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))


class TopicCommands:
    """Waits after each measurement for the command that answers it.

    A command is a JointState with an effort (Nm) for every drive, by joint name in any order.
    Its header stamp equals that of the measurement. The simulation waits at most ``timeout``
    seconds of real time for each command. After a timeout it stops waiting and applies the safe
    torques of `Drives`. It waits again as soon as another valid command arrives, even a late one.

    Parameters
    ----------
    drives : Drives
        Torque limits and safe torques.
    drive_names : sequence of str
        Joint of each drive.
    subscriber_counts : callable
        Number of subscribers of each topic that a controller may need.
    republish : callable
        Publishes the measurements of an instant again.

    Attributes
    ----------
    is_controlled : bool
        Whether a controller answers.
    """

    def __init__(
        self,
        node: Node,
        drives: Drives,
        drive_names: Sequence[str],
        *,
        subscriber_counts: Callable[[], Sequence[int]],
        republish: Callable[[Instant], None],
        timeout: float,
    ) -> None:
        self._node, self._drives, self._timeout = node, drives, timeout
        self._drive_names = tuple(drive_names)
        self._subscriber_counts, self._republish = subscriber_counts, republish
        self._subscription = DecodedSubscription(node, JOINT_COMMAND, JOINT_STATE, DEPTH)
        self._layout: Layout | None = None
        self._indices: IntArray = np.arange(len(self._drive_names))
        self._answered = 0  # stamp of the newest instant that was answered
        self._requested = 0  # stamp of the newest instant for which a command was requested
        self._initial_counts: tuple[int, ...] = ()
        self.counts = TopicCommandCounts()
        self.is_controlled = False

    @property
    def source(self) -> str:
        """Name of the topic."""
        return str(self._subscription.subscription.topic_name)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Nodes that publish commands."""
        found = self._node.get_publishers_info_by_topic(self.source)
        return tuple(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in found)

    def await_controller(self, stop: Event) -> bool:
        """Wait until commands have a publisher, measurements a subscriber, and discovery settles.

        Commands that are in the queue by then belong to an earlier run and are discarded. Returns
        False if ``stop`` is set before.
        """
        await_settled(
            lambda: (self._subscription.publisher_count, max(self._subscriber_counts())),
            stop,
            self._subscriber_counts,
        )
        for _ in self._subscription.take():
            pass
        self._answered, self._initial_counts = 0, self._counts_now()
        self.is_controlled = not stop.is_set()
        return self.is_controlled

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Return the command that answers an instant just published, or safe torques.

        The wait ends after ``timeout``, and immediately when no controller answers or ``stop`` is
        set. The first command may take up to `FIRST_TIMEOUT`, because a controller may initialise
        first. That wait also ends when another node joins that has missed the instant. A second
        call for the same instant publishes it again.
        """
        if instant.stamp == self._requested:
            self._republish(instant)
        self._requested = instant.stamp
        is_first = not self._answered
        deadline = time.monotonic() + max(self._timeout, FIRST_TIMEOUT * is_first)
        while True:
            torques = self._find_answer(instant.stamp)
            if torques is not None:
                return Command(torques, is_safe=False)
            remaining = deadline - time.monotonic()
            if remaining <= 0.0 or not self.is_controlled or stop.is_set():
                break
            if is_first and self._counts_now() != self._initial_counts:
                break
            wait_for_any(self._node, [self._subscription], min(remaining, STOP_POLL))
        if self.is_controlled and not stop.is_set():
            self.is_controlled = False
            self.counts.timeouts += not is_first
        return Command(self._drives.safe_torques(instant.joint_velocity), is_safe=True)

    def _counts_now(self) -> tuple[int, ...]:
        return self._subscription.publisher_count, *self._subscriber_counts()

    def _find_answer(self, stamp: int) -> FloatArray | None:
        """Search the queue for the command that answers the instant with a stamp."""
        found = None
        for payload in self._subscription.take():
            try:
                found = self._torques(self._subscription.decode(payload), stamp)
            except InvalidCommandError as error:
                self._reject(str(error))
            except DataError:
                self._reject("malformed")
            else:
                self.counts.accepted += 1
        return found

    def _reject(self, reason: str) -> None:
        self.counts.rejected[reason] += 1
        self._node.get_logger().warning(
            f"{self.source}: command ignored ({reason}); docs/ros.md lists the reasons",
            throttle_duration_sec=WARNING_PERIOD,
        )

    def _torques(self, command: DecodedMessage, stamp: int) -> FloatArray:
        if command.layout is not self._layout:
            self._indices = self._find_indices(command.layout)
            self._layout = command.layout
        torques: FloatArray = command.record["effort"][0, self._indices]
        objection = self._drives.validate(torques)
        if objection is not None:
            raise InvalidCommandError(objection, "E816")
        if command.stamp > stamp:
            raise InvalidCommandError("future", "E816")
        # Even a late command shows that the controller answers again.
        self.is_controlled = True
        if command.stamp < stamp or stamp == self._answered:
            raise InvalidCommandError("old", "E816")
        self._answered = stamp
        return torques

    def _find_indices(self, layout: Layout) -> IntArray:
        """Return the index of each drive's torque in messages of a layout."""
        names = layout.text["name"]
        if sorted(names) != sorted(self._drive_names):
            raise InvalidCommandError("joints", "E816")
        if layout.dtype["effort"].shape != (len(names),):
            raise InvalidCommandError("length", "E816")
        return np.array([names.index(drive) for drive in self._drive_names])


class UdpSource(UdpServer):
    """A command source that receives UDP datagrams."""

    @property
    def source(self) -> str:
        """Address on which commands are received."""
        return "udp {}:{}".format(*self.address)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Address of the current controller."""
        return () if self.controller is None else ("{}:{}".format(*self.controller),)


CommandSource = TopicCommands | UdpSource


def counts_by_name(counts: TopicCommandCounts | CommandCounts) -> dict[str, int]:
    """Return counts by name; rejected commands are named ``rejected/<reason>``."""
    found = asdict(counts)
    rejected = found.pop("rejected")
    return found | {f"rejected/{reason}": number for reason, number in rejected.items()}


def command_source(
    node: Node, robot: Simulator, topics: BridgeTopics, values: Values
) -> CommandSource | None:
    """Return the command source that parameters select, None for the internal controller."""
    source, timeout = values["command_source"], values["command_timeout"]
    if source == INTERNAL:
        return None
    drives = Drives(robot.joint_names, robot.drive_names, robot.torque_limits)
    if source == UDP:
        return UdpSource(
            values["udp_host"],
            values["udp_port"],
            drives,
            command_timeout=timeout,
            reply_port=values["udp_reply_port"],
        )
    if not topics.has_feedback:
        raise ParameterError(
            "parameter errors: sample_rates leaves instants without IMU data, which a controller "
            "cannot answer; remove sample_rates or choose another command_source",
            "E801",
        )
    return TopicCommands(
        node,
        drives,
        robot.drive_names,
        subscriber_counts=lambda: topics.feedback_subscribers,
        republish=topics.republish_feedback,
        timeout=timeout,
    )
