"""The simulator: a scenario executed by the robot and observed by its sensors."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload, link_index
from symbid_ros.simulation.initial_pose import level_soles
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant, load_model
from symbid_ros.simulation.scenario import (
    SCENARIOS,
    SOLES,
    SUPPORT_FRAME,
    ScenarioRun,
    require_seed,
)
from symbid_ros.simulation.sensors import Instant, Sensors
from symbid_ros.simulation.settings import JointFriction, load_friction, load_noise
from symbid_ros.simulation.systematic_errors import draw_errors, parse_errors

# The shortest time constant that MuJoCo allows at a period of 1 ms. Coulomb friction then has its
# full value or stops the joint within one period; by default joints creep at up to 0.1 rad/s.
FRICTION_TIME_CONSTANT = 2e-3  # s


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
    scenario : str
        ``smooth``, ``squat``, ``vibrating`` (all standing on two feet), ``suspended`` (rocked by
        an overhead support) or ``tare`` (suspended at rest, force plates unloaded).
    moves : int
        Number of moves; ignored by ``tare``.
    motion_seed : int
        Seed of the moves and, in ``vibrating``, of the feedback noise; ignored by ``tare``.
    noise_seed : int
        Seed of the sensor noise.
    noise_factor : float
        Multiplies the standard deviations of the noise, 0 or more.
    ideal : bool
        The same motion with noise-free sensors.
    friction : bool
        Whether the joints have friction and armature; implied by ``friction_path``.
    errors : str
        Comma-separated names of systematic errors; see `parse_errors`.
    error_seed : int
        Seed of these errors; a tare and a log with equal seeds have the same errors.
    model_path : Path or None
        MJCF; None for config/symbitron.xml.
    noise_path : Path or None
        Standard deviations; None for config/noise.yaml.
    friction_path : Path or None
        Friction and armature; None for config/friction.yaml.
    payload : Payload or None
        Attached to the robot during the motion; unknown to the scenario's controller.
    payload_time : float
        When it is attached, in seconds after the start of the motion.
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
        scenario: str = "smooth",
        *,
        moves: int = 20,
        motion_seed: int = 0,
        noise_seed: int = 0,
        noise_factor: float = 1.0,
        ideal: bool = False,
        friction: bool = False,
        errors: str = "",
        error_seed: int = 0,
        model_path: Path | None = None,
        noise_path: Path | None = None,
        friction_path: Path | None = None,
        payload: Payload | None = None,
        payload_time: float = 0.0,
        is_commanded: bool = False,
    ) -> None:
        if scenario not in SCENARIOS:
            raise SimulationError(
                f"no scenario {scenario!r}; choose one of {', '.join(sorted(SCENARIOS))}", "E606"
            )
        for name, seed in (
            ("motion seed", motion_seed),
            ("noise seed", noise_seed),
            ("error seed", error_seed),
        ):
            require_seed(name, seed)
        noise = None
        if not ideal:
            noise = load_noise(noise_path or config_file("noise.yaml")).scaled(noise_factor)
        plant = Plant(model_path or config_file("symbitron.xml"), SOLES)
        self.joint_names = plant.joint_names
        self.errors = draw_errors(
            parse_errors(errors), error_seed, joints=len(plant.joint_names), plates=len(SOLES)
        )
        self.sample_rates = self.errors.sample_rates
        joint_friction = {}
        if friction or friction_path is not None:
            joint_friction = load_friction(friction_path or config_file("friction.yaml"))
        lengths = {}
        if self.errors.link_length.any():
            lengths = dict(zip(plant.joint_names, self.errors.link_length.tolist(), strict=True))
        if joint_friction or lengths:
            plant = _modified_plant(plant, joint_friction, lengths)
        self._plant = plant
        motion = SCENARIOS[scenario](plant, moves, motion_seed)
        self._run = ScenarioRun(plant, motion)
        self.base_frame = plant.base_frame
        self.imu_frame = "imu_link"
        feet = [WrenchSensor(sole.replace("_sole", "_foot/wrench"), sole) for sole in SOLES]
        hook = [WrenchSensor(f"{SUPPORT_FRAME}/wrench", SUPPORT_FRAME)] if motion.support else []
        self.wrench_sensors = (*feet, *hook)
        self.period_ns = round(plant.period * 1e9)
        self.steps = self._run.steps
        driven = np.isin(np.arange(6, plant.model.nv), plant.driven)
        self._sensors = Sensors(driven, len(self.wrench_sensors), noise, noise_seed, self.errors)
        self.drive_names, self.torque_limits = plant.drive_names, plant.torque_limits
        self._is_commanded = is_commanded
        self._scheduled = _schedule_payload(plant, payload, payload_time)
        self._steps_done = 0
        for truth in self._run.settle():
            self._sensors.store(truth)

    @property
    def robot(self) -> str:
        """MJCF of the simulated robot, with its friction and lengths, without payload."""
        return self._plant.text

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
        if self._scheduled is not None and self._steps_done >= self._scheduled[0]:
            self.attach(self._scheduled[1])
            self._scheduled = None
        truth = self._run.advance(self._steps_done, torques)
        self._steps_done += 1
        return self._sensors.measure(truth, self._steps_done * self.period_ns)

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


def _schedule_payload(
    plant: Plant, payload: Payload | None, time: float
) -> tuple[int, Payload] | None:
    """Return the step at which to attach a payload, and the payload."""
    if not (math.isfinite(time) and time >= 0.0):
        raise SimulationError(f"payload time {time:g} s; give a finite number, 0 or more", "E605")
    if payload is None:
        return None
    link_index(plant.model, payload.link)
    return round(time / plant.period), payload


def _modified_plant(
    original: Plant, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> Plant:
    """Return the plant with joint friction and modified lengths, standing like the original."""
    plant = Plant(original.path, SOLES, modify_mjcf(original.path, friction, lengths))
    plant.data.qpos[:] = level_soles(plant.model, original.model, original.data.qpos, SOLES)
    return plant


def modify_mjcf(
    path: Path, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> str:
    """Return the text of an MJCF file with joint friction and modified lengths.

    Parameters
    ----------
    path : Path
        MJCF that contains the bodies and joints itself, without includes.
    friction : mapping of str to JointFriction
        By joint name.
    lengths : mapping of str to float
        By joint name: additional distance of the joint's body from its parent's origin, m. A
        body at its parent's origin stays there.

    Raises
    ------
    SimulationError
        When a joint is not in the file.
    """
    root = ET.parse(path, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    joints = {element.get("name"): element for element in root.iterfind("worldbody//joint")}
    missing = [name for name in (*friction, *lengths) if name not in joints]
    if missing:
        raise SimulationError(
            f"{path}: no joint {missing[0]}; name joints in the worldbody of this file", "E602"
        )
    for name, values in friction.items():
        for attribute, value in asdict(values).items():
            joints[name].set(attribute, repr(value))
        joints[name].set("solreffriction", f"{FRICTION_TIME_CONSTANT} 1")
    if friction:
        _integrate_explicitly(root)
    for body in root.iterfind("worldbody//body"):
        names = [joint.get("name") for joint in body.findall("joint")]
        _lengthen_body(body, sum(lengths.get(str(name), 0.0) for name in names))
    return ET.tostring(root, encoding="unicode") + "\n"


def _integrate_explicitly(root: ET.Element) -> None:
    # With implicit damping, the change of velocity would differ from the acceleration in the
    # equation of motion, by one per cent in light joints: the log would be inconsistent.
    option = root.find("option")
    if option is None:
        option = ET.SubElement(root, "option")
    option.set("integrator", "Euler")
    flag = option.find("flag")
    if flag is None:
        flag = ET.SubElement(option, "flag")
    flag.set("eulerdamp", "disable")


def _lengthen_body(body: ET.Element, amount: float) -> None:
    offset = np.array(body.get("pos", "0 0 0").split(), dtype=np.float64)
    length = float(np.linalg.norm(offset))
    if amount and length > 0.0:
        longer = offset * (1.0 + amount / length)
        body.set("pos", " ".join(repr(float(value)) for value in longer))


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


def simulator_of(
    options: SimulateOptions,
    model: Path | None = None,
    payload: Payload | None = None,
    *,
    is_commanded: bool = False,
) -> Simulator:
    """Return a simulator at the start of the motion that the options choose."""
    return Simulator(
        options.scenario,
        moves=options.moves,
        motion_seed=options.motion_seed,
        noise_seed=options.noise_seed,
        ideal=options.ideal,
        friction=options.friction,
        errors=options.errors,
        error_seed=options.error_seed,
        model_path=model,
        noise_path=options.noise,
        friction_path=options.friction_file,
        payload=payload,
        payload_time=options.payload_time,
        is_commanded=is_commanded,
    )
