"""One draw of the prior, given to every method behind every filter."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import write_text
from symbid_ros.bags import bag_log
from symbid_ros.choices import GAUSSIAN
from symbid_ros.errors import StudyError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior, draw_prior
from symbid_ros.estimation.truncated_svd import METHODS as TRUNCATED
from symbid_ros.estimation.truncated_svd import LeastSquares, select_rank
from symbid_ros.identification.calibration import Tare, read_tare
from symbid_ros.identification.evaluation import MotionEvaluator, link_errors
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.solver import Solver
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.study.logs import identified, truth
from symbid_ros.study.plan import Log, Plan, Spread
from symbid_ros.study.scores import RANK, REFERENCE, Case, Outcome, Scores
from symbid_ros.study.workspace import Workspace

WEIGHING_STD = 0.02  # kg

Found = dict[Case, tuple[FloatArray, int | None]]


def solve_draw(plan: Plan, space: Workspace, data: str, spread: Spread, iteration: int) -> None:
    """Identify with one prior by every method and filter, and judge the results."""
    true = truth(plan.data[data], space)
    prior = drawn_prior(plan, true, spread, iteration)
    found: Found = {Case(data, str(spread), REFERENCE): (prior.mean, None)}
    found |= _truncated(plan, space, data, spread, prior)
    found |= _gaussian(plan, space, data, spread, prior)
    motion = _judge(plan, space, data)
    judged = motion.metrics({str(case): values for case, (values, _) in found.items()})
    outcomes = [
        vars(case) | vars(_outcome(true, vars(judged[str(case)]), values, rank))
        for case, (values, rank) in found.items()
    ]
    write_text(space.draw(data, spread, iteration), json.dumps(outcomes) + "\n")


def load_draw(file: Path) -> dict[Case, Outcome]:
    """Read what :func:`solve_draw` wrote.

    Raises
    ------
    StudyError
        When the file is not whole.
    """
    try:
        return {
            Case(one["data"], one["prior"], one["method"], one["filter"]): Outcome(
                one["metrics"], tuple(one["links"]), one["impossible"], tuple(one["values"])
            )
            for one in json.loads(file.read_text(encoding="utf-8"))
        }
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StudyError(f"{file}: cannot be read ({error}); delete it and start again") from None


def drawn_prior(plan: Plan, true: ParameterSet, spread: Spread, iteration: int) -> Prior:
    """Return one draw about the truth."""
    return draw_prior(true, spread.kind, spread.amount, plan.prior_seed + iteration)


@dataclass(frozen=True)
class _Filtered:
    """Rows behind one filter, of the data and of the validation log."""

    training: Observations
    least_squares: LeastSquares
    validation: Information | None


def _truncated(plan: Plan, space: Workspace, data: str, spread: Spread, prior: Prior) -> Found:
    found: Found = {}
    for cutoff in plan.filters:
        rows = _filtered(plan, space, data, cutoff)
        solver = None
        if rows.validation is None:
            solver = Solver.of(Problem((rows.training,), identified(plan.data[data]), prior))
        for method in TRUNCATED:
            if method not in plan.methods:
                continue
            case = Case(data, str(spread), method, cutoff)
            if solver is not None:
                estimate = solver.truncated(method, Truncation()).estimate
                found[case] = estimate.value, estimate.rank
            elif rows.validation is not None:
                problem = rows.least_squares.scaled(prior, method)
                z = select_rank(problem, rows.validation, plan.z.by)
                found[case] = problem.solution(z), z
    return found


def _gaussian(plan: Plan, space: Workspace, data: str, spread: Spread, prior: Prior) -> Found:
    wanted = [method for method in GAUSSIAN if method in plan.methods]
    if not wanted:
        return {}
    log = plan.data[data]
    if log.cure:
        weighed = np.random.default_rng(prior.seed).normal(_mass(space, log), WEIGHING_STD)
        problem, tare = _loaded(space, log), space.tare(log)
        options = replace(
            problem.options, total_mass=weighed, total_mass_std=WEIGHING_STD, tare=(tare,)
        )
        solver = problem.with_prior(prior, options, _tares(tare)).solver
    else:
        rows = _archive(space.rows(log, log.sensors, None))
        solver = Solver.of(Problem(rows, identified(log), prior))
    solve = {"map": lambda: solver.posterior.mean, "map_lmi": solver.consistent_unknowns}
    count = len(identified(log))
    return {Case(data, str(spread), method): (solve[method]()[:count], None) for method in wanted}


def _outcome(
    true: ParameterSet, metrics: Mapping[str, float], values: FloatArray, rank: int | None
) -> Outcome:
    possible = [is_consistent(phi) for phi in true.link_phi(values)]
    return Outcome(
        metrics=dict(metrics) | ({} if rank is None else {RANK: rank}),
        links=tuple(link_errors(true, values, true.values).tolist()),
        impossible=len(possible) - sum(possible),
        values=tuple(values.tolist()),
    )


# What all draws of a data set share stays in each process that works on them.


@lru_cache(maxsize=16)
def _archive(file: Path) -> tuple[Observations, ...]:
    return load_archive(file)


def _filtered(plan: Plan, space: Workspace, data: str, cutoff: float) -> _Filtered:
    log, ideal = plan.data[data], plan.validation_of(data)
    place = space.rows(log, log.sensors, cutoff)
    other = space.rows(ideal, log.sensors, cutoff)
    return _filtered_rows(place, other if plan.z.using == "validation" else None)


@lru_cache(maxsize=16)
def _filtered_rows(training: Path, validation: Path | None) -> _Filtered:
    (rows,) = _archive(training)
    other = None if validation is None else _archive(validation)[0].rows
    return _Filtered(rows, LeastSquares(rows.rows, counts=rows.counts.diagonal()), other)


def _judge(plan: Plan, space: Workspace, data: str) -> MotionEvaluator:
    return _motion_judge(space, plan.validation_of(data), plan.judged_every)


@lru_cache(maxsize=2)
def _motion_judge(space: Workspace, ideal: Log, every: float) -> MotionEvaluator:
    true = truth(ideal, space)
    motion = read_true_motion([space.log(ideal)], true.model)
    stamp = motion.samples.stamp
    stride = max(1, round(every * 1e9 / float(np.median(np.diff(stamp)))))
    return MotionEvaluator(true, true.values, motion[::stride])


@lru_cache(maxsize=1)
def _loaded(space: Workspace, log: Log) -> LoadedProblem:
    bag = space.log(log)
    # In a tare the hoist carries the robot, which is no sensor of this log.
    options = IdentifyOptions(
        prior_percent=25.0,
        friction=log.friction,
        armature=log.friction,
        unchecked=True,
    )
    return BagRequest((bag,), config_file("symbitron.xml"), options).load()


@lru_cache(maxsize=4)
def _tares(bag: Path) -> dict[str, Tare]:
    return read_tare(bag_log([bag]))


@lru_cache(maxsize=4)
def _mass(space: Workspace, log: Log) -> float:
    true = truth(log, space)
    return float(true.values[: true.inertial : 10].sum())


@dataclass(frozen=True)
class Results:
    """What every draw gave.

    Attributes
    ----------
    plan : Plan
    space : Workspace
    outcomes : dict of Case to list of Outcome
        In the order of the draws.
    """

    plan: Plan
    space: Workspace
    outcomes: dict[Case, list[Outcome]]

    @classmethod
    def read(cls, plan: Plan, space: Workspace) -> "Results":
        """Read all draws.

        Raises
        ------
        StudyError
            When one is missing or not whole.
        """
        outcomes: dict[Case, list[Outcome]] = {}
        for data in plan.data:
            for spread in plan.priors:
                for iteration in range(plan.iterations):
                    draw = load_draw(space.draw(data, spread, iteration))
                    for case, outcome in draw.items():
                        outcomes.setdefault(case, []).append(outcome)
        return cls(plan, space, outcomes)

    @cached_property
    def scores(self) -> Scores:
        """Means over the draws."""
        return Scores.of(self.outcomes)

    def parameters(self, data: str) -> ParameterSet:
        """Return the columns of one data set with the true values."""
        return truth(self.plan.data[data], self.space)

    def cutoff(self, method: str, wanted: float) -> float | None:
        """Return the filter to look a method up with: some have none."""
        return wanted if method in self.plan.truncated else None

    def values(
        self, data: str, spread: Spread, method: str, cutoff: float, iteration: int = 0
    ) -> FloatArray:
        """Return the parameters (p,) that one method found in one draw.

        Raises
        ------
        StudyError
            When the study has no such draw.
        """
        case = Case(data, str(spread), method, self.cutoff(method, cutoff))
        try:
            return np.array(self.outcomes[case][iteration].values)
        except (KeyError, IndexError):
            raise StudyError(
                f"{self.space.out}: no draw {iteration} of {case}; add it to the plan"
            ) from None

    def link_errors(self, data: str, spread: Spread, cutoff: float) -> dict[str, FloatArray]:
        """Return each method's mean error of every link (L,), %, by method."""
        found = {}
        for method in (REFERENCE, *self.plan.methods):
            case = Case(data, str(spread), method, self.cutoff(method, cutoff))
            found[method] = np.mean([one.links for one in self.outcomes[case]], axis=0)
        return found

    def row_errors(self, data: str) -> dict[float, float]:
        """Return by cutoff the norm per sample of y - K φ at the true parameters, N and Nm."""
        log = self.plan.data[data]
        true = self.parameters(data).values
        if not self.plan.truncated:
            return {}
        found = {}
        for cutoff in self.plan.filters:
            (rows,) = load_archive(self.space.rows(log, log.sensors, cutoff))
            squares = [error**2 for error in rows.rows.residual_rmse(true).values()]
            found[cutoff] = float(np.sqrt(sum(squares)))
        return found
