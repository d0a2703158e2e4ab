"""Reading and checking of a robot, a log and all that options name, before any method is chosen."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.choices import SLIDING_TERMS, Method
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import reversed_sensors, unnamed_sensors
from symbid_ros.dynamics.regressor import Samples
from symbid_ros.errors import DataError, EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.constraints import mirror_rows, total_mass_row
from symbid_ros.estimation.estimate import RowSettings
from symbid_ros.estimation.information import INCOMPATIBLE
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import (
    Prior,
    absolute_model_prior,
    load_prior,
    model_prior,
)
from symbid_ros.estimation.provenance import InputDigests, Provenance
from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.identification.calibration import (
    SensorErrorRequest,
    Tare,
    calibrate,
    read_tare,
    with_fixed_gains,
    without_terms,
)
from symbid_ros.identification.contacts import with_contact_options
from symbid_ros.identification.couplings import find_couplings
from symbid_ros.identification.dataset import (
    AlignedLog,
    ChainedSegments,
    Dataset,
    Processing,
    fold_dataset,
    read_dataset,
)
from symbid_ros.identification.drive_gains import (
    ConvertedSegments,
    InitialFactors,
    initial_factors,
    named_joints,
)
from symbid_ros.identification.joint_terms import candidate_prior, choose_terms, rows_of
from symbid_ros.identification.log_checks import NO_CHECKS, LogChecks, check_dataset
from symbid_ros.identification.options import IdentifyOptions, Source
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.result_files import check_output
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.load import model_files
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload, with_payloads
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import reversed_sensor
from symbid_ros.signals.log import Log
from symbid_ros.signals.sensor_errors import DRIVE_GAIN

logger = logging.getLogger(__name__)

ALIKE = "identify both with the same model, joint terms and sensor errors"

# Standard deviations between weighed mass and prior beyond which one of them must be wrong.
CONTRADICTION = 6.0


@dataclass(frozen=True)
class LoadedProblem:
    """All inputs of an identification, to be solved with any method and any prior.

    Attributes
    ----------
    options : IdentifyOptions
    inputs : tuple of str
        Input files, recorded in the estimate.
    columns : ParameterSet
        The columns of the data: the robot's parameters and all joint terms that may be chosen.
    prior : Prior
        Of these.
    dataset : Dataset
        The log.
    solver : Solver
    validation : Dataset or None
        Log on which the number of singular values is chosen.
    tares : mapping of str to Tare
        By frame of the wrench sensor.
    checks : LogChecks
        What the checks of the log found.
    digests : InputDigests or None
        Checksums of the input files, which a thread computes.
    """

    options: IdentifyOptions
    inputs: tuple[str, ...]
    columns: ParameterSet
    prior: Prior
    dataset: Dataset
    solver: Solver
    validation: Dataset | None
    tares: Mapping[str, Tare]
    checks: LogChecks = NO_CHECKS
    digests: InputDigests | None = None

    @property
    def parameters(self) -> ParameterSet:
        """The p parameters to identify."""
        return self.solver.problem.parameters

    def with_prior(
        self,
        prior: Prior,
        options: IdentifyOptions | None = None,
        tares: Mapping[str, Tare] | None = None,
    ) -> "LoadedProblem":
        """Return the same log with another prior and, if given, other options and tares."""
        options = options or self.options
        tares = self.tares if tares is None else tares
        solver = _build_solver(
            options,
            self.inputs,
            self.columns,
            prior,
            dataset=self.dataset,
            tares=tares,
            checks=self.checks,
        )
        return replace(self, options=options, prior=prior, solver=solver, tares=tares)

    def on_dataset(self, dataset: Dataset) -> "LoadedProblem":
        """Return the same problem with another log of the same columns."""
        solver = _build_solver(
            self.options,
            self.inputs,
            self.columns,
            self.prior,
            dataset=dataset,
            tares=self.tares,
            checks=self.checks,
        )
        return replace(self, dataset=dataset, solver=solver)

    def solve(self, method: Method | None = None) -> Identification:
        """Identify with one method, by default that of the options."""
        found = self._solve(method or self.options.method)
        options = self.options
        settings = RowSettings(
            options.row_filter, found.window or options.window, options.cutoff, options.channels
        )
        estimate = replace(found.estimate, rows=settings)
        if estimate.verdict is not None and (alarms := self.checks.alarms):
            verdict = estimate.verdict
            verdict = replace(verdict, alarms=(*alarms, *verdict.alarms))
            estimate = replace(estimate, verdict=verdict)
        return replace(found, estimate=estimate)

    def with_provenance(self, found: Identification, command: str = "") -> Identification:
        """Return an identification of this problem that names its inputs and options."""
        files = () if self.digests is None else self.digests.wait()
        provenance = Provenance.now(files, self.options, command)
        return replace(found, estimate=replace(found.estimate, provenance=provenance))

    def _solve(self, method: Method) -> Identification:
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

    Options, small files and the folder ``out`` for the results are checked first, because reading
    the log takes long.

    Raises
    ------
    SymbidError
        When a file, the data or an option is invalid.
    """
    options = options or IdentifyOptions()
    robot = log.applied_to(robot)
    parameters = load_parameters(robot, options)
    prior = choose_prior(options, parameters)
    parameters = with_load_reference(parameters, prior, options)
    build_pseudo_measurements(options, parameters, prior)
    if out is not None:
        check_output(parameters, out)
    _check_sizes(options, parameters)
    tare = _open_logs(options.tare, log)
    chosen_on = () if options.choose_truncation is None else (options.choose_truncation,)
    other = next(iter(_open_logs(chosen_on, log)), None)
    for _, text in options.loaded_logs:
        Payload.parse(text, robot)
    digests = _digests(robot, options, log)
    dataset, streams = _read(log, options, parameters)
    if wrong := reversed_sensors(dataset.observations[0].rows, parameters):
        return load_problem(robot, log, _with_reversed(options, wrong, log.source), out)
    checks = _check(dataset, streams, options, parameters, prior)
    _require_rows(dataset, parameters.model)
    if options.unchecked:  # otherwise the checks have said so
        _report_unnamed_sensors(parameters.model, dataset)
    dataset, parameters = _with_loaded_logs(options, log, dataset, parameters)
    validation = None
    if other is not None:
        validation, streams = _read(other, options, parameters)
        _check(validation, streams, options, parameters, prior)
    tares = {frame: one for each in tare for frame, one in read_tare(each).items()}
    inputs = tuple(map(str, (*log.files, robot.source, *options.files)))
    solver = _build_solver(
        options, inputs, parameters, prior, dataset=dataset, tares=tares, checks=checks
    )
    if options.finds_couplings and (couplings := find_couplings(solver, dataset)):
        parameters = replace(parameters, couplings=couplings)
        processing = Processing.of(options)
        dataset = fold_dataset(dataset.segments, dataset.source, parameters, processing)
        solver = _build_solver(
            options, inputs, parameters, prior, dataset=dataset, tares=tares, checks=checks
        )
    return LoadedProblem(
        options, inputs, parameters, prior, dataset, solver, validation, tares, checks, digests
    )


