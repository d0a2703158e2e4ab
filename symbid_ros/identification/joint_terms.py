"""Choice of joint terms: which friction, armature and offset the data ask for, joint by joint.

The rows contain the columns of all candidates, so every choice is made on the same rows. A term
is chosen if

- the evidence prefers it to zero. With the other parameters marginalised, the log Bayes factor of
  "free" against "fixed" is the log ratio of the prior's to the posterior's density at the fixed
  value (Savage and Dickey; Dickey 1971, Ann. Math. Statist. 42(1)). The prior's deviation is the
  one that makes the data most probable (empirical Bayes). Terms are removed one by one, the least
  supported first. Residuals that are correlated in time count as fewer rows;
- it predicts rows of its joint that were left out, by groups of seconds, better than the other
  terms do alone.

A sticking joint obeys no friction law. If any joint has Coulomb or Stribeck friction, only rows of
slipping joints are used; otherwise all rows are, and the other terms are chosen again from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SLIDING_TERMS, Term
from symbid_ros.dynamics.regressor import COULOMB_SPEED, equation_of_motion
from symbid_ros.estimation.group_moments import GroupMoments
from symbid_ros.estimation.information import random_motions
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior, posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.window_comparison import WindowComparison
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_errors import CalibratingRows

# Log Bayes factor from which a term is chosen, and below which a chosen one is given up again, so
# that a live choice does not alternate.
ENTER, LEAVE = 2.0, 0.5
# Deviation of a fixed term, as a share of its prior deviation: far below what any data resolve.
FIXED = 1e-7
# Correlation from which two terms of a joint cannot be told apart.
INSEPARABLE = 0.995
# Smallest share of a joint's information that is left when a group of rows is left out.
LEAST_LEFT = 1e-3
# Smallest prior deviation of an armature, as a share of that by which it explains all effort.
LEAST_SHARE = 0.02
# Share of its prior deviation above which an armature is unresolved. Fixed at zero it would bias
# the links' inertias, which it resembles, so it stays free and undetermined.
UNRESOLVED = 0.1
# Share of its variance that is due to the links' parameters, above which it is mixed up with them.
MIXED = 0.5
# Windows in which a joint slips, below which nothing is said about its friction.
FEWEST_SLIPPING = 25
POSTURES = 20
RATES = "velocity", "acceleration", "base_angular_velocity", "base_angular_acceleration"
# Share of a column's square that the other columns leave, below which they replace it.
REPLACED = 1e-8


@dataclass(frozen=True)
class TermChoice:
    """The joint terms that a log asks for.

    Attributes
    ----------
    parameters : ParameterSet
        With all candidates.
    free : (p,) bool
        Parameters that are identified: all of links, the chosen ones of joints.
    evidence : mapping of str to float
        Log Bayes factor of each candidate ``<joint>/<term>``, given the other chosen terms.
    remarks : tuple of str
        What this robot or log cannot tell, one sentence each: parameters that act alike, joints
        that hardly moved.
    slips : bool
        Whether only rows of slipping joints are used.
    """

    parameters: ParameterSet
    free: BoolArray
    evidence: dict[str, float]
    remarks: tuple[str, ...] = ()
    slips: bool = False

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms that at least one joint has."""
        return tuple(
            term
            for term, columns in self.parameters.term_columns.items()
            if self.free[columns].any()
        )

    @property
    def by_joint(self) -> dict[str, tuple[Term, ...]]:
        """The chosen terms of each joint."""
        columns = self.parameters.term_columns
        return {
            joint: tuple(term for term, place in columns.items() if self.free[place][index])
            for index, joint in enumerate(self.parameters.model.joint_names)
        }

    def applied(self, problem: Problem, *, all_columns: bool = False) -> Problem:
        """Return a problem of all candidates with this choice.

        Parameters
        ----------
        problem : Problem
            With the columns of all candidates.
        all_columns : bool
            Whether terms that no joint has remain as fixed parameters.
        """
        observations = self.rows(problem.observations)
        prior = fixed_prior(problem.prior, self.free)
        if all_columns:
            return replace(problem, observations=observations, prior=prior)
        parameters = ParameterSet(self.parameters.model, self.terms)
        names = (*parameters.names, *problem.sensor_names)
        measurements = problem.pseudo_measurements
        if measurements is not None:
            kept = [problem.prior.names.index(name) for name in names]
            measurements = replace(measurements, rows=measurements.rows[:, kept])
        return replace(
            problem,
            observations=tuple(one.restricted(names) for one in observations),
            stored=problem.observations,
            parameters=parameters,
            prior=prior.marginal(names),
            pseudo_measurements=measurements,
            calibrated_rows=problem.calibrated_rows
            and _restricted(problem.calibrated_rows, parameters),
        )

    def rows(self, observations: Sequence[Observations]) -> tuple[Observations, ...]:
        """Return the rows that this choice uses."""
        return rows_of(observations, slips=self.slips)


