"""Further public logs: five arms, a mobile manipulator, and a robot with legs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from real_data import (
    FloatArray,
    RealData,
    RealLog,
    Recording,
    imu_readings,
    load_with_joints,
    load_without,
)
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.signals.joint_clock import sampled_joints

LEGS = ("FR", "FL", "RR", "RL")
JUMP_FILES = ("joint_act.txt", "joint_des.txt", "torque.txt", "pos.txt")
TIAGO_ARM = tuple(f"arm_{index}_joint" for index in range(1, 8))


def kinova(files: Sequence[Path]) -> RealLog:
    """Read link-side torques of a Kinova Gen3 at 1 kHz; `TorqueSm` is measured."""
    run, urdf = files
    rows = np.genfromtxt(run, delimiter=",", names=True)
    position, effort = (
        np.column_stack([rows[f"{name}{joint}"] for joint in range(1, 8)])
        for name in ("Position", "TorqueSm")
    )
    log = Recording("kinova", rows["Time"] / 1000.0, position, effort)
    robot = sy.load_model(urdf, base="fixed")
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0)


def fer(files: Sequence[Path]) -> RealLog:
    """Read a ROS 2 bag of a Franka at 30 Hz, at the times at which its samples were taken.

    Every fiftieth message repeats the one before, because the arm was sampled at 29.4 Hz.
    """
    bag, urdf = files
    log = _recording(bag, [f"fer_joint{index}" for index in range(1, 8)])
    robot = load_without(urdf, "panda_hand_joint")
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=5.0)


def ur10(files: Sequence[Path]) -> RealLog:
    """Read a ROS 2 bag of a UR10 at 125 Hz; the efforts are motor currents in A."""
    bag, urdf = files
    robot = sy.load_model(urdf, base="fixed")
    log = _recording(bag, robot.measured_joint_names)
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0)


def _recording(bag: Path, names: Sequence[str]) -> Recording:
    joints = sampled_joints(sy.load_bag(bag).streams().joints).joints
    order = [joints.names.index(name) for name in names]
    time = 1e-9 * (joints.stamp - joints.stamp[0])
    return Recording(bag.name, time, joints.position[:, order], joints.effort[:, order])


def med7(files: Sequence[Path]) -> RealLog:
    """Read link-side torques of a KUKA LBR Med 7 at 100 Hz, the rate of test_model.py there.

    The driver publishes torques with the opposite sign.
    """
    run, urdf = files
    rows = np.genfromtxt(run, delimiter=",", names=True)
    position, effort = (
        np.column_stack([rows[f"{name}_{joint}"] for joint in range(7)]) for name in ("q", "tau")
    )
    log = Recording("med7", 0.01 * np.arange(len(position)), position, -effort)
    robot = sy.load_model(urdf, base="fixed")
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0)


def rokae(files: Sequence[Path]) -> RealLog:
    """Read link-side torques of a Rokae AR5-5 at 50 Hz, which is mounted sideways."""
    run, urdf = files
    rows = np.genfromtxt(run, delimiter=",", names=True)
    position, effort = (
        np.column_stack([rows[f"{name}{joint}"] for joint in range(7)]) for name in ("q", "tau")
    )
    log = Recording("rokae", rows["time"], position, effort)
    robot = sy.load_model(urdf, base="fixed")
    found = (1.0, -0.016, -0.013)  # by `symbid identify`
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=5.0, gravity=found)


def tiago(files: Sequence[Path]) -> RealLog:
    """Read motor currents of a TIAGo's arm at 100 Hz, times gear ratios and torque constants.

    The constants are those of the repository's identification.py, and so are the rows used. That of
    the torso has none, so that its effort is left out.
    """
    positions, currents, urdf = files
    names = ("torso_lift_joint", *TIAGO_ARM)
    robot = load_with_joints(urdf, names)
    # Nm/A: gear ratio times torque constant.
    gains = np.array([np.nan, *[13.6] * 2, *[-8.7] * 2, *[336 * -0.0613] * 3])
    motion, current = (
        np.loadtxt(path, delimiter=",", skiprows=1)[921:6791] for path in (positions, currents)
    )
    order = [names.index(name) for name in robot.measured_joint_names]
    effort = current[:, 1:] * gains
    log = Recording("tiago", motion[:, 0], motion[:, 1:][:, order], effort[:, order])
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=5.0)


def a1(files: Sequence[Path]) -> RealLog:
    """Read twenty jumps of a Unitree A1 at about 900 Hz, with efforts that were commanded.

    Fifteen are identified and five held out. The rows of each end when the gains of the controller
    change. There is neither an IMU nor a clock: the accelerations are those of the state
    estimator's velocity, and the time between rows follows from positions and velocities.
    """
    folder, urdf = files
    robot = sy.load_model(urdf, base="floating")
    names = [f"{leg}_{joint}_joint" for joint in ("hip", "thigh", "calf") for leg in LEGS]
    order = [names.index(name) for name in robot.measured_joint_names]
    runs = sorted((each for each in folder.iterdir() if (each / "pos.txt").is_file()), key=_number)
    jumps = [_jump(each, order) for each in runs]
    count = 3 * len(jumps) // 4
    return RealLog(
        robot,
        _joined(jumps[:count]),
        _joined(jumps[count:]),
        cutoff=10.0,
        contacts=tuple(f"{leg}_foot" for leg in LEGS),
    )


def _number(folder: Path) -> int:
    return int(folder.name)


def _jump(folder: Path, order: list[int]) -> Recording:
    """Read one jump until the controller's gains change."""
    joints, desired, torque, base = (np.loadtxt(folder / name)[:1095] for name in JUMP_FILES)
    position, velocity = joints[:, :12], joints[:, 12:24]
    # The log has the hips' efforts without those of the controller's gains, 400 and 4.
    hips = 400 * (desired[:, :4] - position[:, :4]) + 4 * (desired[:, 12:16] - velocity[:, :4])
    effort = np.hstack([torque[:, :4] + hips, torque[:, 12:20]])
    time = _clock(position, velocity)
    turn = Rotation.from_euler("ZYX", base[:, [8, 7, 6]])
    imu = imu_readings(time, turn, base[:, :3])
    return Recording(folder.name, time, position[:, order], effort[:, order], imu=imu)


