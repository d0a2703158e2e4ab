"""Balance control over topics: measurements in, torques out, no state shared with the plant."""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from rclpy.node import Node
from threadpoolctl import threadpool_limits

from symbid_ros.arrays import IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.types import IMU, JOINT_STATE
from symbid_ros.package_paths import config_file
from symbid_ros.ros.commands import CommandPublisher
from symbid_ros.ros.model_source import ModelSource
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import construct, run_node
from symbid_ros.ros.raw_subscription import DecodedMessage, DecodedSubscription, wait_for_any
from symbid_ros.ros.reporting import OK, WARN, NodeStatus, StatusPublisher
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.sensors import BalanceFeedback
from symbid_ros.simulation.standing_controller import StandingController

DEPTH = 1000  # length of the queues, messages
MAX_UNPAIRED = 100  # messages that wait for the message of the other topic with the same stamp
# No robot reaches these values, and a single one would corrupt the controller's filters.
LARGEST_POSITION, LARGEST_RATE = 1e6, 1e3  # rad, rad/s
NORMS = 0.9, 1.1  # accepted norms of the orientation quaternion
STOP_POLL = 0.05  # s; longest delay until a stop signal is noticed
SILENCE = 0.5  # s without a measurement until the status becomes a warning
WARNING_PERIOD = 5.0  # s between two warnings of one kind
PARAMETERS = (
    Parameter("scenario", "smooth", "Motion of the robot.", choices=("smooth", "wide", "squat")),
    Parameter("moves", 20, "Number of moves of the centre of mass.", minimum=1, maximum=100_000),
    Parameter("motion_seed", 0, "Random seed of the moves.", minimum=0),
    Parameter(
        "model", "", "The controller's MJCF model of the robot; empty: the package's Symbitron."
    ),
    Parameter(
        "model_source",
        "file",
        "Where the robot's inertias come from: the file alone, or later also the topics of the "
        "node identifier, whose models are used when they can be trusted; moves then begin small "
        "and grow as the standard deviations of mass and centre of mass decrease.",
        choices=("file", "identifier"),
    ),
    Parameter(
        "largest_change",
        0.25,
        "Largest change of a torque by a new model, as a share of the drive's limit.",
        minimum=0.01,
        maximum=1.0,
    ),
)


class FeedbackSubscriber:
    """Subscribes to ``joint_states`` and ``imu/data`` and pairs messages with equal stamps.

    Messages may list the joints in any order.

    Attributes
    ----------
    skipped : int
        Instants skipped because a newer one had already arrived.
    rejected : int
        Messages that were malformed, from another robot or had invalid values.
    """

    def __init__(self, node: Node, joint_names: Sequence[str]) -> None:
        self._node, self._joint_names = node, tuple(joint_names)
        self._joints = DecodedSubscription(node, "joint_states", JOINT_STATE, DEPTH)
        self._imu = DecodedSubscription(node, "imu/data", IMU, DEPTH)
        self._unpaired: tuple[dict[int, DecodedMessage], dict[int, DecodedMessage]] = ({}, {})
        self._layout: Layout | None = None
        self._error: DataError | None = None
        self.skipped = self.rejected = 0
        self._indices: IntArray = np.arange(len(self._joint_names))

    def wait(self, timeout: float) -> None:
        """Sleep until the message that completes a pair may have arrived, at most ``timeout`` s.

        It waits for one topic at a time, since each wait costs some 20 µs of a period of 1 ms.
        """
        joints, imu = (max(unpaired, default=0) for unpaired in self._unpaired)
        wait_for_any(self._node, [self._joints if imu > joints else self._imu], timeout)

    def newest(self) -> BalanceFeedback | None:
        """Return the newest feedback if it has not been returned before.

        Messages from before and after a backward jump of the clock are never paired: the jump
        clears all earlier messages.

        Raises
        ------
        DataError
            When a message has been rejected since the last call. The next call returns the valid
            messages that arrived with it.
        """
        self._receive()
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        joints, imu = self._unpaired
        stamp = max(joints.keys() & imu.keys(), default=None)
        if stamp is None:
            return None
        pair = joints[stamp], imu[stamp]
        self.skipped += sum(each < stamp for each in joints)
        for messages in self._unpaired:
            for done in [each for each in messages if each <= stamp]:
                del messages[done]
        return self._feedback(stamp, *pair)

    def _receive(self) -> None:
        """Decode and store what has arrived; messages from other robots displace nothing."""
        for source, unpaired in zip((self._joints, self._imu), self._unpaired, strict=True):
            for payload in source.take():
                try:
                    message = source.decode(payload)
                    if source is self._joints:
                        self._use_layout(message.layout)
                except DataError as error:
                    self.rejected += 1
                    self._error = error
                else:
                    _store(unpaired, message)

    def _feedback(self, stamp: int, joints: DecodedMessage, imu: DecodedMessage) -> BalanceFeedback:
        self._use_layout(joints.layout)
        feedback = BalanceFeedback(
            stamp,
            joints.record["position"][0, self._indices],
            joints.record["velocity"][0, self._indices],
            imu.record["orientation"][0],
            imu.record["angular_velocity"][0],
        )
        fault = _find_fault(feedback)
        if fault:
            self.rejected += 1
            raise DataError(f"joint_states, imu/data: {fault} at {stamp / 1e9:.3f} s", "E815")
        return feedback

    def _use_layout(self, layout: Layout) -> None:
        """Look up the index of each joint in messages of a layout."""
        if layout is self._layout:
            return
        names = layout.text["name"]
        missing = sorted(set(self._joint_names) - set(names))
        if missing:
            raise DataError(
                f"joint_states: no joint {', '.join(missing)}; publish it or choose another model",
                "E814",
            )
        if {layout.dtype[field].shape for field in ("position", "velocity")} != {(len(names),)}:
            raise DataError(
                "joint_states: the numbers of names, positions and velocities differ; publish one "
                "position and one velocity for each name",
                "E814",
            )
        self._indices = np.array([names.index(name) for name in self._joint_names])
        self._layout = layout


