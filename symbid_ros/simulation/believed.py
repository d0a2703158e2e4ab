"""A plant's model with other inertias: the robot as an estimate believes it to be."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.inertia import drop_shortcuts, set_body_phi
from symbid_ros.simulation.plant import model_name


def believed_model(
    plant_model: mujoco.MjModel, inertias: Mapping[str, FloatArray]
) -> mujoco.MjModel:
    """Return a copy of a model in which links have other inertias, possible or not.

    MuJoCo's compiler refuses negative masses and indefinite inertias, which an estimate may well
    have; its smooth dynamics are sums over the links and take them. The copy is for these alone:
    constants of contacts and constraints are still the plant's.

    Parameters
    ----------
    plant_model : mujoco.MjModel
        The robot; stays as it is.
    inertias : mapping of str to (10,) float64
        By body name, [m, m·c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] about the body's origin, products as
        matrix elements. Other bodies keep their own.

    Raises
    ------
    SimulationError
        When a body does not exist, or a body or the whole robot has no centre of mass.
    """
    model = copy.copy(plant_model)
    for name, phi in inertias.items():
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            raise SimulationError(
                f"{model_name(model)}: no body {name} to give inertias to; name one of the model's"
            )
        if not np.all(np.isfinite(phi)) or (phi[0] == 0.0 and np.any(phi[1:4])):
            raise SimulationError(
                f"{model_name(model)}: body {name} has mass {phi[0]:g} kg and first moment "
                f"{phi[1:4]} kg m, hence no centre of mass; give finite numbers and a mass"
            )
        set_body_phi(model, body, phi)
    drop_shortcuts(model)
    model.body_subtreemass[:] = model.body_mass
    for body in range(model.nbody - 1, 0, -1):
        model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]
    if model.body_subtreemass[model.jnt_bodyid[0]] == 0.0:
        raise SimulationError(
            f"{model_name(model)}: masses that sum to 0 kg have no centre of mass to control; "
            "give the robot's links mass"
        )
    return model
