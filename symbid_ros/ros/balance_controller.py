"""Balance control over topics: measurements in, torques out, no state shared with the plant."""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from rclpy.node import Node
from threadpoolctl import threadpool_limits

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.types import IMU, JOINT_STATE
from symbid_ros.ros.bridge_parameters import robot_name
from symbid_ros.ros.commands import CommandPublisher
from symbid_ros.ros.diagnostics import OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import built, run_node
from symbid_ros.ros.raw_subscription import DecodedMessage, DecodedSubscription, wait_for_any
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.standing_controller import StandingController

DEPTH = 1000  # messages
KEPT = 100  # stamps of one topic that the other may lag behind
# Beyond these no robot works, and a single such value would spoil the controller's filters.
LARGEST_POSITION, LARGEST_RATE = 1e6, 1e3  # rad, rad/s
UNIT = 0.9, 1.1  # norms of quaternions that are taken for orientations
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


@dataclass(frozen=True)
class BalanceFeedback:
    """Joints and IMU of one instant.

    Attributes
    ----------
    stamp : int
        ns.
    joint_position, joint_velocity : (J,) float64
        rad and rad/s.
    imu_orientation : (4,) float64
        Quaternion xyzw of the IMU in the world.
    imu_angular_velocity : (3,) float64
        In the IMU's axes, rad/s.
    """

    stamp: int
    joint_position: FloatArray
    joint_velocity: FloatArray
    imu_orientation: FloatArray
    imu_angular_velocity: FloatArray


class FeedbackSubscriber:
    """Subscribes to ``joint_states`` and ``imu/data`` and pairs them by their stamps.

    Parameters
    ----------
    node : Node
    joint_names : sequence of str
        Order of joint arrays; messages are read by name.

    Attributes
    ----------
    passed_over : int
        Instants that were never the newest: others came with them.
    refused : int
        Messages dropped as malformed or of another robot, and readings that are not finite.
    """

    def __init__(self, node: Node, joint_names: Sequence[str]) -> None:
        self._node, self._joint_names = node, tuple(joint_names)
        self._joints = DecodedSubscription(node, "joint_states", JOINT_STATE, DEPTH)
        self._imu = DecodedSubscription(node, "imu/data", IMU, DEPTH)
        self._waiting: tuple[dict[int, DecodedMessage], dict[int, DecodedMessage]] = ({}, {})
        self._layout: Layout | None = None
        self._refusal: DataError | None = None
        self.passed_over = self.refused = 0
        self._places: IntArray = np.arange(len(self._joint_names))

    def wait(self, seconds: float) -> None:
        """Sleep until a message comes, for so many seconds at most."""
        wait_for_any(self._node, [self._joints, self._imu], seconds)

    def newest(self) -> BalanceFeedback | None:
        """Return the readings last stamped of those that have arrived, if they are new.

        Those stamped before and after a clock that jumped back are never mixed up: whatever
        arrived before the last jump is forgotten.

        Raises
        ------
        DataError
            When a message was dropped since the last call because it is malformed, of another
            robot, or because its values are not finite. The next call returns what came with it.
        """
        self._take()
        if self._refusal is not None:
            refusal, self._refusal = self._refusal, None
            raise refusal
        joints, imu = self._waiting
        stamp = max(joints.keys() & imu.keys(), default=None)
        if stamp is None:
            return None
        pair = joints[stamp], imu[stamp]
        self.passed_over += sum(each < stamp for each in joints)
        for waiting in self._waiting:
            for done in [each for each in waiting if each <= stamp]:
                del waiting[done]
        return self._readings(stamp, *pair)

    def _take(self) -> None:
        """Keep what has arrived and could be of use; foreign messages displace nothing."""
        for mailbox, waiting in zip((self._joints, self._imu), self._waiting, strict=True):
            for payload in mailbox.payloads():
                try:
                    letter = mailbox.read(payload)
                    if mailbox is self._joints and letter.layout is not self._layout:
                        self._places, self._layout = self._find(letter.layout), letter.layout
                except DataError as error:
                    self.refused += 1
                    self._refusal = error
                else:
                    _keep(waiting, letter)

    def _readings(self, stamp: int, joints: DecodedMessage, imu: DecodedMessage) -> BalanceFeedback:
        if joints.layout is not self._layout:  # another one came in between
            self._places, self._layout = self._find(joints.layout), joints.layout
        readings = BalanceFeedback(
            stamp,
            joints.record["position"][0, self._places],
            joints.record["velocity"][0, self._places],
            imu.record["orientation"][0],
            imu.record["angular_velocity"][0],
        )
        fault = _fault(readings)
        if fault:
            self.refused += 1
            raise DataError(f"joint_states, imu/data: {fault} at {stamp / 1e9:.3f} s")
        return readings

    def _find(self, layout: Layout) -> IntArray:
        """Return where each joint lies in messages of a layout."""
        names = layout.text["name"]
        missing = sorted(set(self._joint_names) - set(names))
        if missing:
            raise DataError(
                f"joint_states: no joint {', '.join(missing)}; publish it or choose another model"
            )
        if {layout.dtype[field].shape for field in ("position", "velocity")} != {(len(names),)}:
            raise DataError(
                "joint_states: positions and velocities are not one for each name; publish both"
            )
        return np.array([names.index(name) for name in self._joint_names])


def _fault(readings: BalanceFeedback) -> str:
    """Return what is wrong with the values; empty if nothing is."""
    rates = np.concatenate([readings.joint_velocity, readings.imu_angular_velocity])
    norm = float(np.linalg.norm(readings.imu_orientation))
    values = (*readings.joint_position, *rates, norm)
    if not np.isfinite(values).all():
        return "NaN or infinite values"
    if np.abs(readings.joint_position).max() > LARGEST_POSITION:
        return f"positions above {LARGEST_POSITION:g} rad"
    if np.abs(rates).max() > LARGEST_RATE:
        return f"rates above {LARGEST_RATE:g} rad/s"
    if not UNIT[0] <= norm <= UNIT[1]:
        return f"orientation is not a unit quaternion (norm {norm:.3g})"
    return ""


def _keep(waiting: dict[int, DecodedMessage], letter: DecodedMessage) -> None:
    stamp = letter.stamp
    if waiting and stamp < max(waiting):
        waiting.clear()
    waiting[stamp] = letter
    if len(waiting) > KEPT:
        del waiting[min(waiting)]


@dataclass
class ControlCounts:
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
class AnswerTimes:
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
        self._intake = FeedbackSubscriber(node, self._controller.joint_names)
        self._publisher = CommandPublisher(node, self._controller.drive_names)
        self._record = ControlCounts()
        self._stamp = 0
        self._heard = float("-inf")
        self._pace = AnswerTimes()
        self._health = StatusPublisher(node, self._look, robot_name(values))

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

    def _answer(self, readings: BalanceFeedback) -> None:
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
        except RobotFailureError as error:
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

    def _look(self) -> list[NodeStatus]:
        pace, self._pace = self._pace, AnswerTimes()
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
        return [NodeStatus("control", level, message, values | self._figures())]


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
