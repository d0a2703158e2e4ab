"""Errors of each method, for single draws and as means over the draws."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.choices import GAUSSIAN
from symbid_ros.report.content import METRICS as TITLED

# The fields of `evaluation.Metrics`, and the number of singular values kept.
METRICS = tuple(metric.key for metric in TITLED)
RANK = "singular_values"
REFERENCE = "ref"


@dataclass(frozen=True)
class Case:
    """One combination that a study evaluates; its fields are keys of the files of draws.

    Attributes
    ----------
    data : str
        Name of the data set.
    prior : str
        How the priors were drawn, such as "±25 %".
    method : str
        "ref" for the prior itself, or one of `symbid_ros.identification.problem.METHODS`.
    filter : float or None
        Cutoff of the rows' filter, Hz; 0: unfiltered. None for the prior, and for methods that
        average rows over windows.
    """

    data: str
    prior: str
    method: str
    filter: float | None = None

    @classmethod
    def of(cls, data: str, prior: object, method: str, cutoff: float | None) -> "Case":
        """Return a case, without the cutoff for methods that have no filter."""
        is_filtered = method != REFERENCE and method not in GAUSSIAN
        return cls(data, str(prior), method, cutoff if is_filtered else None)


@dataclass(frozen=True)
class DrawResult:
    """One method's result for one draw of the prior; its fields are keys of the files of draws.

    Attributes
    ----------
    metrics : dict of str to float
        Errors by the names in `METRICS`, and `RANK` for truncated methods.
    links : tuple of float
        Mean relative parameter error of each link, %.
    impossible : int
        Number of physically impossible links.
    values : tuple of float
        The estimated parameters.
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
        Mean errors by the names in `METRICS`, and `RANK` for truncated methods.
    """

    means: Mapping[Case, Mapping[str, float]]

    @classmethod
    def of(cls, results: Mapping[Case, list[DrawResult]]) -> "Scores":
        """Average over the draws."""
        return cls(
            {
                case: {
                    name: float(np.mean([one.metrics[name] for one in found]))
                    for name in found[0].metrics
                }
                for case, found in results.items()
            }
        )

    def filters(self, data: str, prior: str, method: str) -> list[float | None]:
        """Return the cutoffs evaluated for one method, ascending."""
        cutoffs = [
            case.filter
            for case in self.means
            if (case.data, case.prior, case.method) == (data, prior, method)
        ]
        return sorted(cutoffs, key=lambda cutoff: -1.0 if cutoff is None else cutoff)

    def at(self, data: str, prior: str, method: str, cutoff: float | None) -> Mapping[str, float]:
        """Return one method's mean errors with one filter; empty if it was not evaluated."""
        return self.means.get(Case(data, prior, method, cutoff), {})

    def best(self, data: str, prior: str, method: str) -> dict[str, float]:
        """Return the smallest mean of each error over the filters (thesis, Table II).

        The number of singular values is averaged over the filters instead.
        """
        means = [
            self.at(data, prior, method, cutoff) for cutoff in self.filters(data, prior, method)
        ]
        if not means:
            return {}
        return {
            name: float((np.mean if name == RANK else np.min)([one[name] for one in means]))
            for name in means[0]
        }
