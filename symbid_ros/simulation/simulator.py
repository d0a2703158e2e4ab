"""The simulator: a scenario executed by the robot and observed by its sensors."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload, link_index
from symbid_ros.simulation.modified_robot import modified_plant
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant, com_in_pose, load_model
from symbid_ros.simulation.scenario import (
    SCENARIOS,
    SOLES,
    SUPPORT_FRAME,
    ScenarioRun,
)
from symbid_ros.simulation.sensors import Instant, Sensors
from symbid_ros.simulation.settings import load_friction, load_noise
from symbid_ros.simulation.systematic_errors import draw_errors, parse_errors


@dataclass(frozen=True)
class WrenchSensor:
    """A force plate or load cell.

    Attributes
    ----------
    topic : str
        Relative topic name.
    frame_id : str
        Frame whose axes and origin its wrenches refer to.
    """

    topic: str
    frame_id: str


class Simulator:
    """One run of a scenario, simulated one instant at a time.

    Stamps are multiples of the period and start at one period, as a stamp of 0 means "no time" in
    ROS. On one machine, equal seeds give bitwise equal instants.

    Parameters
    ----------
    options : SimulateOptions
        What to simulate. Of the payload's options, only ``payload_time`` is used.
    model_path : Path or None
        MJCF; None for config/symbitron.xml.
    noise_factor : float
        Multiplies the standard deviations of the noise, 0 or more.
    payload : Payload or None
        Attached to the robot at ``payload_time``; unknown to the scenario's controller.
    is_commanded : bool
        Whether external torques drive the robot after the scenario's controller has let it settle.

    Attributes
    ----------
    joint_names : tuple of str
        Order of joint arrays.
    base_frame, imu_frame : str
        Links of the floating base and of the IMU.
    wrench_sensors : tuple of WrenchSensor
        Order of wrenches.
    period_ns : int
        Nanoseconds from one instant to the next.
    steps : int
        Number of instants of the motion.
    errors : SystematicErrors
        The drawn errors, zero if not requested.
    sample_rates : SampleRates
        Sample intervals of the topics, part of these errors.
    drive_names : tuple of str
        The joint of each drive, in the order of torques.
    torque_limits : (n_actuated, 2) float64
        Lowest and highest torque of each drive, Nm.
    """

    def __init__(
        self,
        options: SimulateOptions,
        *,
        model_path: Path | None = None,
        noise_factor: float = 1.0,
        payload: Payload | None = None,
        is_commanded: bool = False,
    ) -> None:
        noise = None
        if not options.ideal:
            noise = load_noise(options.noise or config_file("noise.yaml")).scaled(noise_factor)
        plant = Plant(model_path or config_file("symbitron.xml"), SOLES)
        self.joint_names = plant.joint_names
        self.errors = draw_errors(
            parse_errors(options.errors),
            options.error_seed,
            joints=len(plant.joint_names),
            plates=len(SOLES),
        )
        self.sample_rates = self.errors.sample_rates
        joint_friction = {}
        if options.friction or options.friction_file is not None:
            joint_friction = load_friction(options.friction_file or config_file("friction.yaml"))
        lengths = {}
        if self.errors.link_length.any():
            lengths = dict(zip(plant.joint_names, self.errors.link_length.tolist(), strict=True))
        if joint_friction or lengths:
            plant = modified_plant(plant, SOLES, joint_friction, lengths)
        self._plant = plant
        motion = SCENARIOS[options.scenario](plant, options.moves, options.motion_seed)
        self._run = ScenarioRun(plant, motion)
        self._initial_pose: FloatArray = plant.data.qpos.copy()
        self.base_frame = plant.base_frame
        self.imu_frame = "imu_link"
        feet = [WrenchSensor(sole.replace("_sole", "_foot/wrench"), sole) for sole in SOLES]
        hook = [WrenchSensor(f"{SUPPORT_FRAME}/wrench", SUPPORT_FRAME)] if motion.support else []
        self.wrench_sensors = (*feet, *hook)
        self.period_ns = round(plant.period * 1e9)
        self.steps = self._run.steps
        driven = np.isin(np.arange(6, plant.model.nv), plant.driven)
        self._sensors = Sensors(
            driven, len(self.wrench_sensors), noise, options.noise_seed, self.errors
        )
        self.drive_names, self.torque_limits = plant.drive_names, plant.torque_limits
        self._is_commanded = is_commanded
        self._payload = payload
        self._payload_step = 0
        if payload is not None:
            link_index(plant.model, payload.link)
            if math.isinf(options.payload_time):
                raise SimulationError("payload time inf s; give a finite number, 0 or more", "E605")
            self._payload_step = round(options.payload_time / plant.period)
        self._steps_done = 0
        for truth in self._run.settle():
            self._sensors.store(truth)

    @property
    def robot(self) -> str:
        """MJCF of the simulated robot, with its friction and lengths, without payload."""
        return self._plant.text

    @property
    def com(self) -> FloatArray:
        """(3,) true centre of mass in the world at the newest instant, m."""
        return self._plant.com

    def initial_com(self) -> FloatArray:
        """Return the true centre of mass (3,) in the initial pose, with the present payload, m."""
        return com_in_pose(self._plant.model, self._initial_pose)

    def attach(self, payload: Payload | None) -> None:
        """Attach a payload from the next period on, in place of any other; None removes it.

        Raises
        ------
        SimulationError
            When the robot has no such link; the current payload then stays.
        """
        if payload is None:
            self._plant.detach()
        else:
            self._plant.attach(payload)

    def step(self, torques: FloatArray | None = None) -> Instant:
        """Simulate one period and return the instant at its start.

        Parameters
        ----------
        torques : (n_actuated,) float64 or None
            Drive torques during this period, Nm, clipped to their limits; only for a commanded
            robot, which keeps the last torques if None. They can respond to the previous instant
            at best, a delay that real drives have too.

        Raises
        ------
        SimulationError
            When torques are given to a robot that is not commanded, or have a wrong shape or value.
        RobotFailureError
            When the robot falls or a joint reaches its end stop.
        """
        if torques is not None:
            self._require_valid(torques)
        elif self._is_commanded:
            torques = self._run.torques
        if self._payload is not None and self._steps_done >= self._payload_step:
            self.attach(self._payload)
            self._payload = None
        truth = self._run.advance(self._steps_done, torques)
        self._steps_done += 1
        return self._sensors.measure(truth, self._steps_done * self.period_ns)

    def step_after_failure(self, torques: FloatArray) -> FloatArray:
        """Simulate one period after a failure, and return the true position (nq,) at its start.

        Falls and end stops raise no errors. There are no sensor readings.
        """
        position = self._plant.observe().position
        self._plant.advance(torques)
        return position

    def _require_valid(self, torques: FloatArray) -> None:
        if not self._is_commanded:
            raise SimulationError(
                "torques for a robot that is not commanded; pass is_commanded", "E611"
            )
        drives = len(self.drive_names)
        if np.shape(torques) != (drives,) or not np.all(np.isfinite(torques)):
            raise SimulationError(
                f"torques {torques} for {drives} drives; give that many finite numbers, Nm", "E611"
            )

    def __iter__(self) -> Iterator[Instant]:
        """Yield the remaining instants of the motion."""
        while self._steps_done < self.steps:
            yield self.step()


class PayloadFactory:
    """Makes payloads for one robot.

    Parameters
    ----------
    model : Path or None
        MJCF of the robot; None for config/symbitron.xml.
    """

    def __init__(self, model: Path | None = None) -> None:
        self._model = load_model(model or config_file("symbitron.xml"))
        self._base = str(self._model.body(self._model.jnt_bodyid[0]).name)

    def payload(self, link: str, mass: float, position: Sequence[float]) -> Payload | None:
        """Return a payload; None if its mass is 0. An empty link stands for the base.

        Raises
        ------
        SimulationError
            When the robot has no such link, even if the mass is 0.
        """
        link = link or self._base
        link_index(self._model, link)
        if not mass:
            return None
        x, y, z = position
        return Payload(link, mass, (x, y, z))