def _restricted(build: CalibratingRows, parameters: ParameterSet) -> CalibratingRows:
    """Return the builder for some of the robot's parameters and the same sensor errors."""
    kept = [build.parameters.names.index(name) for name in parameters.names]
    point = replace(build.linearization, phi=build.linearization.phi[kept])
    return replace(build, parameters=parameters, linearization=point)


def fixed_prior(prior: Prior, free: BoolArray) -> Prior:
    """Return the prior with the parameters that are not free fixed at their means."""
    scale = np.ones(len(prior.mean))
    scale[: len(free)][~free] = FIXED
    if prior.factor is None:
        return prior.widened(scale)
    factor = prior.factor * scale[:, None]
    return replace(prior, std=np.linalg.norm(factor, axis=1), factor=factor)


def candidate_prior(prior: Prior, parameters: ParameterSet, observations: Observations) -> Prior:
    """Return the prior in which each term's deviation suits the efforts that the joint needs.

    With that deviation alone a term may explain the joint's whole root mean square effort. An
    armature is rather of the size of the inertia that the joint moves. These replace default
    deviations, which do not know the robot's size; those of the user remain. A value of the model
    file is the mean, and may be wrong by itself.
    """
    std = prior.std.copy()
    inertia = _joint_inertia(parameters, prior.mean)
    rows = observations.rows
    first = 6 * parameters.model.floating
    assumed = set(prior.assumed)
    for term, columns in parameters.term_columns.items():
        for joint, column in enumerate(range(columns.start, columns.stop)):
            if parameters.names[column] not in assumed:
                continue
            square = rows.column_squares(first + joint, column)
            effort = rows.target_squares[first + joint]
            if square > 0 and effort > 0:
                std[column] = np.sqrt(effort / square)
                if term == "armature":
                    std[column] = max(inertia[joint], LEAST_SHARE * std[column])
            std[column] = max(std[column], abs(prior.mean[column]))
    return prior.widened(std / prior.std)


def _joint_inertia(parameters: ParameterSet, phi: FloatArray) -> FloatArray:
    """Return the inertia (J,) that each joint moves with the others at rest, over its postures."""
    model = parameters.model
    count, first = POSTURES, 6 * model.floating
    still = random_motions(model, count)
    still = replace(
        still, **{name: 0.0 * getattr(still, name) for name in RATES}, effort=still.effort
    )
    inertia = np.empty(len(model.joints))
    links = np.append(phi[: parameters.inertial], np.zeros(len(parameters) - parameters.inertial))
    at_rest = equation_of_motion(parameters, still).K @ links
    for joint in range(len(model.joints)):
        acceleration = np.zeros_like(still.acceleration)
        acceleration[:, joint] = 1.0
        force = equation_of_motion(parameters, replace(still, acceleration=acceleration)).K @ links
        inertia[joint] = np.mean(np.abs(force - at_rest)[:, first + joint])
    return inertia


