"""The simulated robot on ROS 2 topics, in real time."""

import json
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from symbid_ros.arrays import FloatArray
from symbid_ros.package_paths import config_file
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.commands import (
    INTERNAL,
    TOPIC,
    UDP,
    CommandSource,
    command_source,
    counts_by_name,
)
from symbid_ros.ros.parameters import Parameter, options_from, parameters_of, watch
from symbid_ros.ros.process import construct, run_node
from symbid_ros.ros.reporting import ERROR, OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import PayloadFactory, Simulator

CATCH_UP = 0.1  # s; longer delays are not caught up
PAUSE_POLL = 0.02  # s between two checks whether a pause has ended
WARNING_PERIOD = 5.0  # s between two warnings of one kind
PARAMETERS = (
    *parameters_of(SimulateOptions),
    Parameter("model", "", "MJCF file of the robot; empty: the package's Symbitron."),
    Parameter(
        "command_source",
        INTERNAL,
        "Source of the drive commands: the scenario's own controller (internal), joint_command "
        "(topic), or UDP datagrams (udp).",
        choices=(INTERNAL, TOPIC, UDP),
    ),
    Parameter(
        "command_timeout",
        0.1,
        "Longest wait for a command before the drives apply safe torques, s of real time.",
        minimum=0.001,
        maximum=60.0,
    ),
    Parameter("udp_host", "127.0.0.1", "Address on which datagrams are received."),
    Parameter(
        "udp_port",
        5005,
        "Port on which datagrams are received; 0: any free port, shown on /diagnostics.",
        minimum=0,
        maximum=65535,
    ),
    Parameter(
        "udp_reply_port",
        0,
        "Port to which measurements are sent; 0: the port from which commands come.",
        minimum=0,
        maximum=65535,
    ),
    Parameter(
        "real_time_factor",
        1.0,
        "Simulated seconds per second, if the machine and the controller are fast enough.",
        minimum=0.01,
        maximum=100.0,
    ),
    Parameter(
        "clock_rate",
        100.0,
        "/clock messages per simulated second; 0: none.",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "ground_truth_rate",
        100.0,
        "Messages per simulated second on each ground_truth/ topic; 0: none.",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter("queue_depth", 5000, "Messages kept for a slow subscriber.", minimum=1),
    Parameter(
        "wait_for_subscribers",
        False,
        "Start when every sensor topic has its subscribers, so that no message is lost.",
    ),
    Parameter(
        "subscribers",
        1,
        "Number of subscribers that each sensor topic needs before the start.",
        minimum=1,
        maximum=100,
    ),
)


@dataclass
class FixedRate:
    """Deadlines at a fixed rate on the monotonic clock; ROS timers would skip ticks.

    Short delays are caught up. After a delay longer than `CATCH_UP`, caused by a pause, a restart
    or a slow controller, the loop continues at the fixed rate.

    Attributes
    ----------
    period_ns : float
        Real time from one deadline to the next, ns.
    late : int
        Number of deadlines missed by a period or more.
    elapsed_ns : int
        Time from each restart to the latest deadline, summed over the restarts.
    """

    period_ns: float
    late: int = 0
    elapsed_ns: int = 0
    _next: float = field(init=False)
    _last: int = field(init=False)

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Set the next deadline to now."""
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
    """Counts and state of the simulation."""

    starts: int = 0  # of the motion
    falls: int = 0  # motions that ended in a fall
    steps: int = 0  # simulated periods
    safe_steps: int = 0  # periods with safe torques, because no command arrived
    time: float = 0.0  # simulated time, s
    last_fall: str = ""  # cause and time of the latest fall
    payload: Payload | None = None  # that the robot carries
    is_waiting: bool = False  # whether simulated time waits for a controller
    is_paused: bool = False  # whether the service has paused it
    is_safe: bool = False  # whether the drives only brake

    def simulation_status(self, scenario: str, late_steps: int) -> NodeStatus:
        """Return the status of the simulation."""
        message = "running"
        if self.is_paused:
            message = "paused"
        elif self.is_waiting:
            message = "simulated time waits for a controller"
        if self.last_fall:
            message += f"; restarted after {self.last_fall}"
        values = {
            "scenario": scenario,
            "time": f"{self.time:.3f}",
            "steps": self.steps,
            "late_steps": late_steps,
            "starts": self.starts,
            "falls": self.falls,
            "payload": format_payload(self.payload),
        }
        return NodeStatus("simulation", WARN if self.last_fall else OK, message, values)

    def command_status(self, commands: CommandSource) -> NodeStatus:
        """Return the status of commands from an external controller."""
        level, message, controllers = OK, "commands are obeyed", commands.controllers
        if self.is_waiting:
            level, message = WARN, "waiting for a controller"
        elif self.is_safe:
            level, message = ERROR, "no command: the drives only brake"
        elif len(controllers) > 1:
            level, message = WARN, "several controllers send commands; stop all but one"
        values = {
            "source": commands.source,
            "controllers": ", ".join(controllers) or "none",
            "safe_steps": self.safe_steps,
        }
        return NodeStatus("commands", level, message, values | counts_by_name(commands.counts))


def format_payload(payload: Payload | None) -> str:
    """Return mass, link and position of a payload as text."""
    if payload is None:
        return "none"
    place = ", ".join(f"{coordinate:g}" for coordinate in payload.position)
    return f"{payload.mass:g} kg on {payload.link} at ({place}) m"


class MujocoBridge:
    """Steps the simulator in real time and publishes its measurements."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node, self._values = node, values
        self._model = Path(values["model"]) if values["model"] else None
        self._simulator = self._new_simulator()
        self._payloads = PayloadFactory(self._model)
        self._payload = self._payload_of(values)
        self._changes: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._reset, self._paused = Event(), Event()
        self._step = 0  # number of instants published since the start of this motion
        self._torques: FloatArray | None = None
        self._is_payload_due = True
        self._state = BridgeState()
        self._rate = FixedRate(self._simulator.period_ns / values["real_time_factor"])
        self._topics = BridgeTopics(node, self._simulator, values)
        self._commands = command_source(node, self._simulator, self._topics, values)
        watch(node, PARAMETERS, self._changes.put, self._payload_of)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(SetBool, "~/pause", self._on_pause)
        robot = (self._model or config_file("symbitron.xml")).stem
        self._status_publisher = StatusPublisher(node, self._current_status, robot)

    def _new_simulator(self) -> Simulator:
        """Return a simulator at the start of the motion and without payload."""
        return Simulator(
            options_from(SimulateOptions, self._values),
            model_path=self._model,
            is_commanded=self._values["command_source"] != INTERNAL,
        )

    def _payload_of(self, values: Mapping[str, Any]) -> Payload | None:
        return self._payloads.payload(
            values["payload_link"], values["payload_mass"], values["payload_position"]
        )

    def run(self, stop: Event) -> None:
        """Run the motion to its end or until stopped, then print counts as JSON."""
        if self._values["wait_for_subscribers"]:
            self._topics.await_subscribers(stop, self._values["subscribers"])
        self._run_motion(stop)
        self._topics.await_acknowledgement(stop)
        state = self._state
        simulated = state.steps * self._simulator.period_ns
        elapsed = self._rate.elapsed_ns
        summary: dict[str, Any] = {
            "published": self._topics.counts,
            "steps": state.steps,
            "late_steps": self._rate.late,
            "real_time_factor": round(simulated / elapsed, 4) if elapsed else 0.0,
        }
        if self._commands is not None:
            given = {"starts": state.starts, "falls": state.falls, "safe": state.safe_steps}
            summary["commands"] = given | counts_by_name(self._commands.counts)
        print(json.dumps(summary), flush=True)

    def _run_motion(self, stop: Event) -> None:
        self._start(stop)
        while not stop.is_set() and (
            self._commands is not None or self._step < self._simulator.steps
        ):
            if self._reset.is_set():
                self._node.get_logger().info(f"reset at {self._state.time:.3f} s on request")
                self._state.last_fall = ""
                self._restart(stop)
            if self._paused.is_set():
                self._wait_while_paused(stop)
                continue
            self._attach_payload()
            try:
                instant = self._simulator.step(self._torques)
            except RobotFailureError as fall:
                if self._commands is None:
                    raise
                self._record_fall(fall)
                self._restart(stop)
                continue
            self._rate.wait()
            self._publish(instant)
            if self._commands is not None:
                self._obey(self._commands, instant, stop)

    def _start(self, stop: Event) -> None:
        """Start the motion; with an external controller, first wait for it."""
        state = self._state
        self._step, self._torques = 0, None
        self._is_payload_due, state.payload = True, None
        state.starts += 1
        state.is_safe = False
        self._reset.clear()
        if self._commands is not None:
            state.is_waiting = True
            self._node.get_logger().info(f"waiting for a controller: {self._commands.source}")
            self._commands.await_controller(stop)
        self._rate.restart()

    def _restart(self, stop: Event) -> None:
        self._simulator = self._new_simulator()
        self._start(stop)

    def _wait_while_paused(self, stop: Event) -> None:
        self._state.is_paused = True
        while self._paused.is_set() and not (stop.is_set() or self._reset.is_set()):
            stop.wait(PAUSE_POLL)
        self._state.is_paused = False
        self._rate.restart()

    def _record_fall(self, fall: RobotFailureError) -> None:
        self._state.falls += 1
        self._state.last_fall = f"{fall.cause} at {fall.time:.3f} s"
        self._node.get_logger().error(f"{self._state.last_fall}; the motion restarts")

    def _publish(self, instant: Instant) -> None:
        self._topics.publish(self._step, instant)
        self._step += 1
        self._state.steps += 1
        self._state.time = instant.stamp / 1e9

    def _obey(self, commands: CommandSource, instant: Instant, stop: Event) -> None:
        """Get the torques of the next period from a command source."""
        state = self._state
        command = commands.exchange(instant, stop)
        # Simulated time does not start before the first command.
        while state.is_waiting and command.is_safe and commands.await_controller(stop):
            command = commands.exchange(instant, stop)
        if state.is_waiting:
            state.is_waiting = False
            self._rate.restart()
        self._torques = command.torques
        state.safe_steps += command.is_safe
        if command.is_safe and not state.is_safe and not stop.is_set():
            self._node.get_logger().warning(
                f"no command for {self._values['command_timeout']:g} s at {state.time:.3f} s: "
                "the drives only brake until a command arrives",
                throttle_duration_sec=WARNING_PERIOD,
            )
        state.is_safe = command.is_safe

    def _attach_payload(self) -> None:
        """Attach the payload when it is due, or immediately if its parameters have changed."""
        period = self._simulator.period_ns / 1e9
        is_set = not self._changes.empty()
        while not self._changes.empty():
            self._payload = self._payload_of(self._changes.get())
        is_due = self._is_payload_due and self._step * period >= self._values["payload_time"]
        if not (is_set or is_due):
            return
        self._is_payload_due = False
        if self._payload == self._state.payload:
            return
        self._simulator.attach(self._payload)
        self._state.payload = self._payload
        self._node.get_logger().info(
            f"payload from {(self._step + 1) * period:.3f} s on: {format_payload(self._payload)}"
        )

    def _on_reset(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success = True
        if self._state.is_waiting:
            answer.message = "already at the start, waiting for a controller"
        else:
            self._reset.set()
            answer.message = "the motion restarts"
        return answer

    def _on_pause(self, request: SetBool.Request, answer: SetBool.Response) -> SetBool.Response:
        if request.data:
            self._paused.set()
        else:
            self._paused.clear()
        answer.success = True
        answer.message = "paused" if request.data else "running"
        return answer

    def _current_status(self) -> list[NodeStatus]:
        state, values = self._state, self._values
        found = [state.simulation_status(values["scenario"], self._rate.late)]
        if self._commands is not None:
            found.append(state.command_status(self._commands))
        return found


def main() -> int:
    """Run the node ``mujoco_bridge`` and return its exit status."""
    return run_node(
        "mujoco_bridge",
        lambda node, values, stop: construct(MujocoBridge, node, values, stop).run(stop),
        purpose="Publish the measurements of a simulated robot on ROS 2 topics in real time.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
