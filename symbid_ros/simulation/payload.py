"""A mass that is fastened to a link while the robot runs."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.simulation.inertia import body_phi, drop_shortcuts, set_body_phi


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
