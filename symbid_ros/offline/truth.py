"""Bags of a simulator with ground truth, read for an evaluation."""

from collections.abc import Sequence
from pathlib import Path

from symbid_ros.bags import read_streams, read_truth
from symbid_ros.identification.evaluation import TrueMotion, true_motion
from symbid_ros.identification.prediction import RealisticMotion, realistic_motion
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import CausalLowPass


def read_true_motion(bags: Sequence[Path], model: RobotModel) -> TrueMotion:
    """Read the ground truth of a simulated bag at the instants that have all of it.

    Raises
    ------
    BagError
        When the bag holds no ground truth, or its truth and its wrenches never coincide.
    """
    return true_motion(read_truth(bags), read_streams(bags), model)


def read_realistic_motion(
    bags: Sequence[Path], model: RobotModel, low_pass: CausalLowPass | None = None
) -> RealisticMotion:
    """Read a noisy simulated bag with ground truth, its velocities filtered by ``low_pass``.

    Raises
    ------
    BagError
        When the bag holds no ground truth, or none at the instants of the joint states.
    DataError
        When the bag of a floating robot has no IMU.
    """
    streams = read_streams(bags)
    return realistic_motion(read_truth(bags), streams, model, low_pass)