def _find_fault(feedback: BalanceFeedback) -> str:
    """Return what is wrong with the values; empty if they are valid."""
    rates = np.concatenate([feedback.joint_velocity, feedback.imu_angular_velocity])
    norm = float(np.linalg.norm(feedback.imu_orientation))
    values = (*feedback.joint_position, *rates, norm)
    if not np.isfinite(values).all():
        return "NaN or infinite values"
    if np.abs(feedback.joint_position).max() > LARGEST_POSITION:
        return f"positions above {LARGEST_POSITION:g} rad"
    if np.abs(rates).max() > LARGEST_RATE:
        return f"rates above {LARGEST_RATE:g} rad/s"
    if not NORMS[0] <= norm <= NORMS[1]:
        return f"orientation is not a unit quaternion (norm {norm:.3g})"
    return ""


def _store(unpaired: dict[int, DecodedMessage], message: DecodedMessage) -> None:
    stamp = message.stamp
    if unpaired and stamp < max(unpaired):
        unpaired.clear()
    unpaired[stamp] = message
    if len(unpaired) > MAX_UNPAIRED:
        del unpaired[min(unpaired)]


class BalanceNode:
    """Answers the newest measurement with a torque command."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        model = Path(values["model"]) if values["model"] else None
        learns = values["model_source"] == "identifier"
        self._controller = StandingController(
            values["scenario"],
            moves=values["moves"],
            motion_seed=values["motion_seed"],
            model_path=model,
            is_cautious=learns,
        )
        self._subscriber = FeedbackSubscriber(node, self._controller.joint_names)
        self._publisher = CommandPublisher(node, self._controller.drive_names)
        self._models: ModelSource | None = None
        if learns:
            self._models = ModelSource(node, self._controller, values["largest_change"])
        # Measurements with and without an answer, and backward jumps of the clock.
        self._answers = {"answered": 0, "unanswered": 0, "restarts": 0}
        self._stamp = 0
        self._heard = float("-inf")
        self._times: list[float] = []  # computing times of the answers since the last status, s
        robot = (model or config_file("symbitron.xml")).stem
        self._status_publisher = StatusPublisher(node, self._current_status, robot)

    def run(self, stop: Event) -> None:
        """Answer measurements until stopped, then print the counts as JSON."""
        while not stop.is_set():
            try:
                feedback = self._subscriber.newest()
            except DataError as error:
                self._warn(f"not answered: {error}")
                continue
            if feedback is None:
                self._subscriber.wait(STOP_POLL)
            else:
                self._answer(feedback)
                if self._models is not None:
                    self._models.update()
        print(json.dumps(self._counts()), flush=True)

    def _answer(self, feedback: BalanceFeedback) -> None:
        start = time.monotonic()
        if feedback.stamp < self._stamp:
            self._answers["restarts"] += 1
            self._node.get_logger().warning(
                f"the clock jumped back from {self._stamp / 1e9:.3f} s to "
                f"{feedback.stamp / 1e9:.3f} s; the motion restarts"
            )
        self._stamp, self._heard = feedback.stamp, start
        try:
            torques = self._controller.torques(feedback)
        except RobotFailureError as error:
            self._answers["unanswered"] += 1
            self._warn(f"not answered: {error}")
            return
        self._publisher.publish(feedback.stamp, torques)
        self._answers["answered"] += 1
        self._times.append(time.monotonic() - start)

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=WARNING_PERIOD)

    def _counts(self) -> dict[str, int]:
        subscriber = self._subscriber
        return {
            **self._answers,
            "unusable": subscriber.rejected,
            "passed_over": subscriber.skipped,
        }

    def _current_status(self) -> list[NodeStatus]:
        times, self._times = self._times, []
        level, message = OK, "measurements are answered"
        if time.monotonic() - self._heard > SILENCE:
            level, message = WARN, "no measurements on joint_states and imu/data"
        elif not times:
            level, message = WARN, "measurements cannot be answered"
        values = {
            "motion_time": f"{self._stamp / 1e9:.3f}",
            "rate": len(times),
            "mean_ms": f"{1e3 * sum(times) / max(len(times), 1):.3f}",
            "longest_ms": f"{1e3 * max(times, default=0.0):.3f}",
        }
        control = NodeStatus("control", level, message, values | self._counts())
        return [control] if self._models is None else [control, self._models.status()]


def main() -> int:
    """Run the node ``balance_controller`` and return its exit status."""
    threadpool_limits(1)
    return run_node(
        "balance_controller",
        lambda node, values, stop: construct(BalanceNode, node, values, stop).run(stop),
        purpose="Balance the robot: read joint_states and imu/data, publish joint_command.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
