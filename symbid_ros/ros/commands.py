"""Commands for the simulated drives from an external controller: a topic or UDP datagrams."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from threading import Event
from typing import Protocol

import numpy as np
from rclpy.node import Node

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout, typestore
from symbid_ros.messages.types import JOINT_STATE, fill_stamp
from symbid_ros.ros.bridge_parameters import INTERNAL, UDP
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.endpoints import await_settled, message_class, reliable_qos
from symbid_ros.ros.parameters import ParameterError, Values
from symbid_ros.ros.raw_subscription import DecodedMessage, DecodedSubscription, wait_for_any
from symbid_ros.simulation.command import Command, CommandCounts, Drives
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import UdpServer

TOPIC = "joint_command"
DEPTH = 100  # commands; at most one of them answers the newest measurement
FIRST = 5.0  # s of waiting for a controller's first command
LISTEN = 0.05  # s; how soon a signal to stop is seen
WARNING_PERIOD = 5.0  # s between two warnings
REASONS = ("malformed", "joints", "length", "not_finite", "beyond_limit", "old", "future")


class CommandPublisher:
    """Publishes torques on the topic, as bytes patched in place.

    Parameters
    ----------
    node : Node
    drive_names : sequence of str
        Joint of each drive, order of torques.
    """

    def __init__(self, node: Node, drive_names: Sequence[str]) -> None:
        layout = effort_layout(tuple(drive_names))
        self._record = layout.records(1)
        self._columns = layout.columns(self._record)
        self._publisher = node.create_publisher(
            message_class(JOINT_STATE), TOPIC, reliable_qos(DEPTH)
        )

    def publish(self, stamp: int, torques: FloatArray) -> None:
        """Publish torques (n_actuated,), Nm, that answer the measurement of a stamp (ns)."""
        fill_stamp(self._columns, stamp)
        self._columns["effort"][0] = torques
        self._publisher.publish(self._record.tobytes())


def effort_layout(names: tuple[str, ...]) -> Layout:
    """Return the layout of a JointState with names and efforts alone."""
    types, nothing = typestore().types, np.zeros(0)
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=""
    )
    message = types[JOINT_STATE](
        header=header,
        name=list(names),
        position=nothing,
        velocity=nothing,
        effort=np.zeros(len(names)),
    )
    return Layout.of(message, JOINT_STATE)


class InvalidCommandError(DataError):
    """A command that must not move the robot; the message is the reason in a word."""


@dataclass
class TopicCommandCounts:
    """What has come in so far.

    Attributes
    ----------
    accepted : int
        Commands obeyed.
    timeouts : int
        How often a controller fell silent.
    rejected : dict of str to int
        Commands by the reason why they were not obeyed: ``malformed`` bytes, ``joints`` missing,
        unknown or twice, ``length`` of the efforts, ``not_finite``, ``beyond_limit``, and
        ``old`` or ``future`` for stamps other than that of the measurement to be answered.
    """

    accepted: int = 0
    timeouts: int = 0
    rejected: dict[str, int] = field(default_factory=lambda: dict.fromkeys(REASONS, 0))


class TopicCommands:
    """Waits, an instant at a time, for the command that answers it.

    A command is a JointState with an effort (Nm) for every drive, by joint name in any order;
    its header stamp is that of the measurement it answers. Who answers is in control: every
    measurement waits for its command, ``timeout`` seconds of real time at most. After such a
    silence torques are the safe ones of `Drives`, at once and not waited for, until a command
    comes again, late as it may be: from the next measurement on it is waited for again.

    Parameters
    ----------
    node : Node
    drives : Drives
        Limits and safe torques.
    drive_names : sequence of str
        Joint of each drive.
    audience : callable
        Number of subscribers of each topic that a controller may need.
    repeat : callable
        Publishes an instant's measurement once more.
    timeout : float
        s of real time.

    Attributes
    ----------
    counts : TopicCommandCounts
        What has come in so far.
    is_controlled : bool
        Whether there is a controller to wait for.
    """

    def __init__(
        self,
        node: Node,
        drives: Drives,
        drive_names: Sequence[str],
        *,
        audience: Callable[[], Sequence[int]],
        repeat: Callable[[Instant], None],
        timeout: float,
    ) -> None:
        self._node, self._drives, self._timeout = node, drives, timeout
        self._drive_names = tuple(drive_names)
        self._audience, self._repeat = audience, repeat
        self._mailbox = DecodedSubscription(node, TOPIC, JOINT_STATE, DEPTH)
        self._layout: Layout | None = None
        self._places: IntArray = np.arange(len(self._drive_names))
        self._answered = 0  # stamp of the instant last answered
        self._asked = 0  # stamp of the instant last asked for
        self._invited: tuple[int, ...] = ()
        self.counts = TopicCommandCounts()
        self.is_controlled = False

    @property
    def place(self) -> str:
        """Where it is listened to."""
        return str(self._mailbox.subscription.topic_name)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Nodes that publish there now."""
        found = self._node.get_publishers_info_by_topic(self.place)
        return tuple(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in found)

    def await_controller(self, stop: Event) -> bool:
        """Wait until somebody publishes commands and somebody listens, and nobody else turns up.

        What lies in the queue then was for a run before and is thrown away.
        """
        await_settled(lambda: (self._mailbox.senders, max(self._audience())), stop, self._audience)
        for _ in self._mailbox.payloads():
            pass
        self._answered, self._invited = 0, self._present()
        self.is_controlled = not stop.is_set()
        return self.is_controlled

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Return the command that answers an instant just published, or a safe one.

        Returns within ``timeout``, and at once when nobody is in control or the stop is set. The
        first command is waited for longer, as a controller may have more to do before it, until
        somebody else turns up who has not heard of the instant; asked for again, it is published
        again.
        """
        if instant.stamp == self._asked:
            self._repeat(instant)
        self._asked = instant.stamp
        is_first = not self._answered
        deadline = time.monotonic() + max(self._timeout, FIRST * is_first)
        while True:
            torques = self._answer(instant.stamp)
            if torques is not None:
                return Command(torques, is_safe=False)
            left = deadline - time.monotonic()
            if left <= 0.0 or not self.is_controlled or stop.is_set():
                break
            if is_first and self._present() != self._invited:
                break
            wait_for_any(self._node, [self._mailbox], min(left, LISTEN))
        if self.is_controlled and not stop.is_set():
            self.is_controlled = False
            self.counts.timeouts += not is_first
        return Command(self._drives.safe_torques(instant.joint_velocity), is_safe=True)

    def _present(self) -> tuple[int, ...]:
        return self._mailbox.senders, *self._audience()

    def _answer(self, stamp: int) -> FloatArray | None:
        """Look through the queue for the command that answers the instant of a stamp."""
        found = None
        for payload in self._mailbox.payloads():
            try:
                found = self._torques(self._mailbox.read(payload), stamp)
            except InvalidCommandError as refusal:
                self._reject(str(refusal))
            except DataError:
                self._reject("malformed")
            else:
                self.counts.accepted += 1
        return found

    def _reject(self, reason: str) -> None:
        self.counts.rejected[reason] += 1
        self._node.get_logger().warning(
            f"{self.place}: a command is ignored ({reason}); docs/ros.md lists the reasons",
            throttle_duration_sec=WARNING_PERIOD,
        )

    def _torques(self, letter: DecodedMessage, stamp: int) -> FloatArray:
        if letter.layout is not self._layout:
            self._places = self._find(letter.layout)
            self._layout = letter.layout
        torques: FloatArray = letter.record["effort"][0, self._places]
        objection = self._drives.validate(torques)
        if objection is not None:
            raise InvalidCommandError(objection)
        if letter.stamp > stamp:
            raise InvalidCommandError("future")
        # Too late, but alive: it is worth waiting for again.
        self.is_controlled = True
        if letter.stamp < stamp or stamp == self._answered:
            raise InvalidCommandError("old")
        self._answered = stamp
        return torques

    def _find(self, layout: Layout) -> IntArray:
        """Return where each drive's torque lies in messages of a layout."""
        names = layout.text["name"]
        if sorted(names) != sorted(self._drive_names):
            raise InvalidCommandError("joints")
        if layout.dtype["effort"].shape != (len(names),):
            raise InvalidCommandError("length")
        return np.array([names.index(drive) for drive in self._drive_names])