def _digests(robot: RobotModel, options: IdentifyOptions, log: Log | None = None) -> InputDigests:
    """Start to compute the checksums of all input files."""
    logs = () if log is None else log.files
    return InputDigests((*logs, *model_files(Path(robot.source)), *options.files))


def _with_loaded_logs(
    options: IdentifyOptions, log: Log, dataset: Dataset, parameters: ParameterSet
) -> tuple[Dataset, ParameterSet]:
    """Return the log together with those of known payloads, and the parameters of all."""
    if not options.loaded_logs:
        return dataset, parameters
    model, logs = parameters.model, [dataset.segments]
    carried = [parameters.payloads]
    for source, text in options.loaded_logs:
        (further,) = _open_logs((source,), log)
        logs.append(AlignedLog(further, model))
        carried.append((Payload.parse(text, model),))
    segments = ChainedSegments(logs)
    payloads = tuple(
        replace(payload, start=start, stop=stop + 1)
        for some, (start, stop) in zip(carried, segments.spans, strict=True)
        for payload in some
    )
    parameters = replace(parameters, payloads=payloads)
    return fold_dataset(segments, dataset.source, parameters, Processing.of(options)), parameters


def _with_reversed(options: IdentifyOptions, wrong: Sequence[str], source: str) -> IdentifyOptions:
    """Return the options with the opposite sign of some wrist sensors, and log a warning."""
    frames = {one.removeprefix("-").partition(":")[0] for one in wrong}
    named = [
        reversed_sensor(one) if one.removeprefix("-").partition(":")[0] in frames else one
        for one in options.wrist_sensors
    ]
    logger.warning(
        "%s: the mass beyond %s would be negative, so its sign is reversed; give `wrist_sensor` %s",
        source,
        ", ".join(sorted(frames)),
        ",".join(named),
    )
    return replace(options, wrist_sensor=tuple(named))


