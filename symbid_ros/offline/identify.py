"""One offline identification as a user asks for it; command and node both run this."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from symbid_ros.bags.container.contents import contents
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import DIFFERENT
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import SoftRows
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.row_weights import SensorDeviation, sensor_row_deviation
from symbid_ros.estimation.truncation import Criterion
from symbid_ros.identification.calibration import Wanted, calibrate, read_tare
from symbid_ros.identification.dataset import Filter, Processing, Record, read_record
from symbid_ros.identification.export import check_output
from symbid_ros.identification.preflight import examine
from symbid_ros.identification.prior_information import Facts, PriorChoice
from symbid_ros.identification.problem import GAUSSIAN, METHODS, Method, Problem, Truncation
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet, Term
from symbid_ros.model.urdf import Base
from symbid_ros.signals.filters import Channels
from symbid_ros.signals.slices import ALL_OF_IT

logger = logging.getLogger(__name__)

ALIKE = "identify both with the same model, joint terms and sensor errors"


@dataclass(frozen=True)
class Job:
    """What to identify, from what, and how.

    Attributes
    ----------
    bags : tuple of Path
        Bags that continue one another.
    model : Path
        URDF or MJCF; only its kinematics are used when there is a prior.
    base : {"auto", "floating", "fixed"}
        Whether a URDF's base may move.
    prior : PriorChoice
        Where the prior comes from.
    method : {"map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"}
        Estimator.
    terms : tuple of {"viscous", "coulomb", "armature", "offset"}
        What is identified of every joint beside the links.
    processing : Processing
        Topics, and how they become rows.
    facts : Facts
        What else is known.
    information : Path or None
        information.npz of a run to go on from.
    rank : int or None
        Number of singular values, for the truncated methods.
    validation : Path or None
        Bag on which to choose the number of singular values.
    criterion : {"gen_force", "torque", "com"}
        What to choose it by.
    sensors : SensorDeviation or None
        Weigh rows of the truncated methods by sensor noise (Eq. 28), not residuals (Eq. 29).
    unchecked : bool
        Do not hold the data against the model before they are believed.
    """

    bags: tuple[Path, ...]
    model: Path
    base: Base = "auto"
    prior: PriorChoice = field(default_factory=PriorChoice)
    method: Method = "map_lmi"
    terms: tuple[Term, ...] = ()
    processing: Processing = field(default_factory=Processing)
    facts: Facts = field(default_factory=Facts)
    information: Path | None = None
    rank: int | None = None
    validation: Path | None = None
    criterion: Criterion = "gen_force"
    sensors: SensorDeviation | None = None
    unchecked: bool = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """The files that the estimate came from."""
        files = [
            *self.bags,
            self.model,
            self.prior.file,
            *self.facts.tare,
            self.information,
            self.validation,
        ]
        return tuple(str(file) for file in files if file is not None)


@dataclass(frozen=True)
class Prepared:
    """A job's files, read; any method can be solved on them."""

    job: Job
    parameters: ParameterSet
    prior: Prior
    record: Record
    solver: Solver
    validation: Record | None

    def under(self, prior: Prior, facts: Facts | None = None) -> "Prepared":
        """Return the same log under another prior and, if given, other facts."""
        job = self.job if facts is None else replace(self.job, facts=facts)
        known = job.facts.rows(self.parameters, prior)
        problem = _problem(job, self.parameters, prior, self.record, known)
        return replace(self, job=job, prior=prior, solver=Solver.of(problem))

    def solve(self, method: Method) -> Identification:
        """Identify with one method."""
        if method == "map_lmi":
            return self.solver.map_lmi()
        if method == "map":
            return self.solver.map()
        deviation = None
        if self.job.sensors is not None:
            model, samples = self.parameters.model, self.record.samples
            deviation = sensor_row_deviation(model, samples, self.job.sensors)
        validation = () if self.validation is None else self.validation.observations
        return self.solver.truncated(
            method, Truncation(self.job.rank, validation, self.job.criterion), deviation
        )


def prepare(job: Job, out: Path | None = None) -> Prepared:
    """Read and check all of a job's files.

    What can be wrong with small files, options and the folder ``out`` for the results is found
    before the long work of reading the bags.

    Raises
    ------
    SymbidError
        When a file, its data or the job itself does not serve.
    """
    check(job)
    parameters = load_parameters(job)
    prior = job.prior.load(parameters)
    known = job.facts.rows(parameters, prior)
    _check_early(job, parameters, out)
    record = _checked_record(job, job.bags, job.processing, parameters, prior)
    validation = None
    if job.validation is not None:
        whole = replace(job.processing, part=ALL_OF_IT)
        validation = _checked_record(job, [job.validation], whole, parameters, prior)
    return Prepared(
        job,
        parameters,
        prior,
        record,
        Solver.of(_problem(job, parameters, prior, record, known)),
        validation,
    )


