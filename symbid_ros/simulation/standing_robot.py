"""Any robot that stands on a floor and follows a trajectory of its joints, and its sensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.stance import Foot
from symbid_ros.errors import SimulationError
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.joint_trajectory import JointTrajectory
from symbid_ros.simulation.modified_robot import FRICTION_TIME_CONSTANT
from symbid_ros.simulation.plant import Plant, State
from symbid_ros.simulation.scenario import Scenario, ScenarioRun
from symbid_ros.simulation.sensors import Instant, Sensors
from symbid_ros.simulation.simulator import WrenchSensor
from symbid_ros.simulation.systematic_errors import SampleRates, draw_errors
from symbid_ros.simulation.tracking import (
    PERIOD,
    centre_damping,
    effort_std,
    position_std,
)

IMU = "imu_link"
FLOOR_FRICTION = 0.8
# Radius of the spheres that touch the floor, m, unless the foot is a ball. A point touches it at
# its frame's origin.
POINT_RADIUS, CORNER_RADIUS = 0.001, 0.005
# Feedback of joints, as if each carried its share of the mass at the farther end of its lever: a
# wrong model of the mass by 25 % then lowers the base by 6 mm. With more damping, light legs
# without armature vibrate at a period of 1 ms.
FREQUENCY, DAMPING_RATIO = 20.0, 0.3  # rad/s
VELOCITY_NOISE = 5e-3  # rad/s or m/s
ANOTHER = "design another trajectory by `symbid excite` with `seed`, give a smaller `truth_percent`"


class StandingSimulator:
    """A robot that stands on a floor while its drives follow a trajectory.

    MuJoCo simulates the true robot on a floor. The feet are free to slip and to lift. The drives
    follow positions and velocities of the joints, with the trajectory's efforts as feed-forward,
    at 1 kHz and with the true state; the sensors are noisy.

    It has the interface of :class:`symbid_ros.simulation.simulator.Simulator`, so that the same
    function records its bag.

    Parameters
    ----------
    truth : RobotModel
        The true robot, with its friction and armature.
    trajectory : JointTrajectory
        With efforts and poses of the base; the feet are at height 0.
    feet : sequence of Foot
    sensors, base_sensors : JointSensorOptions, BaseSensorOptions
    unmeasured : sequence of str
        Frames of the feet without a wrench sensor.
    capacity : (J,) float64
        Largest effort of each joint, Nm or N, of which the noise of efforts is a share.
    seed : int or None
        Seed of the noise; None for sensors without noise.

    Attributes
    ----------
    truth : RobotModel
        The true robot.

    Raises
    ------
    SimulationError
        When the base is fixed, the trajectory has no efforts or no pose of the base, or MuJoCo
        cannot compile the robot.
    RobotFailureError
        When the robot falls before the trajectory starts.
    """

    def __init__(
        self,
        truth: RobotModel,
        trajectory: JointTrajectory,
        feet: Sequence[Foot],
        *,
        sensors: JointSensorOptions,
        base_sensors: BaseSensorOptions,
        capacity: FloatArray,
        unmeasured: Sequence[str] = (),
        seed: int | None,
    ) -> None:
        if trajectory.effort is None or trajectory.base is None:
            raise SimulationError(
                f"{truth.source}: a robot that stands needs a trajectory with efforts and poses of "
                "its base; give `trajectory` the folder of `symbid excite`",
                "E924",
            )
        frames = tuple(foot.frame for foot in feet if foot.frame not in unmeasured)
        plant = _plant(truth, feet, frames, trajectory)
        self.truth = truth
        self.joint_names, self.base_frame = plant.joint_names, plant.base_frame
        self.imu_frame = imu_frame(truth)
        self.wrench_sensors = tuple(WrenchSensor(f"{name}/wrench", name) for name in frames)
        self.sample_rates = SampleRates()
        self._every = max(1, round(1 / (sensors.rate * PERIOD)))
        self.period_ns = round(self._every * PERIOD * 1e9)
        controller = JointFollower(plant, trajectory, len(feet))
        lowest = float(trajectory.base[:, 2].min())
        scenario = Scenario(controller, None, trajectory.duration, lowest, ANOTHER)
        self._run = ScenarioRun(plant, scenario)
        self.steps = self._run.steps // self._every
        order = [truth.joint_names.index(name) for name in plant.joint_names]
        driven = np.isin(np.arange(6, plant.model.nv), plant.driven)
        weight = plant.mass * float(np.linalg.norm(truth.gravity))
        noise = _ChannelNoise(
            position_std(sensors, truth)[order],
            effort_std(sensors, capacity)[order],
            base_sensors,
            base_sensors.wrench_std(weight),
        )
        errors = draw_errors((), 0, joints=len(order), plates=len(frames))
        self._sensors = Sensors(
            driven, len(frames), None if seed is None else noise, seed or 0, errors
        )
        self._steps_done = 0
        for instant in self._run.settle():
            self._sensors.store(instant)

    @property
    def robot(self) -> str:
        """MJCF of the true robot."""
        return mjcf_text(self.truth)

    def step(self) -> Instant:
        """Return the instant at the start of one period of the sensors, and simulate the period.

        Raises
        ------
        RobotFailureError
            When the robot falls or a joint leaves its range.
        """
        first = self._steps_done * self._every
        truth = self._run.advance(first)
        for number in range(1, self._every):
            self._run.advance(first + number)
        self._steps_done += 1
        return self._sensors.measure(truth, self._steps_done * self.period_ns)


@dataclass(frozen=True)
class _ChannelNoise:
    """Standard deviations of the noise of each channel, as :class:`Sensors` needs them."""

    position: FloatArray
    effort: FloatArray
    base: BaseSensorOptions
    wrench: tuple[float, ...]

    def by_channel(self, joints: int, wrenches: int) -> FloatArray:
        velocity = np.full(joints, VELOCITY_NOISE)
        imu = np.repeat([self.base.gyro_noise, self.base.accelerometer_noise], 3)
        plate = np.roll(self.wrench, 3)  # force first
        return np.concatenate([self.position, velocity, self.effort, imu, np.tile(plate, wrenches)])


class JointFollower:
    """Lets the drives follow a trajectory: its efforts, and feedback of positions and velocities.

    Parameters
    ----------
    plant : Plant
        In its initial pose.
    trajectory : JointTrajectory
        With efforts.
    feet : int
        Number of feet that share the weight.
    """

    def __init__(self, plant: Plant, trajectory: JointTrajectory, feet: int) -> None:
        steps = np.arange(int(trajectory.duration / PERIOD) + 2) * PERIOD
        time = np.minimum(steps, trajectory.duration)
        columns = [trajectory.names.index(name) for name in plant.drive_names]
        position, velocity, _ = trajectory.at(time)
        self._position, self._velocity = position[:, columns], velocity[:, columns]
        self._effort = trajectory.effort_at(time)[:, columns]
        self._driven = plant.driven
        inertia = plant.mass / feet * _levers(plant) ** 2
        self._stiffness = FREQUENCY**2 * inertia
        self._damping = 2 * DAMPING_RATIO * FREQUENCY * inertia

    def torques(self, state: State) -> FloatArray:
        """Return the drive torques (n_actuated,), Nm, for one state."""
        step = min(max(round(state.time / PERIOD), 0), len(self._position) - 1)
        position = state.position[1:][self._driven]  # one more number than velocities: a quaternion
        feedback = self._stiffness * (self._position[step] - position)
        feedback += self._damping * (self._velocity[step] - state.velocity[self._driven])
        return np.asarray(self._effort[step] + feedback)


def imu_frame(robot: RobotModel) -> str:
    """Return the frame of the simulated IMU: ``imu_link``, or the base."""
    frames = {frame.name for frame in robot.frames} | set(robot.link_names)
    return IMU if IMU in frames else robot.link_names[0]


def _levers(plant: Plant) -> FloatArray:
    """Return the larger distance (n_actuated,) of floor and centre of mass from each drive, m."""
    model, data = plant.model, plant.data
    mujoco.mj_forward(model, data)
    joints = model.actuator_trnid[:, 0]
    axis, anchor = data.xaxis[joints], data.xanchor[joints]
    to_floor = np.column_stack([np.zeros((len(joints), 2)), -anchor[:, 2]])
    ends = [np.cross(axis, end) for end in (to_floor, plant.com - anchor)]
    reach = np.max([np.linalg.norm(end, axis=1) for end in ends], axis=0)
    slides = model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE
    return np.asarray(np.where(slides, 1.0, reach))


def _plant(
    robot: RobotModel, feet: Sequence[Foot], measured: tuple[str, ...], trajectory: JointTrajectory
) -> Plant:
    """Return the robot on a floor, with contact points, IMU and initial pose."""
    if not robot.floating:
        raise SimulationError(
            f"{robot.source}: its base is fixed, so it cannot stand; give `base` floating", "E924"
        )
    spec = mujoco.MjSpec.from_string(mjcf_text(robot))
    spec.option.timestep, spec.option.tolerance, spec.option.impratio = PERIOD, 1e-10, 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # With implicit damping, the change of velocity would differ from the acceleration in the
    # equation of motion.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    depth = POINT_RADIUS if all(foot.is_point and not foot.radius for foot in feet) else 0.0
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.1],
        pos=[0.0, 0.0, -depth],
        contype=1,
        conaffinity=0,
    )
    for foot in feet:
        _add_contacts(spec, robot, foot)
    _add_imu(spec, robot)
    assert trajectory.base is not None
    model = spec.compile()
    pose = model.qpos0.copy()
    pose[:7] = trajectory.base[0]
    for name, value in zip(trajectory.names, trajectory.position[0].tolist(), strict=True):
        pose[model.joint(name).qposadr[0]] = value
    spec.add_key(name="standing", qpos=pose)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "standing.xml"
        path.write_text(spec.to_xml(), encoding="utf-8")
        plant = Plant(path, measured)
    plant.model.dof_solref[:] = FRICTION_TIME_CONSTANT, 1.0
    centre_damping(plant.model)
    return plant


def _body(spec: mujoco.MjSpec, robot: RobotModel, link: int) -> mujoco.MjsBody:
    """Return the body of a link."""
    return next(body for body in spec.bodies if body.name == robot.link_names[link])


def _add_contacts(spec: mujoco.MjSpec, robot: RobotModel, foot: Foot) -> None:
    """Add the spheres with which a foot touches the floor, and the site of its wrench sensor."""
    frame = robot.frame(foot.frame)
    body = _body(spec, robot, frame.link)
    if all(site.name != foot.frame for site in spec.sites):
        body.add_site(
            name=foot.frame, pos=frame.translation, quat=quaternion_from_rotation(frame.rotation)
        )
    points, radius = np.zeros((1, 3)), foot.radius or POINT_RADIUS
    if not foot.is_point:
        radius = CORNER_RADIUS
        points = np.array([[x, y, radius] for x in foot.sole[:2] for y in foot.sole[2:]])
    for point in points:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0.0, 0.0],
            pos=frame.translation + frame.rotation @ point,
            mass=0.0,
            contype=0,
            conaffinity=1,
            friction=[FLOOR_FRICTION, 0.005, 0.0001],
            solref=[0.005, 1.0],
            solimp=[0.9, 0.95, 0.001, 0.5, 2.0],
        )


def _add_imu(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    """Add the IMU that :class:`Plant` reads."""
    frame = robot.frame(imu_frame(robot))
    site = "simulated_imu"
    _body(spec, robot, frame.link).add_site(
        name=site, pos=frame.translation, quat=quaternion_from_rotation(frame.rotation)
    )
    for name, kind in (
        ("imu_orientation", mujoco.mjtSensor.mjSENS_FRAMEQUAT),
        ("imu_angular_velocity", mujoco.mjtSensor.mjSENS_GYRO),
        ("imu_linear_acceleration", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)
