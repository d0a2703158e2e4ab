"""The robot hanging from an overhead support: the support's wrench and the legs' control."""

import mujoco
import numpy as np
import scipy.optimize

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.plant import Plant, State, driven_dofs, resting_data, site_ids
from symbid_ros.simulation.trajectory import Trajectory


class OverheadSupport:
    """A hook that holds the base by a spring and damper in all six directions.

    The hook does not translate and rotates along a trajectory; a constant counterweight carries
    the robot's weight. A load cell at the hook would measure the wrench on the base.

    Parameters
    ----------
    plant : Plant
        Robot in its initial hanging pose.
    frame : str
        Site held by the hook.
    rotation : Trajectory
        Rotation vector (3,) of the hook from its initial orientation, in that frame's axes, rad.
    """

    # 3.5 Hz for the whole robot, well damped: stiff compared with the motion (below 1 Hz).
    STIFFNESS, DAMPING = 2.0e4, 1.2e3  # N/m, N s/m
    ANGULAR_STIFFNESS, ANGULAR_DAMPING = 6.0e3, 4.0e2  # Nm/rad, Nm s/rad

    def __init__(self, plant: Plant, frame: str, rotation: Trajectory) -> None:
        self._plant, self._rotation = plant, rotation
        (self._site,) = site_ids(plant.model, (frame,))
        plant.observe()
        data = plant.data
        self._site_position = data.site_xpos[self._site]
        self._site_rotation = data.site_xmat[self._site].reshape(3, 3)
        self._hook_position = self._site_position.copy()
        self._hook_attitude = np.zeros(4)
        mujoco.mju_mat2Quat(self._hook_attitude, data.site_xmat[self._site])
        self._counterweight = -plant.mass * plant.model.opt.gravity
        self._motion = np.zeros(6)

    def apply(self, time: float) -> None:
        """Apply the support's wrench at ``time`` (s) to the plant."""
        plant, rotation = self._plant, self._site_rotation
        mujoco.mj_objectVelocity(
            plant.model, plant.data, mujoco.mjtObj.mjOBJ_SITE, self._site, self._motion, 1
        )
        turn, turn_rate, _ = self._rotation.at(time)
        wrench = np.empty(6)
        wrench[:3] = (
            self._counterweight + self.STIFFNESS * (self._hook_position - self._site_position)
        ) @ rotation - self.DAMPING * self._motion[3:]
        wrench[3:] = self.ANGULAR_STIFFNESS * self._attitude_error(turn) + self.ANGULAR_DAMPING * (
            turn_rate - self._motion[:3]
        )
        plant.apply_wrench(self._site, wrench)

    def _attitude_error(self, turn: FloatArray) -> FloatArray:
        """Return the rotation vector from the base's to the hook's attitude, site axes, rad."""
        angle = float(np.linalg.norm(turn))
        rotation, hook, base, error = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_axisAngle2Quat(rotation, turn / angle if angle > 0.0 else turn, angle)
        mujoco.mju_mulQuat(hook, self._hook_attitude, rotation)
        mujoco.mju_mat2Quat(base, self._site_rotation.ravel())
        mujoco.mju_subQuat(error, hook, base)
        return error


class JointController:
    """PD control of the driven joints along a trajectory.

    The gains of each joint are scaled by its inertia in the initial pose, so that hips and
    ankles respond alike.

    Parameters
    ----------
    model : mujoco.MjModel
        The controller's model of the robot.
    position : (nq,) float64
        Initial pose.
    trajectory : Trajectory
        Positions (n_actuated,) of the driven joints, rad.
    gravity_torque : (n_actuated,) float64 or None
        Constant torques that carry the legs, Nm; without them the legs sag.
    """

    FREQUENCY, DAMPING_RATIO = 15.0, 0.7  # natural frequency of each joint alone, rad/s

    def __init__(
        self,
        model: mujoco.MjModel,
        position: FloatArray,
        trajectory: Trajectory,
        gravity_torque: FloatArray | None = None,
    ) -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = position
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        joints = model.actuator_trnid[:, 0]
        self._position, self._velocity = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        inertias = np.diag(inertia)[self._velocity]
        self._stiffness = self.FREQUENCY**2 * inertias
        self._damping = 2.0 * self.DAMPING_RATIO * self.FREQUENCY * inertias
        self._trajectory = trajectory
        self._gravity_torque = np.zeros(model.nu) if gravity_torque is None else gravity_torque

    def torques(self, state: State) -> FloatArray:
        """Return the drive torques (n_actuated,), Nm."""
        position, velocity, _ = self._trajectory.at(state.time)
        return np.asarray(
            self._stiffness * (position - state.position[self._position])
            + self._damping * (velocity - state.velocity[self._velocity])
            + self._gravity_torque
        )


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
    mujoco.mj_rne(model, resting_data(model, position), 0, force)
    return force
