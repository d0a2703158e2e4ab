"""The simulated robot as a source of instants: what bags and topics are made from."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload, link_index
from symbid_ros.simulation.initial_pose import level_soles
from symbid_ros.simulation.plant import Plant
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


@dataclass(frozen=True)
class WrenchSensor:
    """A force plate or load cell.

    Attributes
    ----------
    topic : str
        Relative name of its topic.
    frame_id : str
        Frame in whose axes and about whose origin it reports.
    """

    topic: str
    frame_id: str


class Simulator:
    """One run of a scenario, an instant at a time.

    Stamps are multiples of the period and start at one period: a stamp of 0 means "no time"
    in ROS. Equal seeds give equal instants, bit for bit, on one machine.

    Parameters
    ----------
    scenario : str
        ``smooth``, ``squat``, ``vibrating`` (all standing on two feet), ``suspended`` (rocked in
        a hoist) or ``tare`` (still in the hoist, nothing touching the plates).
    moves : int
        Number of moves; a tare has none.
    motion_seed : int
        Decides the moves and, in ``vibrating``, the noise of the feedback; nothing in a tare.
    noise_seed : int
        Decides the sensors' noise.
    noise_factor : float
        On every deviation of the noise, 0 or more.
    ideal : bool
        The same motion with noise-free sensors.
    friction : bool
        Whether the joints have friction and armature; a ``friction_path`` says so too.
    errors : str
        Systematic errors, a list with commas; see `parse_errors`.
    error_seed : int
        Decides them; equal seeds make one robot of a tare and a log.
    model_path : Path or None
        MJCF; None for config/symbitron.xml.
    noise_path : Path or None
        Standard deviations; None for config/noise.yaml.
    friction_path : Path or None
        Friction and armature; None for config/friction.yaml.
    payload : Payload or None
        Fastened to the robot while it moves; the scenario's controller does not know of it.
    payload_time : float
        When, in seconds of the motion.
    is_commanded : bool
        Whether torques come from outside, once the scenario's controller has let the robot settle.

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
        Number of instants of the whole motion.
    errors : SystematicErrors
        As drawn, zero where not asked for.
    sample_rates : SampleRates
        Of its topics, part of these errors.
    drive_names : tuple of str
        The joint of each drive, order of torques.
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
                f"no scenario {scenario!r}; choose one of {', '.join(sorted(SCENARIOS))}"
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
        resistance = {}
        if friction or friction_path is not None:
            resistance = load_friction(friction_path or config_file("friction.yaml"))
        lengths = {}
        if self.errors.link_length.any():
            lengths = dict(zip(plant.joint_names, self.errors.link_length.tolist(), strict=True))
        if resistance or lengths:
            plant = _modified_plant(plant, resistance, lengths)
        self._plant = plant
        motion = SCENARIOS[scenario](plant, moves, motion_seed)
        self._run = ScenarioRun(plant, motion)
        self.base_frame = plant.base_frame
        self.imu_frame = "imu_link"
        feet = [WrenchSensor(sole.replace("_sole", "_foot/wrench"), sole) for sole in SOLES]
        hook = [WrenchSensor(f"{SUPPORT_FRAME}/wrench", SUPPORT_FRAME)] if motion.hoist else []
        self.wrench_sensors = (*feet, *hook)
        self.period_ns = round(plant.period * 1e9)
        self.steps = self._run.steps
        driven = np.isin(np.arange(6, plant.model.nv), plant.driven)
        self._sensors = Sensors(driven, len(self.wrench_sensors), noise, noise_seed, self.errors)
        self.drive_names, self.torque_limits = plant.drive_names, plant.torque_limits
        self._is_commanded = is_commanded
        self._scheduled = _scheduled(plant, payload, payload_time)
        self._taken = 0
        for truth in self._run.settle():
            self._sensors.watch(truth)

    @property
    def robot(self) -> str:
        """MJCF of the robot as simulated, with its friction and lengths, without payload."""
        return self._plant.text

    def attach(self, payload: Payload | None) -> None:
        """Fasten a payload in place of any other, from the next period on; None takes it off.

        Raises
        ------
        SimulationError
            When the robot has no such link; what is fastened stays.
        """
        if payload is None:
            self._plant.detach()
        else:
            self._plant.attach(payload)

    def step(self, torques: FloatArray | None = None) -> Instant:
        """Advance one period and return the instant at its beginning.

        Parameters
        ----------
        torques : (n_actuated,) float64 or None
            Of the drives during this period, Nm, cut off at their limits; given to a commanded
            robot only, which without them keeps those of the period before. They can be the
            answer to the instant before this one at best: a real drive is late too.

        Raises
        ------
        SimulationError
            When torques are given to a robot that is not commanded, or are no such vector.
        RobotFailureError
            When the robot falls or a joint runs into its end stop.
        """
        if torques is not None:
            self._require(torques)
        elif self._is_commanded:
            torques = self._run.torques
        if self._scheduled is not None and self._taken >= self._scheduled[0]:
            self.attach(self._scheduled[1])
            self._scheduled = None
        truth = self._run.advance(self._taken, torques)
        self._taken += 1
        return self._sensors.measure(truth, self._taken * self.period_ns)

    def _require(self, torques: FloatArray) -> None:
        if not self._is_commanded:
            raise SimulationError("torques for a robot that is not commanded; pass is_commanded")
        drives = len(self.drive_names)
        if np.shape(torques) != (drives,) or not np.all(np.isfinite(torques)):
            raise SimulationError(
                f"torques {torques} for {drives} drives; give that many finite numbers, Nm"
            )

    def __iter__(self) -> Iterator[Instant]:
        """Yield the instants that are left of the motion."""
        while self._taken < self.steps:
            yield self.step()


