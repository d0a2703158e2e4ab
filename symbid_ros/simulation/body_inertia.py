"""A mass that is fastened to a link while the robot runs."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.model.inertia import com_from_phi, phi_from_com

# What the compiler noted where frames coincide and inertias are diagonal, to compute less.
SHORTCUTS = ("body_sameframe", "geom_sameframe", "site_sameframe", "body_simple", "dof_simplenum")
INERTIAL = ("body_mass", "body_ipos", "body_inertia", "body_iquat", *SHORTCUTS)


def body_phi(model: mujoco.MjModel, body: int) -> FloatArray:
    """Return φ (10,) of a body about its origin, in its axes."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    rotation = axes.reshape(3, 3)
    central = (rotation * model.body_inertia[body]) @ rotation.T
    return phi_from_com(float(model.body_mass[body]), model.body_ipos[body], central)


def set_body_phi(model: mujoco.MjModel, body: int, phi: FloatArray) -> None:
    """Give a body φ (10,) about its origin, in its axes, possible or not."""
    mass, com, central = com_from_phi(phi)
    moments, axes = np.linalg.eigh(central)
    if np.linalg.det(axes) < 0.0:
        axes = -axes
    model.body_mass[body], model.body_ipos[body] = mass, com
    model.body_inertia[body] = moments
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())


def drop_shortcuts(model: mujoco.MjModel) -> None:
    """Let MuJoCo compute in full what it does not for the inertias it was compiled with."""
    for name in SHORTCUTS:
        getattr(model, name)[:] = 0


def copy_inertias(source: mujoco.MjModel, target: mujoco.MjModel) -> None:
    """Give a model the inertias, and the shortcuts these allow, of another of the same robot."""
    for name in INERTIAL:
        getattr(target, name)[:] = getattr(source, name)


@dataclass(frozen=True)
class Payload:
    """A solid sphere fastened to a link.

    Attributes
    ----------
    link : str
        Name of the link.
    mass : float
        kg.
    position : tuple of 3 floats
        Of its centre in the link's frame, m.
    radius : float
        m; 0 for a point mass.

    Raises
    ------
    SimulationError
        When a number is not finite, the mass not positive or the radius negative.
    """

    link: str
    mass: float
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.05

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mass) and self.mass > 0.0):
            raise SimulationError(
                f"payload on {self.link}: mass {self.mass:g} kg; give a finite, positive one"
            )
        if len(self.position) != 3 or not all(map(math.isfinite, self.position)):
            raise SimulationError(
                f"payload on {self.link}: position {self.position}; give three finite numbers, m"
            )
        if not (math.isfinite(self.radius) and self.radius >= 0.0):
            raise SimulationError(
                f"payload on {self.link}: radius {self.radius:g} m; give a finite one, 0 or more"
            )

    @property
    def phi(self) -> FloatArray:
        """Inertial parameters (10,) about the link's origin, in the link's axes."""
        moment = 0.4 * self.mass * self.radius**2
        return phi_from_com(self.mass, np.array(self.position), moment * np.eye(3))


def link_index(model: mujoco.MjModel, link: str) -> int:
    """Return the index of a link of the robot.

    Raises
    ------
    SimulationError
        When there is none of that name.
    """
    body = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link))
    base = int(model.jnt_bodyid[0])
    if body < 0 or model.body_rootid[body] != base:
        links = [model.body(i).name for i in range(model.nbody) if model.body_rootid[i] == base]
        raise SimulationError(f"no link {link!r} for a payload; name one of {', '.join(links)}")
    return body


def add_payload(model: mujoco.MjModel, payload: Payload) -> None:
    """Give the payload's link the inertias of both together; constants of the model are left."""
    body = link_index(model, payload.link)
    set_body_phi(model, body, body_phi(model, body) + payload.phi)
    drop_shortcuts(model)
