"""What every method achieved in every draw, and what that is on average."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.report.content import METRICS as TITLED

# The fields of `evaluation.Metrics`, and the number of singular values kept.
METRICS = tuple(metric.key for metric in TITLED)
RANK = "singular_values"
REFERENCE = "ref"


@dataclass(frozen=True)
class Case:
    """What one mean is of.

    Attributes
    ----------
    data : str
        Name of the data set.
    prior : str
        How the priors were drawn, such as "±25 %".
    method : str
        "ref" for the prior itself, or one of `symbid_ros.identification.problem.METHODS`.
    filter : float or None
        Hz, cutoff of its rows, 0 unfiltered; None for the prior and for methods whose rows are
        averaged over windows instead.
    """

    data: str
    prior: str
    method: str
    filter: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What one method made of one draw.

    Attributes
    ----------
    metrics : dict of str to float
        By the names in `METRICS`, and `RANK` for truncated methods.
    links : tuple of float
        Mean relative parameter error of each link, %.
    impossible : int
        Links that no body can have.
    values : tuple of float
        The parameters.
    """

    metrics: Mapping[str, float]
    links: tuple[float, ...]
    impossible: int
    values: tuple[float, ...]


@dataclass(frozen=True)
class Scores:
    """Means over the draws.

    Attributes
    ----------
    means : dict of Case to dict of str to float
        By the names in `METRICS`, and `RANK` for truncated methods.
    """

    means: Mapping[Case, Mapping[str, float]]

    @classmethod
    def of(cls, outcomes: Mapping[Case, list[Outcome]]) -> "Scores":
        """Average over the draws."""
        return cls(
            {
                case: {
                    name: float(np.mean([one.metrics[name] for one in found]))
                    for name in found[0].metrics
                }
                for case, found in outcomes.items()
            }
        )

    def filters(self, data: str, prior: str, method: str) -> list[float | None]:
        """Return the cutoffs tried for one method, ascending."""
        tried = [
            case.filter
            for case in self.means
            if (case.data, case.prior, case.method) == (data, prior, method)
        ]
        return sorted(tried, key=lambda cutoff: -1.0 if cutoff is None else cutoff)

    def at(self, data: str, prior: str, method: str, cutoff: float | None) -> Mapping[str, float]:
        """Return one method's means with one filter; empty where it was not tried."""
        return self.means.get(Case(data, prior, method, cutoff), {})

    def best(self, data: str, prior: str, method: str) -> dict[str, float]:
        """Return each metric's least mean over the filters (thesis, Table II).

        Of the number of singular values it is the mean over the filters.
        """
        tried = [
            self.at(data, prior, method, cutoff) for cutoff in self.filters(data, prior, method)
        ]
        if not tried:
            return {}
        return {
            name: float((np.mean if name == RANK else np.min)([means[name] for means in tried]))
            for name in tried[0]
        }
