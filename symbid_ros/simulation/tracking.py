"""A robot with a fixed base that follows a trajectory of its joints, and its joint sensors."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import SimulationError
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_sensors import JointSensorOptions
from symbid_ros.simulation.joint_trajectory import JointTrajectory
from symbid_ros.simulation.modified_robot import FRICTION_TIME_CONSTANT
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import WrenchSensor
from symbid_ros.simulation.systematic_errors import SampleRates

PERIOD = 1e-3  # s
TOLERANCE = 1e-3  # rad or m, by which a joint may exceed its range; end stops are soft
LARGEST_DECAY = 0.5  # of a joint's speed by its damping within one step
MOST_SUBSTEPS = 50
POSTURES = 200
UNLIMITED = np.pi / 2  # range of a joint without limits, to both sides
# Feedback of the computed-torque controller: 5 Hz, critically damped.
STIFFNESS, DAMPING = 1000.0, 63.0  # 1/s² and 1/s
SETTLING_TIME = 1.0  # s, in which the feedback settles at the start of the trajectory
# Friction and armature of a simulated drive, of the effort that the motion needs (rms).
VISCOUS, COULOMB, ARMATURE = 0.08, 0.10, 0.01
SPREAD = 0.5  # relative half width of their uniform distribution
SLIDE = 0.1  # metres of a slide that count as a radian
COULOMB_SPEED = 0.02  # rad/s, over which the controller's friction compensation changes its sign


def position_std(sensors: JointSensorOptions, robot: RobotModel) -> FloatArray:
    """Return the deviations (J,) of the noise of positions, rad or m."""
    slides = np.array([joint.kind == "prismatic" for joint in robot.joints])
    return np.asarray(sensors.position_noise * np.where(slides, SLIDE, 1.0))


def effort_std(sensors: JointSensorOptions, capacity: FloatArray) -> FloatArray:
    """Return the deviations (J,) of the noise of efforts from the largest efforts (J,), Nm or N."""
    return np.asarray(sensors.effort_noise / 100 * capacity)


def static_torques(robot: RobotModel) -> FloatArray:
    """Return the torques (N, J) that hold a robot by its base in random postures, Nm or N.

    The postures are the same in every call. A joint without limits turns by up to 90 degrees.
    """
    low, high = (
        np.array([getattr(joint, side) for joint in robot.joints]) for side in ("lower", "upper")
    )
    low, high = np.maximum(low, -UNLIMITED), np.minimum(high, UNLIMITED)
    shares = np.random.default_rng(0).uniform(size=(POSTURES, len(low)))
    rest, base = np.zeros((POSTURES, len(low))), np.zeros((POSTURES, 3))
    plain = ParameterSet(without_drive_terms(robot))
    samples = Samples(
        stamp=np.arange(POSTURES, dtype=np.int64),
        position=robot.apply_mimics(low + shares * (high - low)),
        velocity=rest,
        acceleration=rest,
        effort=rest,
        base_angular_velocity=base,
        base_angular_acceleration=base,
        base_specific_force=base - robot.gravity,
        wrenches=np.zeros((POSTURES, 0, 6)),
        wrench_frames=(),
    )
    force = equation_of_motion(plain, samples).K @ plain.values
    return np.asarray(force[:, 6 * robot.floating :])


def effort_capacity(robot: RobotModel) -> FloatArray:
    """Return the largest effort (J,) of joints: the limit, or twice what gravity may demand."""
    limits = np.array([joint.effort for joint in robot.joints])
    needed = np.abs(static_torques(robot)).max(axis=0)
    guess = np.maximum(2 * needed, 0.1 * needed.max())
    return np.where(np.isfinite(limits) & (limits > 0), limits, guess)


def without_drive_terms(robot: RobotModel) -> RobotModel:
    """Return a robot without friction and armature."""
    joints = (
        replace(joint, damping=0.0, friction_loss=0.0, armature=0.0) for joint in robot.joints
    )
    return replace(robot, joints=tuple(joints))


def with_drive_terms(
    robot: RobotModel, effort: FloatArray, random: np.random.Generator
) -> RobotModel:
    """Return the robot whose drives have random friction and armature.

    They are in proportion to efforts (J,), Nm. Joints without a drive remain as they are.
    """
    joints = tuple(
        replace(
            joint,
            damping=VISCOUS * size * random.uniform(1 - SPREAD, 1 + SPREAD),
            friction_loss=COULOMB * size * random.uniform(1 - SPREAD, 1 + SPREAD),
            armature=ARMATURE * size * random.uniform(1 - SPREAD, 1 + SPREAD),
        )
        if joint.mimic is None and joint.effort > 0
        else joint
        for joint, size in zip(robot.joints, effort.tolist(), strict=True)
    )
    return replace(robot, joints=joints)


class TrackingSimulator:
    """A robot on a fixed base whose drives follow a trajectory.

    MuJoCo simulates the true robot. A computed-torque controller at 1 kHz commands the drives. It
    knows the drives' friction and armature, but has another model of the links. Its feedback uses
    the true state; the sensors are noisy.

    It has the interface of :class:`symbid_ros.simulation.simulator.Simulator`, so that the same
    function records its bag.

    Parameters
    ----------
    truth : RobotModel
        The true robot, with its friction and armature.
    controller_model : RobotModel
        The robot whose links the controller knows.
    trajectory : JointTrajectory
        Joints that it does not contain stay at their initial position.
    sensors : JointSensorOptions
    capacity : (J,) float64
        Largest effort of each joint, Nm or N, of which the noise of efforts is a share.
    seed : int or None
        Seed of the noise; None for sensors without noise.

    Raises
    ------
    SimulationError
        When the base floats or MuJoCo cannot compile the robot.
    """

    def __init__(
        self,
        truth: RobotModel,
        controller_model: RobotModel,
        trajectory: JointTrajectory,
        *,
        sensors: JointSensorOptions,
        capacity: FloatArray,
        seed: int | None,
    ) -> None:
        if truth.floating:
            raise SimulationError(
                f"{truth.source}: its base floats, and this trajectory needs a fixed one; give "
                "`base` fixed, or design the trajectory with `feet`",
                "E682",
            )
        self.joint_names, self.base_frame = truth.joint_names, truth.links[0].name
        self.imu_frame = ""
        self.wrench_sensors: tuple[WrenchSensor, ...] = ()
        self.sample_rates = SampleRates()
        self._every = max(1, round(1 / (sensors.rate * PERIOD)))
        self.period_ns = round(self._every * PERIOD * 1e9)
        self.steps = int(trajectory.duration / PERIOD) // self._every
        self._plant = _compile(truth, is_true=True)
        self._substeps = _substeps(self._plant, truth)
        self._plant.opt.timestep = PERIOD / self._substeps
        centre_damping(self._plant)
        self._controller = _compile(replace(controller_model, joints=truth.joints), is_true=False)
        self._damping = self._controller.dof_damping.copy()
        self._controller.dof_damping[:] = 0.0  # compensated for the reference, not for the state
        self._data = mujoco.MjData(self._plant)
        self._inverse = mujoco.MjData(self._controller)
        self._friction = np.array([joint.friction_loss for joint in truth.joints])
        efforts = np.array([joint.effort for joint in truth.joints])
        self._largest = np.where([joint.mimic is None for joint in truth.joints], efforts, np.inf)
        self._truth = truth
        self._reference = self._references(trajectory)
        self._seed = seed
        self._random = np.random.default_rng(seed)
        self._position_std = position_std(sensors, truth)
        self._effort_std = effort_std(sensors, capacity)
        self._data.qpos[:] = self._reference[0, 0]
        self._step = -round(SETTLING_TIME / PERIOD)
        while self._step < 0:
            self._advance()

    @property
    def robot(self) -> str:
        """MJCF of the true robot."""
        return mjcf_text(self._truth)

    def step(self) -> Instant:
        """Return the instant at the start of one period of the sensors, and simulate the period.

        Raises
        ------
        RobotFailureError
            When a joint leaves its range.
        """
        instant = self._instant(self._advance())
        for _ in range(self._every - 1):
            self._advance()
        return instant

    def _references(self, trajectory: JointTrajectory) -> FloatArray:
        """Return position, velocity and acceleration (3, N, J) at each step and one more."""
        joints = len(self.joint_names)
        time = np.minimum(np.arange(self.steps * self._every + 1) * PERIOD, trajectory.duration)
        complete = np.zeros((3, len(time), joints))
        complete[0] = np.clip(
            np.zeros(joints),
            [joint.lower for joint in self._truth.joints],
            [joint.upper for joint in self._truth.joints],
        )
        places = [self.joint_names.index(name) for name in trajectory.names]
        complete[:, :, places] = trajectory.at(time)
        for order in range(3):
            complete[order] = self._truth.apply_mimics(complete[order], rates=order > 0)
        return complete

    def _advance(self) -> "_MotionInstant":
        """Simulate one period of the controller and return what held at its start."""
        plant, data = self._plant, self._data
        mujoco.mj_step1(plant, data)
        position, velocity = data.qpos.copy(), data.qvel.copy()
        torque = self._torques(max(self._step, 0))
        data.qfrc_applied[:] = torque
        mujoco.mj_step2(plant, data)
        acceleration = data.qacc.copy()
        for _ in range(self._substeps - 1):
            mujoco.mj_step(plant, data)
        self._step += 1
        return _MotionInstant(position, velocity, acceleration, torque)

    def _torques(self, step: int) -> FloatArray:
        """Return the computed torques (J,) for the current state, within the joints' limits."""
        position, velocity, acceleration = self._reference[:, step]
        inverse, data = self._inverse, self._data
        inverse.qpos[:], inverse.qvel[:] = data.qpos, data.qvel
        inverse.qacc[:] = (
            acceleration + STIFFNESS * (position - data.qpos) + DAMPING * (velocity - data.qvel)
        )
        mujoco.mj_inverse(self._controller, inverse)
        torque = inverse.qfrc_inverse + self._damping * velocity
        torque += self._friction * np.tanh(velocity / COULOMB_SPEED)
        self._truth.fold_followers(torque[None])
        return np.asarray(np.clip(torque, -self._largest, self._largest))

    def _instant(self, motion: "_MotionInstant") -> Instant:
        for index, joint in enumerate(self._truth.joints):
            position = motion.position[index]
            if not joint.lower - TOLERANCE <= position <= joint.upper + TOLERANCE:
                raise RobotFailureError(
                    f"joint {joint.name} left its range",
                    self._step * PERIOD,
                    "design a trajectory with smaller shares of the limits",
                    "E683",
                )
        noise = np.zeros((2, len(self.joint_names)))
        if self._seed is not None:
            noise = self._random.standard_normal(noise.shape)
        rest, upright = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        return Instant(
            stamp=self._step * round(PERIOD * 1e9),
            joint_position=motion.position + noise[0] * self._position_std,
            joint_velocity=motion.velocity,
            joint_effort=motion.torque + noise[1] * self._effort_std,
            imu_orientation=upright,
            imu_angular_velocity=rest,
            imu_linear_acceleration=rest,
            wrenches=np.zeros((0, 6)),
            true_position=motion.position,
            true_velocity=motion.velocity,
            true_acceleration=motion.acceleration,
            true_effort=motion.torque,
            base_position=rest,
            base_orientation=upright,
            base_linear_velocity=rest,
            base_angular_velocity=rest,
            base_linear_acceleration=rest,
            base_angular_acceleration=rest,
        )


