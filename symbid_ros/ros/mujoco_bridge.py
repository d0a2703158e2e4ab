"""The simulated robot on ROS 2 topics, in real time."""

import json
import sys
from collections.abc import Sequence
from queue import SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from symbid_ros.arrays import FloatArray
from symbid_ros.ros.bridge_health import BridgeRecord, describe, figures
from symbid_ros.ros.bridge_parameters import (
    PARAMETERS,
    PayloadParameters,
    robot_name,
    simulator_from,
)
from symbid_ros.ros.bridge_topics import BridgeTopics
from symbid_ros.ros.command_source import CommandSource, command_source
from symbid_ros.ros.health import Health, HealthPublisher
from symbid_ros.ros.pacing import Schedule
from symbid_ros.ros.parameters import watch
from symbid_ros.ros.process import built, run_node
from symbid_ros.simulation.plant import BreakdownError
from symbid_ros.simulation.sensors import Instant

LOOK_PERIOD = 0.02  # s between two looks at whether a pause is over
WARNING_PERIOD = 5.0  # s between two warnings of one kind


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
        self._record = BridgeRecord()
        self._schedule = Schedule(self._simulator.period_ns / values["real_time_factor"])
        self._topics = BridgeTopics(node, self._simulator, values)
        self._commands = command_source(node, self._simulator, self._topics, values)
        watch(node, PARAMETERS, self._changes.put, self._payloads.require)
        node.create_service(Trigger, "~/reset", self._on_reset)
        node.create_service(SetBool, "~/pause", self._on_pause)
        self._health = HealthPublisher(node, self._look, robot_name(values))

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
            except BreakdownError as fall:
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
            self._node.get_logger().info(f"waiting for a controller: {self._commands.place}")
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

    def _note_fall(self, fall: BreakdownError) -> None:
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

    def _look(self) -> list[Health]:
        record, values = self._record, self._values
        found = [record.simulation(values["scenario"], self._schedule.late)]
        if self._commands is not None:
            counts = self._commands.counts
            found.append(record.commands(self._commands.place, self._commands.controllers, counts))
        return found


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``mujoco_bridge``."""
    sys.exit(
        run_node(
            "mujoco_bridge",
            lambda node, values, stop: built(MujocoBridge, node, values, stop).run(stop),
            args,
            purpose="Publish a simulated robot on ROS 2 topics in real time.",
            parameters=PARAMETERS,
        )
    )
