"""Balance by the robot's own sensors: a controller that can run beside the plant."""

from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from scipy.linalg import lapack

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import BalanceController, BalanceGains
from symbid_ros.simulation.plant import Plant, State, site_ids
from symbid_ros.simulation.scenario import SOLES, STANDING, require_seed, standing_task
from symbid_ros.simulation.sensors import SCALAR_FIRST

# How far the velocities compared with one another are to be trusted, as standard deviations:
# two encoder readings a period apart, a gyroscope (both as in config/noise.yaml), and the
# stillness of a loaded sole.
JOINT_RATE, GYROSCOPE = 1.3e-2, 5e-3  # rad/s
SOLE_TURNING, SOLE_SLIDING = 5e-3, 1e-3  # rad/s, m/s
# Share of a new velocity in the smoothed one: a lag of 3 periods, which balance does not feel,
# for a third of the noise, which would make the legs tremble.
NEW_SHARE = 0.25


class BalanceSensors(Protocol):
    """The sensors that balance needs; an `Instant` has them, and more."""

    @property
    def stamp(self) -> int:
        """Time of the readings, ns."""

    @property
    def joint_position(self) -> FloatArray:
        """(J,) rad."""

    @property
    def joint_velocity(self) -> FloatArray:
        """(J,) rad/s."""

    @property
    def imu_orientation(self) -> FloatArray:
        """(4,) quaternion xyzw of the IMU in the world."""

    @property
    def imu_angular_velocity(self) -> FloatArray:
        """(3,) in the IMU's axes, rad/s."""


class LegOdometry:
    """The state of a robot on soles that stand still, from its own sensors alone.

    The IMU gives the base's attitude, the legs its position over the soles. The velocities are
    those that agree best, by weighted least squares, with gyroscope, joint rates and soles at
    rest, smoothed. In the world the soles are where the standing pose has them, at first;
    a sole that slides takes its error along.

    Parameters
    ----------
    model : mujoco.MjModel
        Kinematics of the robot, a free base first; its inertias do not matter.
    standing : (nq,) float64
        Pose from which the soles' places in the world are taken.
    sole_frames : tuple of str
        Sites of the F soles.
    imu_frame : str
        Site of the IMU.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        standing: FloatArray,
        sole_frames: tuple[str, ...],
        imu_frame: str = "imu_link",
    ) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._soles, (self._imu,) = site_ids(model, sole_frames), site_ids(model, (imu_frame,))
        self._data.qpos[:] = standing
        mujoco.mj_kinematics(model, self._data)
        self._anchors = self._data.site_xpos[self._soles]
        self._data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        joints, soles = model.nv - 6, len(self._soles)
        # Velocities measured, or known to be nil, per unit of ``qvel``: IMU, joints, soles. All
        # in base axes, where the robot is posed.
        self._jacobian = np.zeros((3 + joints + 6 * soles, model.nv))
        self._jacobian[3 : 3 + joints, 6:] = np.eye(joints)
        self._sole_rows = [
            np.split(rows, 2) for rows in np.split(self._jacobian[3 + joints :], soles)
        ]
        sole = np.repeat([SOLE_TURNING, SOLE_SLIDING], 3)
        deviations = [np.full(3, GYROSCOPE), np.full(joints, JOINT_RATE), np.tile(sole, soles)]
        self._weight = 1.0 / np.concatenate(deviations)
        self._measured = np.zeros(len(self._jacobian))
        self._turning = np.zeros((3, model.nv))
        self._velocity: FloatArray | None = None

    def state(self, time: float, readings: BalanceSensors) -> State:
        """Return the state estimated from the readings of one instant at ``time`` (s)."""
        model, data = self._model, self._data
        data.qpos[7:] = readings.joint_position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        attitude, rotation = self._attitude(readings.imu_orientation)
        soles = data.site_xpos[self._soles] @ rotation.T
        base = (self._anchors - soles).mean(axis=0)
        velocity = self._motion(readings)
        velocity[:3] = rotation @ velocity[:3]
        if self._velocity is None:
            # The soles are where the legs say: they may have settled further apart.
            self._anchors, self._velocity = base + soles, velocity
        self._velocity = self._velocity + NEW_SHARE * (velocity - self._velocity)
        position = np.concatenate([base, attitude, readings.joint_position])
        return State(time, position, self._velocity)

    def _attitude(self, imu_orientation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return quaternion wxyz (4,) and rotation (3, 3) from base to world axes."""
        to_base, attitude, rotation = np.zeros(4), np.zeros(4), np.zeros(9)
        mujoco.mju_mat2Quat(to_base, self._data.site_xmat[self._imu])
        mujoco.mju_negQuat(to_base, to_base)
        mujoco.mju_mulQuat(attitude, imu_orientation.take(SCALAR_FIRST), to_base)
        mujoco.mju_quat2Mat(rotation, attitude)
        return attitude, rotation.reshape(3, 3)

    def _motion(self, readings: BalanceSensors) -> FloatArray:
        """Return the velocity (nv,) in the pose last computed, all of it in base axes."""
        model, data = self._model, self._data
        mujoco.mj_jacSite(model, data, None, self._turning, self._imu)
        np.dot(data.site_xmat[self._imu].reshape(3, 3).T, self._turning, self._jacobian[:3])
        for sole, (turning, sliding) in zip(self._soles, self._sole_rows, strict=True):
            mujoco.mj_jacSite(model, data, sliding, turning, sole)
        joints = model.nv - 6
        self._measured[:3] = readings.imu_angular_velocity
        self._measured[3 : 3 + joints] = readings.joint_velocity
        rows = self._weight[:, None] * self._jacobian
        _, velocity, _ = lapack.dposv(rows.T @ rows, rows.T @ (self._weight * self._measured))
        return np.asarray(velocity)


