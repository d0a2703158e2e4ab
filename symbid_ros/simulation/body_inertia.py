"""Inertias of bodies in a compiled MuJoCo model, and payloads that change them at run time."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.model.inertia import com_from_phi, phi_from_com

# Flags set by MuJoCo's compiler: coinciding frames and diagonal inertias allow faster formulas.
SHORTCUTS = ("body_sameframe", "geom_sameframe", "site_sameframe", "body_simple", "dof_simplenum")
INERTIAL_FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat", *SHORTCUTS)


def body_phi(model: mujoco.MjModel, body: int) -> FloatArray:
    """Return the inertial parameters φ (10,) of a body about its origin, in its axes."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    rotation = axes.reshape(3, 3)
    central = (rotation * model.body_inertia[body]) @ rotation.T
    return phi_from_com(float(model.body_mass[body]), model.body_ipos[body], central)


def set_body_phi(model: mujoco.MjModel, body: int, phi: FloatArray) -> None:
    """Set a body's φ (10,) about its origin, in its axes; φ may be physically impossible."""
    mass, com, central = com_from_phi(phi)
    moments, axes = np.linalg.eigh(central)
    if np.linalg.det(axes) < 0.0:
        axes = -axes
    model.body_mass[body], model.body_ipos[body] = mass, com
    model.body_inertia[body] = moments
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())


def disable_shortcuts(model: mujoco.MjModel) -> None:
    """Make MuJoCo use its general formulas, which hold for inertias set after compilation."""
    for name in SHORTCUTS:
        getattr(model, name)[:] = 0


def copy_inertias(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Copy the inertias, with the shortcuts they allow, between two models of one robot."""
    for name in INERTIAL_FIELDS:
        getattr(target, name)[:] = getattr(source, name)


@dataclass(frozen=True)
class Payload:
    """A solid sphere attached to a link.

    Attributes
    ----------
    link : str
        Name of the link.
    mass : float
        kg.
    position : tuple of 3 floats
        Centre of the sphere in the link's frame, m.
    radius : float
        m; 0 for a point mass.

    Raises
    ------
    SimulationError
        When a number is not finite, the mass is not positive or the radius is negative.
    """

    link: str
    mass: float
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.05

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mass) and self.mass > 0.0):
            raise SimulationError(
                f"payload on {self.link}: mass {self.mass:g} kg; give a finite, positive mass",
                "E608",
            )
        if len(self.position) != 3 or not all(map(math.isfinite, self.position)):
            raise SimulationError(
                f"payload on {self.link}: position {self.position}; give three finite numbers, m",
                "E608",
            )
        if not (math.isfinite(self.radius) and self.radius >= 0.0):
            raise SimulationError(
                f"payload on {self.link}: radius {self.radius:g} m; give a finite radius >= 0",
                "E608",
            )

    @property
    def phi(self) -> FloatArray:
        """Inertial parameters (10,) about the link's origin, in the link's axes."""
        moment = 0.4 * self.mass * self.radius**2
        return phi_from_com(self.mass, np.array(self.position), moment * np.eye(3))


def link_index(model: mujoco.MjModel, link: str) -> int:
    """Return the body index of a link of the robot.

    Raises
    ------
    SimulationError
        When the robot has no link of that name.
    """
    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link))
    base = int(model.jnt_bodyid[0])
    if body < 0 or model.body_rootid[body] != base:
        links = [model.body(i).name for i in range(model.nbody) if model.body_rootid[i] == base]
        raise SimulationError(
            f"no link {link!r} for a payload; name one of {', '.join(links)}", "E609"
        )
    return body


def add_payload(model: mujoco.MjModel, payload: Payload) -> None:
    """Add a payload's inertia to its link; constants derived from inertias are not updated."""
    body = link_index(model, payload.link)
    set_body_phi(model, body, body_phi(model, body) + payload.phi)
    disable_shortcuts(model)
