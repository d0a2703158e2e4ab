"""Initial poses: standing on legs of modified length, or hanging at rest."""

import mujoco
import numpy as np
import scipy.optimize

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.plant import driven_dofs, site_ids

ITERATIONS = 6  # Gauss-Newton converges quadratically from millimetres to rounding errors
FLAT = [2, 3, 4]  # height, roll and pitch among displacement and rotation vector


def level_soles(
    model: mujoco.MjModel,
    original: mujoco.MjModel,
    position: FloatArray,
    soles: tuple[str, ...],
) -> FloatArray:
    """Return the pose closest to ``position`` with soles at the original's height and tilt.

    Otherwise a robot with legs of unequal length would start with one sole below the floor and
    the other above it.

    Parameters
    ----------
    model, original : mujoco.MjModel
        Robot to pose, and the robot that ``position`` was made for; same joints.
    position : (nq,) float64
        Pose of the original.
    soles : tuple of str
        Sites of the F soles.
    """
    goal, sites = _kinematics(original, position), site_ids(original, soles)
    pose = position.copy()
    for _ in range(ITERATIONS):
        current = _kinematics(model, pose)
        jacobian = np.zeros((len(soles), 6, model.nv))
        error = np.zeros((len(soles), 6))
        for index, (site, target) in enumerate(zip(site_ids(model, soles), sites, strict=True)):
            mujoco.mj_jacSite(model, current, jacobian[index, :3], jacobian[index, 3:], site)
            error[index, :3] = goal.site_xpos[target] - current.site_xpos[site]
            error[index, 3:] = _rotation_vector(current.site_xmat[site], goal.site_xmat[target])
        step = np.linalg.lstsq(
            jacobian[:, FLAT].reshape(-1, model.nv), error[:, FLAT].ravel(), rcond=None
        )[0]
        mujoco.mj_integratePos(model, pose, step, 1.0)
    return pose


def settle_passive_joints(model: mujoco.MjModel, position: FloatArray) -> FloatArray:
    """Return ``position`` (nq,) with the undriven joints at their equilibrium under gravity."""
    passive = [
        joint for joint in range(1, model.njnt) if model.jnt_dofadr[joint] not in driven_dofs(model)
    ]
    pose = position.copy()

    def torques(angles: FloatArray) -> FloatArray:
        pose[model.jnt_qposadr[passive]] = angles
        return np.asarray(gravity_torques(model, pose)[model.jnt_dofadr[passive]])

    torques(scipy.optimize.fsolve(torques, pose[model.jnt_qposadr[passive]]))
    return pose


def gravity_torques(model: mujoco.MjModel, position: FloatArray) -> FloatArray:
    """Return the generalised forces (nv,) that hold a pose (nq,) at rest, N and Nm."""
    force = np.zeros(model.nv)
    mujoco.mj_rne(model, _kinematics(model, position), 0, force)
    return force


def _kinematics(model: mujoco.MjModel, position: FloatArray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    return data


def _rotation_vector(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) in world axes between two rotation matrices (9,), rad."""
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (end.reshape(3, 3) @ start.reshape(3, 3).T).ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
