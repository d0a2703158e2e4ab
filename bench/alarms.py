"""Which faults of a log are named, and of which correct logs does anybody complain?

Every row is a fault, put into the logs of several robots: the Symbitron in MuJoCo, a quadruped on
point feet, and arms of example-robot-data with and without friction. The model is off by ±25 %.

    .venv/bin/python bench/alarms.py [--only FAULT ...] [--robots NAME ...] [--seeds 2]

prints the doctor's findings. The table of docs/diagnosis.md is printed by

    .venv/bin/python bench/alarms.py --table

which identifies each log as well: what the doctor, the alarms and the remarks say, and the errors
of the determined inertial parameters in their standard deviations, the largest and the root mean
square. It takes some minutes.
"""

import argparse
import logging
import sys
import time
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import files
from pathlib import Path
from tempfile import gettempdir

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).resolve().parents[1] / "test" / "support"))
from arm_log import arm_streams
from quadruped_log import quadruped_urdf, standing_log

from symbid_ros.bags import read_streams
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Diagnosis
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.pipeline import identify_problem
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.package_paths import config_file
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

CACHE = Path(gettempdir()) / "symbid_alarms"
ARMS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
}
Case = tuple[Streams, RobotModel]


def believed(model, seed):
    """Return the model as its maker believes it: inertias off by up to a quarter."""
    parameters = ParameterSet(model)
    return model.with_phi(parameters.link_phi(draw_prior(parameters, "consistent", 25, seed).mean))


@cache
def symbitron(seed: int, options: tuple[tuple[str, object], ...]) -> Case:
    chosen = dict(options)
    name = "_".join(["symbitron", str(seed), *(f"{k}_{v}" for k, v in options)])
    bag = CACHE / name
    if not bag.exists():
        scenario = str(chosen.pop("scenario", "smooth"))
        record(
            Simulator(
                SimulateOptions(
                    scenario, moves=8, motion_seed=seed, noise_seed=seed, error_seed=seed, **chosen
                )
            ),
            bag,
        )
    model = load_model(config_file("symbitron.xml"))
    return read_streams([bag]), believed(model, seed)


@cache
def quadruped(seed: int, friction: float) -> Case:
    path = CACHE / "quadruped.urdf"
    CACHE.mkdir(exist_ok=True)
    path.write_text(quadruped_urdf())
    model = load_model(path)
    log = standing_log(model, 25.0, seed, friction)

    def stamp(topic):
        return 10**18 + np.round(log[topic]["time"] * 1e9).astype(np.int64)

    joints, imu = log["/joint_states"], log["/imu"]
    streams = Streams(
        "quadruped",
        JointStream(
            "/joint_states",
            model.joint_names,
            stamp("/joint_states"),
            joints["position"],
            joints["velocity"],
            joints["effort"],
        ),
        (
            ImuStream(
                "/imu",
                "imu_link",
                stamp("/imu"),
                imu["orientation"],
                imu["angular_velocity"],
                imu["linear_acceleration"],
            ),
        ),
        tuple(
            WrenchStream(
                topic,
                topic.split("/")[1],
                stamp(topic),
                columns["wrench"][:, :3],
                columns["wrench"][:, 3:],
            )
            for topic, columns in log.items()
            if topic.endswith("wrench")
        ),
    )
    return streams, believed(model, seed)


@cache
def arm_model(name: str) -> RobotModel:
    (path,) = (one for one in files("example-robot-data") or () if str(one).endswith(ARMS[name]))
    return load_model(Path(str(path.locate())), "fixed")


@cache
def arm(name: str, seed: int, friction: float, rate: float = 200.0, resting=()) -> Case:
    model = arm_model(name)
    rests = tuple(model.joint_names[i] for i in resting)
    return arm_streams(model, 40.0, seed, rate=rate, friction=friction, resting=rests), believed(
        model, seed
    )


