"""The simulated robot on ROS 2 topics, in real time."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

from rclpy.node import Node

from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.ros.process import run_node
from symbid_ros.ros.publishing import (
    InstantPublisher,
    await_acknowledgement,
    await_subscribers,
    clock_topic,
)
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.topics import sensor_topics, truth_topics

PARAMETERS = (
    Parameter(
        "scenario",
        "smooth",
        "What the robot does.",
        choices=("smooth", "squat", "vibrating", "suspended", "tare"),
    ),
    Parameter(
        "moves",
        20,
        "Number of moves, of the centre of mass or the hook; a tare has none.",
        minimum=1,
    ),
    Parameter("motion_seed", 0, "Draws the moves; the same seed moves the same.", minimum=0),
    Parameter("noise_seed", 0, "Draws the sensor noise.", minimum=0),
    Parameter("ideal", False, "Publish noise-free sensors; the motion stays the same."),
    Parameter("friction", False, "Give the joints friction and armature, as friction.yaml says."),
    Parameter("friction_file", "", "Other YAML file of friction; implies friction."),
    Parameter("errors", "", "Systematic errors: typical, or names with commas; empty for none."),
    Parameter("error_seed", 0, "Draws the systematic errors.", minimum=0),
    Parameter("model", "", "MJCF file of the robot; empty for the package's Symbitron."),
    Parameter("noise", "", "YAML file of sensor noise; empty for the package's noise.yaml."),
    Parameter(
        "real_time_factor",
        1.0,
        "Simulated seconds per second, if the machine keeps up.",
        minimum=0.01,
        maximum=100.0,
    ),
    Parameter(
        "clock_rate", 100.0, "/clock messages per simulated second; 0 for none.", minimum=0.0
    ),
    Parameter(
        "ground_truth_rate",
        100.0,
        "Messages per simulated second on each ground_truth/ topic; 0 for none.",
        minimum=0.0,
    ),
    Parameter("queue_depth", 1000, "Messages a slow subscriber may lag behind.", minimum=1),
    Parameter(
        "wait_for_subscribers",
        False,
        "Start to move once every sensor topic has a subscriber, so that nothing is lost.",
    ),
)


@dataclass(frozen=True)
class Pace:
    """How a run kept to its schedule: steps, of these late by a period or more, and seconds."""

    steps: int
    late_steps: int
    wall_time: float


class MujocoBridge:
    """Steps the simulator on schedule and publishes what it measures."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._simulator = Simulator(
            values["scenario"],
            moves=values["moves"],
            motion_seed=values["motion_seed"],
            noise_seed=values["noise_seed"],
            ideal=values["ideal"],
            friction=values["friction"],
            errors=values["errors"],
            error_seed=values["error_seed"],
            model_path=_path(values["model"]),
            noise_path=_path(values["noise"]),
            friction_path=_path(values["friction_file"]),
        )
        self._real_time_factor: float = values["real_time_factor"]
        self._is_patient: bool = values["wait_for_subscribers"]
        depth = values["queue_depth"]
        self._sensors = [
            InstantPublisher.create(node, topic, every=topic.every, depth=depth)
            for topic in sensor_topics(self._simulator)
        ]
        self._others = []
        for rate, topics in (
            ("clock_rate", [clock_topic()]),
            ("ground_truth_rate", truth_topics(self._simulator)),
        ):
            every = self._steps_between(rate, values[rate])
            if every:
                self._others += [
                    InstantPublisher.create(node, topic, every=every, depth=depth)
                    for topic in topics
                ]

    def run(self, stop: Event) -> None:
        """Play the motion to its end or until stopped, then say what was published."""
        if self._is_patient:
            await_subscribers(self._sensors, self._others, stop)
        pace = self._play(stop)
        publishers = [*self._sensors, *self._others]
        await_acknowledgement(publishers)
        simulated = pace.steps * self._simulator.period_ns / 1e9
        summary = {
            "published": {entry.publisher.topic_name: entry.count for entry in publishers},
            "steps": pace.steps,
            "late_steps": pace.late_steps,
            "real_time_factor": round(simulated / pace.wall_time, 4) if pace.wall_time else 0.0,
        }
        print(json.dumps(summary), flush=True)

    def _play(self, stop: Event) -> Pace:
        # A ROS timer skips ticks: deadlines on the monotonic clock do not.
        period = self._simulator.period_ns / self._real_time_factor
        publishers = [*self._sensors, *self._others]
        late = step = 0
        start = time.monotonic_ns()
        while step < self._simulator.steps and not stop.is_set():
            instant = self._simulator.step()
            ahead = start + step * period - time.monotonic_ns()
            if ahead > 0:
                time.sleep(ahead / 1e9)
            elif -ahead >= period:
                late += 1
            for publisher in publishers:
                publisher.publish(step, instant)
            step += 1
        return Pace(step, late, (time.monotonic_ns() - start) / 1e9)

    def _steps_between(self, name: str, rate: float) -> int:
        """Return how many steps lie between two messages, 0 for no message."""
        if not rate:
            return 0
        every = 1e9 / (rate * self._simulator.period_ns)
        if every < 1 or abs(every - round(every)) > 1e-6:
            highest = 1e9 / self._simulator.period_ns
            raise ParameterError(
                f"parameter {name}: {rate:g} does not divide the simulation's rate; "
                f"give {highest:g} divided by a whole number"
            )
        return round(every)


def _path(value: str) -> Path | None:
    return Path(value) if value else None


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``mujoco_bridge``."""
    sys.exit(
        run_node(
            "mujoco_bridge",
            lambda node, values, stop: MujocoBridge(node, values).run(stop),
            args,
            purpose="Publish a simulated robot on ROS 2 topics in real time.",
            parameters=PARAMETERS,
        )
    )
