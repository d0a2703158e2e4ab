"""Reading and checking of a robot, a log and all that options name, before any method is chosen."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from symbid_ros.choices import Method
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import reversed_sensors
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.estimate import RowSettings
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.provenance import InputDigests, Provenance
from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.identification.calibration.drive_gains import ConvertedSegments
from symbid_ros.identification.calibration.shown_errors import shows_compliance
from symbid_ros.identification.calibration.tares import Tare, read_tare
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.assumed_contacts import with_assumed_contacts
from symbid_ros.identification.conventions.base_gravity import with_found_gravity
from symbid_ros.identification.conventions.end_stops import with_found_end_stops
from symbid_ros.identification.conventions.foot_moments import with_found_moments
from symbid_ros.identification.conventions.position_units import refuse_degrees
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.log_checks import NO_CHECKS, LogChecks, ModelWatch, check_dataset
from symbid_ros.identification.log_reading import (
    open_logs,
    read_log,
    report_unnamed_sensors,
    require_rows,
    with_loaded_logs,
    with_reversed,
    with_rigid_joints,
)
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.prior_options import (
    build_pseudo_measurements,
    choose_prior,
    load_parameters,
    with_load_reference,
)
from symbid_ros.identification.problem import Truncation
from symbid_ros.identification.problem_setup import ProblemSetup, first_factors
from symbid_ros.identification.result_files import check_output
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.rows.fast_motion import with_fast_motion
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.stored_information import check_layout, columns_of, with_columns
from symbid_ros.model.load import model_files
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload, with_payloads
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.end_stops import end_stop_depth
from symbid_ros.signals.log import Log
from symbid_ros.signals.sensor_errors import COMPLIANCE
from symbid_ros.signals.wheels import rolling_wheels, wheel_advice

logger = logging.getLogger(__name__)

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
    solved : SolvedProblem
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
    solved: SolvedProblem
    validation: Dataset | None
    tares: Mapping[str, Tare]
    checks: LogChecks = NO_CHECKS
    digests: InputDigests | None = None
    is_trial: bool = False

    @property
    def parameters(self) -> ParameterSet:
        """The p parameters to identify."""
        return self.solved.problem.parameters

    def with_prior(
        self,
        prior: Prior,
        options: IdentifyOptions | None = None,
        tares: Mapping[str, Tare] | None = None,
    ) -> "LoadedProblem":
        """Return the same log with another prior and, if given, other options and tares."""
        options = options or self.options
        tares = self.tares if tares is None else tares
        setup = ProblemSetup(options, prior, self.inputs, tares, self.checks)
        solved = setup.solve(self.columns, self.dataset)
        return replace(self, options=options, prior=prior, solved=solved, tares=tares)

    def with_drive_gains(
        self, joints: tuple[str, ...], percent: float | None = None
    ) -> "LoadedProblem":
        """Return the same log with the factors of some joints' efforts as unknowns.

        ``percent`` is their standard deviation about 1; None if their unit is unknown.
        """
        options = replace(self.options, drive_gain=joints, drive_gain_percent=percent)
        return self.with_prior(self.prior, options)

    def with_signed_drives(self) -> "LoadedProblem":
        """Return the same log with armature and friction that may be negative.

        Residuals without them may show further terms.
        """
        options = replace(self.options, signed_drives=True)
        setup = ProblemSetup(options, self.prior, self.inputs, self.tares, self.checks)
        solved = setup.solve(self.columns, self.dataset)
        columns, dataset, solved = setup.with_found_terms(self.columns, self.dataset, solved)
        return replace(self, options=options, columns=columns, dataset=dataset, solved=solved)

    def trial_on(self, dataset: Dataset, columns: ParameterSet) -> "LoadedProblem":
        """Return the same problem with another log and its columns, solved to few digits."""
        setup = ProblemSetup(self.options, self.prior, self.inputs, self.tares, self.checks)
        solved = setup.solve(columns, dataset, is_trial=True)
        return replace(self, columns=columns, dataset=dataset, solved=solved, is_trial=True)

    def solve(self, method: Method | None = None) -> Identification:
        """Identify with one method, by default that of the options."""
        found = self._solve(method or self.options.method)
        options = self.options
        first = next(iter(self.dataset.segments), None)
        settings = RowSettings(
            options.row_filter,
            found.window or options.window,
            options.cutoff,
            options.channels,
            None if first is None else first.rate,
        )
        estimate = replace(found.estimate, rows=settings)
        found = replace(found, estimate=estimate)
        return found.with_alarms((*self.checks.alarms, *found.alarms))

    def with_provenance(self, found: Identification, command: str = "") -> Identification:
        """Return an identification of this problem that names its inputs and options.

        Alarms about its log are logged if the method gives no verdict that could hold them.
        """
        for alarm in self.checks.alarms if found.estimate.verdict is None else ():
            logger.warning("%s: %s", self.dataset.source, alarm)
        files = () if self.digests is None else self.digests.wait()
        provenance = Provenance.now(files, self.options, command)
        return replace(found, estimate=replace(found.estimate, provenance=provenance))

    @cached_property
    def _complete_solution(self) -> SolvedProblem:
        """The solved problem, with motion that is faster than the windows."""
        return self.solved if self.is_trial else with_fast_motion(self.solved, self.dataset)

    def _solve(self, method: Method) -> Identification:
        if method == "map_lmi":
            return self._complete_solution.map_lmi()
        if method == "map":
            return self._complete_solution.map()
        deviation = None
        if self.options.sensor_std is not None:
            sensors = SensorNoise(*self.options.sensor_std)
            deviation = sensor_row_std(self.parameters.model, self.dataset.samples, sensors)
        validation = () if self.validation is None else self.validation.observations
        truncation = Truncation(self.options.rank, validation, self.options.select_by)
        return self.solved.truncated(method, truncation, deviation)


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
    if read is None:
        robot = with_rigid_joints(robot, log, options)
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
    watch = None
    if read is None:
        watch = _watch(options, parameters, prior)
        dataset, streams = read_log(log, options, parameters, watch)
    else:
        (dataset, checks), streams = read(options, parameters, prior), None
    corrected = _corrected(options, parameters, dataset)
    if corrected is not options:
        return load_problem(robot, log, corrected, out, read)
    # Only now, because reading takes all cores.
    digests = _digests(robot, options, log)
    if read is None:
        checks = _check(dataset, streams, options, parameters, prior, watch=watch)
    require_rows(dataset, parameters.model)
    _warn_of_wheels(dataset, parameters.model)
    if options.unchecked:  # otherwise the checks have said so
        report_unnamed_sensors(parameters.model, dataset)
    dataset, parameters = with_loaded_logs(options, log, dataset, parameters)
    validation = None
    if other is not None:
        validation, streams = read_log(other, options, parameters)
        _check(validation, streams, options, parameters, prior)
    tares = {frame: one for each in tare for frame, one in read_tare(each).items()}
    inputs = tuple(map(str, (*log.files, robot.source, *options.files)))
    setup = ProblemSetup(options, prior, inputs, tares, checks)
    setup, solved = setup.with_found_biases(parameters, dataset)
    options = setup.options
    parameters, dataset, solved = setup.with_found_terms(parameters, dataset, solved)
    finds_compliance = options.finds_compliance and not checks.has_unsigned_efforts
    if finds_compliance and shows_compliance(solved, dataset):
        options = replace(options, sensor_errors=(COMPLIANCE,))
        solved = replace(setup, options=options).solve(parameters, dataset)
    return LoadedProblem(
        options, inputs, parameters, prior, dataset, solved, validation, tares, checks, digests
    )


def _corrected(
    options: IdentifyOptions, parameters: ParameterSet, dataset: Dataset
) -> IdentifyOptions:
    """Return the options as the log says they should be; the same if it contradicts none."""
    if wrong := reversed_sensors(dataset.observations[0].rows, parameters):
        return with_reversed(options, wrong, dataset.source)
    model, segments = parameters.model, dataset.segments
    if not options.unchecked:
        refuse_degrees(segments, model, dataset.source)
    if options.drive_gains:  # signs and units of the efforts are unknown
        return options
    options = with_found_gravity(options, model, segments, dataset.source)
    options = with_found_moments(options, model, segments, dataset.source)
    if end_stop_depth(dataset.samples.position, model.joints).any():
        options = with_found_end_stops(options, model, segments, dataset.source)
    return options


def _warn_of_wheels(dataset: Dataset, model: RobotModel) -> None:
    wheels = rolling_wheels(dataset.samples.position, model.joints)
    if wheels and not model.floating:
        logger.warning("%s: %s", dataset.source, wheel_advice(wheels))


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
            "without `tare`, and with `sensor_errors` and `drive_gain` none",
            "E505",
        )
    of_logs = "tare", "payload", "drive_gain", "choose_truncation", "sensor_std", "sensor_errors"
    for name in of_logs:
        if getattr(options, name):
            raise OptionError(f"`{name}` needs a log, not information; leave it out", "E503")
    prior = choose_prior(options, parameters)
    parameters = with_load_reference(parameters, prior, options)
    nothing = Dataset("information", (), Samples.none(robot.joint_names), observations)
    inputs = (robot.source, *map(str, options.files))
    solved = ProblemSetup(options, prior, inputs).solve(parameters, nothing)
    digests = _digests(robot, options)
    return LoadedProblem(
        options, inputs, parameters, prior, nothing, solved, None, {}, digests=digests
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


def _watch(options: IdentifyOptions, parameters: ParameterSet, prior: Prior) -> ModelWatch | None:
    """Return what compares a log with the model while it is read; None if nothing does so."""
    robot = _expected_robot(parameters, prior)
    is_compared = not options.unchecked and not options.drive_gains and robot.contacts is None
    return ModelWatch(robot) if is_compared else None


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
    factors = first_factors(options, dataset, parameters, prior)
    if factors is not None:
        factors.report(dataset.source)
        dataset = replace(dataset, segments=ConvertedSegments(dataset.segments, factors.values))
    robot, kinds = _expected_robot(parameters, prior), options.sensor_error_kinds
    return check_dataset(
        dataset,
        streams,
        robot,
        estimated=kinds,
        has_known_units=options.has_known_units,
        watch=watch,
    )