ROBOTS: dict[str, Callable[[int], Case]] = {
    "symbitron": lambda seed: symbitron(seed, ()),
    "symbitron/friction": lambda seed: symbitron(seed, (("friction", True),)),
    "symbitron/typical": lambda seed: symbitron(
        seed, (("errors", "typical,quantisation"), ("friction", True))
    ),
    "symbitron/squat": lambda seed: symbitron(seed, (("scenario", "squat"),)),
    "symbitron/vibrating": lambda seed: symbitron(seed, (("scenario", "vibrating"),)),
    "symbitron/suspended": lambda seed: symbitron(seed, (("scenario", "suspended"),)),
    "quadruped": lambda seed: quadruped(seed, 0.0),
    "quadruped/friction": lambda seed: quadruped(seed, 0.3),
    "ur5": lambda seed: arm("ur5", seed, 0.0),
    "ur5/friction": lambda seed: arm("ur5", seed, 0.08),
    "ur5/resting": lambda seed: arm("ur5", seed, 0.08, resting=(0, 3)),
    "panda": lambda seed: arm("panda", seed, 0.0),
    "panda/friction": lambda seed: arm("panda", seed, 0.08),
    "panda/1kHz": lambda seed: arm("panda", seed, 0.03, 1000.0),
    "xarm7/friction": lambda seed: arm("xarm7", seed, 0.15),
}


# Faults ---------------------------------------------------------------------------------------


def imu_changed(change) -> Callable[[Streams, object, np.random.Generator], Streams | None]:
    def fault(streams, model, rng):
        if not streams.imus:
            return None
        return replace(streams, imus=tuple(change(imu) for imu in streams.imus))

    return fault


def accelerometer(gain):
    return imu_changed(lambda imu: replace(imu, linear_acceleration=gain * imu.linear_acceleration))


def gyroscope(gain, *, has_orientation=True):
    return imu_changed(
        lambda imu: replace(
            imu,
            angular_velocity=gain * imu.angular_velocity,
            orientation=imu.orientation if has_orientation else None,
        )
    )


def turned(axis, degrees):
    turn = Rotation.from_euler(axis, degrees, degrees=True)

    def change(imu):
        return replace(
            imu,
            orientation=None
            if imu.orientation is None
            else (Rotation.from_quat(imu.orientation) * turn).as_quat(),
            angular_velocity=turn.apply(imu.angular_velocity, inverse=True),
            linear_acceleration=turn.apply(imu.linear_acceleration, inverse=True),
        )

    return imu_changed(change)


def every(streams, change) -> Streams:
    """Return streams with the change applied to each."""
    return replace(
        streams,
        joints=change(streams.joints),
        imus=tuple(map(change, streams.imus)),
        wrenches=tuple(map(change, streams.wrenches)),
    )


def sampled_at(stream, late):
    """Return a stream whose samples were taken so much later (N,), s, than they are stamped."""
    at = (stream.stamp - stream.stamp[0]) * 1e-9
    columns = {}
    for name, values in vars(stream).items():
        if isinstance(values, np.ndarray) and values.dtype == float:
            columns[name] = make_interp_spline(at, values, k=1)(np.clip(at + late, at[0], at[-1]))
    return replace(stream, **columns)


def thinned(stream, stride):
    return replace(
        stream,
        **{
            name: values[::stride]
            for name, values in vars(stream).items()
            if isinstance(values, np.ndarray)
        },
    )


def jitter(kind, which="all", rate=None):
    def fault(streams, model, rng):
        if rate is not None:
            period = np.median(np.diff(streams.joints.stamp)) * 1e-9
            streams = every(streams, lambda one: thinned(one, max(1, round(1 / rate / period))))

        def change(stream):
            if which == "joints" and not isinstance(stream, JointStream):
                return stream
            if which == "sensors" and isinstance(stream, JointStream):
                return stream
            time = (stream.stamp - stream.stamp[0]) * 1e-9
            if kind == "white":
                return sampled_at(stream, rng.uniform(-5e-3, 5e-3, len(time)))
            if kind == "slow":
                return sampled_at(stream, 5e-3 * np.sin(2 * np.pi * 0.7 * time + rng.uniform(0, 6)))
            stamp = stream.stamp + rng.integers(-5_000_000, 5_000_000, len(time))
            if kind == "sorted":
                return replace(stream, stamp=np.sort(stamp) + np.arange(len(stamp)))
            # only the stamps that stay in order
            order = np.maximum.accumulate(stamp)
            keep = np.append(True, np.diff(order) > 0)
            return replace(
                stream,
                **{
                    name: values[keep]
                    for name, values in vars(stream).items()
                    if isinstance(values, np.ndarray)
                },
            )

        return every(streams, change)

    return fault


