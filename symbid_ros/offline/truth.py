"""Bags of a simulator with ground truth, read for an evaluation."""

from collections.abc import Sequence
from pathlib import Path

from symbid_ros.bags import read_streams, read_truth
from symbid_ros.errors import EstimateError
from symbid_ros.identification.evaluation import Metrics, TrueMotion, true_motion
from symbid_ros.identification.evaluation import evaluate as evaluate_candidates
from symbid_ros.identification.prediction import RealisticMotion, realistic_motion
from symbid_ros.identification.result import Result
from symbid_ros.model.parameters import ParameterSet
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


def evaluate(robot: RobotModel, result: Result, bags: str | Path | Sequence[str | Path]) -> Metrics:
    """Compare an identified robot with the true one of a simulation.

    Parameters
    ----------
    robot : RobotModel
        The true robot.
    result : Result
    bags : str, Path or sequence of these
        Simulated bag with ground truth, preferably of a motion not identified from.

    Raises
    ------
    BagError, EstimateError
        When the bag has no ground truth, or the result is of another robot.
    """
    estimate = result.estimate
    parameters = ParameterSet(robot, result.options.terms).with_known_values(estimate.known)
    if parameters.names != estimate.names:
        raise EstimateError(
            f"the result is of {estimate.model} and its parameters are not those of "
            f"{robot.source}; give the model it was identified with",
            "E512",
        )
    paths = [bags] if isinstance(bags, str | Path) else bags
    motion = read_true_motion([Path(one) for one in paths], robot)
    candidates = {"result": estimate.value}
    return evaluate_candidates(parameters, candidates, parameters.values, motion)["result"]