class CommandSource(Protocol):
    """A controller elsewhere, asked in lockstep."""

    @property
    def place(self) -> str:
        """Where it is listened to."""
        ...

    @property
    def controllers(self) -> tuple[str, ...]:
        """Who may be heard there now."""
        ...

    @property
    def counts(self) -> TopicCommandCounts | CommandCounts:
        """What has come in so far."""
        ...

    def await_controller(self, stop: Event) -> bool:
        """Wait until there is a controller and tell whether it came to that before the stop."""
        ...

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Return the command that answers an instant just published, or a safe one."""
        ...


class UdpSource(UdpServer):
    """Datagrams as a command source."""

    @property
    def place(self) -> str:
        """Where it is listened to."""
        return "udp {}:{}".format(*self.address)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Address of who is in control."""
        return () if self.controller is None else ("{}:{}".format(*self.controller),)


def command_source(
    node: Node, robot: Simulator, topics: BridgeTopics, values: Values
) -> CommandSource | None:
    """Return what a node's parameters ask for, None for the scenario's own controller.

    Raises
    ------
    SimulationError
        When the address for datagrams cannot be had.
    ParameterError
        When no controller could answer every instant.
    """
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
            "parameter errors: sample_rates leaves instants without IMU, which no controller can "
            "answer; leave it out or choose another command_source"
        )
    return TopicCommands(
        node,
        drives,
        robot.drive_names,
        audience=lambda: topics.audience,
        repeat=topics.repeat_feedback,
        timeout=timeout,
    )
