"""Identification and evaluation of bags: logs, requests and ground truth."""

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from symbid_ros.bags import (
    bag_log,
    count_messages,
    join_names,
    read_streams,
    read_truth,
    read_wrench_frames,
)
from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.choices import Base
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.provenance import Provenance, option_values
from symbid_ros.identification.calibration.rigid_sensors import RigidSensors
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem, load_problem
from symbid_ros.identification.options import IdentifyOptions, PayloadSource
from symbid_ros.identification.predictions.evaluation import (
    Metrics,
    TrueMotion,
    check_true_robot,
    true_motion,
)
from symbid_ros.identification.predictions.evaluation import evaluate as evaluate_candidates
from symbid_ros.identification.predictions.realistic_prediction import (
    RealisticMotion,
    realistic_motion,
)
from symbid_ros.identification.result import Result
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.topics import Topic, TopicSelection, is_measured
from symbid_ros.messages.types import IMU, ODOMETRY, POSE, WRENCH
from symbid_ros.model.held_joints import with_held_joints
from symbid_ros.model.load import as_model, is_mjcf, load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import sensor_frame, with_wrist_sensors
from symbid_ros.options import chosen_options, robot_file_line
from symbid_ros.signals.filters import CausalLowPass
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import TimeRange
from symbid_ros.user_files import as_path

logger = logging.getLogger(__name__)


def load_bag(
    bags: str | Path | Sequence[str | Path],
    robot: RobotModel | str | Path | None = None,
    options: LogOptions | None = None,
    **fields: Any,
) -> Log:
    """Return the log in a bag; its messages are read when needed.

    Parameters
    ----------
    bags : str, Path or sequence of these
        A bag (folder or file), or several of one robot, in any order.
    robot : RobotModel, str or Path, optional
        Robot of the log, or its file; joints that the log lacks are held. By default the robot with
        which the log is used.
    options : LogOptions, optional
        Topics and part of the bag to read.
    **fields
        Fields of :class:`symbid_ros.LogOptions` instead, such as ``start=2.0``.

    Returns
    -------
    Log
        To be identified, diagnosed, validated or predicted; its bags are read then.

    Raises
    ------
    BagError
        When a bag of a floating robot is missing. Other errors of bags are raised where the log is
        used.
    ModelError
        When the model file is invalid.
    OptionError
        When an option is invalid.
    DataError
        When a bag is not given by its path.
    """
    given = list(bags) if isinstance(bags, Sequence) and not isinstance(bags, str) else [bags]
    paths = [as_path("a bag", one) for one in given]
    options = chosen_options(LogOptions, options, fields)
    if robot is None:
        return open_bags(paths, None, options)
    robot = as_model(robot)
    return open_bags(paths, robot, with_wrench_topics(options, robot, paths))


def open_bags(bags: Sequence[Path], robot: RobotModel | None, options: LogOptions) -> Log:
    """Return the log in bags with exactly the topics that options name."""
    topics, part = TopicSelection.of(options), TimeRange(options.start, options.end)
    return bag_log(bags, robot, topics, part)


def with_wrench_topics(
    options: LogOptions,
    robot: RobotModel,
    bags: Sequence[Path],
    *,
    has_contacts: bool = False,
    wrist_sensors: Sequence[str] = (),
) -> LogOptions:
    """Return options that name the wrench topics of a robot's log if no name tells them.

    Topics named ``wrench`` are used anyway. If a floating robot's log has none, all of that type
    are, unless contacts of unknown wrench are named. A wrist sensor's topic may have any name, if
    it has the sensor's frame.
    """
    if options.wrench_topic or not (robot.floating or wrist_sensors):
        return options
    counts = count_messages(bags)
    topics = sorted(
        topic.name
        for topic, count in counts.items()
        if count and topic.msgtype == WRENCH and is_measured(topic.name)
    )
    named = [name for name in topics if name.rsplit("/", 1)[-1] == "wrench"]
    if topics and not named and robot.floating and not has_contacts:
        logger.warning(
            "%s: no topic is named wrench, so %s count as the forces on the robot; give "
            "`wrench_topic` to choose, or %s",
            join_names(bags),
            ", ".join(topics),
            robot_file_line("wrench_topic", *topics),
        )
        return replace(options, wrench_topic=tuple(topics))
    more: list[str] = []
    if len(topics) > len(named) and wrist_sensors:
        mapping = SensorMapping.of(options)
        frames = {
            name: mapping.frame(frame) for name, frame in read_wrench_frames(bags, topics).items()
        }
        lacking = {sensor_frame(one) for one in wrist_sensors} - {
            frames.get(name) for name in named
        }
        more = [name for name in topics if frames.get(name) in lacking]
    return replace(options, wrench_topic=(*named, *more)) if more else options