def _require_rows(dataset: Dataset, model: RobotModel) -> None:
    """Raise an error if no row is usable, so that the data say nothing."""
    if any(np.any(one.counts) for one in dataset.observations):
        return
    why = "each needs an effort"
    if model.contacts is not None:
        why = (
            "with contacts of unknown wrench each needs the efforts of all joints that feel them; "
            "with neither efforts nor wrenches not even the robot's mass can be known"
        )
    raise DataError(
        f"{dataset.source}: no row of the equation of motion is usable: {why}; let the driver fill "
        "JointState.effort, or record the wrenches of all contacts",
        "E326",
    )


def _report_unnamed_sensors(model: RobotModel, dataset: Dataset) -> None:
    """Warn about wrench sensors that read the weight of a payload instead of a contact force."""
    for evidence in unnamed_sensors(model, dataset.samples):
        logger.warning(
            "%s: the force at %s is that of a body of %.3g kg fixed to it (%.0f %% of its "
            "variance); if it is a wrist sensor, give `wrist_sensor` %s",
            dataset.source,
            evidence.frame,
            abs(evidence.mass()[0]),
            100 * evidence.share,
            evidence.sensor,
        )


def load_information(
    robot: RobotModel, observations: tuple[Observations, ...], options: IdentifyOptions
) -> LoadedProblem:
    """Return the information of earlier logs as a problem without any further log.

    Raises
    ------
    SymbidError
        When the information is of another robot or other parameters, or an option is invalid or
        needs a log.
    """
    robot = with_contact_options(robot, options)
    parameters = load_parameters(robot, options)
    if options.chooses_terms:
        columns = _columns_of(robot, observations)
        parameters = replace(columns, link_side=parameters.link_side)
    observations = _with_columns(observations, parameters)
    _check_sizes(options, parameters)
    _check_layout(observations, parameters, "information")
    if any(len(one.layout.parameters) > len(parameters) for one in observations):
        raise EstimateError(
            "information: includes sensor errors, which belong to one log; identify that log "
            "without `sensor_errors` and `tare`",
            "E505",
        )
    for name in (
        "tare",
        "payload",
        "drive_gain",
        "choose_truncation",
        "sensor_std",
        "sensor_errors",
    ):
        if getattr(options, name):
            raise OptionError(f"`{name}` needs a log, not information; leave it out", "E503")
    prior = choose_prior(options, parameters)
    parameters = with_load_reference(parameters, prior, options)
    nothing = Dataset("information", (), Samples.none(robot.joint_names), observations)
    inputs = (robot.source, *map(str, options.files))
    solver = _build_solver(options, inputs, parameters, prior, dataset=nothing, tares={})
    digests = _digests(robot, options)
    return LoadedProblem(
        options, inputs, parameters, prior, nothing, solver, None, {}, digests=digests
    )