def choose_terms(problem: Problem, previous: TermChoice | None = None) -> TermChoice:
    """Choose the joint terms of a problem whose terms are candidates.

    Parameters
    ----------
    problem : Problem
        With a prior by :func:`candidate_prior`.
    previous : TermChoice, optional
        An earlier choice from fewer data, which needs less evidence to stay.
    """
    parameters = problem.parameters
    names = np.array(parameters.names[parameters.inertial :])
    stated = problem.prior.mean[: len(parameters)] != 0
    slipping = np.zeros(len(parameters), bool)
    for term, columns in parameters.term_columns.items():
        slipping[columns] = term in SLIDING_TERMS
    everything = np.ones(len(parameters), bool)
    selections = []
    if _any_slips(problem.observations, parameters):
        selections.append(_Selection.of(problem, everything, stated, previous, slips=True))
    slips = any(bool(np.any(one.free & slipping)) for one in selections)
    if not slips:
        selections.append(_Selection.of(problem, ~slipping, stated, previous, slips=False))
    evidence = dict.fromkeys(names.tolist(), -np.inf)
    for one in selections:
        evidence |= one.evidence
    last = selections[-1]
    return TermChoice(
        parameters,
        last.free,
        evidence,
        (
            *_resting(problem.observations, parameters),
            *_replaceable(parameters, last.free),
            *_inseparable(selections[0].inseparable, parameters, last.free),
        ),
        slips,
    )


@dataclass
class _Selection:
    """Backward elimination of terms on one set of rows."""

    free: BoolArray
    evidence: dict[str, float]
    inseparable: tuple[tuple[int, int], ...]

    @classmethod
    def of(
        cls,
        problem: Problem,
        candidates: BoolArray,
        stated: BoolArray,
        previous: TermChoice | None,
        *,
        slips: bool,
    ) -> "_Selection":
        parameters = problem.parameters
        prior = fixed_prior(problem.prior, candidates)
        observations = rows_of(problem.observations, slips=slips)
        usable = replace(problem, observations=observations, prior=prior)
        chosen, near = WindowComparison(usable).finish()
        start = near
        correlation = None
        for _ in range(2):
            found = posterior(
                chosen,
                prior,
                problem.pseudo_measurements,
                empirical=problem.is_empirical,
                count=parameters.inertial,
                tolerance=1e-2,
                start=start,
                correlation=correlation,
                approximate=True,
            )
            start = found.mean
            if chosen.groups is not None:
                correlation = chosen.groups.correlation(found.mean, chosen.rows)
        terms = np.flatnonzero(candidates)
        terms = terms[terms >= parameters.inertial]
        elimination = _Elimination(found, parameters, terms)
        inseparable = elimination.inseparable()
        kept = set(terms[stated[terms] | elimination.unresolved()].tolist())
        before = set() if previous is None else set(np.flatnonzero(previous.free).tolist())
        elimination.run(kept, before)
        free = np.ones(len(parameters), bool)
        free[parameters.inertial :] = False
        free[elimination.left] = True
        if chosen.groups is not None:
            free = _cross_validated(free, kept, found, chosen, parameters)
        return cls(free, elimination.evidence, inseparable)