class StandingController:
    """Stands and moves as a scenario says, told nothing but readings of the sensors.

    With the plant it shares the model file and the numbers from which the moves are drawn.
    Stamps that run back are a new beginning, of the moves and of the odometry.

    Parameters
    ----------
    scenario : str
        ``smooth`` or ``squat``.
    moves : int
        Number of moves.
    motion_seed : int
        Decides the moves.
    model_path : Path or None
        MJCF that it believes the robot to be; None for config/symbitron.xml.

    Attributes
    ----------
    joint_names : tuple of str
        Order of joint arrays.
    drive_names : tuple of str
        The joint of each drive, order of torques.
    duration : float
        Of the moves, s; it goes on standing after them.
    """

    def __init__(
        self,
        scenario: str = "smooth",
        *,
        moves: int = 20,
        motion_seed: int = 0,
        model_path: Path | None = None,
    ) -> None:
        if scenario not in STANDING:
            raise SimulationError(
                f"no standing in scenario {scenario!r}; choose one of {', '.join(STANDING)}"
            )
        require_seed("motion seed", motion_seed)
        robot = Plant(model_path or config_file("symbitron.xml"), SOLES)
        self.joint_names, self.drive_names = robot.joint_names, robot.drive_names
        self._period = robot.period
        self._limits = robot.torque_limits
        self._robot, self._stamp = robot, 0
        self._task = standing_task(robot, moves, motion_seed, *STANDING[scenario])
        self.duration = self._task.duration
        self._restart()

    def _restart(self) -> None:
        robot = self._robot
        self._odometry = LegOdometry(robot.model, robot.data.qpos, SOLES)
        # A new one, lest its programme's last solution be where the next begins.
        self._controller = BalanceController(robot.model, self._task, SOLES, BalanceGains())

    def torques(self, readings: BalanceSensors) -> FloatArray:
        """Return the drives' torques (n_actuated,), Nm, that answer readings of one instant.

        Raises
        ------
        RobotFailureError
            When there are none.
        """
        if readings.stamp < self._stamp:
            self._restart()
        self._stamp = readings.stamp
        # The motion's first instant is stamped with one period: 0 is no time.
        time = 1e-9 * readings.stamp - self._period
        wanted = self._controller.torques(self._odometry.state(time, readings))
        # The programme keeps to the limits within its tolerance, a plant may not forgive that.
        return np.clip(wanted, *self._limits.T)