def load_parameters(robot: RobotModel, options: IdentifyOptions) -> ParameterSet:
    """Return the columns of the data, and warn about known joint terms of the model file."""
    robot = with_contact_options(robot, options)
    if options.chooses_terms and options.information is not None:
        parameters = _columns_of(robot, load_archive(options.information))
    else:
        parameters = ParameterSet(
            robot,
            options.terms,
            candidates=options.chooses_terms,
            couplings=tuple(Coupling.parse(one, robot) for one in options.couplings),
        )
    parameters = replace(
        parameters,
        link_side=_link_side(robot, options.effort_sides),
        payloads=tuple(Payload.parse(one, robot) for one in options.payloads),
    )
    for term, values in parameters.known_terms.items():
        stated = [
            name for name, value in zip(robot.joint_names, values, strict=True) if value != 0.0
        ]
        logger.warning(
            "%s states %s of %s, which is taken as known; add %s to `joint_terms` if it may be "
            "wrong",
            robot.source,
            f"{term} friction" if term in ("viscous", "coulomb") else term,
            ", ".join(stated),
            term,
        )
    return parameters


def _link_side(robot: RobotModel, sides: Mapping[str, str]) -> tuple[int, ...]:
    """Return the joints whose efforts are measured on the link's side."""
    for name in sides:
        if name and name not in robot.joint_names:
            raise OptionError(
                f"`effort_side`: {robot.source} has no joint {name!r}; name one of "
                f"{', '.join(robot.joint_names)}",
                "E501",
            )
    default = sides.get("", "motor")
    named = [sides.get(name, default) for name in robot.joint_names]
    return tuple(index for index, side in enumerate(named) if side == "link")


def _columns_of(robot: RobotModel, observations: Sequence[Observations]) -> ParameterSet:
    """Return the columns that observations have: those of candidate terms, or of given ones."""
    if any(one.slipping is not None for one in observations):
        names = observations[0].layout.parameters
        return replace(ParameterSet.of_names(robot, names), candidates=True)
    return ParameterSet.of_names(robot, observations[0].layout.parameters)


def _with_columns(
    observations: tuple[Observations, ...], parameters: ParameterSet
) -> tuple[Observations, ...]:
    """Return data of candidate terms for the terms that the user names; other data as they are."""
    named = parameters.names
    if parameters.candidates or any(
        one.slipping is None or not set(named) <= set(one.layout.parameters) for one in observations
    ):
        return observations
    slips = not SLIDING_TERMS.isdisjoint(parameters.terms)
    return tuple(one.restricted(named) for one in rows_of(observations, slips=slips))


def choose_prior(options: IdentifyOptions, parameters: ParameterSet) -> Prior:
    """Return the prior that the options name.

    Raises
    ------
    PriorError
        When the prior file is invalid or belongs to another robot.
    """
    if options.prior is not None:
        return load_prior(options.prior, parameters)
    if options.prior_absolute is not None:
        return absolute_model_prior(parameters, options.prior_absolute)
    if options.prior_percent is not None:
        return model_prior(parameters, options.prior_percent)
    return model_prior(parameters)


def with_load_reference(
    parameters: ParameterSet, prior: Prior, options: IdentifyOptions
) -> ParameterSet:
    """Return the parameters with the joints' load from a prior file, if there is one."""
    if options.prior is None:
        return parameters
    return replace(parameters, reference=prior.mean[: parameters.inertial])


