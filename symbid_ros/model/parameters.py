"""The parameter vector φ: the columns of the regressor, their names, units and values."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import JOINT_TERMS, TERMS, Term
from symbid_ros.errors import ModelError
from symbid_ros.model.coupling import Coupling, coupled_terms, couplings_in
from symbid_ros.model.inertia import PARAMETERS, UNITS
from symbid_ros.model.payload import Payload
from symbid_ros.model.ripple import Ripple, ripples_in
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.warming import Course, Warming, warming_in
from symbid_ros.model.wrist_sensors import COMPONENTS

# Multiples of the golden section, without whole parts, are spread evenly between 0 and 1.
SPREAD = 0.618034
# Start of the names of wrist sensors' offsets.
OFFSET = "offset_"
# Power of a mimic joint's multiplier with which these act on its leader.
_FOLDED: dict[Term, int] = {"viscous": 2, "coulomb": 1, "armature": 2}
_FIELDS = {term: each.field for term, each in JOINT_TERMS.items() if each.field}


@dataclass(frozen=True)
class ParameterSet:
    """The standard parameters of a robot, Eq. 2.27–2.28 and 2.49, in column order.

    Each link that is not virtual has ten parameters, base first. They are followed by one
    parameter per moving joint for each of ``terms``, by some of these terms for each coupling, by
    two of each ripple, by the changes of friction that warms up, and by six offsets of each wrist
    sensor.

    Attributes
    ----------
    model : RobotModel
        The robot.
    terms : tuple of str
        Terms that a drive adds to its joint's row: viscous q̇, Coulomb sign(q̇), armature q̈
        (the reflected inertia of rotor and gear), a constant offset, Stribeck friction
        sign(q̇) exp(-|q̇|/v), Coulomb friction in proportion to the load, sign(q̇) |τ|, the lag of
        friction after a reversal (presliding), the stiffness of a spring, q - q₀, and friction that
        changes its sign before the velocity does (lead) or is softer at low speed (creep). They are
        sorted in this order.
    candidates : bool
        Whether the terms are candidates, of which the data choose some for each joint.
    couplings : tuple of Coupling
        Drives that turn with several joints, with friction and armature of their own.
    ripples : tuple of Ripple
        Torques that depend on a joint's angle and repeat several times in a turn.
    warming : tuple of Warming
        Friction that changes during a log.
    link_side : tuple of int
        Joints whose effort is measured behind the gear. It does not contain the armature.
    payloads : tuple of Payload
        Known bodies that the robot carries. They do not belong to the parameters.
    reference : (inertial,) float64 or None
        Link parameters that give the joints' load τ; by default those of the model.
    signed_drives : bool
        Whether armatures and, beside Coulomb friction, the slope of friction over speed may be
        negative: the efforts contain more than a drive.

    Raises
    ------
    ModelError
        When a term is unknown.
    """

    model: RobotModel
    terms: tuple[Term, ...] = ()
    candidates: bool = False
    couplings: tuple[Coupling, ...] = ()
    link_side: tuple[int, ...] = ()
    payloads: tuple[Payload, ...] = ()
    reference: FloatArray | None = None
    signed_drives: bool = False
    ripples: tuple[Ripple, ...] = ()
    warming: tuple[Warming, ...] = ()

    def __post_init__(self) -> None:
        """Check and sort the terms."""
        unknown = [term for term in self.terms if term not in TERMS]
        if unknown:
            raise ModelError(
                f"{self.model.source}: a joint has no term {unknown[0]!r}; choose from "
                f"{', '.join(TERMS)}",
                "E117",
            )
        object.__setattr__(self, "terms", tuple(term for term in TERMS if term in self.terms))

    @cached_property
    def links(self) -> IntArray:
        """Indices of the links that have parameters."""
        return np.array([i for i, link in enumerate(self.model.links) if not link.virtual])

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        """Names of the links that have parameters."""
        return tuple(self.model.link_names[i] for i in self.links)

    @property
    def inertial(self) -> int:
        """Number of inertial parameters, which come before the joint terms."""
        return 10 * len(self.links)

    @cached_property
    def joints(self) -> IntArray:
        """Indices of the joints that have terms: those that move."""
        return np.array(self.model.moving_joints, dtype=np.int64)

    @cached_property
    def term_columns(self) -> dict[Term, slice]:
        """Columns of each term in use, one for each of ``joints``."""
        joints = len(self.joints)
        starts = (self.inertial + joints * position for position in range(len(self.terms)))
        return {
            term: slice(start, start + joints)
            for term, start in zip(self.terms, starts, strict=True)
        }

    @cached_property
    def coupling_columns(self) -> dict[Coupling, dict[Term, int]]:
        """Column of each term of each coupling."""
        terms = coupled_terms(self.terms)
        return {
            coupling: {
                term: self.first_coupled + len(terms) * index + place
                for place, term in enumerate(terms)
            }
            for index, coupling in enumerate(self.couplings)
        }

    @property
    def first_coupled(self) -> int:
        """Number of parameters of links and joints, which come before those of couplings."""
        return self.inertial + len(self.joints) * len(self.terms)

    @property
    def first_ripple(self) -> int:
        """Number of parameters that come before those of ripples."""
        return self.first_coupled + len(coupled_terms(self.terms)) * len(self.couplings)

    @cached_property
    def further_columns(self) -> dict[Ripple | Warming, slice]:
        """The columns of each ripple, and of friction that changes."""
        further: tuple[Ripple | Warming, ...] = (*self.ripples, *self.warming)
        columns, start = {}, self.first_ripple
        for one in further:
            columns[one] = slice(start, start + len(one.terms))
            start += len(one.terms)
        return columns

    @property
    def ripple_columns(self) -> dict[Ripple, slice]:
        """The two columns of each ripple."""
        return {one: self.further_columns[one] for one in self.ripples}

    @property
    def warming_columns(self) -> dict[Warming, slice]:
        """The columns of friction that changes."""
        return {one: self.further_columns[one] for one in self.warming}

    @property
    def courses(self) -> tuple[Course, ...]:
        """Parts of the log during which friction changes."""
        return self.warming[0].courses if self.warming else ()

    def typical_stamps(self, count: int) -> IntArray:
        """Return stamps (count,), ns, spread over the parts of a log in which friction changes."""
        index = np.arange(count)
        if not self.courses:
            return index
        start, stop = np.array(self.courses).T[:, index % len(self.courses)]
        stamps: IntArray = start + np.floor(SPREAD * index % 1 * (stop - start)).astype(np.int64)
        return stamps

    @classmethod
    def of_names(
        cls, model: RobotModel, names: Collection[str], courses: Sequence[Course] = ()
    ) -> "ParameterSet":
        """Return the parameters of a robot with the joint terms that occur in ``names``.

        ``courses`` are the parts of the log during which friction changes.
        """
        return cls(
            model,
            terms_in(names),
            couplings=couplings_in(names, model),
            ripples=ripples_in(names, model),
            warming=warming_in(names, model, courses),
        )

    @cached_property
    def sensor_offsets(self) -> slice:
        """Columns of the offsets of wrist sensors, in the order of their joints."""
        first = self.first_ripple + sum(len(one.terms) for one in self.further_columns)
        return slice(first, first + 6 * len(self.model.wrist_sensors))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names ``<link>/<m|mc_x|…|Izz>``, then ``<joint>/<term>`` by term, then couplings.

        Ripples follow, ``<joint>/ripple<periods>_<sin|cos>``, and friction that changes,
        ``<joint>/<viscous|coulomb>_excess_<0|10|30|60>``. The offsets of wrist sensors are
        last, ``<frame>/offset_<moment|force>_<x|y|z>``.
        """
        inertial = [f"{link}/{name}" for link in self.link_names for name in PARAMETERS]
        named = self.model.joint_names
        joint = [f"{named[place]}/{term}" for term in self.terms for place in self.joints]
        coupled = [
            f"{one.label}/{term}" for one in self.couplings for term in coupled_terms(self.terms)
        ]
        ripples = [f"{named[one.joint]}/{term}" for one in self.ripples for term in one.terms]
        warming = [f"{named[one.joint]}/{term}" for one in self.warming for term in one.terms]
        offsets = [
            f"{frame}/{OFFSET}{component}"
            for frame in self.model.wrist_sensors
            for component in COMPONENTS
        ]
        return (*inertial, *joint, *coupled, *ripples, *warming, *offsets)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI unit of each parameter."""
        joint = [
            JOINT_TERMS[term].units[self.model.joints[place].kind == "prismatic"]
            for term in self.terms
            for place in self.joints
        ]
        coupled = [
            JOINT_TERMS[term].units[self.model.joints[one.joints[0]].kind == "prismatic"]
            for one in self.couplings
            for term in coupled_terms(self.terms)
        ]
        ripples = ("Nm",) * (2 * len(self.ripples))
        warming = [
            JOINT_TERMS[one.term].units[self.model.joints[one.joint].kind == "prismatic"]
            for one in self.warming
            for _ in one.terms
        ]
        offsets = (("Nm",) * 3 + ("N",) * 3) * len(self.model.wrist_sensors)
        return (*(UNITS * len(self.links)), *joint, *coupled, *ripples, *warming, *offsets)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def unplaced(self) -> tuple[str, ...]:
        """Names of the payloads whose places are unknown, each once."""
        return tuple(dict.fromkeys(one.name for one in self.payloads if one.frame is not None))

    @cached_property
    def load_reference(self) -> FloatArray:
        """(inertial,) parameters of the links from which the joints' load follows."""
        if self.reference is None:
            return self.model.phi[self.links].ravel()
        return self.reference

    @cached_property
    def values(self) -> FloatArray:
        """(p,) parameters of the model file; joint terms that it does not give are zero.

        Friction and armature of mimic joints act on their leader, and are part of its own.
        """
        values = np.zeros(len(self))
        values[: self.inertial] = self.model.phi[self.links].ravel()
        for term, columns in self.term_columns.items():
            values[columns] = [self._drive_value(place, term) for place in self.joints]
        return values

    @cached_property
    def nonnegative(self) -> BoolArray:
        """(p,) joint terms that cannot be negative: friction and armature."""
        signed = set()
        if self.signed_drives:
            signed = {"armature"} | ({"viscous"} if "coulomb" in self.terms else set())
        chosen = np.zeros(len(self), dtype=bool)
        for term, columns in self.term_columns.items():
            chosen[columns] = JOINT_TERMS[term].is_nonnegative and term not in signed
        for coupled in self.coupling_columns.values():
            for term, column in coupled.items():
                chosen[column] = JOINT_TERMS[term].is_nonnegative
        return chosen

    def of_term(self, term: Term) -> BoolArray:
        """Return which parameters (p,) are a term of a joint."""
        found = np.zeros(len(self), dtype=bool)
        if term in self.term_columns:
            found[self.term_columns[term]] = True
        return found

    def of_terms(self, terms: Iterable[Term]) -> BoolArray:
        """Return which parameters (p,) are one of some terms of a joint."""
        found = np.zeros(len(self), dtype=bool)
        for term in terms:
            found |= self.of_term(term)
        return found

    @cached_property
    def known_terms(self) -> dict[Term, FloatArray]:
        """(J,) values of each term that the model file gives but φ does not contain.

        The equation of motion takes them as known.
        """
        stated = {
            term: np.array([self._file_value(j, term) for j in range(len(self.model.joints))])
            for term in TERMS
            if term not in self.terms
        }
        return {term: values for term, values in stated.items() if np.any(values)}

    @property
    def known_values(self) -> dict[str, float]:
        """Non-zero known terms by name, ``<joint>/<term>``."""
        return {
            f"{joint}/{term}": value
            for term, values in self.known_terms.items()
            for joint, value in zip(self.model.joint_names, values.tolist(), strict=True)
            if value != 0.0
        }

    def with_known_values(self, known: Mapping[str, float]) -> "ParameterSet":
        """Return the same parameters with exactly these known terms."""
        joints = tuple(
            replace(
                joint,
                **{
                    field: known.get(f"{joint.name}/{term}", 0.0)
                    for term, field in _FIELDS.items()
                    if term not in self.terms
                },  # type: ignore[arg-type]
            )
            for joint in self.model.joints
        )
        return replace(self, model=replace(self.model, joints=joints))

    def link_phi(self, values: FloatArray) -> FloatArray:
        """Return the (len(links), 10) inertial part of a parameter vector (p,)."""
        return values[: self.inertial].reshape(-1, 10)

    def apply(self, values: FloatArray) -> RobotModel:
        """Return the robot with parameters (p,); joints keep their other terms."""
        phi = np.zeros((len(self.model.links), 10))
        phi[self.links] = self.link_phi(values)
        joints = list(self.model.joints)
        for term, columns in self.term_columns.items():
            if term in _FIELDS:
                for place, value in zip(self.joints, values[columns].tolist(), strict=True):
                    if term == "armature" and place in self.link_side:
                        continue
                    joints[place] = replace(joints[place], **{_FIELDS[term]: value})
        return replace(self.model.with_phi(phi), joints=tuple(joints))

    def _drive_value(self, joint: int, term: Term) -> float:
        """Return what the model file states of a term of a joint and of all that mimic it."""
        if term not in _FOLDED:
            return self._file_value(joint, term)
        if joint in self.model.followers:
            return 0.0
        return self._file_value(joint, term) + sum(
            abs(mimic.multiplier) ** _FOLDED[term] * self._file_value(follower, term)
            for follower, mimic in self.model.followers.items()
            if mimic.leader == joint
        )

    def _file_value(self, joint: int, term: Term) -> float:
        """Return what the model file states of a term that acts on the joint's measured effort."""
        if term not in _FIELDS or (term == "armature" and joint in self.link_side):
            return 0.0
        return float(getattr(self.model.joints[joint], _FIELDS[term]))


def terms_in(names: Collection[str]) -> tuple[Term, ...]:
    """Return the joint terms that occur in parameter names."""
    kinds = {name.rpartition("/")[2] for name in names}
    return tuple(term for term in TERMS if term in kinds)
