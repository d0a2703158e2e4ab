"""Reading and checking of a robot, a log and all that options name, before any method is chosen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from symbid_ros.choices import SPRING, Method
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import reversed_sensors
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.estimate import RowSettings
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import (
    Prior,
)
from symbid_ros.estimation.provenance import InputDigests, Provenance
from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.identification.assumed_contacts import with_assumed_contacts
from symbid_ros.identification.base_gravity import with_found_gravity
from symbid_ros.identification.calibration import (
    SensorErrorRequest,
    calibrate,
    with_fixed_gains,
    without_terms,
)
from symbid_ros.identification.compliance import shows_compliance
from symbid_ros.identification.contacts import contact_alarms, with_robot_options
from symbid_ros.identification.couplings import find_couplings
from symbid_ros.identification.dataset import (
    Dataset,
    Processing,
    fold_dataset,
)
from symbid_ros.identification.drive_gains import (
    ConvertedSegments,
    InitialFactors,
    initial_factors,
    named_joints,
)
from symbid_ros.identification.fast_motion import with_fast_motion
from symbid_ros.identification.gain_iteration import identify_gains
from symbid_ros.identification.joint_terms import choose_terms
from symbid_ros.identification.log_checks import NO_CHECKS, LogChecks, ModelWatch, check_dataset
from symbid_ros.identification.log_reading import (
    open_logs,
    read_log,
    report_unnamed_sensors,
    require_rows,
    with_loaded_logs,
    with_reversed,
)
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.prior_options import (
    build_pseudo_measurements,
    choose_prior,
    load_parameters,
    with_load_reference,
)
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.result_files import check_output
from symbid_ros.identification.ripples import find_ripples
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.identification.springs import shows_springs
from symbid_ros.identification.stored_information import (
    check_layout,
    columns_of,
    merged_observations,
    with_columns,
)
from symbid_ros.identification.tares import Tare, read_tare
from symbid_ros.identification.term_priors import candidate_prior, named_term_prior
from symbid_ros.identification.warming import find_warming
from symbid_ros.model.load import model_files
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload, with_payloads
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.log import Log
from symbid_ros.signals.sensor_errors import COMPLIANCE, DRIVE_GAIN, PLACE

# Reads and checks a log on other machines, for the parameters and their prior.
LogReader = Callable[[IdentifyOptions, ParameterSet, Prior], tuple[Dataset, LogChecks]]


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
    is_trial : bool
        Whether only predictions are compared, for which slow motion suffices.
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
    is_trial: bool = False

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

    def trial_on(self, dataset: Dataset, columns: ParameterSet) -> "LoadedProblem":
        """Return the same problem with another log and its columns, solved to few digits."""
        solver = _build_solver(
            self.options,
            self.inputs,
            columns,
            self.prior,
            dataset=dataset,
            tares=self.tares,
            checks=self.checks,
            is_trial=True,
        )
        return replace(self, columns=columns, dataset=dataset, solver=solver, is_trial=True)

    def solve(self, method: Method | None = None) -> Identification:
        """Identify with one method, by default that of the options."""
        found = self._solve(method or self.options.method)
        options = self.options
        settings = RowSettings(
            options.row_filter, found.window or options.window, options.cutoff, options.channels
        )
        estimate = replace(found.estimate, rows=settings)
        count = self.parameters.inertial
        masses = self.prior.mean[:count:10], estimate.value[:count:10]
        alarms = (
            *self.checks.alarms,
            *self.solver.problem.alarms,
            *contact_alarms(self.parameters.model, *masses),
        )
        if estimate.verdict is not None and alarms:
            verdict = estimate.verdict
            verdict = replace(verdict, alarms=(*alarms, *verdict.alarms))
            estimate = replace(estimate, verdict=verdict)
        return replace(found, estimate=estimate)

    def with_provenance(self, found: Identification, command: str = "") -> Identification:
        """Return an identification of this problem that names its inputs and options."""
        files = () if self.digests is None else self.digests.wait()
        provenance = Provenance.now(files, self.options, command)
        return replace(found, estimate=replace(found.estimate, provenance=provenance))

    @cached_property
    def _complete_solver(self) -> Solver:
        """The solver, with motion that is faster than the windows."""
        return self.solver if self.is_trial else with_fast_motion(self.solver, self.dataset)

    def _solve(self, method: Method) -> Identification:
        if method == "map_lmi":
            return self._complete_solver.map_lmi()
        if method == "map":
            return self._complete_solver.map()
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
    read: LogReader | None = None,
) -> LoadedProblem:
    """Read and check a log and everything that the options name.

    Options, small files and the folder ``out`` for the results are checked first, because reading
    the log takes long. ``read`` reads it in place of this process.

    Raises
    ------
    SymbidError
        When a file, the data or an option is invalid.
    """
    options = options or IdentifyOptions()
    log = log.of_robot(robot)
    robot = log.applied_to(robot)
    if read is None and not options.tare:
        options = with_assumed_contacts(options, robot, log)
    parameters = load_parameters(robot, options)
    prior = choose_prior(options, parameters)
    parameters = with_load_reference(parameters, prior, options)
    build_pseudo_measurements(options, parameters, prior)
    if out is not None:
        check_output(parameters, out)
    _check_sizes(options, parameters)
    tare = open_logs(options.tare, log)
    chosen_on = () if options.choose_truncation is None else (options.choose_truncation,)
    other = next(iter(open_logs(chosen_on, log)), None)
    for _, text in options.loaded_logs:
        Payload.parse(text, robot)
    digests = _digests(robot, options, log)
    watch = None
    if read is None:
        watch = _watch(options, parameters, prior)
        dataset, streams = read_log(log, options, parameters, watch)
    else:
        (dataset, checks), streams = read(options, parameters, prior), None
    corrected = _corrected(options, parameters, dataset)
    if corrected is not options:
        return load_problem(robot, log, corrected, out, read)
    if read is None:
        checks = _check(dataset, streams, options, parameters, prior, watch=watch)
    require_rows(dataset, parameters.model)
    if options.unchecked:  # otherwise the checks have said so
        report_unnamed_sensors(parameters.model, dataset)
    dataset, parameters = with_loaded_logs(options, log, dataset, parameters)
    validation = None
    if other is not None:
        validation, streams = read_log(other, options, parameters)
        _check(validation, streams, options, parameters, prior)
    tares = {frame: one for each in tare for frame, one in read_tare(each).items()}
    inputs = tuple(map(str, (*log.files, robot.source, *options.files)))
    solver = _build_solver(
        options, inputs, parameters, prior, dataset=dataset, tares=tares, checks=checks
    )
    searched = _with_known_gains(options, parameters, prior, solver, dataset)
    for searches, find in (
        (options.finds_springs, _with_springs),
        (options.finds_couplings, _with_couplings),
        (options.finds_warming, _with_warming),
        (options.finds_ripples, _with_ripples),
    ):
        if not searches or (more := find(parameters, *searched)) is parameters:
            continue
        parameters, processing = more, Processing.of(options)
        dataset = fold_dataset(dataset.segments, dataset.source, parameters, processing)
        solver = _build_solver(
            options, inputs, parameters, prior, dataset=dataset, tares=tares, checks=checks
        )
        searched = _with_known_gains(options, parameters, prior, solver, dataset)
    if options.finds_compliance and shows_compliance(solver, dataset):
        options = replace(options, sensor_errors=(COMPLIANCE,))
        solver = _build_solver(
            options, inputs, parameters, prior, dataset=dataset, tares=tares, checks=checks
        )
    return LoadedProblem(
        options, inputs, parameters, prior, dataset, solver, validation, tares, checks, digests
    )


def _corrected(
    options: IdentifyOptions, parameters: ParameterSet, dataset: Dataset
) -> IdentifyOptions:
    """Return the options as the log says they should be; the same if it contradicts none."""
    if wrong := reversed_sensors(dataset.observations[0].rows, parameters):
        return with_reversed(options, wrong, dataset.source)
    if options.drive_gains:  # signs and units of the efforts are unknown
        return options
    return with_found_gravity(options, parameters.model, dataset.segments, dataset.source)


def _with_couplings(parameters: ParameterSet, solver: Solver, dataset: Dataset) -> ParameterSet:
    """Return the parameters with the couplings that a log shows."""
    found = find_couplings(solver, dataset)
    return replace(parameters, couplings=found) if found else parameters


def _with_springs(parameters: ParameterSet, solver: Solver, dataset: Dataset) -> ParameterSet:
    """Return the parameters with the stiffness of joints if a log shows springs."""
    if not shows_springs(solver, dataset):
        return parameters
    return replace(parameters, terms=(*parameters.terms, SPRING))


def _with_warming(parameters: ParameterSet, solver: Solver, dataset: Dataset) -> ParameterSet:
    """Return the parameters with the changes of friction that a log shows."""
    found = find_warming(solver, dataset)
    return replace(parameters, warming=found) if found else parameters


def _with_ripples(parameters: ParameterSet, solver: Solver, dataset: Dataset) -> ParameterSet:
    """Return the parameters with the ripples that a log shows."""
    found = find_ripples(solver, dataset)
    return replace(parameters, ripples=found) if found else parameters


def _digests(robot: RobotModel, options: IdentifyOptions, log: Log | None = None) -> InputDigests:
    """Start to compute the checksums of all input files."""
    logs = () if log is None else log.files
    return InputDigests((*logs, *model_files(Path(robot.source)), *options.files))


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
    robot = with_robot_options(robot, options)
    parameters = load_parameters(robot, options)
    if options.chooses_terms:
        columns = columns_of(robot, observations)
        parameters = replace(columns, link_side=parameters.link_side)
    observations = with_columns(observations, parameters)
    _check_sizes(options, parameters)
    check_layout(observations, parameters, "information")
    if any(len(one.layout.parameters) > len(parameters) for one in observations):
        raise EstimateError(
            "information: includes sensor errors, which belong to one log; identify that log "
            "without `tare` and with `sensor_errors` none",
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


def _check_sizes(options: IdentifyOptions, parameters: ParameterSet) -> None:
    """Check that a rank and an information file fit the parameters."""
    if options.rank is not None and options.rank > len(parameters):
        raise OptionError(
            f"`rank` {options.rank} exceeds {len(parameters)}, the number of parameters; choose "
            "a smaller one",
            "E501",
        )
    if options.information is not None:
        earlier = with_columns(load_archive(options.information), parameters)
        check_layout(earlier, parameters, str(options.information))


def _build_solver(
    options: IdentifyOptions,
    inputs: tuple[str, ...],
    parameters: ParameterSet,
    prior: Prior,
    *,
    dataset: Dataset,
    tares: Mapping[str, Tare],
    checks: LogChecks = NO_CHECKS,
    is_trial: bool = False,
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
    if parameters.candidates or (parameters.terms and options.is_empirical):
        scale = None if factors is None else factors.values
        of_terms = candidate_prior if parameters.candidates else named_term_prior
        prior = of_terms(prior, parameters, dataset.observations[0], scale)
        problem = replace(problem, prior=prior)
    kinds: tuple[str, ...] = options.sensor_error_kinds + (PLACE,) * bool(parameters.unplaced)
    if factors is not None and not kinds and parameters.model.contacts is None:
        solve = partial(_with_chosen_terms, is_trial=True)
        problem = identify_gains(problem, dataset, factors, solve)
        return Solver.of(problem, is_trial=is_trial)
    kinds += (DRIVE_GAIN,) * (factors is not None)
    if kinds:
        # What the user recorded for the purpose counts more than times in the air.
        request = SensorErrorRequest(kinds, {**checks.tares, **tares}, checks.mountings, factors)
        problem = calibrate(problem, dataset, request)
    if options.information is not None:
        earlier = with_columns(load_archive(options.information), parameters)
        both = merged_observations(problem.observations, earlier, str(options.information))
        problem = replace(problem, observations=both)
    gained = None if factors is None else dataset
    return _with_chosen_terms(problem, is_trial=is_trial, gained=gained)


def _with_chosen_terms(
    problem: Problem, *, is_trial: bool, gained: Dataset | None = None
) -> Solver:
    """Solve a problem, with the terms that its data ask for if they are candidates.

    ``gained`` is the log of a problem with drive gains as unknowns.
    """
    if not problem.parameters.candidates:
        return Solver.of(problem, is_trial=is_trial)

    def with_terms(window: float | None = None) -> Problem:
        """Return the problem with the terms that all rows ask for, or those of one window."""
        rows = tuple(one for one in problem.observations if window in (None, one.window))
        some = replace(problem, observations=rows)
        choice = choose_terms(some if gained is None else with_fixed_gains(some))
        if gained is not None:
            some = without_terms(some, gained, choice.free)
        return replace(choice.applied(some), choice=choice)

    solver = Solver.of(with_terms(), is_trial=is_trial)
    choice = solver.problem.choice
    if choice is None or choice.window in (None, solver.chosen.window):
        return solver
    # Noise may spoil the rows of short windows for all candidates together, and not for the chosen
    # ones. Rows that are used choose the terms as well.
    again = replace(with_terms(solver.chosen.window), stored=solver.problem.stored)
    return Solver.of(again, is_trial=is_trial)


def _with_known_gains(
    options: IdentifyOptions,
    parameters: ParameterSet,
    prior: Prior,
    solver: Solver,
    dataset: Dataset,
) -> tuple[Solver, Dataset]:
    """Return a solution and its log; of one with unknown drive gains, those with the gains found.

    Terms are searched for in residuals in Nm, in which gains are no unknowns.
    """
    build = solver.problem.calibrated_rows
    if build is None or not build.errors.gained or not options.searches:
        return solver, dataset
    factors = np.ones(len(parameters.model.joints))
    factors[build.errors.gained_joints] = build.errors.of_kind(
        DRIVE_GAIN, build.linearization.theta
    )[:, 0]
    segments = ConvertedSegments(dataset.segments, factors)
    processing = Processing.of(options)
    converted = fold_dataset(segments, dataset.source, parameters, processing)
    known = replace(options, drive_gain=())
    return _build_solver(known, (), parameters, prior, dataset=converted, tares={}), converted


def _initial_factors(
    options: IdentifyOptions, dataset: Dataset, parameters: ParameterSet, prior: Prior
) -> InitialFactors | None:
    """Return first guesses of the factors of efforts, if any is unknown."""
    joints = named_joints(options.drive_gains, parameters.model)
    if not joints:
        return None
    return initial_factors(dataset.segments, parameters, prior.mean, joints)


def _watch(options: IdentifyOptions, parameters: ParameterSet, prior: Prior) -> ModelWatch | None:
    """Return what checks a log against the model while it is read, if that saves time."""
    robot = _expected_robot(parameters, prior)
    is_needed = not options.unchecked and not options.drive_gains and robot.contacts is None
    return ModelWatch(robot) if is_needed and Processing.of(options).jobs > 1 else None


def _expected_robot(parameters: ParameterSet, prior: Prior) -> RobotModel:
    return with_payloads(parameters.apply(prior.mean), parameters.payloads)


def _check(
    dataset: Dataset,
    streams: StreamChecks | None,
    options: IdentifyOptions,
    parameters: ParameterSet,
    prior: Prior,
    *,
    watch: ModelWatch | None = None,
) -> LogChecks:
    """Check a log as `symbid bag doctor` does; nothing happens without checks of its streams."""
    if streams is None:
        return NO_CHECKS
    factors = _initial_factors(options, dataset, parameters, prior)
    if factors is not None:
        dataset = replace(dataset, segments=ConvertedSegments(dataset.segments, factors.values))
    robot, kinds = _expected_robot(parameters, prior), options.sensor_error_kinds
    return check_dataset(dataset, streams, robot, estimated=kinds, watch=watch)
