"""Several robots of one type: common parameters, spread between robots, and robots that differ.

The common parameters μ and the spread between robots, a variance D of their deviations δ_r, come
from :mod:`symbid_ros.estimation.fleet_spread`.

The data rows are b_r = A_r (μ + δ_r) + ε, with V_r = 1 + A_r D A_rᵀ. A link of robot r that has
changed by E t shows it in the score g = Eᵀ A_rᵀ V_r⁻¹ (b_r - A_r μ̂). Without a change g has the
covariance M = Eᵀ A_rᵀ W A_r E, so gᵀ M⁺ g is χ² distributed. Each link of each robot is tested.
Holm's correction (1979, Scand. J. Stat. 6(2)) keeps the chance of any false alarm below ``LEVEL``.
A place that fails the test is named if its evidence, ½ gᵀ (1 + M)⁻¹ g - ½ log det (1 + M), also
exceeds the prior odds against it, one in as many as there are places. The one with the largest
evidence comes first. Then the spread is estimated again without it, and so on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.fleet_changes import DENSER, LEVEL, MassChange, link_change
from symbid_ros.estimation.fleet_spread import FleetFit, covariance_root, data_rows, spread_groups
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior_std import payload_std, term_scale
from symbid_ros.model.parameters import ParameterSet

# Places whose evidence is smaller than the best one's by this, nat, are ruled out.
DISTINGUISHABLE = 5.0


@dataclass(frozen=True)
class FleetMember:
    """One robot of a fleet.

    Attributes
    ----------
    name : str
    posterior : Posterior
        From its own data and the prior that all members share.
    """

    name: str
    posterior: Posterior


@dataclass(frozen=True)
class Deviation:
    """A place at which one robot differs from the others.

    Attributes
    ----------
    robot, place : str
        Name of the robot, and of the link or joint.
    p_value : float
        Chance of such a deviation anywhere in a fleet of equal robots, up to its usual spread.
    evidence : float
        Log-likelihood ratio of this deviation to none, nat.
    relative, relative_std : float or None
        Relative change of the whole link, if its mass is distributed as in the others; None for a
        joint.
    change, std : (k,) float64
        Change of the place's parameters, SI units, and its standard deviations.
    columns : tuple of int
        Columns of these parameters.
    alternatives : tuple of str
        Other places of this robot that explain its data about as well.
    """

    robot: str
    place: str
    p_value: float
    evidence: float
    relative: float | None
    relative_std: float | None
    change: FloatArray
    std: FloatArray
    columns: tuple[int, ...]
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class FleetEstimate:
    """Parameters of a fleet.

    Attributes
    ----------
    parameters : ParameterSet
        The p columns.
    common, common_std : (p,) float64
        Common parameters, SI units.
    values, stds : (R, p) float64
        Parameters of each robot, given the fleet.
    single_stds : (R, p) float64
        Standard deviations of the common parameters from one robot's data and the spread.
    robots : tuple of str
    spread : dict of str to float
        Relative standard deviation between robots of the moments of ``"links"`` and of each
        joint term.
    deviations : tuple of Deviation
        Robots that differ, the most evident first.
    link_changes : tuple of tuple of (MassChange or None)
        Of each link of each robot; None if the data do not show a change of the link.
    tests : int
        Number of places of all robots that were tested: those at which a typical change would show.
    """

    parameters: ParameterSet
    common: FloatArray
    common_std: FloatArray
    values: FloatArray
    stds: FloatArray
    single_stds: FloatArray
    robots: tuple[str, ...]
    spread: dict[str, float]
    deviations: tuple[Deviation, ...]
    link_changes: tuple[tuple[MassChange | None, ...], ...]
    tests: int


@dataclass(frozen=True)
class _Place:
    """A link or joint that may differ, with deviations t ~ N(0, 1) of its parameters E t.

    Attributes
    ----------
    name : str
    columns : tuple of int
        Columns of its parameters.
    any_change : (p, k) float64
        E of any change, in SI units.
    denser : (p, 1) float64 or None
        E of a link whose mass is distributed as before.
    """

    name: str
    columns: tuple[int, ...]
    any_change: FloatArray
    denser: FloatArray | None


def estimate_fleet(members: Sequence[FleetMember], parameters: ParameterSet) -> FleetEstimate:
    """Estimate common parameters and the spread between robots, and name robots that differ.

    There are at least three members, with the same prior and the same columns ``parameters``.
    """
    prior = members[0].posterior.prior
    L = prior.covariance_factor()
    typical = np.mean([one.posterior.mean for one in members], axis=0)
    single = np.sqrt(np.mean([one.posterior.std**2 for one in members], axis=0))
    # A value that is not known may be as large as its deviation.
    size = np.hypot(typical, single)
    rows = [data_rows(one.posterior) for one in members]
    fit = FleetFit.of(rows, *spread_groups(parameters, typical, size, L))
    places = _places(parameters, typical)
    scaled = [_scaled(place, L) for place in places]
    found: list[tuple[int, int, float, float, tuple[str, ...]]] = []
    tests = 0
    while True:
        tested = [
            (*test, robot, index)
            for robot in range(len(members))
            for index, one in enumerate(scaled)
            if (robot, index) not in [(entry[0], entry[1]) for entry in found]
            if (test := _test(fit, robot, one)) is not None
        ]
        tests = tests or len(tested)
        # Holm: the p-value of the next deviation counts the tests that are left.
        count = len(tested)
        odds = np.log(max(count, 1) / LEVEL)
        significant = [one for one in tested if one[1] * count < LEVEL and one[0] > odds]
        if not significant or len(found) >= len(members) * len(places) // 2:
            break
        evidence, p_value, robot, index = max(significant)
        near = tuple(
            places[other].name
            for value, p, own, other in sorted(tested, reverse=True)
            if own == robot
            and other != index
            and value > evidence - DISTINGUISHABLE
            and p * count < LEVEL
        )
        found.append((robot, index, evidence, p_value * count, near))
        fit = fit.with_deviation(robot, scaled[index][0])
    mean, covariance = fit.common
    common = prior.mean + L @ mean
    common_std = _norms(L @ np.linalg.cholesky(covariance))
    values, stds = [], []
    for robot in range(len(members)):
        own, spread = fit.member(robot)
        values.append(prior.mean + L @ own)
        stds.append(_norms(L @ covariance_root(spread)))
    links = list(zip(places, scaled, strict=True))[: len(parameters.link_names)]
    changes = [
        [_link_change(fit, robot, place, factors, L, tests=tests) for place, factors in links]
        for robot in range(len(members))
    ]
    deviations = []
    for robot, index, evidence, p_value, near in found:
        place, link = places[index], changes[robot][index] if index < len(links) else None
        deviations.append(
            Deviation(
                members[robot].name,
                place.name,
                p_value,
                evidence,
                None if link is None else link.relative,
                None if link is None else link.std,
                *_size(fit, robot, place, scaled[index][0], L),
                place.columns,
                near,
            )
        )
    return FleetEstimate(
        parameters,
        common,
        common_std,
        np.array(values),
        np.array(stds),
        np.array([_norms(L @ covariance_root(fit.alone(robot))) for robot in range(len(members))]),
        tuple(one.name for one in members),
        {name: float(size) for name, size in zip(fit.names, fit.sizes, strict=True)},
        tuple(sorted(deviations, key=lambda one: -one.evidence)),
        tuple(map(tuple, changes)),
        tests,
    )


def _places(parameters: ParameterSet, typical: FloatArray) -> list[_Place]:
    """Return the links and joints that may differ."""
    p = len(parameters)
    places = []
    added = payload_std(parameters, typical)
    for index, (name, phi) in enumerate(
        zip(parameters.link_names, parameters.link_phi(typical), strict=True)
    ):
        columns = slice(10 * index, 10 * index + 10)
        factor, denser = np.zeros((p, 10)), np.zeros((p, 1))
        factor[columns] = np.diag(added[index])
        denser[columns, 0] = DENSER * phi
        places.append(_Place(name, tuple(range(10 * index, 10 * index + 10)), factor, denser))
    scale = term_scale(parameters)
    for index, joint in enumerate(parameters.joints.tolist()):
        columns_of = [columns.start + index for columns in parameters.term_columns.values()]
        if not columns_of:
            continue
        factor = np.zeros((p, len(columns_of)))
        for place, column in enumerate(columns_of):
            factor[column, place] = scale[column - parameters.inertial]
        name = parameters.model.joint_names[joint]
        places.append(_Place(name, tuple(columns_of), factor, None))
    return places


def _scaled(place: _Place, L: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return the factors of a place in prior deviations."""
    inverse = np.asarray(np.linalg.inv(L))
    return inverse @ place.any_change, None if place.denser is None else inverse @ place.denser