class _Elimination:
    """Removes the least supported term, again and again, from a Gaussian over the terms."""

    def __init__(self, found: Posterior, parameters: ParameterSet, terms: IntArray) -> None:
        factor = found.deviation_factor[terms]
        self.left = terms
        self.evidence: dict[str, float] = {}
        self._mean, self._covariance = found.mean[terms], factor @ factor.T
        precision = found.factor[:, terms]
        self._without_links = np.linalg.inv(precision.T @ precision).diagonal()
        self._prior = found.prior
        self._parameters = parameters
        self._nonnegative = parameters.nonnegative

    def inseparable(self) -> tuple[tuple[int, int], ...]:
        """Return pairs of terms of one joint whose errors are completely correlated."""
        std = np.sqrt(self._covariance.diagonal())
        correlation = np.abs(self._covariance / np.outer(std, std))
        wide = std > 0.1 * self._prior.std[self.left]
        pairs = np.argwhere(np.triu(correlation > INSEPARABLE, 1) & np.outer(wide, wide))
        joints = [self._parameters.names[i].rpartition("/")[0] for i in self.left]
        return tuple(
            (int(self.left[one]), int(self.left[two]))
            for one, two in pairs
            if joints[one] == joints[two]
        )

    def unresolved(self) -> BoolArray:
        """Return which terms are armatures that the data cannot tell from the links' inertias.

        They would be known far better if the links' parameters were.
        """
        variance = self._covariance.diagonal()
        std = np.sqrt(variance)
        kinds = [self._parameters.names[i].rpartition("/")[2] for i in self.left]
        is_armature = np.array([kind == "armature" for kind in kinds], dtype=bool)
        mixed = self._without_links < (1 - MIXED) * variance
        return is_armature & mixed & (std > UNRESOLVED * self._prior.std[self.left])

    def run(self, kept: set[int], kept_before: set[int]) -> None:
        """Remove terms until all that are left are supported; ``kept`` are never removed."""
        while len(self.left):
            factors = self._log_bayes_factors()
            for column, factor in zip(self.left.tolist(), factors.tolist(), strict=True):
                self.evidence[self._parameters.names[column]] = factor
            least = np.array([LEAVE if i in kept_before else ENTER for i in self.left])
            margin = factors - least
            margin[[i in kept for i in self.left]] = np.inf
            worst = int(np.argmin(margin))
            if margin[worst] >= 0:
                return
            self._remove(worst)

    def _log_bayes_factors(self) -> FloatArray:
        """Return the log Bayes factor of each term, free against fixed at the prior's mean.

        For z posterior deviations between estimate and prior mean, it is the largest over the
        prior deviations that are possible, (z² - 1 - ln z²)/2.
        """
        shift = self._mean - self._prior.mean[self.left]
        # A negative friction or armature is impossible, so its size supports nothing.
        impossible = (self._mean < 0) & (shift < 0) & self._nonnegative[self.left]
        square = np.where(impossible, 0.0, shift**2 / self._covariance.diagonal())
        square = np.maximum(square, 1.0)
        return np.asarray((square - 1 - np.log(square)) / 2)

    def _remove(self, index: int) -> None:
        """Condition on a term at its prior mean."""
        covariance = self._covariance
        gain = covariance[:, index] / covariance[index, index]
        shift = self._mean[index] - self._prior.mean[self.left[index]]
        self._mean = np.delete(self._mean - gain * shift, index)
        covariance = covariance - np.outer(gain, covariance[index])
        self._covariance = np.delete(np.delete(covariance, index, 0), index, 1)
        self.left = np.delete(self.left, index)


def rows_of(observations: Sequence[Observations], *, slips: bool) -> tuple[Observations, ...]:
    """Return all rows, or those of slipping joints; window lengths without any are left out."""
    if not slips:
        return tuple(observations)
    some = [one.slipping for one in observations if one.slipping is not None]
    return tuple(one for one in some if one.rows.samples > 0)