def _scheduled(plant: Plant, payload: Payload | None, time: float) -> tuple[int, Payload] | None:
    """Return the step at which a payload is to be fastened, and the payload."""
    if not (math.isfinite(time) and time >= 0.0):
        raise SimulationError(f"payload time {time:g} s; give a finite number, 0 or more")
    if payload is None:
        return None
    link_index(plant.model, payload.link)
    return round(time / plant.period), payload


def _modified_plant(
    original: Plant, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> Plant:
    """Return the plant with other joints and lengths, standing where the original stands."""
    plant = Plant(original.path, SOLES, modify_mjcf(original.path, friction, lengths))
    plant.data.qpos[:] = level_soles(plant.model, original.model, original.data.qpos, SOLES)
    return plant


# The shortest MuJoCo allows at a period of 1 ms: Coulomb friction then either has its full value
# or stops the joint within the period. By default joints creep, at up to .1 rad/s here.
FRICTION_TIME_CONSTANT = 2e-3  # s


def modify_mjcf(
    path: Path, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> str:
    """Return an MJCF file's text with other joints and lengths.

    Parameters
    ----------
    path : Path
        MJCF that MuJoCo compiles, bodies and joints in the file itself.
    friction : mapping of str to JointFriction
        By joint name.
    lengths : mapping of str to float
        By joint name: how much further from its parent's origin the joint's body lies, m. A
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
            f"{path}: no joint {missing[0]} to change; name joints of the file's own worldbody"
        )
    for name, values in friction.items():
        for attribute, value in asdict(values).items():
            joints[name].set(attribute, repr(value))
        joints[name].set("solreffriction", f"{FRICTION_TIME_CONSTANT} 1")
    if friction:
        _integrate_explicitly(root)
    for body in root.iterfind("worldbody//body"):
        names = [joint.get("name") for joint in body.findall("joint")]
        _lengthen(body, sum(lengths.get(str(name), 0.0) for name in names))
    return ET.tostring(root, encoding="unicode") + "\n"


def _integrate_explicitly(root: ET.Element) -> None:
    # Damping taken implicitly would make the velocity's rate differ from the acceleration of
    # the equation of motion, by a per cent in the light joints: a log of two truths.
    option = root.find("option")
    if option is None:
        option = ET.SubElement(root, "option")
    option.set("integrator", "Euler")
    flag = option.find("flag")
    if flag is None:
        flag = ET.SubElement(option, "flag")
    flag.set("eulerdamp", "disable")


def _lengthen(body: ET.Element, amount: float) -> None:
    offset = np.array(body.get("pos", "0 0 0").split(), dtype=np.float64)
    length = float(np.linalg.norm(offset))
    if amount and length > 0.0:
        longer = offset * (1.0 + amount / length)
        body.set("pos", " ".join(repr(float(value)) for value in longer))
