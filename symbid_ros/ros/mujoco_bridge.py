"""The simulated robot on ROS 2 topics, in real time."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from queue import SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from symbid_ros.arrays import FloatArray
from symbid_ros.ros.bridge_parameters import (
    PARAMETERS,
    PayloadParameters,
    robot_name,
    simulator_from,
)
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.commands import CommandSource, TopicCommandCounts, command_source
from symbid_ros.ros.diagnostics import ERROR, OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.ros.parameters import watch
from symbid_ros.ros.process import construct, run_node
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.command import CommandCounts
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.sensors import Instant

CATCH_UP = 0.1  # s; a schedule further behind than this is not made up for
LOOK_PERIOD = 0.02  # s between two looks at whether a pause is over
WARNING_PERIOD = 5.0  # s between two warnings of one kind


@dataclass
class FixedRate:
    """Deadlines of equal periods on the monotonic clock; ROS timers would skip ticks.

    What is a little late catches up. What was held up for longer, by a pause, a new start or a
    slow controller, goes on at its pace instead of racing.

    Attributes
    ----------
    period_ns : float
        Real nanoseconds from one deadline to the next.
    late : int
        Deadlines missed by a period or more.
    elapsed_ns : int
        From restarts to the deadlines after them, what lay before the restarts left out.
    """

    period_ns: float
    late: int = 0
    elapsed_ns: int = 0
    _next: float = field(init=False)
    _last: int = field(init=False)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Make now the next deadline."""
        self._next = self._last = time.monotonic_ns()

    def wait(self) -> None:
        """Sleep until the next deadline, unless it has passed."""
        ahead = self._next - time.monotonic_ns()
        if ahead > 0:
            time.sleep(ahead / 1e9)
        elif -ahead >= self.period_ns:
            self.late += 1
            if -ahead > CATCH_UP * 1e9:
                self._next = time.monotonic_ns()
        self._next += self.period_ns
        now = time.monotonic_ns()
        self.elapsed_ns += now - self._last
        self._last = now


@dataclass
class BridgeState:
    """How the simulation has gone.

    Attributes
    ----------
    starts, falls : int
        How often the motion has begun, and been broken off by the robot.
    steps, safe_steps : int
        Periods taken, of these with safe torques for want of a command.
    time : float
        Simulated, s.
    last_fall : str
        What happened then.
    payload : Payload or None
        What the robot carries.
    is_waiting, is_paused, is_safe : bool
        Whether time stands still for want of a controller or on demand, and whether the drives
        only brake.
    """

    starts: int = 0
    falls: int = 0
    steps: int = 0
    safe_steps: int = 0
    time: float = 0.0
    last_fall: str = ""
    payload: Payload | None = None
    is_waiting: bool = False
    is_paused: bool = False
    is_safe: bool = False

    def simulation(self, scenario: str, late_steps: int) -> NodeStatus:
        """Return the status of the simulation."""
        message = "running"
        if self.is_paused:
            message = "paused"
        elif self.is_waiting:
            message = "time stands still until a controller commands"
        if self.last_fall:
            message += f"; began anew as {self.last_fall}"
        values = {
            "scenario": scenario,
            "time": f"{self.time:.3f}",
            "steps": self.steps,
            "late_steps": late_steps,
            "starts": self.starts,
            "falls": self.falls,
            "payload": describe(self.payload),
        }
        return NodeStatus("simulation", WARN if self.last_fall else OK, message, values)

    def commands(
        self, source: str, controllers: Sequence[str], counts: TopicCommandCounts | CommandCounts
    ) -> NodeStatus:
        """Return the status of the commands from outside.

        Parameters
        ----------
        source : str
            Topic or datagrams.
        controllers : sequence of str
            Who sends them.
        counts : TopicCommandCounts or CommandCounts
            What came in.
        """
        level, message = OK, "commands are followed"
        if self.is_waiting:
            level, message = WARN, "waiting for a controller"
        elif self.is_safe:
            level, message = ERROR, "no command: the drives only brake"
        elif len(controllers) > 1:
            level, message = WARN, "several controllers command; stop all but one"
        values = {
            "source": source,
            "controllers": ", ".join(controllers) or "none",
            "safe_steps": self.safe_steps,
        }
        return NodeStatus("commands", level, message, values | figures(counts))


def figures(counts: TopicCommandCounts | CommandCounts) -> dict[str, int]:
    """Return counts by name, rejections as ``rejected/<reason>``."""
    found: dict[str, int] = {}
    for name, value in asdict(counts).items():
        if isinstance(value, Mapping):
            found |= {f"{name}/{reason}": number for reason, number in value.items()}
        else:
            found[name] = value
    return found


def describe(payload: Payload | None) -> str:
    """Return a payload in words."""
    if payload is None:
        return "none"
    place = ", ".join(f"{coordinate:g}" for coordinate in payload.position)
    return f"{payload.mass:g} kg on {payload.link} at ({place}) m"


