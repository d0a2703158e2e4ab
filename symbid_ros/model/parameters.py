"""The parameter vector: which columns the regressor has, and what they are called."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.choices import TERMS, Term
from symbid_ros.errors import ModelError
from symbid_ros.model.inertia import PARAMETERS, UNITS
from symbid_ros.model.tree import Joint, RobotModel

# The joint's field that a model file states; a torque offset belongs to a drive, not to a file.
_STATED: dict[Term, Literal["damping", "friction_loss", "armature"]] = {
    "viscous": "damping",
    "coulomb": "friction_loss",
    "armature": "armature",
}
_UNITS: dict[Term, dict[str, str]] = {
    "viscous": {"revolute": "Nm s/rad", "prismatic": "N s/m"},
    "coulomb": {"revolute": "Nm", "prismatic": "N"},
    "armature": {"revolute": "kg m^2", "prismatic": "kg"},
    "offset": {"revolute": "Nm", "prismatic": "N"},
}


@dataclass(frozen=True)
class ParameterSet:
    """The standard parameters of a robot, Eq. 2.27–2.28 and 2.49, in column order.

    First ten per link that has parameters of its own, base first; then, for each of
    ``terms``, one per joint.

    Attributes
    ----------
    model : RobotModel
        The robot.
    terms : tuple of {"viscous", "coulomb", "armature", "offset"}
        What a joint's drive adds to its row: viscous q̇, Coulomb sign(q̇), armature q̈
        (the reflected inertia of rotor and gear) and a constant offset. Kept in
        this order, however given.

    Raises
    ------
    ModelError
        When a term is none of these.
    """

    model: RobotModel
    terms: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        """Bring the terms into their order."""
        unknown = [term for term in self.terms if term not in TERMS]
        if unknown:
            raise ModelError(
                f"{self.model.source}: a joint has no term {unknown[0]!r}; choose from "
                f"{', '.join(TERMS)}"
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
        """Number of inertial parameters; they come before the joints' terms."""
        return 10 * len(self.links)

    @cached_property
    def term_columns(self) -> dict[Term, slice]:
        """Columns of each term in use, one per joint in the model's order."""
        joints = len(self.model.joints)
        starts = (self.inertial + joints * position for position in range(len(self.terms)))
        return {
            term: slice(start, start + joints)
            for term, start in zip(self.terms, starts, strict=True)
        }

    @cached_property
    def names(self) -> tuple[str, ...]:
        """``<link>/<m|mc_x|…|Izz>``, then ``<joint>/<term>`` with all joints of a term together."""
        inertial = [f"{link}/{name}" for link in self.link_names for name in PARAMETERS]
        joint = [f"{joint}/{term}" for term in self.terms for joint in self.model.joint_names]
        return (*inertial, *joint)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI unit of each parameter."""
        joint = [_UNITS[term][joint.kind] for term in self.terms for joint in self.model.joints]
        return (*(UNITS * len(self.links)), *joint)

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def values(self) -> FloatArray:
        """(p,) parameters of the model file; what it does not state of a joint is zero."""
        values = np.zeros(len(self))
        values[: self.inertial] = self.model.phi[self.links].ravel()
        for term, columns in self.term_columns.items():
            values[columns] = [_stated(joint, term) for joint in self.model.joints]
        return values

    @cached_property
    def known_terms(self) -> dict[Term, FloatArray]:
        """(J,) values of each term that is not in use but stated by the model file.

        They are taken as known, so they are part of the equation of motion but not of φ.
        """
        stated = {
            term: np.array([_stated(joint, term) for joint in self.model.joints])
            for term in TERMS
            if term not in self.terms
        }
        return {term: values for term, values in stated.items() if np.any(values)}

    @property
    def known_values(self) -> dict[str, float]:
        """The same as ``<joint>/<term>`` and value, without zeros."""
        return {
            f"{joint}/{term}": value
            for term, values in self.known_terms.items()
            for joint, value in zip(self.model.joint_names, values.tolist(), strict=True)
            if value != 0.0
        }

    def with_known_values(self, known: Mapping[str, float]) -> "ParameterSet":
        """Return the same parameters with these known terms, and no others."""
        joints = tuple(
            replace(
                joint,
                **{
                    field: known.get(f"{joint.name}/{term}", 0.0)
                    for term, field in _STATED.items()
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
        """Return the robot with the parameters (p,); joints keep the terms not in use."""
        phi = np.zeros((len(self.model.links), 10))
        phi[self.links] = self.link_phi(values)
        joints = list(self.model.joints)
        for term, columns in self.term_columns.items():
            if term in _STATED:
                joints = [
                    replace(joint, **{_STATED[term]: value})
                    for joint, value in zip(joints, values[columns].tolist(), strict=True)
                ]
        return replace(self.model.with_phi(phi), joints=tuple(joints))


def terms_in(names: Collection[str]) -> tuple[Term, ...]:
    """Return the terms that parameter names are about."""
    kinds = {name.rpartition("/")[2] for name in names}
    return tuple(term for term in TERMS if term in kinds)


def _stated(joint: Joint, term: Term) -> float:
    return float(getattr(joint, _STATED[term])) if term in _STATED else 0.0
