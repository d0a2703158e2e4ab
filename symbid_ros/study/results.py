"""All that a study has worked out, read back."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.study.draws import load_draw
from symbid_ros.study.logs import truth
from symbid_ros.study.plan import Plan, Spread
from symbid_ros.study.scores import REFERENCE, Case, Outcome, Scores
from symbid_ros.study.workspace import Workspace


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