class MujocoBridge:
    """Steps the simulator on schedule and publishes what it measures.

    Parameters
    ----------
    node : Node
    values : dict
        Of its parameters, declared.
    """

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node, self._values = node, values
        self._simulator = simulator_from(values)
        self._payloads = PayloadParameters(values)
        self._payload = self._payloads.payload(values)
        self._changes: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._again, self._paused = Event(), Event()
        self._taken = 0  # instants of this motion
        self._torques: FloatArray | None = None
        self._is_payload_due = True
        self._record = BridgeState()
        self._schedule = FixedRate(self._simulator.period_ns / values["real_time_factor"])
        self._topics = BridgeTopics(node, self._simulator, values)
        self._commands = command_source(node, self._simulator, self._topics, values)
        watch(node, PARAMETERS, self._changes.put, self._payloads.require)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(SetBool, "~/pause", self._on_pause)
        self._health = StatusPublisher(node, self._look, robot_name(values))

    def run(self, stop: Event) -> None:
        """Play the motion to its end or until stopped, then say what was published."""
        if self._values["wait_for_subscribers"]:
            self._topics.await_subscribers(stop, self._values["subscribers"])
        self._play(stop)
        self._topics.await_acknowledgement(stop)
        record = self._record
        simulated = record.steps * self._simulator.period_ns
        elapsed = self._schedule.elapsed_ns
        summary: dict[str, Any] = {
            "published": self._topics.counts,
            "steps": record.steps,
            "late_steps": self._schedule.late,
            "real_time_factor": round(simulated / elapsed, 4) if elapsed else 0.0,
        }
        if self._commands is not None:
            given = {"starts": record.starts, "falls": record.falls, "safe": record.safe_steps}
            summary["commands"] = given | figures(self._commands.counts)
        print(json.dumps(summary), flush=True)

    def _play(self, stop: Event) -> None:
        self._begin(stop)
        while not stop.is_set() and (
            self._commands is not None or self._taken < self._simulator.steps
        ):
            if self._again.is_set():
                self._node.get_logger().info(f"reset at {self._record.time:.3f} s, as asked")
                self._record.last_fall = ""
                self._begin_again(stop)
            if self._paused.is_set():
                self._rest(stop)
                continue
            self._fasten_payload()
            try:
                instant = self._simulator.step(self._torques)
            except RobotFailureError as fall:
                if self._commands is None:
                    raise
                self._note_fall(fall)
                self._begin_again(stop)
                continue
            self._schedule.wait()
            self._publish(instant)
            if self._commands is not None:
                self._obey(self._commands, instant, stop)

    def _begin(self, stop: Event) -> None:
        """Stand at the beginning of the motion until there is a controller, if one is needed."""
        record = self._record
        self._taken, self._torques = 0, None
        self._is_payload_due, record.payload = True, None
        record.starts += 1
        record.is_safe = False
        self._again.clear()
        if self._commands is not None:
            record.is_waiting = True
            self._node.get_logger().info(f"waiting for a controller: {self._commands.source}")
            self._commands.await_controller(stop)
        self._schedule.restart()

    def _begin_again(self, stop: Event) -> None:
        self._simulator = simulator_from(self._values)
        self._begin(stop)

    def _rest(self, stop: Event) -> None:
        self._record.is_paused = True
        while self._paused.is_set() and not (stop.is_set() or self._again.is_set()):
            stop.wait(LOOK_PERIOD)
        self._record.is_paused = False
        self._schedule.restart()

    def _note_fall(self, fall: RobotFailureError) -> None:
        self._record.falls += 1
        self._record.last_fall = f"{fall.cause} at {fall.time:.3f} s"
        self._node.get_logger().error(f"{self._record.last_fall}; the motion begins anew")

    def _publish(self, instant: Instant) -> None:
        self._topics.publish(self._taken, instant)
        self._taken += 1
        self._record.steps += 1
        self._record.time = instant.stamp / 1e9

    def _obey(self, commands: CommandSource, instant: Instant, stop: Event) -> None:
        """Get the torques for the next period."""
        record = self._record
        command = commands.exchange(instant, stop)
        # Time stands still until the first command.
        while record.is_waiting and command.is_safe and commands.await_controller(stop):
            command = commands.exchange(instant, stop)
        if record.is_waiting:
            record.is_waiting = False
            self._schedule.restart()
        self._torques = command.torques
        record.safe_steps += command.is_safe
        if command.is_safe and not record.is_safe and not stop.is_set():
            self._node.get_logger().warning(
                f"no command for {self._values['command_timeout']:g} s at {record.time:.3f} s: "
                "the drives only brake until one comes",
                throttle_duration_sec=WARNING_PERIOD,
            )
        record.is_safe = command.is_safe

    def _fasten_payload(self) -> None:
        """Give the robot its payload when it is due, or at once if it was set meanwhile."""
        period = self._simulator.period_ns / 1e9
        is_set = not self._changes.empty()
        while not self._changes.empty():
            self._payload = self._payloads.payload(self._changes.get())
        is_due = self._is_payload_due and self._taken * period >= self._values["payload_time"]
        if not (is_set or is_due):
            return
        self._is_payload_due = False
        if self._payload == self._record.payload:
            return
        self._simulator.attach(self._payload)
        self._record.payload = self._payload
        self._node.get_logger().info(
            f"payload from {(self._taken + 1) * period:.3f} s on: {describe(self._payload)}"
        )

    def _on_reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success = True
        if self._record.is_waiting:
            answer.message = "at the beginning already, waiting for a controller"
        else:
            self._again.set()
            answer.message = "the motion begins anew"
        return answer

    def _on_pause(self, wish: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if wish.data:
            self._paused.set()
        else:
            self._paused.clear()
        answer.success = True
        answer.message = "paused" if wish.data else "running"
        return answer

    def _look(self) -> list[NodeStatus]:
        record, values = self._record, self._values
        found = [record.simulation(values["scenario"], self._schedule.late)]
        if self._commands is not None:
            counts = self._commands.counts
            found.append(record.commands(self._commands.source, self._commands.controllers, counts))
        return found


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``mujoco_bridge``."""
    sys.exit(
        run_node(
            "mujoco_bridge",
            lambda node, values, stop: construct(MujocoBridge, node, values, stop).run(stop),
            args,
            purpose="Publish a simulated robot on ROS 2 topics in real time.",
            parameters=PARAMETERS,
        )
    )
