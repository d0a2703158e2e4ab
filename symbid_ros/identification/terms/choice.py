"""Choice of joint terms: which friction, armature and offset the data ask for, joint by joint.

The rows contain the columns of all candidates, so every choice is made on the same rows. A term
is chosen if

- the best set of its joint's terms contains it (:mod:`symbid_ros.estimation.term_sets`), with the
  other parameters marginalised. Residuals that are correlated in time count as fewer rows;
- it predicts rows of its joint that were left out, by groups of seconds, better than the other
  terms do alone.

Some armatures resemble the inertias of the links, so that a log does not separate them. These are
free if most of the other drives have an armature, and zero otherwise.

A sticking joint obeys no friction law. If any joint has Coulomb or Stribeck friction, only rows of
slipping joints are used; otherwise all rows are, and the other terms are chosen again from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import LEAD, SIMULATED_TERMS, SLIDING_TERMS, Term
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.passive_drives import contradicts_signs
from symbid_ros.estimation.posterior import Posterior, posterior
from symbid_ros.estimation.term_evidence import (
    FRICTION,
    CandidateTerms,
    cross_validated,
    have_common_lead,
)
from symbid_ros.estimation.term_sets import TermSets
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.window_comparison import COMPARABLE, WindowComparison
from symbid_ros.identification.terms.priors import fixed_prior, released_prior
from symbid_ros.identification.terms.remarks import (
    FEWEST_SLIPPING,
    inseparable_terms,
    joints_without_rows,
    replaceable_terms,
    resting_joints,
    resting_remarks,
)
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows

UNEXPLAINED_SIGNS = (
    "positive ones do not explain the efforts: torque sensors behind the gears do not measure the "
    "rotors, or other effects, such as wrong link lengths, act like these terms"
)
SIGNED_DRIVES = (
    "armature and viscous friction may be negative in this result, because "
    f"{UNEXPLAINED_SIGNS}; model files are written without negative ones"
)
POSITIVE_DRIVES = (
    "armature and viscous friction are positive in this result, although "
    f"{UNEXPLAINED_SIGNS}; `signed_drives` lets them be negative"
)


@dataclass(frozen=True)
class TermChoice:
    """The joint terms that a log asks for.

    Attributes
    ----------
    parameters : ParameterSet
        With all candidates.
    free : (p,) bool
        Parameters that are identified: all of links, the chosen ones of joints.
    measured : (d,) bool
        Driven joints that have rows. The terms of the others stay as the model file states them.
    remarks : tuple of str
        What this robot or log leaves open, one sentence each: parameters that act alike, joints
        that hardly moved.
    slips : bool
        Whether only rows of slipping joints are used.
    deviations : (p + s, k) float64 or None
        N: other sets of terms that explain the data as well add the covariance N Nᵀ of all
        unknowns.
    contradicts_signs : bool
        Whether the efforts contradict positive armature and friction.
    signed_drives : bool
        Whether armature and the slope of friction may be negative.
    window : float or None
        Length of the windows from whose rows the terms were chosen, s; None if no joint has rows.
    unjudged : tuple of str
        Joints that moved, but too little to judge their friction.
    """

    parameters: ParameterSet
    free: BoolArray
    measured: BoolArray
    remarks: tuple[str, ...] = ()
    slips: bool = False
    deviations: FloatArray | None = None
    contradicts_signs: bool = False
    signed_drives: bool = False
    window: float | None = None
    unjudged: tuple[str, ...] = ()

    @property
    def terms(self) -> tuple[Term, ...]:
        """Terms that at least one joint has."""
        return tuple(
            term
            for term, columns in self.parameters.term_columns.items()
            if self.free[columns].any() or any(term in one for one in self._coupled.values())
        )

    @property
    def couplings(self) -> tuple[Coupling, ...]:
        """Couplings of which at least one term was chosen."""
        return tuple(coupling for coupling, terms in self._coupled.items() if terms)

    @cached_property
    def _coupled(self) -> dict[Coupling, tuple[Term, ...]]:
        """The chosen terms of each coupling."""
        return {
            coupling: tuple(term for term, column in columns.items() if self.free[column])
            for coupling, columns in self.parameters.coupling_columns.items()
        }

    @property
    def by_joint(self) -> dict[str, tuple[str, ...]]:
        """The chosen terms of each joint and coupling."""
        columns, names = self.parameters.term_columns, self.parameters.model.joint_names
        joints: dict[str, tuple[str, ...]] = {
            names[joint]: tuple(term for term, place in columns.items() if self.free[place][index])
            for index, joint in enumerate(self.parameters.joints)
        }
        for one in self.parameters.further_columns:
            joints[names[one.joint]] += one.terms
        return joints | {coupling.label: terms for coupling, terms in self._coupled.items()}

    def applied(self, problem: Problem) -> Problem:
        """Return a problem, which has the columns of all candidates, with this choice."""
        observations = self.rows(problem.observations)
        prior = fixed_prior(problem.prior, self.free)
        parameters = replace(
            self.parameters,
            terms=self.terms,
            candidates=False,
            couplings=self.couplings,
            signed_drives=self.signed_drives,
        )
        names = (*parameters.names, *problem.sensor_names)
        kept = [problem.prior.names.index(name) for name in names]
        measurements = problem.pseudo_measurements
        if measurements is not None:
            measurements = replace(measurements, rows=measurements.rows[:, kept])
        return replace(
            problem,
            observations=tuple(one.restricted(names) for one in observations),
            stored=problem.data,
            parameters=parameters,
            prior=prior.marginal(names),
            pseudo_measurements=measurements,
            term_deviations=None if self.deviations is None else self.deviations[kept],
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
    slipping = np.zeros(len(parameters), bool)
    for term, columns in parameters.term_columns.items():
        slipping[columns] = term in SLIDING_TERMS
    for coupled in parameters.coupling_columns.values():
        for term, column in coupled.items():
            slipping[column] = term in SLIDING_TERMS
    everything = np.ones(len(parameters), bool)
    measured = _measured_joints(problem.observations, parameters)
    for columns in parameters.term_columns.values():
        # They act on the leader's row alone, like the leader's own terms.
        everything[columns] = ~np.isin(parameters.joints, list(parameters.model.followers))
        everything[columns] &= measured
    stated = everything & (problem.prior.mean[: len(parameters)] != 0)
    unmeasured = joints_without_rows(problem.observations[0], parameters)
    if not measured.any():
        return TermChoice(parameters, everything, measured, unmeasured)
    selections = []
    # With friction in the model file, a joint may stick even if no joint of the log slips.
    if _any_slips(problem.observations, parameters) or np.any(stated & slipping):
        usual = everything & ~parameters.of_terms(SIMULATED_TERMS)
        selection = _Selection.of(problem, usual, stated, previous, slips=True)
        if selection.has_leading_friction(problem):
            selection = _Selection.of(problem, everything, stated, previous, slips=True)
        selections.append(selection)
    slips = any(bool(np.any(one.free & slipping)) for one in selections)
    if not slips:
        selections.append(
            _Selection.of(problem, everything & ~slipping, stated, previous, slips=False)
        )
    last = selections[-1]
    slipping_rows = problem.observations[0].slipping
    if slips and parameters.model.contacts is None:
        slipping_rows = last.rows
    slow = resting_joints(slipping_rows, parameters) & measured
    if slips and parameters.model.contacts is None:
        last = last.with_friction_of(slow)
    free, contradicts = last.free, last.contradicts_signs()
    signed = contradicts and problem.allows_signed_drives
    if signed and "armature" in parameters.terms:
        # What lowers the inertia that efforts show acts on all joints alike.
        free = free.copy()
        armature = parameters.term_columns["armature"]
        free[armature] = everything[armature]
    return TermChoice(
        parameters,
        free,
        measured,
        (
            *unmeasured,
            *resting_remarks(slipping_rows, parameters, slow, slips=slips),
            *replaceable_terms(parameters, free),
            *inseparable_terms(selections[0].inseparable, parameters, free),
            *([SIGNED_DRIVES if signed else POSITIVE_DRIVES] if contradicts else []),
        ),
        slips,
        last.deviations(),
        contradicts,
        signed,
        last.rows.window,
        _moved_too_little(slipping_rows, parameters, slow),
    )


def _moved_too_little(
    slipping: Observations | None, parameters: ParameterSet, slow: BoolArray
) -> tuple[str, ...]:
    """Return which of the joints (d,) without enough rows in which they slip have some."""
    if slipping is None or parameters.model.contacts is not None:
        return ()
    counts = slipping.counts.diagonal()[6 * parameters.model.floating + parameters.joints]
    names = parameters.model.joint_names
    return tuple(names[joint] for joint in parameters.joints[slow & (counts > 0)].tolist())


def candidate_posterior(
    problem: Problem, candidates: BoolArray, *, slips: bool
) -> tuple[Posterior, Observations]:
    """Return the posterior with all candidates free, and the rows that it is from.

    Parameters that are not ``candidates`` (p,) are fixed at their prior means. With ``slips``, only
    rows of slipping joints are used.
    """
    prior = fixed_prior(problem.prior, candidates)
    observations = rows_of(problem.observations, slips=slips)
    usable = replace(problem, observations=observations, prior=prior)
    chosen, found = WindowComparison(usable).finish()
    for _ in range(1 if found is not None else 2):
        found = posterior(
            chosen,
            prior,
            problem.pseudo_measurements,
            empirical=problem.is_empirical,
            count=problem.parameters.inertial,
            tolerance=COMPARABLE,
            start=None if found is None else found.mean,
            correlation=None if found is None else chosen.joint_correlation(found.mean),
            approximate=True,
        )
    assert found is not None
    return found, chosen


@dataclass(frozen=True)
class _Selection:
    """The best set of terms on one set of rows.

    Attributes
    ----------
    free : (p,) bool
    inseparable : tuple of tuple of int
        Pairs of terms that the data do not separate.
    found : Posterior
        With all candidates free.
    rows : Observations
        The rows that it is from.
    sets : TermSets
        The sets that were compared.
    parameters : ParameterSet
    """

    free: BoolArray
    inseparable: tuple[tuple[int, int], ...]
    found: Posterior
    rows: Observations
    sets: TermSets
    parameters: ParameterSet

    def deviations(self) -> FloatArray:
        """Return N (p + s, k) of all unknowns, due to other sets that explain the data as well."""
        return self.sets.deviations(np.flatnonzero(self.free))

    def with_friction_of(self, slow: BoolArray) -> "_Selection":
        """Return the selection with free friction of slow joints (d,), which lack rows to judge it.

        If fixed, it would seem to be zero without any uncertainty.
        """
        free, columns = self.free.copy(), self.parameters.term_columns
        for term in FRICTION:
            if term in columns:
                free[columns[term]] |= slow
        return replace(self, free=free)

    def contradicts_signs(self) -> bool:
        """Return whether the data contradict positive armature and friction."""
        return contradicts_signs(self.found, self.parameters, self.rows)

    def has_leading_friction(self, problem: Problem) -> bool:
        """Return whether the friction of the joints that have any reverses ahead of them."""
        coulomb = np.flatnonzero(self.parameters.of_term("coulomb"))
        leads = np.flatnonzero(self.parameters.of_term(LEAD))
        if not len(leads) or not self.free[coulomb].any():
            return False
        rubs = self.free[coulomb]
        coulomb, leads = coulomb[rubs], leads[rubs]
        found = posterior(
            self.rows,
            released_prior(self.found.prior, leads),
            problem.pseudo_measurements,
            tolerance=COMPARABLE,
            start=self.found.mean,
            correlation=self.rows.joint_correlation(self.found.mean),
            approximate=True,
        )
        return have_common_lead(found, leads, coulomb)

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
        found, chosen = candidate_posterior(problem, candidates, slips=slips)
        is_term = np.zeros(len(parameters), bool)
        is_term[parameters.inertial : parameters.first_ripple] = True
        terms = np.flatnonzero(candidates & is_term)
        evidence = CandidateTerms(found, parameters, terms)
        of_file = set(terms[stated[terms]].tolist())
        unresolved = set(terms[evidence.unresolved()].tolist())
        ambiguous = set(terms[evidence.ambiguous()].tolist()) - of_file
        resolved = terms[evidence.resolved()].tolist()
        # In its own rows the links can replace a mixed armature or an offset, so these cannot
        # judge it.
        replaced = set(terms[evidence.mixed() | evidence.hidden_offsets()].tolist())
        before = set() if previous is None else set(np.flatnonzero(previous.free).tolist())

        def selected(kept: set[int], fixed: set[int]) -> tuple[BoolArray, TermSets]:
            sets = TermSets(found, parameters, terms, kept=kept, fixed=fixed, before=before)
            free = ~is_term
            free[sets.best()] = True
            if chosen.groups is not None:
                free = cross_validated(free, kept | replaced, found, chosen, parameters)
            return free, sets

        kept = of_file | (ambiguous if resolved else unresolved)
        if evidence.have_common_armature():
            kept |= set(terms[evidence.armatures].tolist())
        free, sets = selected(kept, set())
        # The drives of a robot are alike: if those that the log resolves have no armature, the
        # others have none either.
        if ambiguous and 2 * np.count_nonzero(free[resolved]) < len(resolved):
            free, sets = selected(of_file, ambiguous)
        return cls(free, evidence.inseparable(), found, chosen, sets, parameters)


def rows_of(observations: Sequence[Observations], *, slips: bool) -> tuple[Observations, ...]:
    """Return all rows, or those of slipping joints; window lengths without any are left out."""
    if not slips:
        return tuple(observations)
    some = [one.slipping for one in observations if one.slipping is not None]
    return tuple(one for one in some if one.rows.samples > 0)


def _measured_joints(observations: Sequence[Observations], parameters: ParameterSet) -> BoolArray:
    """Return which driven joints (d,) have rows."""
    if parameters.model.contacts is not None:
        return np.ones(len(parameters.joints), bool)  # combinations contain all joints
    rows = 6 * parameters.model.floating + parameters.joints
    return np.asarray(np.any([one.counts.diagonal()[rows] > 0 for one in observations], axis=0))


def _any_slips(observations: Sequence[Observations], parameters: ParameterSet) -> bool:
    slipping = [one.slipping for one in observations if one.slipping is not None]
    rows = 6 * parameters.model.floating + parameters.joints
    if parameters.model.contacts is not None:
        rows = np.arange(parameters.model.dof)  # combinations contain the friction of all joints
    return any(np.any(one.counts.diagonal()[rows] >= FEWEST_SLIPPING) for one in slipping)
