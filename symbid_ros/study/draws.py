"""Identification from draws of the prior by every method and filter, and its results."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.bags import bag_log
from symbid_ros.choices import GAUSSIAN
from symbid_ros.errors import StudyError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior, draw_prior
from symbid_ros.estimation.truncated_svd import METHODS as TRUNCATED
from symbid_ros.estimation.truncated_svd import LeastSquares, select_rank
from symbid_ros.identification.calibration.tares import Tare, read_tare
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import MotionEvaluator, link_errors
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.study.logs import nominal_parameters, true_parameters
from symbid_ros.study.plan import Plan, PriorSpread, SimulatedLog
from symbid_ros.study.scores import RANK, REFERENCE, Case, DrawResult, Scores
from symbid_ros.study.study_folder import StudyFolder, read_result, write_result

WEIGHING_STD = 0.02  # kg

# Parameters, and the number of singular values of truncated methods.
Estimates = dict[Case, tuple[FloatArray, int | None]]


def solve_draw(
    plan: Plan, folder: StudyFolder, data: str, spread: PriorSpread, iteration: int
) -> None:
    """Identify from one prior by every method and filter, and write the evaluated estimates."""
    true = true_parameters(plan.data[data], folder)
    prior = draw_prior(true, spread.kind, spread.amount, plan.prior_seed + iteration)
    estimates: Estimates = {Case(data, str(spread), REFERENCE): (prior.mean, None)}
    estimates |= _truncated_estimates(plan, folder, data, spread, prior)
    estimates |= _gaussian_estimates(plan, folder, data, spread, prior)
    evaluator = _evaluator(folder, plan.validation_log(data), plan.judged_every)
    metrics = evaluator.metrics({str(case): values for case, (values, _) in estimates.items()})
    results = [
        vars(case) | vars(_result(true, vars(metrics[str(case)]), values, rank))
        for case, (values, rank) in estimates.items()
    ]
    write_result(folder.draw(data, spread, iteration), results)


def load_draw(file: Path) -> dict[Case, DrawResult]:
    """Read the results that :func:`solve_draw` wrote.

    Raises
    ------
    StudyError
        If the file is missing or damaged.
    """
    return read_result(
        file,
        lambda content: {
            Case(one["data"], one["prior"], one["method"], one["filter"]): DrawResult(
                one["metrics"], tuple(one["links"]), one["impossible"], tuple(one["values"])
            )
            for one in content
        },
    )


@dataclass(frozen=True)
class _FilteredRows:
    """Rows of the data and of the validation log after one filter."""

    training: Observations
    least_squares: LeastSquares
    validation: Information | None


def _truncated_estimates(
    plan: Plan, folder: StudyFolder, data: str, spread: PriorSpread, prior: Prior
) -> Estimates:
    estimates: Estimates = {}
    if not plan.truncated_methods:
        return estimates
    log, ideal = plan.data[data], plan.validation_log(data)
    for cutoff in plan.filters:
        validation = folder.rows(ideal, log.sensors, cutoff)
        rows = _filtered_rows(
            folder.rows(log, log.sensors, cutoff),
            validation if plan.z.using == "validation" else None,
        )
        solved = None
        if rows.validation is None:
            solved = SolvedProblem.of(Problem((rows.training,), nominal_parameters(log), prior))
        for method in TRUNCATED:
            if method not in plan.methods:
                continue
            case = Case(data, str(spread), method, cutoff)
            if solved is not None:
                estimate = solved.truncated(method, Truncation()).estimate
                estimates[case] = estimate.value, estimate.rank
            elif rows.validation is not None:
                problem = rows.least_squares.scaled(prior, method)
                z = select_rank(problem, rows.validation, plan.z.by)
                estimates[case] = problem.solution(z), z
    return estimates


def _gaussian_estimates(
    plan: Plan, folder: StudyFolder, data: str, spread: PriorSpread, prior: Prior
) -> Estimates:
    methods = [method for method in GAUSSIAN if method in plan.methods]
    if not methods:
        return {}
    log = plan.data[data]
    if log.cure:
        weighed = np.random.default_rng(prior.seed).normal(_mass(folder, log), WEIGHING_STD)
        problem, tare = _loaded(folder, log), folder.tare(log)
        options = replace(
            problem.options, total_mass=weighed, total_mass_std=WEIGHING_STD, tare=(tare,)
        )
        solved = problem.with_prior(prior, options, _tares(tare)).solved
    else:
        rows = _archive(folder.rows(log, log.sensors, None))
        solved = SolvedProblem.of(Problem(rows, nominal_parameters(log), prior))
    solve = {"map": lambda: solved.posterior.mean, "map_lmi": solved.consistent_unknowns}
    count = len(nominal_parameters(log))
    return {Case(data, str(spread), method): (solve[method]()[:count], None) for method in methods}


def _result(
    true: ParameterSet, metrics: Mapping[str, float], values: FloatArray, rank: int | None
) -> DrawResult:
    possible = [is_consistent(phi) for phi in true.link_phi(values)]
    return DrawResult(
        metrics=dict(metrics) | ({} if rank is None else {RANK: rank}),
        links=tuple(link_errors(true, values, true.values).tolist()),
        impossible=len(possible) - sum(possible),
        values=tuple(values.tolist()),
    )


# All draws of a data set share the following, so each process caches them.


@lru_cache(maxsize=16)
def _archive(file: Path) -> tuple[Observations, ...]:
    return load_archive(file)


@lru_cache(maxsize=16)
def _filtered_rows(training: Path, validation: Path | None) -> _FilteredRows:
    (rows,) = _archive(training)
    other = None if validation is None else _archive(validation)[0].rows
    return _FilteredRows(rows, LeastSquares(rows.rows, counts=rows.counts.diagonal()), other)


@lru_cache(maxsize=2)
def _evaluator(folder: StudyFolder, ideal: SimulatedLog, interval: float) -> MotionEvaluator:
    true = true_parameters(ideal, folder)
    motion = read_true_motion([folder.log(ideal)], true.model)
    stamp = motion.samples.stamp
    stride = max(1, round(interval * 1e9 / float(np.median(np.diff(stamp)))))
    return MotionEvaluator(true, true.values, motion[::stride])


@lru_cache(maxsize=1)
def _loaded(folder: StudyFolder, log: SimulatedLog) -> LoadedProblem:
    # Unchecked, as no sensor measures the overhead support, which carries the robot in a tare.
    # The methods are compared on the same parameters: those that the simulated robot has.
    terms = ("viscous", "coulomb", "armature") if log.friction else ("none",)
    options = IdentifyOptions(prior_percent=25.0, joint_terms=terms, unchecked=True)
    return BagRequest((folder.log(log),), config_file("symbitron.xml"), options).load()


@lru_cache(maxsize=4)
def _tares(bag: Path) -> dict[str, Tare]:
    return read_tare(bag_log([bag]))


@lru_cache(maxsize=4)
def _mass(folder: StudyFolder, log: SimulatedLog) -> float:
    true = true_parameters(log, folder)
    return float(true.values[: true.inertial : 10].sum())


@dataclass(frozen=True)
class StudyResults:
    """The results of all draws.

    Attributes
    ----------
    plan : Plan
    folder : StudyFolder
    draws : dict of Case to list of DrawResult
        In the order of the draws.
    """

    plan: Plan
    folder: StudyFolder
    draws: dict[Case, list[DrawResult]]

    @classmethod
    def read(cls, plan: Plan, folder: StudyFolder) -> "StudyResults":
        """Read all draws.

        Raises
        ------
        StudyError
            If a draw is missing or damaged.
        """
        draws: dict[Case, list[DrawResult]] = {}
        for data in plan.data:
            for spread in plan.priors:
                for iteration in range(plan.iterations):
                    draw = load_draw(folder.draw(data, spread, iteration))
                    for case, result in draw.items():
                        draws.setdefault(case, []).append(result)
        return cls(plan, folder, draws)

    @cached_property
    def scores(self) -> Scores:
        """Means over the draws."""
        return Scores.of(self.draws)

    def true_parameters(self, data: str) -> ParameterSet:
        """Return the parameters of one data set with their true values."""
        return true_parameters(self.plan.data[data], self.folder)

    def estimate(
        self, data: str, spread: PriorSpread, method: str, cutoff: float, iteration: int = 0
    ) -> FloatArray:
        """Return the parameters (p,) that one method estimated in one draw.

        Raises
        ------
        StudyError
            If the study has no such draw.
        """
        case = Case.of(data, spread, method, cutoff)
        try:
            return np.array(self.draws[case][iteration].values)
        except (KeyError, IndexError):
            raise StudyError(
                f"{self.folder.out}: no draw {iteration} of {case}; add it to the plan", "E707"
            ) from None

    def link_errors(self, data: str, spread: PriorSpread, cutoff: float) -> dict[str, FloatArray]:
        """Return each method's mean error of every link (L,), %."""
        draws = {m: self.draws[Case.of(data, spread, m, cutoff)] for m in self.plan.compared}
        return {m: np.mean([one.links for one in own], axis=0) for m, own in draws.items()}

    def row_errors(self, data: str) -> dict[float, float]:
        """Return the RMS norm of y - K φ at the true parameters, N and Nm, by cutoff."""
        log = self.plan.data[data]
        true = self.true_parameters(data).values
        if not self.plan.truncated_methods:
            return {}
        errors = {}
        for cutoff in self.plan.filters:
            (rows,) = load_archive(self.folder.rows(log, log.sensors, cutoff))
            squares = [error**2 for error in rows.rows.residual_rmse(true).values()]
            errors[cutoff] = float(np.sqrt(sum(squares)))
        return errors