def build_pseudo_measurements(
    options: IdentifyOptions, parameters: ParameterSet, prior: Prior
) -> PseudoMeasurements | None:
    """Return the weighed mass and the symmetry of left and right as pseudo-measurements.

    Raises
    ------
    EstimateError
        When the weighed mass contradicts the prior.
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
    if not rows:
        return None
    is_weighed = options.weighing is not None
    return PseudoMeasurements(np.concatenate(rows), np.concatenate(targets), is_weighed)


def merged_observations(
    first: tuple[Observations, ...],
    second: tuple[Observations, ...],
    named: str = "information",
) -> tuple[Observations, ...]:
    """Return the information of two runs together, for each window length that both have.

    Raises
    ------
    EstimateError
        When they differ in robot, parameters or windows, or share seconds of a log.
    """
    earlier = {one.window: one for one in second}
    now, before = (frozenset[int]().union(*(one.seconds for one in run)) for run in (first, second))
    if again := now & before:
        raise EstimateError(
            f"{named}: {len(again)} s of this log are in it already and would be counted twice; "
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


def _open_logs(sources: tuple[Source, ...], log: Log) -> list[Log]:
    """Return logs; all bags given by their paths form one log."""
    logs = [source for source in sources if isinstance(source, Log)]
    bags = tuple(source for source in sources if not isinstance(source, Log))
    return [*logs, *([log.other(bags)] if bags else [])]


def _check_sizes(options: IdentifyOptions, parameters: ParameterSet) -> None:
    """Check that a rank and an information file fit the parameters."""
    if options.rank is not None and options.rank > len(parameters):
        raise OptionError(
            f"`rank` {options.rank} exceeds {len(parameters)}, the number of parameters; choose "
            "a smaller one",
            "E501",
        )
    if options.information is not None:
        earlier = _with_columns(load_archive(options.information), parameters)
        _check_layout(earlier, parameters, str(options.information))


def _check_layout(
    observations: tuple[Observations, ...], parameters: ParameterSet, named: str
) -> None:
    p, coordinates = len(parameters), parameters.model.coordinates
    for one in observations:
        if (one.layout.parameters[:p], one.layout.coordinates) != (parameters.names, coordinates):
            raise EstimateError(f"{named}: {INCOMPATIBLE}; {ALIKE}", "E505")


def _build_solver(
    options: IdentifyOptions,
    inputs: tuple[str, ...],
    parameters: ParameterSet,
    prior: Prior,
    *,
    dataset: Dataset,
    tares: Mapping[str, Tare],
    checks: LogChecks = NO_CHECKS,
) -> Solver:
    prior = prior.for_columns(parameters)
    factors = _initial_factors(options, dataset, parameters, prior)
    problem = Problem(
        dataset.observations,
        parameters,
        prior,
        pseudo_measurements=build_pseudo_measurements(options, parameters, prior),
        is_empirical=options.is_empirical,
        inputs=inputs,
        force_scale_std=options.force_scale,
    )
    if parameters.candidates:
        scale = None if factors is None else factors.values
        prior = candidate_prior(prior, parameters, dataset.observations[0], scale)
        problem = replace(problem, prior=prior)
    if options.sensor_error_kinds or factors is not None:
        kinds = options.sensor_error_kinds + ((DRIVE_GAIN,) if factors is not None else ())
        request = SensorErrorRequest(kinds, tares, checks.mountings, factors)
        problem = calibrate(problem, dataset, request)
    if options.information is not None:
        earlier = _with_columns(load_archive(options.information), parameters)
        both = merged_observations(problem.observations, earlier, str(options.information))
        problem = replace(problem, observations=both)
    if parameters.candidates:
        choice = choose_terms(problem if factors is None else with_fixed_gains(problem))
        if factors is not None:
            problem = without_terms(problem, dataset, choice.free)
        problem = replace(choice.applied(problem), choice=choice)
    return Solver.of(problem)


def _read(
    log: Log, options: IdentifyOptions, parameters: ParameterSet
) -> tuple[Dataset, StreamChecks | None]:
    """Read a log; the checks of its streams are None if the options skip them."""
    checks = None if options.unchecked else StreamChecks(parameters.model)
    return read_dataset(log, parameters, Processing.of(options), checks), checks


def _initial_factors(
    options: IdentifyOptions, dataset: Dataset, parameters: ParameterSet, prior: Prior
) -> InitialFactors | None:
    """Return first guesses of the factors of efforts, if any is unknown."""
    joints = named_joints(options.drive_gains, parameters.model)
    if not joints:
        return None
    return initial_factors(dataset.segments, parameters, prior.mean, joints)


def _check(
    dataset: Dataset,
    streams: StreamChecks | None,
    options: IdentifyOptions,
    parameters: ParameterSet,
    prior: Prior,
) -> LogChecks:
    """Check a log as `symbid bag doctor` does; nothing happens without checks of its streams."""
    if streams is None:
        return NO_CHECKS
    factors = _initial_factors(options, dataset, parameters, prior)
    if factors is not None:
        dataset = replace(dataset, segments=ConvertedSegments(dataset.segments, factors.values))
    robot = with_payloads(parameters.apply(prior.mean), parameters.payloads)
    turns = "imu_mounting" in options.sensor_error_kinds
    return check_dataset(dataset, streams, robot, estimates_mounting=turns)
