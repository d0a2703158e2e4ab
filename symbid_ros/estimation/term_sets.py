"""Sets of joint terms, compared joint by joint in one Gaussian over all candidate terms.

With the other terms fixed at their prior means, the largest log-likelihood of a set is
-½ dᵀ C⁻¹ d: d is by how much the fixed terms miss their prior means if all terms are free, C the
covariance of these misses. Each free term has a cost, less if most of the other drives have such a
term, more if few have (a beta-binomial prior; Scott and Berger 2010, Ann. Statist. 38(5)). Terms of
one joint resemble each other over a small range of speeds, so a term that seems needless beside the
others may belong to the best set, and all sets of a joint are compared.

Several sets may explain the data alike. The deviations then allow for all of them, each with its
posterior probability (Bayesian model averaging; Hoeting et al. 1999, Statistical Science 14(4)).
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SIMULATED_TERMS, Term
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.model.parameters import ParameterSet

# Log-likelihood that a free term must add if half of the drives have it: 2.6 standard deviations.
ENTER = 3.4
# By how much more a term must add that resembles the friction of every drive, viscous and Coulomb.
RARE = 2.0
RARE_TERMS: frozenset[Term] = frozenset(
    {"stribeck", "load", "presliding", "stiffness", *SIMULATED_TERMS}
)
# By how much less a term must add that was chosen before, so that a live choice does not alternate.
STAY = 1.8
# Smallest cost of a term that all other drives have: 0.7 standard deviations.
LEAST = 0.25
# Passes over all joints, which end earlier when no set changes.
PASSES = 20
# Relative probability below which a set is not regarded.
LEAST_PROBABLE = 1e-4


@dataclass(frozen=True)
class _JointSets:
    """The sets of one joint that are possible if the other joints keep theirs.

    Attributes
    ----------
    free : (k, m) bool
        Which terms each set frees.
    score : (k,) float64
        Log-likelihood less the cost of the free terms.
    shift, covariance : (m,), (m, m) float64
        Of the joint's terms from their prior means, if all of them are free.
    """

    free: BoolArray
    score: FloatArray
    shift: FloatArray
    covariance: FloatArray

    def removed(self, free: BoolArray, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how much variance (m, m) and shift (m,) a set's fixed terms take away.

        Both are in the units of ``root`` (m, m).
        """
        fixed = np.ix_(~free, ~free)
        precision = np.zeros_like(self.covariance)
        precision[fixed] = np.linalg.inv(self.covariance[fixed])
        return root.T @ precision @ root, -root.T @ (precision @ self.shift)


