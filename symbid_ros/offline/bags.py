"""Bags for the functions of the API: logs, requests for an identification, ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from symbid_ros.bags import bag_log, read_streams, read_truth
from symbid_ros.choices import Base
from symbid_ros.errors import EstimateError
from symbid_ros.identification.evaluation import Metrics, TrueMotion, true_motion
from symbid_ros.identification.evaluation import evaluate as evaluate_candidates
from symbid_ros.identification.loaded_problem import LoadedProblem, load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.realistic_prediction import RealisticMotion, realistic_motion
from symbid_ros.identification.result import Result
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import CausalLowPass
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import TimeRange


def load_bag(
    bags: str | Path | Sequence[str | Path],
    robot: RobotModel | None = None,
    options: LogOptions | None = None,
    **fields: Any,
) -> Log:
    """Return the log in a bag; its messages are read when they are needed.

    Parameters
    ----------
    bags : str, Path or sequence of these
        A bag (folder or file), or several that continue one another.
    robot : RobotModel, optional
        Whose joints must be in the log.
    options : LogOptions, optional
        Topics and part of the bag to read.
    **fields
        Fields of :class:`symbid_ros.LogOptions` instead, such as ``start=2.0``.

    Raises
    ------
    OptionError
        When an option is invalid.
    """
    options = options or LogOptions(**fields)
    paths = [bags] if isinstance(bags, str | Path) else bags
    topics, part = TopicSelection.of(options), TimeRange(options.start, options.end)
    return bag_log([Path(one) for one in paths], robot, topics, part)


@dataclass(frozen=True)
class BagRequest:
    """Bags and a robot model, and how to identify the robot from them.

    Attributes
    ----------
    bags : tuple of Path
        Bags that continue one another.
    model : Path
        URDF or MJCF; only its kinematics are used if there is a prior.
    options : IdentifyOptions
    log : LogOptions
        Topics and part of the bags.
    base : {"auto", "floating", "fixed"}
        Whether the base of a URDF may move.
    """

    bags: tuple[Path, ...]
    model: Path
    options: IdentifyOptions = field(default_factory=IdentifyOptions)
    log: LogOptions = field(default_factory=LogOptions)
    base: Base = "auto"

    def load(self, out: Path | None = None) -> LoadedProblem:
        """Read everything; the folder ``out`` for the results is checked first.

        Raises
        ------
        SymbidError
            When a file, the data or an option is invalid.
        """
        robot = load_model(self.model, self.base)
        return load_problem(robot, load_bag(self.bags, robot, self.log), self.options, out)


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
