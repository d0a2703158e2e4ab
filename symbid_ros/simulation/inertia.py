"""Inertial parameters in a compiled MuJoCo model."""

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
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