def _checked_record(
    job: Job, bags: Sequence[Path], processing: Processing, parameters: ParameterSet, prior: Prior
) -> Record:
    """Read a log and check it as the doctor does, unless the job does without."""
    if job.unchecked:
        return read_record(bags, parameters, processing)
    checks = StreamChecks(parameters.model)
    record = read_record(bags, parameters, processing, checks)
    examine(record, checks, parameters, prior, processing.topics)
    return record


def _check_early(job: Job, parameters: ParameterSet, out: Path | None) -> None:
    """Refuse what would otherwise be noticed after the work only."""
    if out is not None:
        check_output(parameters, out)
    if job.rank is not None and job.rank > len(parameters):
        raise EstimateError(
            f"rank {job.rank} is larger than {len(parameters)}, the number of parameters; choose "
            "another --rank"
        )
    contents([*job.facts.tare, *filter(None, [job.validation])])
    if job.information is not None:
        p, coordinates = len(parameters), parameters.model.coordinates
        for earlier in load_archive(job.information):
            layout = earlier.layout
            if (layout.parameters[:p], layout.coordinates) != (parameters.names, coordinates):
                raise EstimateError(f"{job.information}: {DIFFERENT}; {ALIKE}")


def load_parameters(job: Job) -> ParameterSet:
    """Return the columns of a job's robot, and say what its file states beside them.

    Raises
    ------
    ModelError
        When the file does not serve.
    """
    parameters = ParameterSet(load_model(job.model, job.base), job.terms)
    names = parameters.model.joint_names
    for term, values in parameters.known_terms.items():
        stated = [name for name, value in zip(names, values, strict=True) if value != 0.0]
        option = "armature" if term == "armature" else "friction"
        logger.warning(
            "%s states %s of %s, which is taken as known; identify it with --%s if it may be wrong",
            job.model,
            f"{term} friction" if option == "friction" else term,
            ", ".join(stated),
            option,
        )
    return parameters


def chosen_filter(
    named: Filter | None, method: Method, cutoff: float | None, channels: Channels | None
) -> Filter:
    """Return the filter of the rows: the one named, or the one that the other options imply.

    The thesis's methods were published with Butterworth-filtered rows, so a cutoff or channels
    given with one of them ask for that filter.
    """
    if named is not None:
        return named
    is_butterworth = method not in GAUSSIAN and not (cutoff is None and channels is None)
    return "butterworth" if is_butterworth else "weak"


def check(job: Job) -> None:
    """Refuse what the method cannot take: an option without effect is a misunderstanding.

    Raises
    ------
    EstimateError
        When an option is of no use with another.
    """
    if job.method not in METHODS:
        raise EstimateError(f"no method {job.method!r}; choose one of {', '.join(METHODS)}")
    if job.rank is not None and job.validation is not None:
        raise EstimateError("--rank and --validate both choose the singular values; give one")
    facts = job.facts
    if job.method in GAUSSIAN:
        if job.rank is not None or job.validation is not None or job.sensors is not None:
            raise EstimateError(
                f"{job.method} cuts off no singular values and weighs rows by their residuals; "
                "leave --rank, --validate and --sensor-std out, or use wls_rc"
            )
    elif facts.kinds or facts.rows_wanted:
        raise EstimateError(
            f"{job.method} takes neither sensor errors, a tare nor a total mass; use map or map_lmi"
        )
    if facts.kinds and job.processing.smoothing is not None:
        raise EstimateError("sensor errors need rows averaged over windows; leave --filter out")


def _problem(
    job: Job, parameters: ParameterSet, prior: Prior, record: Record, known: SoftRows | None
) -> Problem:
    problem = Problem(
        record.observations,
        parameters,
        prior,
        known=known,
        empirical=job.prior.empirical,
        inputs=job.inputs,
        has_wrenches=bool(record.samples.wrench_frames),
    )
    if job.facts.kinds:
        problem = _calibrated(job, problem, record)
    return replace(problem, observations=_with_earlier(job.information, problem.observations))


def _calibrated(job: Job, problem: Problem, record: Record) -> Problem:
    tares = read_tare(job.facts.tare, job.processing.topics) if job.facts.tare else {}
    wanted = Wanted(job.facts.kinds, tares)
    found = calibrate(record, problem.parameters, problem.prior, wanted, problem.known)
    return problem.calibrated(found)


def _with_earlier(
    information: Path | None, observations: tuple[Observations, ...]
) -> tuple[Observations, ...]:
    """Return observations with those of an earlier run added, window by window."""
    if information is None:
        return observations
    earlier = {one.window: one for one in load_archive(information)}
    now, before = (
        frozenset[int]().union(*(one.seconds for one in run))
        for run in (observations, earlier.values())
    )
    if again := now & before:
        raise EstimateError(
            f"{information}: holds {len(again)} s of this log already, which would be counted "
            "twice; leave --information out, or name another log"
        )
    try:
        both = tuple(
            earlier[one.window].merge(one) for one in observations if one.window in earlier
        )
    except DataError as error:
        raise EstimateError(f"{information}: {error}; {ALIKE}") from None
    if not both:
        raise EstimateError(
            f"{information}: its rows are averaged over other windows than this run's; identify "
            "both with the same filter and sensor errors"
        )
    return both