def load_robot(model: Path, base: Base, bags: Sequence[Path]) -> RobotModel:
    """Load the model of the robot in bags; see :func:`with_likely_base`.

    Raises
    ------
    ModelError, BagError
        When the model or a bag cannot be read.
    """
    robot = load_model(model, base)
    return with_likely_base(robot, model, base, lambda: measured_types(count_messages(bags)))


def measured_types(topics: Iterable[Topic]) -> set[str]:
    """Return the types of topics that a robot would have, without a simulation's ground truth."""
    return {topic.msgtype for topic in topics if is_measured(topic.name)}


def with_likely_base(
    robot: RobotModel, model: Path, base: Base, types: Callable[[], AbstractSet[str]]
) -> RobotModel:
    """Return a robot whose base counts as fixed if it is an arm whose base nothing measures.

    All joints of an arm lie beyond a single one. Most URDF files of arms do not say that their base
    is fixed.

    Parameters
    ----------
    robot : RobotModel
        As read from the file ``model``.
    model : Path
    base : {"auto", "floating", "fixed"}
        Only "auto" leaves the base open.
    types : callable
        Returns the types of the log's topics.
    """
    on_base = [joint for joint in robot.joints if joint.parent == 0]
    if base != "auto" or not robot.floating or len(on_base) != 1 or is_mjcf(model):
        return robot
    if types() & {IMU, POSE, ODOMETRY}:
        return robot
    logger.warning(
        "%s: its base counts as fixed, because all its joints lie beyond %s and the log has "
        "neither an IMU nor a pose; give `base` fixed to say so",
        model,
        on_base[0].name,
    )
    return load_model(model, "fixed")


@dataclass(frozen=True)
class BagRequest:
    """Bags, a robot model and options: the input of `symbid identify` and of the node.

    Attributes
    ----------
    bags : tuple of Path
        Bags of one robot, in any order.
    model : Path
        URDF or MJCF; with a prior file, only its kinematics are used.
    options : IdentifyOptions
    log : LogOptions
        Topics and part of the bags.
    base : {"auto", "floating", "fixed"}
        Whether the base of a URDF may move.
    robot : RobotModel or None
        The robot in ``model``, once the request is completed.
    """

    bags: tuple[Path, ...]
    model: Path
    options: IdentifyOptions = field(default_factory=IdentifyOptions)
    log: LogOptions = field(default_factory=LogOptions)
    base: Base = "auto"
    robot: RobotModel | None = field(default=None, compare=False, repr=False)

    def completed(self) -> "BagRequest":
        """Return the request with what follows from the bags: base, topics of wrenches, payloads.

        A result records them, so that other logs can be compared with it.

        Raises
        ------
        ModelError, BagError
            When the model or a bag cannot be read.
        """
        bags, options = self._without_loaded_bags()
        robot = load_robot(self.model, self.base, bags)
        log = with_wrench_topics(
            self.log,
            robot,
            bags,
            has_contacts=bool(options.contacts),
            wrist_sensors=options.wrist_sensors,
        )
        is_open = self.base == "auto" and not is_mjcf(self.model)
        base = "fixed" if is_open and not robot.floating else self.base
        return replace(self, bags=bags, options=options, log=log, base=base, robot=robot)

    def _without_loaded_bags(self) -> tuple[tuple[Path, ...], IdentifyOptions]:
        """Return the bags without those that `payload` names; one is the log if no other is left.

        Users name such bags among the others, too.
        """
        loaded = {one.resolve() for one, _ in self.options.loaded_logs if isinstance(one, Path)}
        left = tuple(bag for bag in self.bags if bag.resolve() not in loaded)
        if left or not loaded:
            return left, self.options
        log = self.bags[0]
        payload: list[PayloadSource] = []
        for bag, text in self.options.loaded_logs:
            if not isinstance(bag, Path):
                payload.append((bag, text))
            else:
                payload.append(text if bag.resolve() == log.resolve() else f"{bag}:{text}")
        return (log,), replace(self.options, payload=(*self.options.payloads, *payload))

    def load(self, out: Path | None = None) -> LoadedProblem:
        """Read all inputs, after a check of the folder ``out`` for the results.

        Raises
        ------
        SymbidError
            When a file, the data or an option is invalid.
        """
        if self.robot is None:
            return self.completed().load(out)
        log = open_bags(self.bags, self.robot, self.log)
        return load_problem(self.robot, log, self.options, out)

    def attributed(
        self, found: Identification, command: str, files: Sequence[Path] = ()
    ) -> Identification:
        """Return an identification that also names the command, these options and further files."""
        provenance = found.estimate.provenance or Provenance()
        options = option_values(self.log) | {"base": self.base}
        provenance = provenance.extended(command, files, options)
        return replace(found, estimate=replace(found.estimate, provenance=provenance))


