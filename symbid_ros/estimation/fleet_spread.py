"""Common parameters of several robots of one type, and the spread between these.

Robot r has the parameters φ_r = μ + δ_r. The common ones have the prior of the model, μ ~ N(φ̄, P).
The deviations δ_r ~ N(0, D) have a variance for all moments of links and one for each joint term,
relative to the values, and a gain that all efforts of one robot have in common. These variances are
those that make the data most probable, with μ integrated out (restricted maximum likelihood:
Patterson and Thompson 1971, Biometrika 58(3)), by the fixed-point iteration of Harville 1977,
J. Am. Stat. Assoc. 72(358).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.mass_scale import FORCE_SCALE_STD
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior_std import body_covariance, term_scale
from symbid_ros.model.parameters import ParameterSet

# Information below which a direction of a robot is not used, relative to the prior's.
LEAST_INFORMATION = 1e-6
LINKS = "links"  # group of all moments of all links
# Relative deviations between robots: from where the iteration starts, and the smallest.
FIRST_SPREAD, LEAST_SPREAD = 0.01, 1e-4
ITERATIONS = 200
CONVERGED = 1e-3
# A deviation of a joint term of which nothing is known, relative to that of the prior.
LEAST_TERM = 0.02


def data_rows(found: Posterior) -> tuple[FloatArray, FloatArray]:
    """Return whitened rows A (k, p) and targets b (k,) that hold what the data alone say.

    They are about x with φ = φ̄ + L x, where x ~ N(0, 1) is the prior. Residuals that are correlated
    in time are allowed for.
    """
    L = found.prior.covariance_factor()
    R = found.factor @ L
    precision = R.T @ R
    h = precision @ np.linalg.solve(L, found.mean - found.prior.mean)
    values, V = np.linalg.eigh(precision - np.eye(len(h)))
    kept = values > max(LEAST_INFORMATION, 1e-12 * values[-1])
    root = np.sqrt(values[kept])
    U = V[:, kept] * root
    # J = U Uᵀ and h = U b. Correlated residuals add a covariance to b.
    b = V[:, kept].T @ h / root
    if found.excess_score is not None:
        excess = (V[:, kept] / root).T @ (L.T @ found.excess_score)
        whitening = np.linalg.cholesky(np.eye(len(b)) + excess @ excess.T)
        return np.linalg.solve(whitening, U.T), np.linalg.solve(whitening, b)
    return U.T, b


@dataclass(frozen=True)
class FleetFit:
    """Rows of all robots with the spread between these, in prior deviations.

    Attributes
    ----------
    rows : list of ((k, p), (k,))
        A and b of each robot.
    names : tuple of str
        Names of the groups of parameters that have a spread of their own.
    factors : tuple of (p, q) float64
        B of each group: deviations of 1 have the covariance B Bᵀ.
    sizes : (g,) float64
        Relative deviations.
    gain : (p, 1) float64
        Deviation of all parameters with the gain of a robot's efforts.
    free : tuple of tuple of (p, k) float64
        Factors of further deviations of each robot.
    """

    rows: list[tuple[FloatArray, FloatArray]]
    names: tuple[str, ...]
    factors: tuple[FloatArray, ...]
    sizes: FloatArray
    gain: FloatArray
    free: tuple[tuple[FloatArray, ...], ...]

    @classmethod
    def of(
        cls,
        rows: list[tuple[FloatArray, FloatArray]],
        factors: Mapping[str, FloatArray],
        gain: FloatArray,
    ) -> "FleetFit":
        """Estimate the spread of each group."""
        first = np.full(len(factors), FIRST_SPREAD)
        nothing: tuple[tuple[FloatArray, ...], ...] = ((),) * len(rows)
        return cls(rows, tuple(factors), tuple(factors.values()), first, gain, nothing)._converged()

    def with_deviation(self, robot: int, factor: FloatArray) -> "FleetFit":
        """Return the fit with a further deviation of one robot."""
        return self._with_free(robot, (*self.free[robot], factor))._converged()

    def without_deviation(self, robot: int, factor: FloatArray) -> "FleetFit":
        """Return the fit without that deviation, whose score then shows its size."""
        kept = tuple(one for one in self.free[robot] if one is not factor)
        return self if len(kept) == len(self.free[robot]) else self._with_free(robot, kept)

    def _with_free(self, robot: int, factors: tuple[FloatArray, ...]) -> "FleetFit":
        return replace(self, free=(*self.free[:robot], factors, *self.free[robot + 1 :]))

    def _converged(self) -> "FleetFit":
        fit = self
        for _ in range(ITERATIONS):
            sizes = np.maximum(fit.sizes * np.sqrt(fit._ratios()), LEAST_SPREAD)
            change = np.max(np.abs(np.log(sizes / fit.sizes)), initial=0.0)
            fit = replace(fit, sizes=sizes)
            if change < CONVERGED:
                break
        return fit

    def _ratios(self) -> FloatArray:
        """Squares of the groups' scores over their expected values, (g,)."""
        totals = np.zeros((2, len(self.factors)))
        for score, information in self.scores:
            for group, factor in enumerate(self.factors):
                totals[0, group] += np.sum((factor.T @ score) ** 2)
                totals[1, group] += np.sum((information @ factor) * factor)
        return np.asarray(totals[0] / np.maximum(totals[1], 1e-300))

    def spread_factor(self, robot: int) -> FloatArray:
        """Return F (p, q) with the covariance D = F Fᵀ of a robot's deviations."""
        scaled = [size * one for size, one in zip(self.sizes, self.factors, strict=True)]
        return np.concatenate([*scaled, self.gain, *self.free[robot]], axis=1)

    @cached_property
    def whitened(self) -> list[tuple[FloatArray, FloatArray]]:
        """V^(-1/2) A and V^(-1/2) b of each robot."""
        found = []
        for robot, (A, b) in enumerate(self.rows):
            moved = A @ self.spread_factor(robot)
            root = np.linalg.cholesky(np.eye(len(b)) + moved @ moved.T)
            found.append((np.linalg.solve(root, A), np.linalg.solve(root, b)))
        return found

    @cached_property
    def common(self) -> tuple[FloatArray, FloatArray]:
        """Mean (p,) and covariance (p, p) of the common parameters."""
        parts = self.whitened
        p = self.gain.shape[0]
        precision = np.eye(p) + sum(A.T @ A for A, _ in parts)
        covariance = np.linalg.inv(precision)
        mean = covariance @ sum(A.T @ b for A, b in parts)
        return mean, (covariance + covariance.T) / 2

    def alone(self, robot: int) -> FloatArray:
        """Return the covariance (p, p) of the common parameters from one robot's data."""
        A, _ = self.whitened[robot]
        return np.asarray(np.linalg.inv(np.eye(A.shape[1]) + A.T @ A))

    @cached_property
    def scores(self) -> list[tuple[FloatArray, FloatArray]]:
        """The score (p,) of each robot's deviation, and its covariance (p, p)."""
        mean, covariance = self.common
        found = []
        for A, b in self.whitened:
            information = A.T @ A
            spread = information - information @ covariance @ information
            found.append((A.T @ (b - A @ mean), spread))
        return found

    def member(self, robot: int) -> tuple[FloatArray, FloatArray]:
        """Return mean (p,) and covariance (p, p) of a robot's parameters, given all robots."""
        mean, covariance = self.common
        A, b = self.whitened[robot]
        F = self.spread_factor(robot)
        D = F @ F.T
        moved = D @ A.T  # covariance of the deviation with the whitened rows
        left = np.eye(len(mean)) - moved @ A
        spread = D - moved @ moved.T + left @ covariance @ left.T
        return mean + moved @ (b - A @ mean), spread


