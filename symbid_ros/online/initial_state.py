"""What an online identification begins with: the robot, the prior, what an earlier run knew."""

from dataclasses import dataclass
from pathlib import Path

from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.problem import Problem
from symbid_ros.offline.job import Job, check, load_parameters


@dataclass(frozen=True)
class InitialState:
    """A job's files, read and checked before the first message.

    Attributes
    ----------
    job : Job
        What to identify and how; it names no bags.
    problem : Problem
        Everything but observations.
    layout : RowLayout
        Of the rows.
    observations : tuple of Observations
        What is known already, for each length of window.
    """

    job: Job
    problem: Problem
    layout: RowLayout
    observations: tuple[Observations, ...]

    @classmethod
    def of(cls, job: Job) -> "InitialState":
        """Read a job's files.

        Raises
        ------
        SymbidError
            When a file or the job does not serve.
        """
        check(job)
        _check_online(job)
        parameters = load_parameters(job)
        prior = job.prior.load(parameters)
        problem = Problem(
            (),
            parameters,
            prior,
            known=job.facts.rows(parameters, prior),
            empirical=job.prior.empirical,
            inputs=job.inputs,
        )
        layout = RowLayout.of(parameters)
        nothing = tuple(Observations.empty(layout, one) for one in job.processing.windows)
        known = nothing if job.information is None else _resumed(job.information, nothing)
        return cls(job, problem, layout, known)

    @property
    def nothing(self) -> tuple[Observations, ...]:
        """Observations of no rows."""
        return tuple(Observations.empty(self.layout, one.window) for one in self.observations)


def _check_online(job: Job) -> None:
    """Refuse what takes a whole log."""
    if job.processing.smoothing is not None:
        raise EstimateError("online, rows are averaged over windows; leave the filter out")
    if job.facts.kinds:
        raise EstimateError(
            "a tare and sensor errors take several passes over a log; record one and identify "
            "offline"
        )
    if job.validation is not None:
        raise EstimateError(
            "online, singular values are chosen by the data or given; leave the validation bag out"
        )


def _resumed(archive: Path, nothing: tuple[Observations, ...]) -> tuple[Observations, ...]:
    """Return what an earlier run knew, window by window; other windows are not used."""
    earlier = {one.window: one for one in load_archive(archive)}
    try:
        known = tuple(earlier[one.window].merge(one) for one in nothing if one.window in earlier)
    except DataError:
        known = ()
    if not known:
        raise EstimateError(
            f"{archive}: of another robot, other columns or other windows; resume with the model "
            "and the options it was written with"
        )
    return known