def encoder(joint, degrees):
    def fault(streams, model, rng):
        joints = streams.joints
        index = joint if joint < len(joints.names) else -1
        position = joints.position.copy()
        position[:, index] += np.radians(degrees)
        return replace(streams, joints=replace(joints, position=position))

    return fault


def effort(joint, factor):
    return efforts((joint, factor))


def efforts(*factors):
    """Return efforts of joints times their factors."""

    def fault(streams, model, rng):
        joints = streams.joints
        values = joints.effort.copy()
        for joint, factor in factors:
            values[:, joint] *= factor
        return replace(streams, joints=replace(joints, effort=values))

    return fault


def effort_offset(joint, offset):
    def fault(streams, model, rng):
        joints = streams.joints
        index = min(joint, len(joints.names) - 1)
        values = joints.effort.copy()
        values[:, index] += offset
        return replace(streams, joints=replace(joints, effort=values))

    return fault


def scaled(factor):
    """Return forces and efforts with a gain in common."""

    def fault(streams, model, rng):
        joints = replace(streams.joints, effort=factor * streams.joints.effort)
        wrenches = tuple(
            replace(one, force=factor * one.force, torque=factor * one.torque)
            for one in streams.wrenches
        )
        return replace(streams, joints=joints, wrenches=wrenches)

    return fault


def supported(newton):
    """Return what sensors read while a cord at the base's origin carries this much."""

    def fault(streams, model, rng):
        if not streams.wrenches or not streams.imus or streams.imus[0].orientation is None:
            return None
        joints, imu = streams.joints, streams.imus[0]
        order = [joints.names.index(name) for name in model.joint_names]
        poses = link_poses(model, joints.position[:, order])
        mount = model.frame(imu.frame_id)
        at = poses.rotation[:, mount.link] @ mount.rotation
        # The world's vertical in base axes, at the stamps of the joint states.
        near = np.clip(np.searchsorted(imu.stamp, joints.stamp), 0, len(imu.stamp) - 1)
        up = Rotation.from_quat(imu.orientation[near]).inv().apply([0.0, 0.0, 1.0])
        force = newton * np.einsum("tij,tj->ti", at, up)
        effort, wrenches = joints.effort.copy(), []
        share = 1 / len(streams.wrenches)
        for one in streams.wrenches:
            frame = model.frame(one.frame_id)
            rotation = poses.rotation[:, frame.link] @ frame.rotation
            origin = poses.position[:, frame.link] + np.einsum(
                "tij,j->ti", poses.rotation[:, frame.link], frame.translation
            )
            # The plate carries the share of the cord less.
            moment = np.cross(-origin, force)
            less = share * np.concatenate([moment, force], axis=1).reshape(-1, 2, 3)
            less = np.einsum("tji,tcj->tci", rotation, less)
            felt = contact_jacobian(model, (one.frame_id,), poses)
            first = 6 * model.floating
            change = np.einsum("tcn,tc->tn", felt[:, :, first:], less.reshape(-1, 6))
            effort[:, order] += change
            place = np.clip(np.searchsorted(joints.stamp, one.stamp), 0, len(joints.stamp) - 1)
            wrenches.append(
                replace(one, torque=one.torque - less[place, 0], force=one.force - less[place, 1])
            )
        return replace(streams, joints=replace(joints, effort=effort), wrenches=tuple(wrenches))

    return fault


def correct(streams, model, rng):
    return streams


