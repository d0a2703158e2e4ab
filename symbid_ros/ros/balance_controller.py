"""Balance over topics: measurements in, torques out, nothing shared with the plant."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any

from rclpy.node import Node
from threadpoolctl import threadpool_limits

from symbid_ros.errors import DataError
from symbid_ros.ros.bridge_parameters import robot_name
from symbid_ros.ros.commands import CommandPublisher
from symbid_ros.ros.health import OK, WARN, Health, HealthPublisher
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import built, run_node
from symbid_ros.ros.readings import Readings, ReadingsIntake
from symbid_ros.simulation.plant import BreakdownError
from symbid_ros.simulation.standing_controller import StandingController

LISTEN = 0.05  # s; how soon a signal to stop is seen
SILENCE = 0.5  # s without a measurement after which that is said
WARNING_PERIOD = 5.0  # s between two warnings of one kind

PARAMETERS = (
    Parameter("scenario", "smooth", "What the robot does.", choices=("smooth", "squat")),
    Parameter("moves", 20, "Number of moves of the centre of mass.", minimum=1, maximum=100_000),
    Parameter("motion_seed", 0, "Draws the moves; the same seed moves the same.", minimum=0),
    Parameter(
        "model", "", "MJCF that the robot is believed to be; empty for the package's Symbitron."
    ),
)


@dataclass
class ControlRecord:
    """How the control has gone.

    Attributes
    ----------
    answered : int
        Measurements answered.
    unanswered : int
        Measurements for which there were no torques.
    restarts : int
        How often the clock jumped back.
    """

    answered: int = 0
    unanswered: int = 0
    restarts: int = 0


@dataclass
class Pace:
    """How long answers took since the last look.

    Attributes
    ----------
    count : int
    total, longest : float
        s.
    """

    count: int = 0
    total: float = 0.0
    longest: float = 0.0

    def add(self, seconds: float) -> None:
        """Note one answer."""
        self.count += 1
        self.total += seconds
        self.longest = max(self.longest, seconds)

    @property
    def mean_ms(self) -> float:
        """Mean, 0 without answers."""
        return 1e3 * self.total / self.count if self.count else 0.0

    @property
    def longest_ms(self) -> float:
        """Longest, ms."""
        return 1e3 * self.longest


class BalanceNode:
    """Answers the newest measurement with a command.

    Parameters
    ----------
    node : Node
    values : dict
        Of its parameters, declared.
    """

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        self._controller = StandingController(
            values["scenario"],
            moves=values["moves"],
            motion_seed=values["motion_seed"],
            model_path=Path(values["model"]) if values["model"] else None,
        )
        self._intake = ReadingsIntake(node, self._controller.joint_names)
        self._publisher = CommandPublisher(node, self._controller.drive_names)
        self._record = ControlRecord()
        self._stamp = 0
        self._heard = float("-inf")
        self._pace = Pace()
        self._health = HealthPublisher(node, self._look, robot_name(values))

    def run(self, stop: Event) -> None:
        """Answer measurements until stopped, then say how many."""
        while not stop.is_set():
            try:
                readings = self._intake.newest()
            except DataError as error:
                self._warn(f"not answered: {error}")
                continue
            if readings is None:
                self._intake.wait(LISTEN)
            else:
                self._answer(readings)
        print(json.dumps(self._figures()), flush=True)

    def _answer(self, readings: Readings) -> None:
        start = time.monotonic()
        if readings.stamp < self._stamp:
            self._record.restarts += 1
            self._node.get_logger().warning(
                f"the clock jumped back from {self._stamp / 1e9:.3f} s to "
                f"{readings.stamp / 1e9:.3f} s: the moves begin anew"
            )
        self._stamp, self._heard = readings.stamp, start
        try:
            torques = self._controller.torques(readings)
        except BreakdownError as error:
            self._record.unanswered += 1
            self._warn(f"not answered: {error}")
            return
        self._publisher.publish(readings.stamp, torques)
        self._record.answered += 1
        self._pace.add(time.monotonic() - start)

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=WARNING_PERIOD)

    def _figures(self) -> dict[str, int]:
        intake = self._intake
        return asdict(self._record) | {
            "unusable": intake.refused,
            "passed_over": intake.passed_over,
        }

    def _look(self) -> list[Health]:
        pace, self._pace = self._pace, Pace()
        level, message = OK, "measurements are answered"
        if time.monotonic() - self._heard > SILENCE:
            level, message = WARN, "no measurements on joint_states and imu/data"
        elif not pace.count:
            level, message = WARN, "measurements cannot be answered"
        values = {
            "motion_time": f"{self._stamp / 1e9:.3f}",
            "rate": pace.count,
            "mean_ms": f"{pace.mean_ms:.3f}",
            "longest_ms": f"{pace.longest_ms:.3f}",
        }
        return [Health("control", level, message, values | self._figures())]


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``balance_controller``."""
    threadpool_limits(1)
    sys.exit(
        run_node(
            "balance_controller",
            lambda node, values, stop: built(BalanceNode, node, values, stop).run(stop),
            args,
            purpose="Keep the robot in balance: joint_states and imu/data in, joint_command out.",
            parameters=PARAMETERS,
        )
    )