def spread_groups(
    parameters: ParameterSet, typical: FloatArray, size: FloatArray, L: FloatArray
) -> tuple[dict[str, FloatArray], FloatArray]:
    """Return the factors of the groups of parameters, and of the gain, in prior deviations."""
    p, first = len(parameters), parameters.inertial
    blocks = [covariance_root(body_covariance(phi, 100.0)) for phi in parameters.link_phi(typical)]
    groups = {LINKS: np.zeros((p, first))}
    groups[LINKS][:first] = block_diag(*blocks)
    least = np.zeros(p)
    least[first:] = LEAST_TERM * term_scale(parameters)
    size = np.maximum(size, least)
    for term, columns in parameters.term_columns.items():
        indices = np.arange(p)[columns]
        factor = np.zeros((p, len(indices)))
        factor[indices, np.arange(len(indices))] = size[indices]
        groups[term] = factor
    inverse = np.linalg.inv(L)
    scaled = {name: inverse @ factor for name, factor in groups.items()}
    return scaled, inverse @ (FORCE_SCALE_STD * typical[:, None])


def covariance_root(covariance: FloatArray) -> FloatArray:
    """Return F with F Fᵀ equal to a covariance that may be singular."""
    values, V = np.linalg.eigh((covariance + covariance.T) / 2)
    root: FloatArray = V * np.sqrt(np.maximum(values, 0.0))
    return root
