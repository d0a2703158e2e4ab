"""Public logs of real robots, and the converters that read them.

Each :class:`RealData` names repository, commit, licence and files. The files are not part of this
project: their licences differ, and a user downloads them. ``SHA256`` holds the content that the
published figures belong to.
"""

import hashlib
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.model.export_urdf import urdf_text

FIRST_STAMP = 1_000_000_000_000_000_000  # ns
PAUSE = 3600.0  # s

FloatArray = NDArray[np.float64]
# Of velocities and accelerations, (N, J) each: columns (N, n, k), or torques (N, n).
Motion = Callable[[FloatArray, FloatArray], FloatArray]


PLATE_CUTOFF = 5.0  # Hz
GRAVITY = np.array([0.0, 0.0, 9.81])  # m/s²


class MissingDataError(Exception):
    """A file that the user has to download is absent."""


@dataclass(frozen=True)
class Recording:
    """One contiguous recording.

    Attributes
    ----------
    name : str
    time : (N,) float64
        s.
    position, effort : (N, J) float64
        rad and Nm at the joints; NaN where there is no effort.
    pose : (N, 7) float64 or None
        Of a floating base in the world: position (m) and quaternion (xyzw).
    wrench : (N, 6) float64 or None
        Force plate on the body: force (N) and torque (Nm) about the world's origin, in world axes.
    imu : (N, 6) float64 or None
        Angular velocity (rad/s) and specific force (m/s²) of a floating base, in its axes.
    """

    name: str
    time: FloatArray
    position: FloatArray
    effort: FloatArray
    pose: FloatArray | None = None
    wrench: FloatArray | None = None
    imu: FloatArray | None = None

    def part(self, start: float, stop: float) -> "Recording":
        """Return the rows between two shares of the recording."""
        first, last = (round(share * len(self.time)) for share in (start, stop))
        arrays = {
            name: value[first:last]
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)

    def joined(self, later: "Recording") -> "Recording":
        """Return this recording followed by a later one, after a second if clocks start anew."""
        arrays = {
            name: np.concatenate([value, getattr(later, name)])
            for name, value in vars(self).items()
            if isinstance(value, np.ndarray)
        }
        if later.time[0] <= self.time[-1]:
            shifted = later.time - later.time[0] + self.time[-1] + 1.0
            arrays["time"] = np.concatenate([self.time, shifted])
        return replace(self, **arrays)


def imu_readings(time: FloatArray, turn: Rotation, velocity: FloatArray) -> FloatArray:
    """Return what an IMU would read, (N, 6), in a base whose pose alone was recorded.

    Parameters
    ----------
    time : (N,) float64
        s.
    turn : Rotation
        N rotations from the base to the world.
    velocity : (N, 3) float64
        In world axes, m/s.
    """
    rate = (turn[:-2].inv() * turn[2:]).as_rotvec() / (time[2:] - time[:-2])[:, None]
    rate = np.concatenate([rate[:1], rate, rate[-1:]])
    force = turn.inv().apply(np.gradient(velocity, time, axis=0) + GRAVITY)
    return np.hstack([rate, force])


@dataclass(frozen=True)
class RealLog:
    """A robot, what it is trained on, and what it is judged on.

    Attributes
    ----------
    robot : RobotModel
    training, heldout : Recording
    cutoff : float
        Low-pass of the rows of the reference, on which all are judged, Hz.
    terms : tuple of str
        Joint terms of the plain reference.
    extra : mapping of str to Motion
        Further columns of the reference, such as the coupling of two joints.
    published : mapping of str to Motion
        Published torques to be added to those of the model file's inertias.
    contacts : tuple of str
        Frames at which points without sensors touch the ground.
    gravity : (3,) tuple of float, or None
        Direction in which gravity acts on the base, if it is not that of the model file.
    """

    robot: sy.RobotModel
    training: Recording
    heldout: Recording
    cutoff: float
    terms: tuple[str, ...] = ("viscous", "coulomb", "offset")
    extra: dict[str, Motion] | None = None
    published: dict[str, Motion] | None = None
    contacts: tuple[str, ...] = ()
    gravity: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class RealData:
    """Where a public log comes from, and how it is read.

    Attributes
    ----------
    title : str
    source : str
        Repository and commit.
    licence : str
    files : mapping of str to str
        Path in the repository to SHA-256; of a folder, that of the text files one level below.
    convert : callable
        Reads the files, which are given in the order above.
    note : str
        What others published about these data.
    """

    title: str
    source: str
    licence: str
    files: dict[str, str]
    convert: Callable[[Sequence[Path]], RealLog]
    note: str

    def find(self, folder: Path, others: Mapping[str, Path] | None = None) -> list[Path]:
        """Return the files in a folder: under their path in the repository, or side by side.

        ``others`` take the place of files of these names.

        Raises
        ------
        MissingDataError
            When a file is absent.
        """
        found, missing = [], []
        for name in self.files:
            if others and Path(name).name in others:
                found.append(others[Path(name).name])
                continue
            places = [folder / name, folder / Path(name).name]
            here = next((place for place in places if place.exists()), None)
            found.append(here) if here else missing.append(name)
        if missing:
            raise MissingDataError(
                f"{folder} lacks {', '.join(missing)}: download from {self.source}"
            )
        return found

    def describe(self, files: Sequence[Path]) -> str:
        """Return where the data come from and what the files hold."""
        lines = [self.title, f"{self.source} ({self.licence})"]
        for path, expected in zip(files, self.files.values(), strict=True):
            found = sha256(path)
            note = "" if found == expected else ", other content than that of docs/real-logs.md"
            lines.append(f"  {path.name}  sha256 {found}{note}")
        return "\n".join([*lines, f"  {self.note}"])


