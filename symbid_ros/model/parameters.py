"""The parameter vector: which columns the regressor has, and what they are called."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.model.inertia import PARAMETERS, UNITS
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class ParameterSet:
    """The standard parameters of a robot, Eq. 2.27–2.28, in column order.

    First ten per link that has parameters of its own, base first; then, with
    ``friction``, a viscous coefficient per joint and a Coulomb one per joint.

    Attributes
    ----------
    model : RobotModel
        The robot.
    friction : bool
        Whether the friction columns of Eq. 2.49 are there.
    """

    model: RobotModel
    friction: bool = False

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
        """Number of inertial parameters; they come before the friction coefficients."""
        return 10 * len(self.links)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """``<link>/<m|mc_x|…|Izz>``, then ``<joint>/viscous``, then ``<joint>/coulomb``."""
        inertial = [f"{link}/{name}" for link in self.link_names for name in PARAMETERS]
        kinds = ("viscous", "coulomb") if self.friction else ()
        friction = [f"{joint}/{kind}" for kind in kinds for joint in self.model.joint_names]
        return (*inertial, *friction)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI unit of each parameter."""
        revolute = [joint.kind == "revolute" for joint in self.model.joints]
        viscous = ["Nm s/rad" if turns else "N s/m" for turns in revolute]
        coulomb = ["Nm" if turns else "N" for turns in revolute]
        return (*(UNITS * len(self.links)), *((viscous + coulomb) if self.friction else ()))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def values(self) -> FloatArray:
        """(p,) parameters of the model file; friction coefficients are zero."""
        values = np.zeros(len(self))
        values[: self.inertial] = self.model.phi[self.links].ravel()
        return values

    def link_phi(self, values: FloatArray) -> FloatArray:
        """Return the (len(links), 10) inertial part of a parameter vector (p,)."""
        return values[: self.inertial].reshape(-1, 10)

    def apply(self, values: FloatArray) -> RobotModel:
        """Return the robot with the inertias of the parameter vector (p,)."""
        phi = np.zeros((len(self.model.links), 10))
        phi[self.links] = self.link_phi(values)
        return self.model.with_phi(phi)
