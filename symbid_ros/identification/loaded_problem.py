"""A log and a robot, read and checked once, to be solved with any method and any prior."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.choices import JOINT_TERMS, Method
from symbid_ros.diagnosis.findings import Finding, Kind
from symbid_ros.diagnosis.model_checks import check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stream_checks import StreamChecks, unusable
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError, EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.constraints import mirror_rows, total_mass_row
from symbid_ros.estimation.information import INCOMPATIBLE
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior, absolute_model_prior, load_prior, model_prior
from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.identification.calibration import Tare, Wanted, calibrate, read_tare
from symbid_ros.identification.dataset import Dataset, Processing, read_dataset
from symbid_ros.identification.options import IdentifyOptions, Source
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.result_files import check_output
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.log import Log

logger = logging.getLogger(__name__)

ALIKE = "identify both with the same model, joint terms and sensor errors"


@dataclass(frozen=True)
class LoadedProblem:
    """Everything that an identification reads, read.

    Attributes
    ----------
    options : IdentifyOptions
    inputs : tuple of str
        Files that the estimate comes from.
    parameters : ParameterSet
        The p parameters of the robot.
    prior : Prior
        Of these.
    dataset : Dataset
        The log.
    solver : Solver
    validation : Dataset or None
        Log on which to choose the number of singular values.
    tares : mapping of str to Tare
        What the unloaded wrench sensors read, by frame.
    """

    options: IdentifyOptions
    inputs: tuple[str, ...]
    parameters: ParameterSet
    prior: Prior
    dataset: Dataset
    solver: Solver
    validation: Dataset | None
    tares: Mapping[str, Tare]

    def under(
        self,
        prior: Prior,
        options: IdentifyOptions | None = None,
        tares: Mapping[str, Tare] | None = None,
    ) -> "LoadedProblem":
        """Return the same log under another prior and, if given, other options and tares."""
        options = options or self.options
        tares = self.tares if tares is None else tares
        solver = _solver(
            options, self.inputs, self.parameters, prior, dataset=self.dataset, tares=tares
        )
        return replace(self, options=options, prior=prior, solver=solver, tares=tares)

    def solve(self, method: Method | None = None) -> Identification:
        """Identify with one method; the one of the options by default."""
        method = method or self.options.method
        if method == "map_lmi":
            return self.solver.map_lmi()
        if method == "map":
            return self.solver.map()
        deviation = None
        if self.options.sensor_std is not None:
            sensors = SensorNoise(*self.options.sensor_std)
            deviation = sensor_row_std(self.parameters.model, self.dataset.samples, sensors)
        validation = () if self.validation is None else self.validation.observations
        truncation = Truncation(self.options.rank, validation, self.options.select_by)
        return self.solver.truncated(method, truncation, deviation)


def load_problem(
    robot: RobotModel,
    log: Log,
    options: IdentifyOptions | None = None,
    out: Path | None = None,
) -> LoadedProblem:
    """Read and check a log and everything that the options name.

    Small files, options and the folder ``out`` for the results are checked before the log is read,
    which takes long.

    Raises
    ------
    SymbidError
        When a file, the data or an option is invalid.
    """
    options = options or IdentifyOptions()
    parameters = load_parameters(robot, options)
    prior = prior_of(options, parameters)
    known_rows(options, parameters, prior)
    if out is not None:
        check_output(parameters, out)
    _check_sizes(options, parameters)
    tare = _opened(options.tare, log)
    (other,) = _opened((options.validate,), log) if options.validate else (None,)
    dataset = _checked_dataset(log, options, parameters, prior)
    validation = None if other is None else _checked_dataset(other, options, parameters, prior)
    tares = {frame: one for each in tare for frame, one in read_tare(each).items()}
    inputs = tuple(map(str, (*log.files, robot.source, *options.files)))
    solver = _solver(options, inputs, parameters, prior, dataset=dataset, tares=tares)
    return LoadedProblem(options, inputs, parameters, prior, dataset, solver, validation, tares)


def load_parameters(robot: RobotModel, options: IdentifyOptions) -> ParameterSet:
    """Return the parameters to identify, and warn of joint terms that the model file states."""
    parameters = ParameterSet(robot, options.terms)
    for term, values in parameters.known_terms.items():
        stated = [
            name for name, value in zip(robot.joint_names, values, strict=True) if value != 0.0
        ]
        flag = JOINT_TERMS[term].option
        logger.warning(
            "%s states %s of %s, which is taken as known; identify it with `%s` if it may be wrong",
            robot.source,
            f"{term} friction" if flag == "friction" else term,
            ", ".join(stated),
            flag,
        )
    return parameters


def _opened(sources: tuple[Source, ...], log: Log) -> list[Log]:
    """Return logs; bags given by their paths continue one another."""
    logs = [source for source in sources if isinstance(source, Log)]
    bags = tuple(source for source in sources if not isinstance(source, Log))
    return [*logs, *([log.other(bags)] if bags else [])]


def _checked_dataset(
    log: Log, options: IdentifyOptions, parameters: ParameterSet, prior: Prior
) -> Dataset:
    """Read a log and check it as `symbid bag doctor` does, unless the options skip that."""
    processing = Processing.of(options)
    if options.unchecked:
        return read_dataset(log, parameters, processing)
    checks = StreamChecks(parameters.model)
    dataset = read_dataset(log, parameters, processing, checks)
    examine(dataset, checks, parameters, prior)
    return dataset


def _check_sizes(options: IdentifyOptions, parameters: ParameterSet) -> None:
    """Refuse a rank and an information file that do not fit the parameters."""
    if options.rank is not None and options.rank > len(parameters):
        raise OptionError(
            f"`rank` {options.rank} exceeds {len(parameters)}, the number of parameters; choose "
            "a smaller one",
            "E501",
        )
    if options.information is not None:
        _check_layout(load_archive(options.information), parameters, str(options.information))


def _check_layout(
    observations: tuple[Observations, ...], parameters: ParameterSet, named: str
) -> None:
    p, coordinates = len(parameters), parameters.model.coordinates
    for one in observations:
        if (one.layout.parameters[:p], one.layout.coordinates) != (parameters.names, coordinates):
            raise EstimateError(f"{named}: {INCOMPATIBLE}; {ALIKE}", "E505")


def _solver(
    options: IdentifyOptions,
    inputs: tuple[str, ...],
    parameters: ParameterSet,
    prior: Prior,
    *,
    dataset: Dataset,
    tares: Mapping[str, Tare],
) -> Solver:
    known = known_rows(options, parameters, prior)
    problem = Problem(
        dataset.observations,
        parameters,
        prior,
        pseudo_measurements=known,
        empirical=options.is_empirical,
        inputs=inputs,
        has_wrenches=bool(dataset.samples.wrench_frames),
    )
    if options.sensor_error_kinds:
        wanted = Wanted(options.sensor_error_kinds, dict(tares))
        problem = problem.calibrated(calibrate(dataset, parameters, prior, wanted, known))
    if options.information is not None:
        earlier = load_archive(options.information)
        both = merged_observations(problem.observations, earlier, str(options.information))
        problem = replace(problem, observations=both)
    return Solver.of(problem)


def load_information(
    robot: RobotModel, observations: tuple[Observations, ...], options: IdentifyOptions
) -> LoadedProblem:
    """Return what earlier logs told, ready to be solved without any further log.

    Raises
    ------
    SymbidError
        When the information is of another robot or other parameters, or an option is invalid or
        needs a log.
    """
    parameters = load_parameters(robot, options)
    _check_sizes(options, parameters)
    _check_layout(observations, parameters, "information")
    if any(len(one.layout.parameters) > len(parameters) for one in observations):
        raise EstimateError(
            "information: sensor errors are among its unknowns, which belong to one log; identify "
            "that log without `sensor_errors` and `tare`",
            "E505",
        )
    for name in ("tare", "validate", "sensor_std", "sensor_errors"):
        if getattr(options, name):
            raise OptionError(f"`{name}` needs a log, not information; leave it out", "E503")
    prior = prior_of(options, parameters)
    nothing = Dataset("information", (), Samples.none(robot.joint_names), observations)
    inputs = (robot.source, *map(str, options.files))
    solver = _solver(options, inputs, parameters, prior, dataset=nothing, tares={})
    return LoadedProblem(options, inputs, parameters, prior, nothing, solver, None, {})


def merged_observations(
    first: tuple[Observations, ...],
    second: tuple[Observations, ...],
    named: str = "information",
) -> tuple[Observations, ...]:
    """Return what two runs tell together, for each length of window that both have.

    Raises
    ------
    EstimateError
        When they are of different robots, parameters or windows, or share seconds of a log.
    """
    earlier = {one.window: one for one in second}
    now, before = (frozenset[int]().union(*(one.seconds for one in run)) for run in (first, second))
    if again := now & before:
        raise EstimateError(
            f"{named}: holds {len(again)} s of this log already, which would be counted twice; "
            "leave `information` out, or name another log",
            "E506",
        )
    try:
        both = tuple(earlier[one.window].merge(one) for one in first if one.window in earlier)
    except DataError as error:
        raise EstimateError(f"{named}: {error}; {ALIKE}", "E505") from None
    if not both:
        raise EstimateError(
            f"{named}: its rows are averaged over other windows than those of this run; identify "
            "both with the same `filter` and `sensor_errors`",
            "E505",
        )
    return both


# A weighing this many standard deviations from the prior's mass is an error, not news.
CONTRADICTION = 6.0


def prior_of(options: IdentifyOptions, parameters: ParameterSet) -> Prior:
    """Return the prior that the options choose.

    Raises
    ------
    PriorError
        When the file of the prior is invalid or belongs to another robot.
    """
    if options.prior is not None:
        return load_prior(options.prior, parameters)
    if options.prior_absolute is not None:
        return absolute_model_prior(parameters, options.prior_absolute)
    if options.prior_percent is not None:
        return model_prior(parameters, options.prior_percent)
    return model_prior(parameters)


def known_rows(
    options: IdentifyOptions, parameters: ParameterSet, prior: Prior
) -> PseudoMeasurements | None:
    """Return the weighed mass and the symmetry of left and right as pseudo-measurements.

    Raises
    ------
    EstimateError
        When the weighing contradicts the prior.
    """
    rows, targets = [], []
    if options.weighing is not None:
        mass, std = options.weighing
        row, target = total_mass_row(parameters, mass, std)
        expected = row @ prior.mean * std
        spread = np.hypot(np.linalg.norm(row @ prior.covariance_factor()) * std, std)
        if abs(mass - expected) > CONTRADICTION * spread:
            raise EstimateError(
                f"a total mass of {mass:g} kg contradicts the prior, whose links weigh "
                f"{expected:.3g} ± {spread:.2g} kg together; check `total_mass` and the model",
                "E504",
            )
        rows.append(row[None])
        targets.append(np.array([target]))
    if options.mirror is not None:
        tied, zero = mirror_rows(parameters, prior.std, options.mirror)
        rows.append(tied)
        targets.append(zero)
    return PseudoMeasurements(np.concatenate(rows), np.concatenate(targets)) if rows else None


logger = logging.getLogger(__name__)


def examine(
    record: Dataset,
    checks: StreamChecks,
    parameters: ParameterSet,
    prior: Prior,
) -> None:
    """Warn of what is wrong with a record's streams, and between them and its model.

    Parameters
    ----------
    record : Dataset
        Its stretches are read once more if they are too long to be kept.
    checks : StreamChecks
        Of its streams.
    parameters : ParameterSet
        Of the job.
    prior : Prior
        Whose mean is taken for the robot, to ±25 %.

    Raises
    ------
    DataError
        When the record is unusable: a unit, sign, frame or mounting is wrong, a contact is
        missing, or a topic says next to nothing.
    """
    source = record.source
    of_streams = checks.findings(source)
    _refuse(source, of_streams)
    watch: ModelStatistics | None = None
    for segment in record.segments:
        if watch is None:
            robot = parameters.apply(prior.mean)
            watch = ModelStatistics(robot, segment.wrench_frames, segment.imu_frames)
        watch.add(segment)
    if watch is None:
        return
    found = check_model(
        watch,
        checks.joint_topic,
        checks.imu_topics,
        dict(zip(watch.gains.wrench_frames, checks.wrench_topics, strict=True)),
    ).findings
    _refuse(source, found)
    for finding in sorted([*of_streams, *found], key=lambda one: -one.severity):
        left_out = finding.kind in (Kind.FROZEN, Kind.SATURATED)
        also = "; those messages are left out" if left_out else ""
        logger.warning("%s: %s%s", source, finding.message, also)


def _refuse(source: str, findings: Sequence[Finding]) -> None:
    if wrong := unusable(findings):
        raise DataError(_refusal(source, wrong))


def _refusal(source: str, wrong: Sequence[Finding]) -> str:
    others = ", ".join(f"{one.kind.value} of {one.stream or 'all'}" for one in wrong[1:])
    also = f"; also {others}" if others else ""
    return f"{source}: {wrong[0].message}{also}; give `unchecked` to use the log anyway"
