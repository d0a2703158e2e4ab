"""Balance from sensor readings: leg odometry and a controller that runs beside the plant."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from scipy.linalg import lapack

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import BalanceController, BalanceGains, BalanceTask
from symbid_ros.simulation.controller_model import replace_inertias
from symbid_ros.simulation.plant import Plant, State, com_in_pose, site_ids
from symbid_ros.simulation.reach import Reach, ScaledMotion, least_reach
from symbid_ros.simulation.scenario import (
    COM_MOVES,
    SOLES,
    STANDING,
    draw_standing_task,
    require_seed,
)
from symbid_ros.simulation.sensors import SCALAR_FIRST, BalanceFeedback

# Standard deviations of the velocities in least squares: the difference of two encoder readings,
# the gyroscope (both as in config/noise.yaml), and the motion of a loaded sole.
JOINT_RATE, GYROSCOPE = 1.3e-2, 5e-3  # rad/s
SOLE_TURNING, SOLE_SLIDING = 5e-3, 1e-3  # rad/s, m/s
# Weight of the newest velocity in exponential smoothing. The lag of 3 periods does not affect
# balance; the noise, reduced to a third, no longer makes the legs vibrate.
SMOOTHING = 0.25
# Duration, s, over which the torques of a new model replace those of the old one.
BLENDING = 1.0


@dataclass(frozen=True)
class ModelProposal:
    """A controller with another model of the robot, which is not used yet.

    Attributes
    ----------
    model : mujoco.MjModel
    controller : BalanceController
        With that model.
    torque_change : (A,) float64
        By how much its torques differ from the present ones in the present state, Nm; zero before
        the first readings.
    """

    model: mujoco.MjModel
    controller: BalanceController
    torque_change: FloatArray


@dataclass(frozen=True)
class _Transition:
    """The controller that takes over, and since when, s."""

    controller: BalanceController
    model: mujoco.MjModel
    since: float

    def share(self, time: float) -> float:
        """Return the share of its torques, which grows without a jump of its rate."""
        passed = min(max((time - self.since) / BLENDING, 0.0), 1.0)
        return passed * passed * (3.0 - 2.0 * passed)


class LegOdometry:
    """Estimates the robot's state from IMU and joints while its soles are at rest.

    The IMU gives the base's attitude, and the leg kinematics its position above the soles. The
    velocity is the weighted least-squares fit to gyroscope, joint rates and soles at rest,
    smoothed over time. The soles' initial positions in the world are those of the standing pose;
    if a sole slides, the position estimate drifts by the same distance.

    Parameters
    ----------
    model : mujoco.MjModel
        Kinematics of the robot, with a free base first; its inertias are not used.
    standing : (nq,) float64
        Pose that defines the soles' positions in the world.
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
        # Jacobian of the velocities of IMU, joints and soles (zero) with respect to ``qvel``. All
        # in base axes, as the model's base stays at the origin.
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

    def state(self, time: float, readings: BalanceFeedback) -> State:
        """Return the state at ``time`` (s), estimated from the readings of one instant."""
        model, data = self._model, self._data
        data.qpos[7:] = readings.joint_position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        attitude, rotation = self._attitude(readings.imu_orientation)
        soles = data.site_xpos[self._soles] @ rotation.T
        base = (self._anchors - soles).mean(axis=0)
        velocity = self._solve_velocity(readings)
        velocity[:3] = rotation @ velocity[:3]
        if self._velocity is None:
            # Use the measured distance between the soles, which may differ from the standing pose.
            self._anchors, self._velocity = base + soles, velocity
        self._velocity = self._velocity + SMOOTHING * (velocity - self._velocity)
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

    def _solve_velocity(self, readings: BalanceFeedback) -> FloatArray:
        """Return the velocity (nv,) in the current pose, entirely in base axes."""
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
    """Executes a standing scenario from sensor readings alone.

    It needs the plant's model file, number of moves and motion seed. When stamps decrease, moves
    and odometry restart.

    Parameters
    ----------
    scenario : str
        ``smooth``, ``wide`` or ``squat``.
    moves : int
        Number of moves.
    motion_seed : int
        Seed of the random moves.
    model_path : Path or None
        The controller's model of the robot as MJCF; None for config/symbitron.xml.
    is_cautious : bool
        Whether moves have the least reach at first, as with a model that may be wrong.

    Attributes
    ----------
    joint_names : tuple of str
        Order of joint arrays.
    drive_names : tuple of str
        The joint of each drive, in the order of torques.
    duration : float
        Duration of the moves, s; the robot keeps standing after them.
    size : float
        Largest horizontal distance of a move's end from the middle, m; for squatting, whose trunk
        leans, that of ``smooth``.
    """

    def __init__(
        self,
        scenario: str = "smooth",
        *,
        moves: int = 20,
        motion_seed: int = 0,
        model_path: Path | None = None,
        is_cautious: bool = False,
    ) -> None:
        if scenario not in STANDING:
            raise SimulationError(
                f"scenario {scenario!r} does not stand; choose one of {', '.join(STANDING)}", "E606"
            )
        require_seed("motion seed", motion_seed)
        robot = Plant(model_path or config_file("symbitron.xml"), SOLES)
        self.joint_names, self.drive_names = robot.joint_names, robot.drive_names
        self._period = robot.period
        self._limits = robot.torque_limits
        self._robot, self._stamp = robot, 0
        self._model = robot.model
        self._state: State | None = None
        self._transition: _Transition | None = None
        widths = np.maximum(STANDING[scenario][0].half_widths, COM_MOVES.half_widths)
        self.size = float(widths[:2].max())
        self._reach = Reach(self.least_reach if is_cautious else 1.0)
        self._task = draw_standing_task(robot, moves, motion_seed, *STANDING[scenario])
        self.duration = self._task.duration
        self._moves = ScaledMotion(self._task.com, np.zeros(3), self._reach.at)
        self._feed_forward: tuple[mujoco.MjModel, BalanceController] | None = None
        self._restart()

    def _restart(self) -> None:
        robot = self._robot
        self._odometry = LegOdometry(robot.model, robot.data.qpos, SOLES)
        if self._transition is not None:
            self._model, self._transition = self._transition.model, None
        self._reach.restart()
        # A new controller, as the QP of the old one would start from its last solution.
        self._controller = self._controller_of(self._model)
        self._state = None

    def _controller_of(self, model: mujoco.MjModel) -> BalanceController:
        """Return a controller whose moves begin at the model's centre of mass in the initial pose.

        Models differ by centimetres in where that is. With a common reference the robot would
        stand elsewhere with each of them.
        """
        return BalanceController(model, self._task_of(model), SOLES, BalanceGains())

    def _task_of(self, model: mujoco.MjModel) -> BalanceTask:
        """Return the moves within reach, from the model's centre of mass in the initial pose."""
        pose, robot = self._robot.data.qpos, self._robot.model
        offset = com_in_pose(model, pose) - com_in_pose(robot, pose)
        return replace(
            self._task,
            com=ScaledMotion(self._task.com, offset, self._reach.at),
            turns=ScaledMotion(self._task.turns, np.zeros(3), self._reach.at),
        )

    @property
    def torque_limits(self) -> FloatArray:
        """Largest torques (A,) of the drives, Nm."""
        return np.asarray(np.abs(self._limits).min(axis=1))

    @property
    def least_reach(self) -> float:
        """Share of the size of the moves that the margin of the soles covers with any model."""
        return least_reach(self.size)

    @property
    def reach(self) -> float:
        """Share of the size of the moves at the newest readings."""
        return self._reach.at(self._time)[0]

    @property
    def wanted_reach(self) -> float:
        """Share of the size of the moves that was last asked for."""
        return self._reach.wanted

    def move_within(self, reach: float) -> None:
        """Let moves go up to a share of their size, within some seconds and without a jump."""
        self._reach.change(reach, self._time)

    @property
    def displacement(self) -> FloatArray:
        """Distance (3,) of the reference centre of mass from its start, m."""
        return self._moves.displacement(self._time)

    def feed_forward(self) -> FloatArray:
        """Return the torques (A,) without feedback at the newest readings, Nm.

        They are those of the present model; while another one is replacing it, of the former one.

        Raises
        ------
        RobotFailureError
            When there are none.
        SimulationError
            Before the first readings.
        """
        if self._state is None:
            raise SimulationError("no readings yet; call `torques` first", "E611")
        if self._feed_forward is None or self._feed_forward[0] is not self._model:
            task, gains = self._task_of(self._model), BalanceGains().feed_forward
            controller = BalanceController(self._model, task, SOLES, gains)
            self._feed_forward = self._model, controller
        return self._feed_forward[1].torques(self._state)

    @property
    def is_changing(self) -> bool:
        """Whether one model is replacing another."""
        return self._transition is not None

    def propose(self, inertias: Mapping[str, FloatArray]) -> ModelProposal:
        """Return a controller with other inertias, and how its torques differ now.

        Parameters
        ----------
        inertias : mapping of str to (10,) float64
            By link, as :func:`~symbid_ros.simulation.controller_model.replace_inertias` takes them.

        Raises
        ------
        SimulationError
            When a link does not exist or has no centre of mass.
        RobotFailureError
            When the new controller finds no torques.
        """
        model = replace_inertias(self._robot.model, inertias)
        controller = self._controller_of(model)
        change = np.zeros(len(self._limits))
        if self._state is not None:
            change = controller.torques(self._state) - self._controller.torques(self._state)
        return ModelProposal(model, controller, change)

    def adopt(self, proposal: ModelProposal) -> None:
        """Let a proposed model replace the present one within :data:`BLENDING` seconds."""
        self._transition = _Transition(proposal.controller, proposal.model, self._time)

    def fall_back(self) -> None:
        """Return to the model before, without a jump, if another one is replacing it."""
        if self._transition is None:
            return
        new, passed = self._transition, self._time - self._transition.since
        self._transition = _Transition(
            self._controller, self._model, self._time - max(BLENDING - passed, 0.0)
        )
        self._controller, self._model = new.controller, new.model

    @property
    def _time(self) -> float:
        """Time of the motion at the newest readings, s."""
        # The motion's first instant is stamped with one period, as a stamp of 0 means "no time".
        return 1e-9 * self._stamp - self._period

    def torques(self, readings: BalanceFeedback) -> FloatArray:
        """Return the drive torques (n_actuated,), Nm, for the readings of one instant.

        Raises
        ------
        RobotFailureError
            When the controller finds no torques.
        """
        if readings.stamp < self._stamp:
            self._restart()
        self._stamp = readings.stamp
        self._state = state = self._odometry.state(self._time, readings)
        torques = self._controller.torques(state)
        if self._transition is not None:
            share = self._transition.share(self._time)
            torques = torques + share * (self._transition.controller.torques(state) - torques)
            if share == 1.0:
                self._controller, self._model = self._transition.controller, self._transition.model
                self._transition = None
        # The QP exceeds the limits by up to its tolerance, which a plant may reject.
        return np.clip(torques, *self._limits.T)