def read_true_motion(
    bags: Sequence[Path], model: RobotModel, internal: Collection[str] = ()
) -> TrueMotion:
    """Read the ground truth of a simulated bag at the stamps that all its topics share.

    ``internal`` names the frames of wrist sensors, whose wrenches are internal to the robot.

    Raises
    ------
    BagError
        When the bag has no ground truth, or none at the stamps of the wrenches.
    """
    return true_motion(read_truth(bags), read_streams(bags), model, internal)


def read_realistic_motion(
    bags: Sequence[Path],
    model: RobotModel,
    low_pass: CausalLowPass | None = None,
    internal: Collection[str] = (),
) -> RealisticMotion:
    """Read a noisy simulated bag with ground truth, its velocities filtered by ``low_pass``.

    ``internal`` names the frames of wrist sensors, whose wrenches are internal to the robot.

    Raises
    ------
    BagError
        When the bag has no ground truth, or none at the stamps of the joint states.
    DataError
        When the base floats and the bag has no IMU.
    """
    streams = read_streams(bags)
    return realistic_motion(read_truth(bags), streams, model, low_pass, internal)


@on_one_blas_thread
def evaluate(robot: RobotModel, result: Result, bags: str | Path | Sequence[str | Path]) -> Metrics:
    """Compare an identified robot with the true robot of a simulation.

    A robot that does not explain the forces of the bag is named in a warning.

    Parameters
    ----------
    robot : RobotModel
        The true robot.
    result : Result
    bags : str, Path or sequence of these
        Simulated bag with ground truth, preferably of another motion than the identified log.

    Returns
    -------
    Metrics
        Errors of the identified robot, in SI units and percent.

    Raises
    ------
    BagError, EstimateError
        When the bag has no ground truth, or the result is of another robot.
    """
    robot.require_mass()
    estimate = result.estimate
    robot = with_held_joints(robot, estimate.held_joints)
    divided = with_wrist_sensors(robot, estimate.wrist_sensors)
    parameters = estimate.parameters_of(divided)
    if parameters.names != estimate.names:
        raise EstimateError(
            f"result: its parameters, of model {estimate.model!r}, are not those of "
            f"{robot.source}; give the model it was identified with",
            "E512",
        )
    paths = [bags] if isinstance(bags, str | Path) else bags
    motion = read_true_motion([Path(one) for one in paths], robot, divided.wrist_sensors)
    check_true_robot(robot, motion)
    rigid = RigidSensors.of(parameters)
    candidates = {"result": rigid.matrix @ estimate.value}
    truth = rigid.matrix @ parameters.values
    return evaluate_candidates(rigid.parameters, candidates, truth, motion)["result"]
