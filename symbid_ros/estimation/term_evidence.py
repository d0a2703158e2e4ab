"""Evidence for joint terms: which the data resolve, and cross-validation by groups of seconds.

Both work on the Gaussian posterior of all candidates together, so that no term needs a solve of
its own.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SPRING, Term
from symbid_ros.estimation.group_moments import CoordinateMoments, CoordinateRows, GroupMoments
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.ripple import Ripple
from symbid_ros.model.warming import Warming

# Log Bayes factor from which the evidence alone supports an armature.
SUPPORTED = 2.0
# Correlation from which two terms of a joint are inseparable.
INSEPARABLE = 0.995
# Smallest share of a joint's information that is left when a group of rows is left out.
LEAST_LEFT = 1e-3
# Share of its prior deviation above which an armature is unresolved. Fixed at zero it would bias
# the links' inertias, which it resembles, so it stays free and undetermined.
UNRESOLVED = 0.1
# Share of its variance that is due to the links' parameters, above which it is mixed up with them.
MIXED = 0.5
# Share by which a coupled drive or a ripple must reduce the square error of left-out rows of its
# joints. On arms without coupled drives, model errors let it fall by up to 0.42; on a Stäubli TX40
# by 0.79.
LEAST_GAIN = 0.5

# Log-likelihood that one armature of all drives must add, and of how many drives at least.
COMMON = 5.0
FEWEST_ALIKE = 6
# Log-likelihood that friction which leads at all drives alike must add.
COMMON_LEAD = 20.0

FRICTION: tuple[Term, ...] = ("viscous", "coulomb")
# Terms by which a coupled drive is found. The rotor of one with little friction shows by its
# armature: unless the joints are parallel, no link has its inertia in both rows.
DRIVE: tuple[Term, ...] = (*FRICTION, "armature")

Key = TypeVar("Key", bound=Hashable)


class CandidateTerms:
    """Evidence for each candidate term, from the Gaussian posterior with all of them free."""

    def __init__(self, found: Posterior, parameters: ParameterSet, terms: IntArray) -> None:
        factor = found.deviation_factor[terms]
        self._terms = terms
        self._mean, self._covariance = found.mean[terms], factor @ factor.T
        precision = found.factor[:, terms]
        self._without_links = np.linalg.inv(precision.T @ precision).diagonal()
        self._prior = found.prior
        self._parameters = parameters
        self._nonnegative = parameters.nonnegative
        owners = [parameters.names[i].rpartition("/") for i in terms]
        self._joints = [joint for joint, _, _ in owners]
        self._kinds = np.array([kind for _, _, kind in owners], dtype=np.str_)

    def inseparable(self) -> tuple[tuple[int, int], ...]:
        """Return pairs of terms of one joint whose errors are completely correlated.

        Friction that depends on the load, which may resemble all other terms together, is fixed.
        """
        covariance = self._covariance
        fixed = self._kinds == "load"
        if fixed.any():
            gain = np.linalg.solve(covariance[np.ix_(fixed, fixed)], covariance[fixed])
            covariance = covariance - covariance[:, fixed] @ gain
        std = np.sqrt(np.where(fixed, self._covariance.diagonal(), covariance.diagonal()))
        correlation = np.abs(covariance / np.outer(std, std))
        wide = std > 0.1 * self._prior.std[self._terms]
        pairs = np.argwhere(np.triu(correlation > INSEPARABLE, 1) & np.outer(wide, wide))
        return tuple(
            (int(self._terms[one]), int(self._terms[two]))
            for one, two in pairs
            if self._joints[one] == self._joints[two]
        )

    @property
    def armatures(self) -> BoolArray:
        """Which terms are armatures of joints."""
        is_armature = self._kinds == "armature"
        return np.asarray(is_armature & (self._terms < self._parameters.first_coupled))

    def have_common_armature(self) -> bool:
        """Return whether the data support one armature of all drives, with the other terms free.

        Legs have the same motor in each joint. Their armatures may resemble the links' inertias so
        much that none is visible alone.
        """
        some = np.flatnonzero(self.armatures)
        if len(some) < FEWEST_ALIKE:
            return False
        precision = np.linalg.inv(self._covariance[np.ix_(some, some)])
        shift = (self._mean - self._prior.mean[self._terms])[some]
        # Least squares of one value for all of them.
        information = float(precision.sum())
        value = float(precision.sum(axis=0) @ shift) / information
        return value > 0 and 0.5 * value**2 * information > COMMON

    def mixed(self) -> BoolArray:
        """Return which terms are armatures that would be known far better if the links were."""
        return np.asarray(self.armatures & self._depends_on_links)

    def hidden_offsets(self) -> BoolArray:
        """Return which terms are offsets that would be known far better if the links were.

        In the rows of their joint alone, inertias replace them; the other rows separate both.
        """
        return np.asarray((self._kinds == "offset") & self._depends_on_links)

    @property
    def _depends_on_links(self) -> BoolArray:
        """Which terms would be known far better if the parameters of the links were known."""
        return np.asarray(self._without_links < (1 - MIXED) * self._covariance.diagonal())

    def ambiguous(self) -> BoolArray:
        """Return which terms are mixed armatures that the evidence alone does not support."""
        return np.asarray(self.mixed() & (self._log_bayes_factors() < SUPPORTED))

    def resolved(self) -> BoolArray:
        """Return which terms are armatures that the log resolves."""
        std = np.sqrt(self._covariance.diagonal())
        is_known = std < UNRESOLVED * self._prior.std[self._terms]
        return np.asarray(self.armatures & is_known & ~self.ambiguous())

    def unresolved(self) -> BoolArray:
        """Return which terms are armatures that the data do not separate from inertias of links."""
        std = np.sqrt(self._covariance.diagonal())
        return np.asarray(self.mixed() & (std > UNRESOLVED * self._prior.std[self._terms]))

    def _log_bayes_factors(self) -> FloatArray:
        """Return the log Bayes factor of each term, free against fixed at the prior's mean.

        For z posterior deviations between estimate and prior mean, it is the largest over the
        prior deviations that are possible, (z² - 1 - ln z²)/2.
        """
        shift = self._mean - self._prior.mean[self._terms]
        # A negative friction or armature is impossible, so its size supports nothing.
        impossible = (self._mean < 0) & (shift < 0) & self._nonnegative[self._terms]
        square = np.where(impossible, 0.0, shift**2 / self._covariance.diagonal())
        square = np.maximum(square, 1.0)
        return np.asarray((square - 1 - np.log(square)) / 2)


def have_common_lead(found: Posterior, leads: IntArray, coulomb: IntArray) -> bool:
    """Return whether the Coulomb friction of all drives leads by one and the same share of itself.

    A simulator's friction leads at every joint. Single drives that seem to lead are errors of
    their model: in eight logs of real arms this share added 14 to the log-likelihood at most, and
    thousands in those of a simulated quadruped. All these terms are free in ``found``; ``leads``
    and ``coulomb`` (k,) are the parameters of the same drives.
    """
    factor = found.deviation_factor[leads]
    friction = np.maximum(found.mean[coulomb], 0.0)
    precise = np.linalg.solve(factor @ factor.T, friction)
    # Least squares of the share.
    information, value = float(friction @ precise), float(precise @ found.mean[leads])
    return value > 0 and 0.5 * value**2 > COMMON_LEAD * information


def cross_validated(
    free: BoolArray,
    kept: set[int],
    found: Posterior,
    chosen: Observations,
    parameters: ParameterSet,
) -> BoolArray:
    """Return the free parameters without terms that predict left-out rows no better than none."""
    free = free.copy()
    groups = chosen.groups
    assert groups is not None
    first = 6 * parameters.model.floating
    columns_of = list(parameters.term_columns.values())
    joints = parameters.joints.tolist()
    parts = {part.coordinate: part for part in groups.complete}
    for index, joint in enumerate(joints):
        own = {columns.start + index for columns in columns_of}
        part = parts.get(first + joint)
        has_rows = bool(groups.counts[:, first + joint].any())
        if parameters.model.contacts is not None and not has_rows:
            free = _without_useless(free, own - kept, found, groups)
            continue
        if part is None:
            continue
        while True:
            terms = [i for i in sorted(own) if free[i] and i not in kept]
            if any(parameters.names[i].endswith("/stribeck") for i in terms):
                # Stribeck friction is by how much friction exceeds Coulomb's.
                terms = [i for i in terms if not parameters.names[i].endswith("/coulomb")]
            if not terms:
                break
            if (useless := _useless_term(terms, [_LeftOut(found, free, groups, part)])) is None:
                break
            free[useless] = False
    for coupling, coupled in parameters.coupling_columns.items():
        # The drive's terms act on several joints, whose rows judge them together.
        of_joints = [parts[first + joint] for joint in coupling.joints if first + joint in parts]
        while terms := [i for i in coupled.values() if free[i]]:
            losses = [_LeftOut(found, free, groups, part) for part in of_joints]
            if (useless := _useless_term(terms, losses)) is None:
                break
            free[useless] = False
    return free


def _useless_term(terms: Sequence[int], losses: Sequence["_LeftOut"]) -> int | None:
    """Return the term that predicts left-out rows least; None if each predicts them better."""
    before = sum(loss.without(None) for loss in losses)
    gains = [sum(loss.without(term) for loss in losses) - before for term in terms]
    worst = int(np.argmin(gains))
    return None if gains[worst] > 0 else terms[worst]


def _without_useless(
    free: BoolArray, own: set[int], found: Posterior, groups: GroupMoments
) -> BoolArray:
    """Return the free parameters without those of ``own`` that predict no left-out row better.

    A joint without rows of its own is part of those without the wrenches of contacts. All rows
    that a term affects judge it.
    """
    own = {term for term in own if free[term]}
    free = free.copy()
    columns = groups.layout.columns
    judges = [
        _LeftOut(found, free, groups, part)
        for part in groups.complete
        if groups.counts[:, part.coordinate].any() and not own.isdisjoint(columns[part.coordinate])
    ]
    before = sum(one.without(None) for one in judges)
    for term in own:
        if sum(one.without(term) for one in judges) <= before:
            free[term] = False
    return free


@dataclass(frozen=True)
class Effect:
    """Columns of one possible cause of residuals.

    Attributes
    ----------
    columns : tuple of int
    coordinates : tuple of int
        Coordinates whose rows judge it.
    positive : tuple of int
        Columns whose coefficients cannot be negative.
    """

    columns: tuple[int, ...]
    coordinates: tuple[int, ...]
    positive: tuple[int, ...] = ()


def coupled_drives(parameters: ParameterSet) -> dict[Coupling, Effect]:
    """Return the effects of all couplings: friction and armature of a drive of several joints."""
    first, effects = 6 * parameters.model.floating, {}
    for coupling, columns in parameters.coupling_columns.items():
        own = tuple(columns[term] for term in DRIVE if term in columns)
        coordinates = tuple(first + joint for joint in coupling.joints)
        effects[coupling] = Effect(own, coordinates, positive=own)
    return effects


def ripple_torques(parameters: ParameterSet) -> dict[Ripple, Effect]:
    """Return the effects of all ripples."""
    first = 6 * parameters.model.floating
    return {
        ripple: Effect((columns.start, columns.start + 1), (first + ripple.joint,))
        for ripple, columns in parameters.ripple_columns.items()
    }


def changing_friction(parameters: ParameterSet) -> dict[Warming, Effect]:
    """Return the effects of friction that changes during the log: it falls in each part."""
    first, effects = 6 * parameters.model.floating, {}
    for one, columns in parameters.warming_columns.items():
        all_columns = tuple(range(columns.start, columns.stop))
        starts = tuple(
            column
            for column, term in zip(all_columns, one.terms, strict=True)
            if term.endswith("_0")
        )
        effects[one] = Effect(all_columns, (first + one.joint,), positive=starts)
    return effects


def spring_torques(parameters: ParameterSet) -> dict[int, Effect]:
    """Return the effects of springs by joint: with its offset, a spring is relaxed anywhere."""
    first = 6 * parameters.model.floating
    columns = [parameters.term_columns[term] for term in (SPRING, "offset")]
    return {
        joint: Effect(tuple(one.start + index for one in columns), (first + joint,))
        for index, joint in enumerate(parameters.joints.tolist())
        if joint not in parameters.model.followers
    }


def predictive_effects(
    found: Posterior,
    chosen: Observations,
    effects: Mapping[Key, Effect],
    free: BoolArray,
    least: float = LEAST_GAIN,
) -> tuple[Key, ...]:
    """Return the effects that predict left-out rows of their coordinates better.

    The one that helps most is added first, until none helps any more.

    Parameters
    ----------
    found : Posterior
        With the columns of all effects.
    chosen : Observations
        The rows that it is from.
    effects : mapping to Effect
        By whatever names them.
    free : (p,) bool
        Parameters that are free without any effect.
    least : float
        Share of the square error that an effect must remove; half of it by default.
    """
    groups = chosen.groups
    assert groups is not None
    parts = {part.coordinate: part for part in groups.complete}
    taken: list[Key] = []

    def error(effect: Effect, free: BoolArray) -> float:
        judges = [parts[one] for one in effect.coordinates if one in parts]
        return sum((_LeftOut(found, free, groups, part).without(None) for part in judges), 0.0)

    while True:
        best, most, best_free = None, least, free
        for name, effect in effects.items():
            before = 0.0 if name in taken else error(effect, free)
            if before == 0:
                continue
            more = _with_effect(found, free, effect)
            if more is None:
                continue
            gain = 1 - error(effect, more) / before
            if gain > most:
                best, most, best_free = name, gain, more
        if best is None:
            return tuple(taken)
        taken.append(best)
        free = best_free


def _with_effect(found: Posterior, free: BoolArray, effect: Effect) -> BoolArray | None:
    """Return the free parameters (p,) with an effect; None if what must be positive is not.

    If all columns must be positive, as those of drives, some may do without the others: a part of
    them resembles other terms, as Coulomb friction does Stribeck friction.
    """
    columns, positive = np.array(effect.columns), np.array(effect.positive, dtype=np.int64)

    def some(used: IntArray) -> tuple[BoolArray, IntArray]:
        """Return the free parameters with some columns, and those of them that are negative."""
        more = free.copy()
        more[used] = True
        of_sign = np.intersect1d(used, positive)
        return more, of_sign[conditional(found, more, of_sign)[0] < 0]

    more, negative = some(columns)
    while len(negative) and len(positive) == len(effect.columns):
        columns = np.setdiff1d(columns, negative)
        more, negative = some(columns)
    added = np.any(more & ~free)
    return more if added and not len(negative) else None


def conditional(
    found: Posterior, unknowns: BoolArray, some: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (s,) and covariance (s, s) of some parameters.

    Those of the first k that are not ``unknowns`` (k,) are given to be at their prior means.
    """
    mean, covariance = found.mean[some], found.parameter_covariance
    fixed = np.flatnonzero(~unknowns)
    own = covariance[np.ix_(some, some)]
    if len(fixed):
        cross = covariance[np.ix_(fixed, some)]
        gain = np.linalg.solve(covariance[np.ix_(fixed, fixed)], cross).T
        mean = mean - gain @ (found.mean - found.prior.mean)[fixed]
        own = own - gain @ cross
    return mean, own