def _clock(position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return the times (N,) at which integrated velocities are the positions."""
    moved, speed = np.diff(position, axis=0), (velocity[1:] + velocity[:-1]) / 2
    along, square = (gaussian_filter1d((each * speed).sum(axis=1), 25.0) for each in (moved, speed))
    # Robots at rest show no time; rows are written every millisecond at best.
    step = np.where(square > 1.0, np.clip(along / np.maximum(square, 1e-9), 8e-4, 2.5e-3), 1e-3)
    return np.concatenate([[0.0], np.cumsum(step)])


def _joined(runs: list[Recording], pause: float = 0.5) -> Recording:
    """Return runs one after the other, with pauses (s) in which nothing was recorded."""
    starts = np.cumsum([0.0, *(run.time[-1] + pause for run in runs[:-1])])
    return Recording(
        "a1",
        np.concatenate([start + run.time for start, run in zip(starts, runs, strict=True)]),
        *(np.concatenate([getattr(run, name) for run in runs]) for name in ("position", "effort")),
        imu=np.concatenate([run.imu for run in runs]),
    )


FURTHER_DATA = {
    "kinova": RealData(
        "Kinova Gen3, 7 joints, link-side torques, 1 kHz, 4.7 s",
        "https://github.com/wissem01chiha/dynamic-identification commit 3b3baef",
        "CC0-1.0",
        {
            "pyDynaMapp/data/kinova/validation_data/opti_traj_testing1.csv": ""
            "0c9229ae8882a43fb1aac59c1b527a0942a99dcb0fe2aed77e948091fe8bf274",
            "pyDynaMapp/robot/kinova/gen3.urdf": ""
            "798b384976d9e847f8896e29ac58b0581c1dbcb6bad2d5d8ed9474841b38e1f8",
        },
        kinova,
        "The repository publishes no held-out error for this run.",
    ),
    "fer": RealData(
        "Franka (FER), 7 joints, link-side torques, ROS 2 bag, 30 Hz, 24 s",
        "https://github.com/unisa-acg/inverse-dynamics-solver commit 41e196d; panda.urdf: "
        "https://github.com/Gepetto/example-robot-data (pip install example-robot-data==6.0.0)",
        "BSD-3-Clause; panda.urdf: BSD",
        {
            "franka_inria_inverse_dynamics_solver/bagfiles/panda_exciting_trajectory.db3": ""
            "6794c9dc89628d775bd77bfaee3ed73e0a7d7716401886e17e06d81ea3b7f299",
            "panda.urdf": "63792d2679f22c4e41cda2c4d9d903644e628970ad0656b9eec8485113941555",
        },
        fer,
        "The repository publishes no held-out error for this run.",
    ),
    "ur10": RealData(
        "UR10, 6 joints, motor currents, ROS 2 bag, 125 Hz, 28 s",
        "https://github.com/unisa-acg/inverse-dynamics-solver commit 41e196d; ur10_robot.urdf: "
        "https://github.com/Gepetto/example-robot-data (pip install example-robot-data==6.0.0)",
        "BSD-3-Clause; ur10_robot.urdf: BSD",
        {
            "ur10_inverse_dynamics_solver/bagfiles/ur10_exciting_trajectory.db3": ""
            "14244fc39e9b42047039824f3c20ab984f9d1b28d5a67e9415cc1b3cc0ac3369",
            "ur10_robot.urdf": "16e4d9c85f01d2533fa219d28e2e5a2ce93836be7afaf243b46be4ba76e0d4ea",
        },
        ur10,
        "The repository publishes no held-out error for this run.",
    ),
    "med7": RealData(
        "KUKA LBR Med 7, 7 joints, torque sensors, 100 Hz, 16 s",
        "https://github.com/lbr-stack/dynamic_parameter_identification commit 58b4d88",
        "MIT",
        {
            "src/test/measurements.csv": ""
            "a1c7d3fb1c0e0224e938b5d3d0d72042534573072905f661a07f31dfa2addd4d",
            "urdf/med/med7dock.urdf": ""
            "29b19bce6d82a5a991ad3a7d24da87ee19194ad165eaeb63911de824276f43de",
        },
        med7,
        "The repository publishes no held-out error.",
    ),
    "rokae": RealData(
        "Rokae AR5-5, 7 joints, torque sensors, 50 Hz, 60 s",
        "https://github.com/FrankJIE09/Dynamics_identification_Frank commit 758dc8d",
        "no licence stated",
        {
            "src/config/dynamics_identification_data_real.csv": ""
            "1c58c840362a20bc00162f20e6c154dd40bae10e27f9b21bf2abd8b8cc50d578",
            "scripts/AR5-5_07R-W4C4A2/AR5-5_07R-W4C4A2.urdf": ""
            "ab27968f2857cba2f736137483f0ac64d28ff521464ed0088b747c8899dcff02",
        },
        rokae,
        "The repository publishes no held-out error.",
    ),
    "tiago": RealData(
        "TIAGo, 7 joints of its arm, motor currents times published constants, 100 Hz, 59 s",
        "https://github.com/thanhndv212/figaroh-examples commit c0b5c7f",
        "Apache-2.0",
        {
            "examples/tiago/data/identification/dynamic/tiago_position.csv": ""
            "4297a60d434ee89f1f424ad0da8ec65bc00072ac57eb06b94966c0819fc2786d",
            "examples/tiago/data/identification/dynamic/tiago_effort.csv": ""
            "12c635987705efade603426a600f5b315add7f580c720a4b84609dadb9d0a2e9",
            "examples/tiago/urdf/tiago_48_schunk.urdf": ""
            "e4412357e3ea141097acc835d81c4ac477f889ad99b05d2a9818ed9cdf9d12b6",
        },
        tiago,
        "The repository publishes no held-out error.",
    ),
    "a1": RealData(
        "Unitree A1, 12 joints, 20 jumps, commanded torques, no sensors in the feet, 900 Hz, 25 s",
        "https://github.com/DRCL-USC/Learning_MPC_Jumping commit 79871b7; a1.urdf: "
        "https://github.com/Gepetto/example-robot-data (pip install example-robot-data==6.0.0)",
        "MIT; a1.urdf: BSD",
        {
            "residual_learning/data/mix-20traj": "271aebae79e1fc67a5efc44ff690edf2"
            "dccbe4f1870fe546ae72d1f19bf3864f",
            "a1.urdf": "48ddf0c904a271358e6f0e6b74c25bf3c704575888182b24c367761c92f46d43",
        },
        a1,
        "The manufacturer states 12 kg; the model file has 13.7 kg.",
    ),
}
