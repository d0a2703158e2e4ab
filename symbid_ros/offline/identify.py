"""One offline identification as a user asks for it; command and node both run this."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from symbid_ros.bags import bag_log, count_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import INCOMPATIBLE
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.truncated_svd import sensor_row_std
from symbid_ros.identification.calibration import Wanted, calibrate, read_tare
from symbid_ros.identification.dataset import Record, read_record
from symbid_ros.identification.export import check_output
from symbid_ros.identification.preflight import examine
from symbid_ros.identification.prior_information import Facts
from symbid_ros.identification.problem import Method, Problem, Truncation
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.job import Job, check, load_parameters
from symbid_ros.signals.streams import ALL_OF_IT, TimeRange

logger = logging.getLogger(__name__)

ALIKE = "identify both with the same model, joint terms and sensor errors"


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
            deviation = sensor_row_std(model, samples, self.job.sensors)
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
    record = _checked_record(job, job.bags, job.part, parameters, prior)
    validation = None
    if job.validation is not None:
        validation = _checked_record(job, [job.validation], ALL_OF_IT, parameters, prior)
    return Prepared(
        job,
        parameters,
        prior,
        record,
        Solver.of(_problem(job, parameters, prior, record, known)),
        validation,
    )


def _checked_record(
    job: Job, bags: Sequence[Path], part: TimeRange, parameters: ParameterSet, prior: Prior
) -> Record:
    """Read a log and check it as the doctor does, unless the job does without."""
    log = bag_log(bags, parameters.model, job.topics, part)
    if job.unchecked:
        return read_record(log, parameters, job.processing)
    checks = StreamChecks(parameters.model)
    record = read_record(log, parameters, job.processing, checks)
    examine(record, checks, parameters, prior)
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
    count_messages([*job.facts.tare, *filter(None, [job.validation])])
    if job.information is not None:
        p, coordinates = len(parameters), parameters.model.coordinates
        for earlier in load_archive(job.information):
            layout = earlier.layout
            if (layout.parameters[:p], layout.coordinates) != (parameters.names, coordinates):
                raise EstimateError(f"{job.information}: {INCOMPATIBLE}; {ALIKE}")


def _problem(
    job: Job,
    parameters: ParameterSet,
    prior: Prior,
    record: Record,
    known: PseudoMeasurements | None,
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
    tares = read_tare(bag_log(job.facts.tare, topics=job.topics)) if job.facts.tare else {}
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