def _cross_validated(
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
    for place, coordinate in enumerate(groups.layout.own_coordinates):
        own = {columns.start + coordinate - first for columns in columns_of}
        while True:
            terms = [i for i in sorted(own) if free[i] and i not in kept]
            if not terms:
                break
            loss = _LeftOut(found, free, groups, place)
            gains = [loss.without(i) - loss.without(None) for i in terms]
            worst = int(np.argmin(gains))
            if gains[worst] > 0:
                break
            free[terms[worst]] = False
    return free


class _LeftOut:
    """Square error of a joint's rows, each group predicted from all other rows."""

    def __init__(self, found: Posterior, free: BoolArray, groups: GroupMoments, place: int) -> None:
        self._found = found
        self._everything = found.deviation_factor @ found.deviation_factor.T
        self._unknowns = np.ones(len(found.mean), bool)
        self._unknowns[: len(free)] = free
        coordinate = groups.layout.own_coordinates[place]
        self._moment, self._columns = groups.moments[place], groups.layout.columns[coordinate]
        self._weight = 1 / found.covariance[coordinate, coordinate]

    def without(self, term: int | None) -> float:
        """Return the sum of squares if one of the free terms is fixed too."""
        unknowns = self._unknowns.copy()
        if term is not None:
            unknowns[term] = False
        found, fixed = self._found, np.flatnonzero(~unknowns)
        mean, covariance = found.mean, self._everything
        if len(fixed):
            gain = np.linalg.solve(covariance[np.ix_(fixed, fixed)], covariance[fixed]).T
            mean = mean - gain @ (mean - found.prior.mean)[fixed]
            covariance = covariance - gain @ covariance[fixed]
        used = unknowns[self._columns]
        columns = self._columns[used]
        offset = self._columns[~used]
        # Rows of the free columns, with the fixed ones moved to the right-hand side.
        change = np.zeros((len(self._columns) + 1, len(columns) + 1))
        change[np.flatnonzero(used), np.arange(len(columns))] = 1.0
        change[np.flatnonzero(~used), -1] = -found.prior.mean[offset]
        change[-1, -1] = 1.0
        moments = change.T @ self._moment @ change
        some = covariance[np.ix_(columns, columns)]
        values, V = np.linalg.eigh(some)
        L = V * np.sqrt(np.maximum(values, 0.0))
        total = 0.0
        for moment in moments:
            G, g = self._weight * moment[:-1, :-1], self._weight * moment[:-1, -1]
            left, U = np.linalg.eigh(np.eye(len(L)) - L.T @ G @ L)
            pull = U.T @ (L.T @ (G @ mean[columns] - g))
            without = mean[columns] + L @ (U @ (pull / np.maximum(left, LEAST_LEFT)))
            value = np.append(-without, 1.0)
            total += float(value @ moment @ value)
        return total


def _any_slips(observations: Sequence[Observations], parameters: ParameterSet) -> bool:
    slipping = [one.slipping for one in observations if one.slipping is not None]
    first = 6 * parameters.model.floating
    return any(np.any(one.counts.diagonal()[first:] >= FEWEST_SLIPPING) for one in slipping)


def _resting(observations: Sequence[Observations], parameters: ParameterSet) -> tuple[str, ...]:
    """Return a sentence about the joints whose friction cannot be judged."""
    slipping = observations[0].slipping
    if slipping is None:
        return ()
    first = 6 * parameters.model.floating
    rows = slipping.counts.diagonal()[first:]
    own = [
        name
        for index, name in enumerate(parameters.model.joint_names)
        if rows[index] < FEWEST_SLIPPING and index not in parameters.model.followers
    ]
    if not own:
        return ()
    seconds = FEWEST_SLIPPING * observations[0].window / 2
    return (
        f"{', '.join(own)}: moved faster than {COULOMB_SPEED:g} rad/s for less than "
        f"{seconds:.2g} s, too little to judge friction",
    )


def _inseparable(
    pairs: Sequence[tuple[int, int]], parameters: ParameterSet, free: BoolArray
) -> tuple[str, ...]:
    """Return a sentence about each pair of which a term was chosen."""
    names = [name.rpartition("/") for name in parameters.names]
    return tuple(
        f"{names[one][0]}: this log does not tell {names[one][2]} from {names[two][2]}"
        for one, two in pairs
        if free[one] or free[two]
    )


def _replaceable(parameters: ParameterSet, free: BoolArray) -> tuple[str, ...]:
    """Return the chosen terms that act exactly like inertial parameters, one sentence each."""
    count = parameters.inertial
    samples = random_motions(parameters.model, 3 * len(parameters) // parameters.model.dof + 10)
    K = equation_of_motion(parameters, samples).K
    K = K.reshape(-1, K.shape[2])
    terms = [i for i in range(count, len(parameters)) if free[i]]
    if not terms:
        return ()
    scale = np.linalg.norm(K, axis=0)
    scale[scale == 0] = 1.0
    inertial = K[:, :count] / scale[:count]
    fit, *_ = np.linalg.lstsq(inertial, K[:, terms] / scale[terms], rcond=1e-10)
    rest = np.linalg.norm(inertial @ fit - K[:, terms] / scale[terms], axis=0)
    found = []
    for index, term in enumerate(terms):
        if rest[index] ** 2 > REPLACED:
            continue
        alike = inertial.T @ (K[:, term] / scale[term])
        partner = parameters.names[int(np.argmax(np.abs(alike)))]
        found.append(
            f"{parameters.names[term]} acts like {partner}; the data determine their sum only"
        )
    return tuple(found)