def sha256(path: Path) -> str:
    files = [path] if path.is_file() else sorted(path.glob("*/*.txt"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def tx40(files: Sequence[Path]) -> RealLog:
    """Read motor angles and motor torques of a Stäubli TX40 at 5 kHz.

    Motor 6 turns with joints 5 and 6 (ratios and coupling of FIGAROH's staubli_tx40_tools.py), so
    that friction and inertia of its rotor act on both joints.
    """
    angles, torques, urdf = files
    robot = sy.load_model(urdf, base="fixed")
    ratios = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    ratios[5, 4] = ratios[5, 5]
    # Power is the same on both sides: θ = R q, hence τ_joint = Rᵀ τ_motor.
    position = np.linalg.solve(ratios, _table(angles).T).T
    position[:, 1:3] += [-np.pi / 2, np.pi / 2]
    effort = _table(torques) @ ratios
    time = np.arange(len(position)) / 5000.0
    log = Recording("tx40", time, position, effort)

    # Of TX40_config.yaml: rotor inertia, viscous and Coulomb friction, offset.
    values = np.array(
        [
            [0.362, 0.362, 0.0988, 0.0313, 0.0468, 0.0105],
            [8.05, 5.53, 1.97, 1.11, 1.86, 0.65],
            [7.14, 8.26, 6.34, 2.48, 3.03, 0.282],
            [0.392, 1.37, 0.326, -0.102, -0.0288, 0.127],
        ]
    )

    def published(velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
        own = values[0] * acceleration + values[1] * velocity + values[2] * np.sign(velocity)
        coupled: FloatArray = wrist_coupling(velocity, acceleration) @ [0.00964, 0.616, 1.95]
        return own + values[3] + coupled

    return RealLog(
        robot,
        log.part(0.0, 0.75),
        log.part(0.75, 1.0),
        cutoff=20.0,
        extra={"with the coupling of joints 5 and 6": wrist_coupling},
        published={"model file + drives of TX40_config.yaml": published},
    )


def wrist_coupling(velocity: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Return columns (N, 6, 3) of rotor 6, which turns with the sum of joints 5 and 6.

    Its inertia, viscous and Coulomb friction act on both joints. The shares that joint 6 causes at
    joint 6, and joint 5 at joint 5, belong to the joints' own terms.
    """
    columns = np.zeros((*velocity.shape, 3))
    for joint, other in ((4, 5), (5, 4)):
        columns[:, joint, 0] = acceleration[:, other]
        columns[:, joint, 1] = velocity[:, other]
        columns[:, joint, 2] = np.sign(velocity[:, 4] + velocity[:, 5])
    return columns


def lwr4(files: Sequence[Path]) -> RealLog:
    """Read link-side torques of a KUKA LWR4+ at 200 Hz.

    The authors filtered the positions, whose velocity falls to zero at both ends while the robot
    moves on. The filter's transient lasts less than a second, which is left out.
    """
    run, urdf = files
    with np.load(run) as content:
        time = content["times"]
        settled = (time > time[0] + 1.0) & (time < time[-1] - 1.0)
        columns = (time, content["positions"], content["torques"])
        log = Recording("lwr4", *(each[settled] for each in columns))
    robot = sy.load_model(urdf, base="fixed")
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0)


def panda(files: Sequence[Path]) -> RealLog:
    """Read a Franka Panda at 1 kHz.

    The hand of the model file is removed. The published model errs 3 % without it and 18 % with it,
    so the arm carried none.
    """
    times, positions, torques, urdf = files
    robot = load_without(urdf, "panda_hand_joint")
    position, effort = (np.loadtxt(each).reshape(-1, 7) for each in (positions, torques))
    log = Recording("panda", np.loadtxt(times), position, effort)
    # Gaz et al. 2019, Table II: amplitude, steepness and shift of a sigmoid for each joint.
    sigmoid = np.array(
        [
            [0.54615, 0.87224, 0.64068, 1.2794, 0.83904, 0.30301, 0.56489],
            [5.1181, 9.0657, 10.136, 5.5903, 8.3469, 17.133, 10.336],
            [0.039533, 0.025882, -0.04607, 0.036194, 0.026226, -0.021047, 0.0035526],
        ]
    )

    def friction(velocity: FloatArray, _: FloatArray) -> FloatArray:
        amplitude, steepness, shift = sigmoid
        moving = 1 / (1 + np.exp(-steepness * (velocity + shift)))
        torque: FloatArray = amplitude * (moving - 1 / (1 + np.exp(-steepness * shift)))
        return torque

    return RealLog(
        robot,
        log.part(0.0, 0.75),
        log.part(0.75, 1.0),
        cutoff=10.0,
        published={"model file + friction of Gaz et al. 2019": friction},
    )


def ur10e(files: Sequence[Path]) -> RealLog:
    """Read a UR10e at about 100 Hz; the efforts are motor currents times published gains."""
    run, urdf = files
    robot = sy.load_model(urdf, base="fixed")
    rows = np.loadtxt(run, delimiter=",")
    # Nm/A: "found in the paper by De Luca", main.m of the repository.
    gains = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])
    log = Recording("ur10e", rows[:, 0], rows[:, 1:7], rows[:, 13:19] * gains)
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0)


def human(files: Sequence[Path]) -> RealLog:
    """Read a human on a force plate at 30 Hz: pelvis pose and joint angles from motion capture.

    The file lists the joints as Pinocchio orders them: depth first, siblings by name. Many poses
    are repeated. The wrenches were filtered at 5 Hz by their authors, so the motion is too.
    """
    table, urdf = files
    robot = sy.load_model(urdf, base="floating")
    rows = _table(table)
    order = joint_order(urdf)
    columns = [7 + order.index(name) for name in robot.measured_joint_names]
    turns_back = np.cumsum((rows[1:, 3:7] * rows[:-1, 3:7]).sum(axis=1) < 0) % 2 == 1
    rows[1:, 3:7][turns_back] *= -1.0  # q and -q are the same rotation
    motion = low_pass(rows, 1 / 30.0, PLATE_CUTOFF)
    position = motion[:, columns]
    log = Recording(
        "human",
        np.arange(len(rows)) / 30.0,
        position,
        np.full_like(position, np.nan),
        pose=motion[:, :7],
        wrench=rows[:, -6:],
    )
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), PLATE_CUTOFF, terms=())


def joint_order(urdf: Path) -> list[str]:
    """Return the moving joints of a URDF depth first, siblings by name."""
    joints = sorted(ET.parse(urdf).getroot().findall("joint"), key=lambda joint: joint.get("name"))
    children = {joint.find("child").get("link") for joint in joints}
    (root,) = {joint.find("parent").get("link") for joint in joints} - children

    def below(link: str) -> list[str]:
        found = []
        for joint in joints:
            if joint.find("parent").get("link") == link:
                own = [] if joint.get("type") == "fixed" else [joint.get("name")]
                found += own + below(joint.find("child").get("link"))
        return found

    return below(root)


def load_without(urdf: Path, joint: str) -> sy.RobotModel:
    """Load a URDF with a fixed base, without a joint and all that it carries."""
    tree = ET.parse(urdf)
    root = tree.getroot()
    dropped = {root.find(f"joint[@name='{joint}']").find("child").get("link")}
    for _ in root.findall("joint"):  # a URDF may list joints in any order
        for each in root.findall("joint"):
            if each.find("parent").get("link") in dropped:
                dropped.add(each.find("child").get("link"))
    for each in [*root.findall("joint"), *root.findall("link")]:
        child = each.find("child")
        if each.get("name") in dropped or (child is not None and child.get("link") in dropped):
            root.remove(each)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / urdf.name
        tree.write(path)
        return sy.load_model(path, base="fixed")


def load_with_joints(urdf: Path, names: Sequence[str]) -> sy.RobotModel:
    """Load a URDF with a fixed base, all joints but some held at zero."""
    tree = ET.parse(urdf)
    for joint in tree.getroot().findall("joint"):
        if joint.get("name") not in names:
            joint.set("type", "fixed")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / urdf.name
        tree.write(path)
        return sy.load_model(path, base="fixed")


@dataclass(frozen=True)
class BaseReadings:
    """What an IMU at the base and a sensor of the plate's wrench there would read.

    Attributes
    ----------
    imu : (N, 6) float64
        Angular velocity (rad/s) and specific force (m/s²) in base axes.
    wrench : (N, 6) float64
        Force (N) and torque (Nm) about the base's origin, in base axes.
    """

    imu: FloatArray
    wrench: FloatArray


def base_readings(recording: Recording, gravity: FloatArray) -> BaseReadings:
    """Differentiate the pose of a floating base and move the plate's wrench to its origin."""
    period = float(np.median(np.diff(recording.time)))
    place = recording.pose[:, :3]
    rotation = Rotation.from_quat(recording.pose[:, 3:])
    step = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / period
    rate = np.vstack([step[:1], (step[:-1] + step[1:]) / 2, step[-1:]])
    acceleration = np.gradient(np.gradient(place, period, axis=0), period, axis=0)
    specific_force = rotation.inv().apply(acceleration - gravity)
    force, moment = recording.wrench[:, :3], recording.wrench[:, 3:]
    moment = moment - np.cross(place, force)
    return BaseReadings(
        np.hstack([rate, specific_force]),
        np.hstack([rotation.inv().apply(force), rotation.inv().apply(moment)]),
    )


def low_pass(values: FloatArray, period: float, cutoff: float) -> FloatArray:
    """Apply a Butterworth filter of order 4 forwards and backwards."""
    if 2 * cutoff * period >= 1:
        return values
    sections = butter(4, cutoff, fs=1 / period, output="sos")
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0)
    return filtered


def to_log(robot: sy.RobotModel, recording: Recording) -> sy.Log:
    """Return a recording as a log, through the public API."""
    sensors = {}
    if recording.pose is not None:
        poses = {robot.links[0].name: recording.pose}
        sensors = {"poses": poses, "wrenches": {"world": recording.wrench}}
    if recording.imu is not None:
        sensors = {"imus": {robot.links[0].name: recording.imu}}
    return sy.Log.from_arrays(
        robot,
        time=recording.time,
        position=recording.position,
        effort=recording.effort,
        name=recording.name,
        **sensors,
    )


def write_files(log: RealLog, folder: Path) -> None:
    """Write an arm's URDF and bags of both parts of its log, as a user of `symbid` has them.

    Raises
    ------
    SystemExit
        When the log has sensors other than those of joints, or the folder exists.
    """
    if log.robot.floating:
        raise SystemExit("bags are written of logs of arms alone")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise SystemExit(f"{folder}: exists; name another folder") from None
    source = Path(log.robot.source)
    text = urdf_text(log.robot, source if source.is_file() else None)
    (folder / "robot.urdf").write_text(text)
    names, begin, end = log.robot.measured_joint_names, log.training.time[0], log.training.time[-1]
    # Some are two recordings, whose times start anew: stamps of one log never overlap.
    later = begin if log.heldout.time[0] > end else log.heldout.time[0] - (end - begin) - PAUSE
    _write_joint_states(names, log.training, folder / "training", begin)
    _write_joint_states(names, log.heldout, folder / "held_out", later)


def _write_joint_states(
    names: tuple[str, ...], part: Recording, folder: Path, begin: float
) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = "sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
    joint_state, header, instant = (store.types[kind] for kind in kinds)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/joint_states", kinds[0], typestore=store)
        # Bags have Unix time, in which zero is not a valid stamp.
        stamps = np.round(1e9 * (part.time - begin)).astype(np.int64) + FIRST_STAMP
        for stamp, position, effort in zip(
            stamps.tolist(), part.position, part.effort, strict=True
        ):
            message = joint_state(
                header=header(stamp=instant(*divmod(stamp, 1_000_000_000)), frame_id=""),
                name=list(names),
                position=np.ascontiguousarray(position, dtype=np.float64),
                velocity=np.zeros(0),
                effort=np.ascontiguousarray(effort, dtype=np.float64),
            )
            bag.write(topic, stamp, store.serialize_cdr(message, kinds[0]))


def _table(path: Path) -> FloatArray:
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


REAL_DATA = {
    "tx40": RealData(
        "Stäubli TX40, 6 joints, motor angles and motor torques, 5 kHz, 9 s",
        "https://github.com/thanhndv212/figaroh-examples commit c0b5c7f",
        "Apache-2.0",
        {
            "examples/staubli_TX40/data/pos_read_data.csv": "5cc1cecc1024ef0e331d0caba06f6894"
            "56ab789ec3f1e904599c0a8be5c27bc8",
            "examples/staubli_TX40/data/curr_data.csv": "f4592f4ba4db42f5d7625688986be25b"
            "575ca34d0504b27979ca6b0276bd3af9",
            "examples/staubli_TX40/urdf/tx40_mdh_modified.urdf": "3d00cbd46279c915d594b1bb4610dbac"
            "78d1e99ed27f95de70984bde13486074",
        },
        tx40,
        "The repository publishes friction, offsets and rotor inertias (TX40_config.yaml), but no "
        "held-out error.",
    ),
    "lwr4": RealData(
        "KUKA LWR4+, 7 joints, link-side torques, 200 Hz, 25 s",
        "https://github.com/kjyv/FloBaRoID commit 4e2e5a2",
        "LGPL-3.0",
        {
            "data/KUKA/HW/measurements_1.npz": "55b94c07e86a75311a584cc945c4436e"
            "7a5dbeafd5f7378a53225a0dd820c1fd",
            "model/kuka_lwr4.urdf": "29562d0bee29bce03c78f17c9fc81c82"
            "6a4d234aeb671d3b9cbe94ef4c09c6b8",
        },
        lwr4,
        "The repository publishes no held-out error for these runs.",
    ),
    "panda": RealData(
        "Franka Panda, 7 joints, link-side torques, 1 kHz, 21 s",
        "https://github.com/marcocognetti/FrankaEmikaPandaDynModel commit 24d85ce; panda.urdf: "
        "https://github.com/Gepetto/example-robot-data (pip install example-robot-data==6.0.0)",
        "GPL-3.0; panda.urdf: BSD",
        {
            "matlab/data/Exciting_Traj/Trajectory_1/rbt_log/exciting_traj_time.txt": ""
            "031063612f297011dc005ab29830903e36f4bfeba77bce59c0fbde13620fb20d",
            "matlab/data/Exciting_Traj/Trajectory_1/rbt_log/exciting_traj_positions.txt": ""
            "50bf82a082c439aff8220e8142985c8dd783f7ddc1415987cd75c9efb88bcf69",
            "matlab/data/Exciting_Traj/Trajectory_1/rbt_log/exciting_traj_torques.txt": ""
            "11fda32785bb29ce444e14e0f45f4893aab7142dc6ee29576d828ab154852f9c",
            "panda.urdf": "63792d2679f22c4e41cda2c4d9d903644e628970ad0656b9eec8485113941555",
        },
        panda,
        "The inertias of panda.urdf are those of Gaz et al., RA-L 2019, identified on this arm.",
    ),
    "ur10e": RealData(
        "UR10e, 6 joints, motor currents times published gains, 100 Hz, 58 s",
        "https://github.com/shamilmamedov/dynamic_calibration commit 11af40e",
        "data: none stated; URDF: BSD",
        {
            "dataset_ur10e/identification_data/ur-20_02_12-50sec_12harm.csv": ""
            "bb48cca42716a88f8b255d2d1b3eb3fa4a6eac4a9a52b694d4c1066ce8b4ca51",
            "URe/urdf/ur10e.urdf": ""
            "0d2abc6ebc70725c691a35aa6c2d03fd6e8158017a1b7da7a10a3ef52de7b821",
        },
        ur10e,
        "The repository publishes friction parameters for other gains, but no held-out error.",
    ),
    "human": RealData(
        "Human on a force plate, 36 joints, motion capture, no torques, 30 Hz, 90 s",
        "https://github.com/thanhndv212/figaroh-plus commit 8a39239",
        "Apache-2.0",
        {
            "examples/human/data/q+Forces_sampled_30Hz_filtered.csv": ""
            "d7b36f35747ee5ea70bb627ffd044dc7d1f4368267dc04c2303abf976ede3a69",
            "models/others/robots/human_description/urdf/human.urdf": ""
            "8862e23dd488d4288c309e8eac675a2d46ce68a73ed988490a326dc8fdcf0af9",
        },
        human,
        "The model file scales anthropometric tables to this person: 94.5 kg; the plate reads "
        "94.4 kg.",
    ),
}
