"""Random robots simulated by MuJoCo, as instants for bags and as streams."""

from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.systematic_errors import SampleRates


@dataclass(frozen=True)
class Sensor:
    topic: str
    frame_id: str


class TreeSimulation:
    """Driven joints track sines, sinusoidal wrenches act on each frame, and sensors are ideal.

    It has the interface of `Simulator`, so `record` can write its bag.
    """

    period_ns = 1_000_000
    imu_frame = "imu_link"
    sample_rates = SampleRates()

    def __init__(self, model, seconds, seed):
        rng = np.random.default_rng(seed)
        self.model, self.steps = model, int(seconds * 1000)
        self.joint_names = model.joint_names
        self.base_frame = model.links[0].name
        frames = [f.name for f in model.frames if f.name.startswith("wrench")]
        self.wrench_sensors = tuple(Sensor(f"{name}/wrench", name) for name in frames)
        self.m = mujoco.MjModel.from_xml_string(mjcf_text(model))
        self.m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        # Ten Runge-Kutta steps between the readings of 1 kHz sensors.
        self.m.opt.timestep = 1e-4
        self.m.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.d = mujoco.MjData(self.m)
        joints = len(model.joints)
        # Views into MuJoCo's arrays, whose addresses are fixed: each lookup costs 1 µs.
        sites = [self.m.site(name).id for name in frames]
        self.sites = [
            (self.d.site_xmat[site].reshape(3, 3), self.d.site_xpos[site], self.m.site_bodyid[site])
            for site in sites
        ]
        self.position = self.d.qpos[self.m.nq - joints :]
        self.driven = np.array([joint.effort > 0 for joint in model.joints])
        self.friction_loss = np.array([joint.friction_loss for joint in model.joints])
        self.has_friction = bool(self.friction_loss.any())
        self.frequency = rng.uniform(0.3, 1.5, (4, joints + 6 * len(frames)))
        self.phase = rng.uniform(0, 6, self.frequency.shape)
        self.rate = 2 * np.pi * self.frequency
        self.joints = slice(self.m.nv - joints, self.m.nv)
        self.velocity, self.applied = self.d.qvel[self.joints], self.d.qfrc_applied
        self.applied_to_joints = self.applied[self.joints]
        self.scale = 10 * model.phi[:, 0].sum()
        self.inertia = self.m.dof_M0[self.joints]
        self.position[:] = self._target(0.0)[:joints]
        mujoco.mj_forward(self.m, self.d)

    def _target(self, time):
        return np.add.reduce(np.sin(self.rate * time + self.phase)) / len(self.phase)

    def step(self):
        forces = self._apply_forces()
        mujoco.mj_forward(self.m, self.d)
        instant = self._instant(*forces)
        self._advance()
        for _ in range(9):
            self._apply_forces()
            self._advance()
        return instant

    def _advance(self):
        mujoco.mj_step(self.m, self.d)
        mujoco.mj_kinematics(self.m, self.d)

    def _apply_forces(self):
        wave = self._target(self.d.time)
        joints, sites = len(self.joint_names), len(self.sites)
        # Servos of a few hertz; joints without motor swing freely.
        error = wave[:joints] - self.position
        effort = self.inertia * (400 * error - 30 * self.velocity) * self.driven
        wrenches = np.zeros((sites, 6))
        self.applied[:] = 0
        self.applied_to_joints[:] = effort
        if self.has_friction:
            # Coulomb friction; MuJoCo's dry friction would be softer at low speed.
            self.applied_to_joints -= self.friction_loss * np.clip(self.velocity / 1e-3, -1, 1)
        if sites:
            waves = wave[joints:].reshape(-1, 6)
            wrenches[:, 3:] = self.scale * waves[:, :3] / sites
            wrenches[:, :3] = 0.1 * self.scale * waves[:, 3:]
        for (axes, place, body), wrench in zip(self.sites, wrenches, strict=True):
            force, moment = np.dot(axes, wrench[3:]), np.dot(axes, wrench[:3])
            mujoco.mj_applyFT(self.m, self.d, force, moment, place, body, self.applied)
        return effort, wrenches

    def _instant(self, effort, wrenches):
        m, d = self.m, self.d
        joints = len(self.joint_names)
        rotation = np.eye(3)
        base = np.zeros((5, 3))
        quaternion = np.array([0.0, 0, 0, 1])
        if self.model.floating:
            rotation = d.body(self.base_frame).xmat.reshape(3, 3).copy()
            quaternion = np.roll(d.qpos[3:7], -1)
            base = np.array(
                [
                    d.qpos[:3],
                    rotation.T @ d.qvel[:3],
                    d.qvel[3:6],
                    rotation.T @ d.qacc[:3],
                    d.qacc[3:6],
                ]
            )
        omega, force = self._imu()
        position, velocity = d.qpos[m.nq - joints :].copy(), d.qvel[self.joints].copy()
        imu = np.empty(4)
        mujoco.mju_mat2Quat(imu, d.site(self.imu_frame).xmat)
        return Instant(
            stamp=round(d.time * 1e3) * self.period_ns,
            joint_position=position,
            joint_velocity=velocity,
            joint_effort=effort.copy(),
            imu_orientation=np.roll(imu, -1),
            imu_angular_velocity=omega,
            imu_linear_acceleration=force,
            wrenches=np.concatenate([wrenches[:, 3:], wrenches[:, :3]], axis=1),
            true_position=position,
            true_velocity=velocity,
            true_acceleration=d.qacc[self.joints].copy(),
            true_effort=effort.copy(),
            base_position=base[0],
            base_orientation=quaternion,
            base_linear_velocity=base[1],
            base_angular_velocity=base[2],
            base_linear_acceleration=base[3],
            base_angular_acceleration=base[4],
        )

    def _imu(self):
        """Return the IMU's rate and specific force as MuJoCo computes them."""
        m, d = self.m, self.d
        mujoco.mj_rnePostConstraint(m, d)
        site = m.site(self.imu_frame).id
        velocity, acceleration = np.empty(6), np.empty(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 1)
        mujoco.mj_objectAcceleration(m, d, mujoco.mjtObj.mjOBJ_SITE, site, acceleration, 1)
        return velocity[:3], acceleration[3:]


def streams_of(simulation):
    """Return the sensor streams and the instants of a whole simulation."""
    instants = [simulation.step() for _ in range(simulation.steps)]

    def column(name):
        return np.array([getattr(instant, name) for instant in instants])

    stamp = np.array([instant.stamp for instant in instants], dtype=np.int64)
    joints = JointStream(
        "/joint_states",
        simulation.joint_names,
        stamp,
        column("joint_position"),
        column("joint_velocity"),
        column("joint_effort"),
    )
    imu = ImuStream(
        "/imu/data",
        simulation.imu_frame,
        stamp,
        column("imu_orientation"),
        column("imu_angular_velocity"),
        column("imu_linear_acceleration"),
    )
    wrenches = tuple(
        WrenchStream(
            sensor.topic,
            sensor.frame_id,
            stamp,
            column("wrenches")[:, index, :3],
            column("wrenches")[:, index, 3:],
        )
        for index, sensor in enumerate(simulation.wrench_sensors)
    )
    return Streams("simulated", joints, (imu,), wrenches), instants