def _test(
    fit: FleetFit, robot: int, factors: tuple[FloatArray, FloatArray | None]
) -> tuple[float, float] | None:
    """Return evidence and p-value of a deviation of a robot; None if no change would show."""
    score, information = fit.scores[robot]
    evidences, p_values = [], []
    for factor in factors:
        if factor is None:
            continue
        g, M = factor.T @ score, factor.T @ information @ factor
        H = np.eye(len(g)) + M
        evidences.append(float(g @ np.linalg.solve(H, g) - np.linalg.slogdet(H)[1]) / 2)
        values, V = np.linalg.eigh(M)
        shown = values > 1.0  # directions in which a typical change exceeds its deviation
        if shown.any():
            square = float(np.sum((V[:, shown].T @ g) ** 2 / values[shown]))
            p_values.append(float(chi2.sf(square, np.count_nonzero(shown))))
    if not p_values:
        return None
    evidence = float(np.logaddexp.reduce(evidences) - np.log(len(evidences)))
    return evidence, min(1.0, *(len(p_values) * one for one in p_values))


def _link_change(
    fit: FleetFit,
    robot: int,
    place: _Place,
    factors: tuple[FloatArray, FloatArray | None],
    L: FloatArray,
    *,
    tests: int,
) -> MassChange | None:
    """Return the relative change of a link; None if a change would not show."""
    any_change, denser = factors
    assert denser is not None  # it is of every link
    without = fit.without_deviation(robot, any_change)
    columns = list(place.columns)
    known = (L @ fit.common[1] @ L.T)[np.ix_(columns, columns)]
    own = np.linalg.inv(L)[:, columns] @ covariance_root(known)
    return link_change(*without.scores[robot], denser, own, tests)


def _size(
    fit: FleetFit, robot: int, place: _Place, any_change: FloatArray, L: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the change (k,) of a deviation that the fit contains, and its deviations (k,)."""
    score, information = fit.without_deviation(robot, any_change).scores[robot]
    H = np.eye(any_change.shape[1]) + any_change.T @ information @ any_change
    covariance = np.linalg.inv(H)
    own = (L @ any_change)[list(place.columns)]
    std = np.sqrt(np.einsum("ij,jk,ik->i", own, covariance, own))
    return own @ covariance @ (any_change.T @ score), std


def _norms(factor: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(factor, axis=1))