class _LeftOut:
    """Square error of a joint's rows, each group predicted from all other rows."""

    def __init__(
        self,
        found: Posterior,
        free: BoolArray,
        groups: GroupMoments,
        part: CoordinateMoments | CoordinateRows,
    ) -> None:
        self._found = found
        self._unknowns = np.ones(len(found.mean), bool)
        self._unknowns[: len(free)] = free
        self._part, self._columns = part, groups.layout.columns[part.coordinate]
        self._weight = 1 / found.covariance[part.coordinate, part.coordinate]

    def without(self, term: int | None) -> float:
        """Return the sum of squares, in variances, if one of the free terms is fixed too."""
        unknowns = self._unknowns.copy()
        if term is not None:
            unknowns[term] = False
        found = self._found
        used = unknowns[self._columns]
        # The fixed columns are moved to the right-hand side.
        right = np.zeros(len(self._columns) + 1)
        right[:-1][~used] = -found.prior.mean[self._columns[~used]]
        right[-1] = 1.0
        mean, covariance = conditional(found, unknowns, self._columns[used])
        if isinstance(self._part, CoordinateRows):
            return self._of_rows(self._part, used, right, mean, covariance)
        return self._of_moments(self._part, used, right, mean, covariance)

    def _of_rows(
        self,
        part: CoordinateRows,
        used: BoolArray,
        right: FloatArray,
        mean: FloatArray,
        covariance: FloatArray,
    ) -> float:
        """Return the sum of squares from a group's rows, which are fewer than its columns.

        With the share H = K C Kᵀ of the rows in their own prediction, the residual e becomes
        (1 - H)⁻¹ e without them.
        """
        total = 0.0
        for rows in part.rows:
            K = np.sqrt(self._weight) * rows[:, :-1][:, used]
            residual = K @ mean - np.sqrt(self._weight) * (rows @ right)
            share, U = np.linalg.eigh(K @ covariance @ K.T)
            pull = share / np.maximum(1 - share, LEAST_LEFT) * (U.T @ residual)
            total += float(np.sum((residual + U @ pull) ** 2))
        return total

    def _of_moments(
        self,
        part: CoordinateMoments,
        used: BoolArray,
        right: FloatArray,
        mean: FloatArray,
        covariance: FloatArray,
    ) -> float:
        """Return the sum of squares from a group's moments."""
        moved, place = part.moments @ right, np.flatnonzero(used)
        values, V = np.linalg.eigh(covariance)
        L = V * np.sqrt(np.maximum(values, 0.0))
        total = 0.0
        for moment, side in zip(part.moments, moved, strict=True):
            G, g = self._weight * moment[np.ix_(place, place)], self._weight * side[place]
            left, U = np.linalg.eigh(np.eye(len(L)) - L.T @ G @ L)
            pull = U.T @ (L.T @ (G @ mean - g))
            without = mean + L @ (U @ (pull / np.maximum(left, LEAST_LEFT)))
            total += float(without @ G @ without - 2 * g @ without + self._weight * right @ side)
        return total