EVERY = slice(None)
FAULTS = {
    "correct": correct,
    "accelerometer +1 %": accelerometer(1.01),
    "accelerometer +2 %": accelerometer(1.02),
    "accelerometer +5 %": accelerometer(1.05),
    "gyroscope +10 %": gyroscope(1.1),
    "gyroscope +10 %, without orientation": gyroscope(1.1, has_orientation=False),
    "gyroscope -10 %, without orientation": gyroscope(0.9, has_orientation=False),
    "IMU turned 3° about x": turned("x", 3),
    "IMU turned 5° about y": turned("y", 5),
    "IMU turned 4° about z": turned("z", 4),
    "jitter ±5 ms of the samples": jitter("white"),
    "jitter ±5 ms of the samples at 100 Hz": jitter("white", rate=100),
    "jitter ±5 ms of the joints' samples": jitter("white", "joints"),
    "jitter ±5 ms of the sensors' samples": jitter("white", "sensors"),
    "wander ±5 ms of all": jitter("slow"),
    "wander ±5 ms of the joints": jitter("slow", "joints"),
    "jitter ±5 ms of sorted stamps": jitter("sorted"),
    "jitter ±5 ms of stamps at 50 Hz": jitter("sorted", rate=50),
    "effort 1 +0.2 Nm": effort_offset(1, 0.2),
    "effort 1 +0.5 Nm": effort_offset(1, 0.5),
    "forces and efforts x 1.05": scaled(1.05),
    "support of 8 N": supported(8.0),
    "encoder 1 +10°": encoder(1, 10),
    "encoder 2 +10°": encoder(2, 10),
    "encoder 3 -10°": encoder(3, -10),
    "effort 1 always zero": effort(1, 0),
    "efforts x 0.1": effort(EVERY, 0.1),
    "effort 1 x 0.1": effort(1, 0.1),
    "effort 2 x 10": effort(2, 10),
    "effort 1 x -1": effort(1, -1),
    "effort 1 x 1.1, 2 x 0.8": efforts((1, 1.1), (2, 0.8)),
}


# Faults of the table, each with its robot and the options of the identification.
WEIGHED = {"total_mass_std": 0.02}
TABLE = (
    ("correct", "symbitron", {}),
    ("correct", "symbitron/typical", {"tare": True} | WEIGHED),
    ("accelerometer +1 %", "symbitron", {}),
    ("accelerometer +2 %", "symbitron", {}),
    ("accelerometer +5 %", "symbitron", {}),
    ("gyroscope +10 %", "symbitron", {}),
    ("IMU turned 5° about y", "symbitron", {}),
    ("IMU turned 5° about y", "symbitron", {"sensor_errors": ("imu_mounting",)}),
    ("jitter ±5 ms of the samples", "symbitron", {}),
    ("effort 1 +0.2 Nm", "symbitron", {}),
    ("effort 1 +0.5 Nm", "symbitron", {}),
    ("support of 8 N", "symbitron", {}),
    ("support of 8 N", "symbitron", WEIGHED),
    ("support of 8 N", "symbitron/typical", {"tare": True} | WEIGHED),
    ("forces and efforts x 1.05", "symbitron", {}),
    ("forces and efforts x 1.05", "symbitron", {"force_scale_std": 5.0}),
    ("forces and efforts x 1.05", "symbitron", WEIGHED),
    ("correct", "symbitron", WEIGHED | {"off": 1.0}),
    ("correct", "quadruped", {}),
    ("accelerometer +2 %", "quadruped", {}),
    ("gyroscope +10 %", "quadruped", {}),
    ("effort 1 +0.5 Nm", "quadruped", {}),
    ("correct", "ur5", {}),
    ("effort 1 +0.5 Nm", "ur5", {}),
    ("encoder 1 +10°", "ur5", {}),
    ("encoder 2 +10°", "panda", {}),
    ("effort 1 always zero", "ur5", {}),
    ("effort 1 x 0.1", "ur5", {}),
    ("efforts x 0.1", "ur5", {}),
    ("effort 1 x 1.1, 2 x 0.8", "ur5", {"no_holdout": False}),
    ("effort 1 x 1.1, 2 x 0.8", "panda", {"no_holdout": False}),
    ("correct", "panda", {"no_holdout": False}),
)


def identified(
    streams: Streams, model: RobotModel, truth: RobotModel, seed: int, known: dict
) -> tuple[list[str], str]:
    """Return what an identification says, and the errors in standard deviations."""
    options = dict(known)
    off = options.pop("off", 0.0)
    if "total_mass_std" in options:
        options["total_mass"] = truth.phi[:, 0].sum() + off
    if options.pop("tare", False):
        options["tare"] = (tare(seed),)
    options = IdentifyOptions(**{"no_holdout": True} | options)
    try:
        problem = load_problem(model, Log.from_streams(streams), options)
        if options.no_holdout:
            result = problem.solve()
        else:
            _, result = identify_problem(problem)
    except SymbidError as error:
        return [f"refused: {error}"], "– | –"
    estimate = result.estimate
    true = ParameterSet(truth).values
    some = np.flatnonzero(estimate.determined[: len(true)])
    findings = [one.message for one in problem.checks.findings]
    said = list(dict.fromkeys([*findings, *estimate.verdict.alarms]))
    if scale := estimate.verdict.describe_mass_scale():
        said.append(scale)
    if not len(some):
        return said, "nothing determined | –"
    error = (estimate.value[some] - true[some]) / estimate.std[some]
    return said, f"{np.abs(error).max():.1f} | {np.sqrt(np.mean(error**2)):.1f}"


