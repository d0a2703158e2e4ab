"""Who decides the drives' torques from outside: a topic or datagrams."""

from threading import Event
from typing import Protocol

from rclpy.node import Node

from symbid_ros.ros.bridge_parameters import INTERNAL, UDP
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.commands import TopicCommands, TopicCounts
from symbid_ros.ros.parameters import ParameterError, Values
from symbid_ros.simulation.command import Command, CommandCounts, Drives
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import UdpCommands


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
    def counts(self) -> TopicCounts | CommandCounts:
        """What has come in so far."""
        ...

    def await_controller(self, stop: Event) -> bool:
        """Wait until there is a controller and tell whether it came to that before the stop."""
        ...

    def exchange(self, instant: Instant, stop: Event) -> Command:
        """Return the command that answers an instant just published, or a safe one."""
        ...


class UdpSource(UdpCommands):
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
