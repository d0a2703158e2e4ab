"""The robot hung in a hoist: what holds and rocks the base, and what moves the legs."""

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.plant import Plant, State, site_ids
from symbid_ros.simulation.trajectory import Trajectory


class OverheadSupport:
    """A hook that carries the base by a spring and damper in all six directions.

    The hook stays in place and turns through rotation vectors; a constant counterweight takes
    the robot's weight. Its wrench on the base is what a load cell at the hook would read.

    Parameters
    ----------
    plant : Plant
        Robot, in the pose in which it is hung up.
    frame : str
        Site the hook holds.
    reference : Trajectory
        Rotation vector (3,) of the hook from its first orientation, in that frame's axes, rad.
    """

    # 3.5 Hz for the whole robot, well damped: stiff beside the motion asked for (below 1 Hz).
    STIFFNESS, DAMPING = 2.0e4, 1.2e3  # N/m, N s/m
    TURNING_STIFFNESS, TURNING_DAMPING = 6.0e3, 4.0e2  # Nm/rad, Nm s/rad

    def __init__(self, plant: Plant, frame: str, reference: Trajectory) -> None:
        self._plant, self._reference = plant, reference
        (self._site,) = site_ids(plant.model, (frame,))
        plant.observe()
        data = plant.data
        self._site_position = data.site_xpos[self._site]
        self._site_rotation = data.site_xmat[self._site].reshape(3, 3)
        self._hook_position = self._site_position.copy()
        self._hook_attitude = np.zeros(4)
        mujoco.mju_mat2Quat(self._hook_attitude, data.site_xmat[self._site])
        self._weight = -plant.mass * plant.model.opt.gravity
        self._motion = np.zeros(6)

    def pull(self, time: float) -> None:
        """Apply the hoist's wrench of this instant to the plant."""
        plant, rotation = self._plant, self._site_rotation
        mujoco.mj_objectVelocity(
            plant.model, plant.data, mujoco.mjtObj.mjOBJ_SITE, self._site, self._motion, 1
        )
        turn, turning, _ = self._reference.at(time)
        wrench = np.empty(6)
        wrench[:3] = (
            self._weight + self.STIFFNESS * (self._hook_position - self._site_position)
        ) @ rotation - self.DAMPING * self._motion[3:]
        wrench[3:] = self.TURNING_STIFFNESS * self._lag(turn) + self.TURNING_DAMPING * (
            turning - self._motion[:3]
        )
        plant.push(self._site, wrench)

    def _lag(self, turn: FloatArray) -> FloatArray:
        """Rotation vector from the base's to the hook's attitude, site axes, rad."""
        angle = float(np.linalg.norm(turn))
        rotation, hook, base, lag = np.zeros(4), np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_axisAngle2Quat(rotation, turn / angle if angle > 0.0 else turn, angle)
        mujoco.mju_mulQuat(hook, self._hook_attitude, rotation)
        mujoco.mju_mat2Quat(base, self._site_rotation.ravel())
        mujoco.mju_subQuat(lag, hook, base)
        return lag


class JointController:
    """Proportional and derivative control of the driven joints along a reference.

    Each joint's gains are scaled by its inertia in the first pose, so that hips and ankles
    respond alike.

    Parameters
    ----------
    model : mujoco.MjModel
        Robot as the controller believes it to be.
    position : (nq,) float64
        First pose.
    reference : Trajectory
        Positions (n_actuated,) of the driven joints, rad.
    weight : (n_actuated,) float64 or None
        Torques that carry the legs, Nm; without them they sag by their springs.
    """

    FREQUENCY, DAMPING_RATIO = 15.0, 0.7  # rad/s of each joint by itself

    def __init__(
        self,
        model: mujoco.MjModel,
        position: FloatArray,
        reference: Trajectory,
        weight: FloatArray | None = None,
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
        self._reference = reference
        self._weight = np.zeros(model.nu) if weight is None else weight

    def torques(self, state: State) -> FloatArray:
        """Return the drives' torques (n_actuated,), Nm."""
        position, velocity, _ = self._reference.at(state.time)
        return np.asarray(
            self._stiffness * (position - state.position[self._position])
            + self._damping * (velocity - state.velocity[self._velocity])
            + self._weight
        )