class TermSets:
    """Sets of free terms, and how probable they are.

    Parameters
    ----------
    found : Posterior
        With all candidates free.
    parameters : ParameterSet
    terms : (t,) int
        Indices of the candidates among the parameters.
    kept, fixed, before : set of int
        Parameters that are free in every set or in none, and those of an earlier choice.
    """

    def __init__(
        self,
        found: Posterior,
        parameters: ParameterSet,
        terms: IntArray,
        *,
        kept: set[int],
        fixed: set[int],
        before: set[int],
    ) -> None:
        self._factor = found.deviation_factor
        self._terms = terms
        factor = self._factor[terms]
        self._covariance = factor @ factor.T
        self._prior = found.prior.mean[terms]
        self._shift = found.mean[terms] - self._prior
        self._nonnegative = parameters.nonnegative[terms]
        self._kept = np.array([i in kept for i in terms], dtype=bool)
        self._fixed = np.array([i in fixed for i in terms], dtype=bool)
        names = [parameters.names[i].rpartition("/") for i in terms]
        self._kinds = np.array([kind for _, _, kind in names])
        drives = np.array([drive for drive, _, _ in names])
        self._groups = [np.flatnonzero(drives == one) for one in dict.fromkeys(drives.tolist())]
        earlier = np.array([i in before for i in terms], dtype=bool)
        is_rare = np.isin(self._kinds, sorted(RARE_TERMS))
        self._enter = ENTER + RARE * is_rare - STAY * earlier
        self._cost = self._enter

    def best(self) -> IntArray:
        """Return the indices of the parameters of the best set found.

        Each joint in turn gets its best set beside those of the others, until none changes. The
        first pass does not know yet what most drives have.
        """
        free = ~self._fixed
        for turn in range(PASSES):
            changed = turn == 0
            for places in self._groups:
                sets = self._sets(places, free)
                better = sets.free[int(np.argmax(sets.score))]
                changed |= not np.array_equal(free[places], better)
                free[places] = better
            if not changed:
                break
            self._cost = self._costs(free)
        chosen: IntArray = self._terms[free]
        return chosen

    def deviations(self, chosen: IntArray) -> FloatArray:
        """Return N (p, k): other sets than the chosen one add N Nᵀ to the covariance.

        Each joint's other sets are regarded beside the chosen sets of the others.
        """
        free = np.isin(self._terms, chosen)
        self._cost = self._costs(free)
        parts = [np.zeros((len(self._factor), 0))]
        for places in self._groups:
            sets = self._sets(places, free)
            weight = np.exp(np.minimum(sets.score - sets.score.max(), 0.0))
            weight[weight < LEAST_PROBABLE] = 0.0
            weight = weight / weight.sum()
            # In units in which the joint's terms, all free, are independent.
            root, inverse = _root(sets.covariance)
            now, shift_now = sets.removed(free[places], root)
            core = np.zeros_like(now)
            for one, probability in zip(sets.free, weight, strict=True):
                if probability == 0 or np.array_equal(one, free[places]):
                    continue
                other, shift = sets.removed(one, root)
                change = shift - shift_now
                core += probability * (now - other + np.outer(change, change))
            values, U = np.linalg.eigh(core)
            if values[-1] <= 0:
                continue
            effect = self._effect(places, free) @ inverse
            parts.append(effect @ (U * np.sqrt(np.maximum(values, 0.0))))
        return np.concatenate(parts, axis=1)

    def _costs(self, free: BoolArray) -> FloatArray:
        """Return the cost (t,) of each term beside the other drives' terms of its kind."""
        alike = self._kinds == self._kinds[:, None]
        np.fill_diagonal(alike, False)
        have = alike @ free.astype(float)
        lack = alike @ (~free).astype(float)
        cost: FloatArray = np.maximum(self._enter + np.log((lack + 0.5) / (have + 0.5)), LEAST)
        return cost

    def _sets(self, places: IntArray, free: BoolArray) -> _JointSets:
        """Return the possible sets of one joint beside the others' free terms."""
        shift, covariance = self._beside(places, free)
        choices = [
            (True,) if self._kept[i] else (False,) if self._fixed[i] else (False, True)
            for i in places
        ]
        sets = np.array(list(product(*choices)), dtype=bool)
        is_possible, score = self._scores(places, sets, shift, covariance)
        return _JointSets(sets[is_possible], score[is_possible], shift, covariance)

    def _scores(
        self, places: IntArray, sets: BoolArray, shift: FloatArray, covariance: FloatArray
    ) -> tuple[BoolArray, FloatArray]:
        """Return which sets (k, m) of free terms are possible, and the score (k,) of each."""
        kinds, kept = self._kinds[places], self._kept[places]
        optional = sets & ~kept
        cost = optional @ self._cost[places]
        # C⁻¹ d of the fixed terms, with rows and columns of the identity for the free ones.
        taken = ~sets
        fixed = np.where(taken[:, :, None] & taken[:, None, :], covariance, np.eye(len(places)))
        pull = np.linalg.solve(fixed, np.where(taken, shift, 0.0)[:, :, None])[:, :, 0]
        left = np.where(taken, 0.0, shift - pull @ covariance)
        # A negative friction or armature is impossible, so its size supports nothing.
        value = self._prior[places] + left
        negative = optional & self._nonnegative[places] & (value < 0) & (left < 0)
        is_possible = ~negative.any(axis=1)
        # Stribeck friction is by how much friction exceeds Coulomb's at low speed, presliding by
        # how much it lags behind.
        if "coulomb" in kinds:
            beside = sets[:, np.isin(kinds, ["stribeck", "presliding", *SIMULATED_TERMS])].any(
                axis=1
            )
            is_possible &= sets[:, kinds == "coulomb"].any(axis=1) | ~beside
        return is_possible, -0.5 * (pull @ shift) - cost

    def _beside(self, places: IntArray, free: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return shift and covariance of a joint's terms, the others' fixed ones at their means."""
        shift, covariance = self._shift[places], self._covariance[np.ix_(places, places)]
        fixed = self._others_fixed(places, free)
        if len(fixed):
            gain = self._gain(self._covariance[places][:, fixed], fixed)
            shift = shift - gain @ self._shift[fixed]
            covariance = covariance - gain @ self._covariance[np.ix_(fixed, places)]
        return shift, covariance

    def _effect(self, places: IntArray, free: BoolArray) -> FloatArray:
        """Return the covariance (p, m) of all unknowns with a joint's terms, all of them free."""
        factor = self._factor @ self._factor[self._terms].T
        effect = factor[:, places]
        fixed = self._others_fixed(places, free)
        if len(fixed):
            gain = self._gain(factor[:, fixed], fixed)
            effect = effect - gain @ self._covariance[np.ix_(fixed, places)]
        return effect

    def _others_fixed(self, places: IntArray, free: BoolArray) -> IntArray:
        fixed = ~free
        fixed[places] = False
        return np.flatnonzero(fixed)

    def _gain(self, rows: FloatArray, fixed: IntArray) -> FloatArray:
        gain = np.linalg.solve(self._covariance[np.ix_(fixed, fixed)], rows.T).T
        return np.asarray(gain, dtype=np.float64)


def _root(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R (m, m) with R Rᵀ = C, and R⁻ᵀ.

    Deviations of terms that a log does not show exceed those of others by many orders of magnitude,
    so that eigenvalues of C itself would be rounding errors.
    """
    std = np.sqrt(np.diag(covariance))
    size, V = np.linalg.eigh(covariance / np.outer(std, std))
    size = np.maximum(size, np.finfo(float).eps)
    return std[:, None] * V * np.sqrt(size), V / np.sqrt(size) / std[:, None]