@cache
def tare(seed: int) -> Log:
    """Return readings of the same unloaded sensors."""
    bag = CACHE / f"tare_{seed}"
    if not bag.exists():
        options = SimulateOptions(
            "tare", noise_seed=seed, error_seed=seed, errors="typical,quantisation", friction=True
        )
        record(Simulator(options), bag)
    return Log.from_streams(read_streams([bag]))


GIVEN = {
    "tare": "tare",
    "total_mass_std": "weighing ± 0.02 kg",
    "off": "which is 1 kg too heavy",
    "force_scale_std": "`--force-scale-std 5`",
    "sensor_errors": "`--sensor-errors imu_mounting`",
}


def shortened(said: str) -> str:
    """Return a message without its advice and its list of causes."""
    ends = "; ", " (", ", according to", ": the model lacks", ", not checkable", ": move more"
    for end in ends:
        said = said.split(end, maxsplit=1)[0]
    return said.replace("refused: ", "")


def print_table(faults: Container[str], robots: Container[str], seed: int) -> None:
    """Print rows of docs/diagnosis.md."""
    print("| fault | robot | output | error, σ: largest | RMS |")
    print("|---|---|---|---|---|")
    for name, robot, known in TABLE:
        if name not in faults or robot not in robots:
            continue
        streams, model = ROBOTS[robot](seed)
        spoilt = FAULTS[name](streams, model, np.random.default_rng(seed))
        said, error = identified(spoilt, model, TRUTH[robot.split("/")[0]](), seed, known)
        given = ", ".join(GIVEN[key] for key in known if key in GIVEN)
        what = f"{name}, {given}" if given else name
        text = " / ".join(map(shortened, said)) or "–"
        print(f"| {what} | {robot} | {text} | {error} |", flush=True)


TRUTH: dict[str, Callable[[], RobotModel]] = {
    "symbitron": lambda: load_model(config_file("symbitron.xml")),
    "quadruped": lambda: load_model(CACHE / "quadruped.urdf"),
} | {name: (lambda name=name: arm_model(name)) for name in ARMS}


@dataclass(frozen=True)
class Row:
    robot: str
    fault: str
    seed: int
    diagnosis: Diagnosis
    seconds: float


def rows(robots, faults, seeds, has_model) -> Iterator[Row]:
    for robot in robots:
        for seed in range(1, seeds + 1):
            streams, model = ROBOTS[robot](seed)
            for fault in faults:
                spoilt = FAULTS[fault](streams, model, np.random.default_rng(seed))
                if spoilt is None:
                    continue
                start = time.process_time()
                diagnosis = diagnose(Log.from_streams(spoilt), model if has_model else None)
                yield Row(robot, fault, seed, diagnosis, time.process_time() - start)


def main() -> None:
    """Print what is found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=list(FAULTS))
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--figures", action="store_true")
    parser.add_argument("--streams", action="store_true", help="check the streams alone")
    parser.add_argument("--table", action="store_true", help="identify, and print the table")
    parser.add_argument("--seed", type=int, default=1, help="of the table")
    chosen = parser.parse_args()
    threadpool_limits(1)
    require_packages(EXAMPLE_ROBOTS)
    CACHE.mkdir(exist_ok=True)
    if chosen.table:
        logging.disable(logging.WARNING)
        print_table(chosen.only, chosen.robots, chosen.seed)
        return
    for row in rows(chosen.robots, chosen.only, chosen.seeds, not chosen.streams):
        found = [f"[{one.kind.value}] {one.message}" for one in row.diagnosis.findings]
        print(f"{row.robot:20s} {row.seed} {row.fault:38s} {row.seconds:5.1f} s", flush=True)
        for one in found or ["-"]:
            print(f"      {one[:230]}")
        if chosen.figures:
            print({k: round(v, 4) for k, v in row.diagnosis.figures.items()})
            print(row.diagnosis.left_out)


if __name__ == "__main__":
    main()
