"""Poses to start from: standing on legs of other lengths, hanging plumb."""

import mujoco
import numpy as np
import scipy.optimize

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.plant import driven_dofs, site_ids

ITERATIONS = 6  # of Gauss and Newton: quadratic from millimetres, so that rounding is left
FLAT = [2, 3, 4]  # of displacement and rotation vector: height, roll and pitch


def level_soles(
    model: mujoco.MjModel,
    original: mujoco.MjModel,
    position: FloatArray,
    soles: tuple[str, ...],
) -> FloatArray:
    """Return the pose nearest to ``position`` whose soles are as high and flat as the original's.

    Without it, legs of unequal length would start with one sole in the floor and the other in
    the air.

    Parameters
    ----------
    model, original : mujoco.MjModel
        Robot to pose, and the one that ``position`` was made for; same joints.
    position : (nq,) float64
        Pose of the original.
    soles : tuple of str
        Sites of the F soles.
    """
    aim, sites = _placed(original, position), site_ids(original, soles)
    pose = position.copy()
    for _ in range(ITERATIONS):
        now = _placed(model, pose)
        jacobian = np.zeros((len(soles), 6, model.nv))
        away = np.zeros((len(soles), 6))
        for index, (site, target) in enumerate(zip(site_ids(model, soles), sites, strict=True)):
            mujoco.mj_jacSite(model, now, jacobian[index, :3], jacobian[index, 3:], site)
            away[index, :3] = aim.site_xpos[target] - now.site_xpos[site]
            away[index, 3:] = _turn(now.site_xmat[site], aim.site_xmat[target])
        step = np.linalg.lstsq(
            jacobian[:, FLAT].reshape(-1, model.nv), away[:, FLAT].ravel(), rcond=None
        )[0]
        mujoco.mj_integratePos(model, pose, step, 1.0)
    return pose


def settle_passive_joints(model: mujoco.MjModel, position: FloatArray) -> FloatArray:
    """Return ``position`` (nq,) with the undriven joints where gravity holds them at rest."""
    free = [
        joint for joint in range(1, model.njnt) if model.jnt_dofadr[joint] not in driven_dofs(model)
    ]
    pose = position.copy()

    def torques(angles: FloatArray) -> FloatArray:
        pose[model.jnt_qposadr[free]] = angles
        return np.asarray(gravity_torques(model, pose)[model.jnt_dofadr[free]])

    torques(scipy.optimize.fsolve(torques, pose[model.jnt_qposadr[free]]))
    return pose


def gravity_torques(model: mujoco.MjModel, position: FloatArray) -> FloatArray:
    """Return the generalised forces (nv,) that hold a pose (nq,) at rest, N and Nm."""
    force = np.zeros(model.nv)
    mujoco.mj_rne(model, _placed(model, position), 0, force)
    return force


def _placed(model: mujoco.MjModel, position: FloatArray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    return data


def _turn(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) in world axes between rotations (9,), rad."""
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (end.reshape(3, 3) @ start.reshape(3, 3).T).ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