@dataclass(frozen=True)
class _MotionInstant:
    """Position, velocity, acceleration and torque (J,) of one instant."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    torque: FloatArray


def _substeps(model: mujoco.MjModel, robot: RobotModel) -> int:
    """Return the number of steps of a period in which explicit damping is stable.

    Raises
    ------
    SimulationError
        When the damping of a joint is out of proportion to its inertia.
    """
    rate = model.dof_damping / model.dof_M0
    fastest = int(np.argmax(rate))
    substeps = int(np.ceil(rate[fastest] * PERIOD / LARGEST_DECAY))
    if substeps > MOST_SUBSTEPS:
        joint = robot.joints[fastest]
        raise SimulationError(
            f"{robot.source}: the damping {joint.damping:g} of joint {joint.name} is out of "
            f"proportion to its inertia {model.dof_M0[fastest]:.2g} kg m^2, so it cannot be "
            "simulated; correct the file, or give `friction` for a drive that fits the robot",
            "E684",
        )
    return max(1, substeps)


def centre_damping(model: mujoco.MjModel) -> None:
    """Let damping act on the velocity at the instant of the position, half a step after MuJoCo's.

    Positions q advance by the velocity at the end of each step, so v is their derivative half a
    step before q. With b (v + a Δt/2) in place of b v, the damping b obeys the trapezoidal rule.
    Otherwise a log shows an armature that is smaller by b Δt/2.
    """
    model.dof_armature += model.dof_damping * model.opt.timestep / 2
    mujoco.mj_setConst(model, mujoco.MjData(model))  # inertias that MuJoCo keeps


def _compile(robot: RobotModel, *, is_true: bool) -> mujoco.MjModel:
    """Return MuJoCo's model of a robot; that of the controller has no constraints and friction."""
    try:
        model = mujoco.MjModel.from_xml_string(mjcf_text(robot))
    except ValueError as error:
        raise SimulationError(
            f"{robot.source}: MuJoCo cannot compile the robot ({' '.join(str(error).split())}); "
            "correct its links",
            "E601",
        ) from None
    model.opt.timestep = PERIOD
    # With implicit damping, the change of velocity would differ from the acceleration in the
    # equation of motion.
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    model.dof_solref[:] = FRICTION_TIME_CONSTANT, 1.0
    if not is_true:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model
