"""Public logs of robots that laboratories built, measured or simulated themselves."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from real_data import FloatArray, RealData, RealLog, Recording, imu_readings
from scipy.spatial.transform import Rotation

import symbid_ros as sy

SOLO_LEGS = "FL", "FR", "HL", "HR"
GEN3 = "Examples/Kinova/SystemIdentification/IterativeSystemIdentification/full_params_data"
AIRBOT = "examples/airbot_play/data"
XMATE = "filtering/data/excit"
# Of each joint of the xMate3 Pro: offset along its axis, m, and quarter turns about the x axis
# before it (modified Denavit-Hartenberg parameters in robot_model.m; all others are zero).
XMATE_JOINTS = (0.3415, 0.0), (0, -1), (0.394, 1), (0, -1), (0.366, 1), (0, -1), (0.2503, 1)
XMATE_INERTIAL = """
    <inertial>
      <mass value="2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial>"""


def double_pendulum(files: Sequence[Path]) -> RealLog:
    """Read a double pendulum with two drives at 500 Hz; `tau_meas` is measured."""
    run, urdf = files
    rows = np.genfromtxt(run, delimiter=",", names=True)
    position, effort = (
        np.column_stack([rows[f"{name}1"], rows[f"{name}2"]]) for name in ("pos_meas", "tau_meas")
    )
    return _split(sy.load_model(urdf, base="fixed"), rows["time"], position, effort, 10.0)


def gen3(files: Sequence[Path]) -> RealLog:
    """Read link-side torques of a Kinova Gen3 at 100 Hz, of the opposite sign.

    The angles of joints that turn without end are wrapped.
    """
    *rows, urdf = files
    position, effort, time = (np.loadtxt(one, ndmin=2) for one in rows)
    position = np.unwrap(position, axis=0)
    robot = sy.load_model(urdf, base="fixed")
    return _split(robot, time.ravel() - time.min(), position, -effort, 10.0)


def airbot(files: Sequence[Path]) -> RealLog:
    """Read torques of an AIRBOT Play at 100 Hz, the rate of airbot_play_config.yaml there."""
    *rows, urdf = files
    position, effort = (np.loadtxt(one, delimiter=",", skiprows=1) for one in rows)
    time = 0.01 * np.arange(len(position))
    return _split(sy.load_model(urdf, base="fixed"), time, position, effort, 5.0)


def xmate(files: Sequence[Path]) -> RealLog:
    """Read a Rokae xMate3 Pro at 1 kHz: torques of its joints' sensors, or of its motors.

    The repository has a kinematic model alone, so every link gets the same mass at its joint.
    """
    position, effort = (np.loadtxt(one) for one in files)
    return _split(xmate_robot(), 0.001 * np.arange(len(position)), position, effort, 10.0)


def xmate_robot() -> sy.RobotModel:
    """Return the xMate3 Pro with inertias that are placeholders."""
    parts = [f'<robot name="xmate3_pro">\n  <link name="link0">{XMATE_INERTIAL}\n  </link>']
    for index, (offset, quarters) in enumerate(XMATE_JOINTS):
        angle = quarters * np.pi / 2
        y, z = -offset * np.sin(angle), offset * np.cos(angle)
        parts.append(
            f'  <link name="link{index + 1}">{XMATE_INERTIAL}\n  </link>\n'
            f'  <joint name="joint{index + 1}" type="revolute">\n'
            f'    <parent link="link{index}"/>\n    <child link="link{index + 1}"/>\n'
            f'    <origin xyz="0 {y} {z}" rpy="{angle} 0 0"/>\n    <axis xyz="0 0 1"/>\n'
            '    <limit lower="-3" upper="3" effort="85" velocity="2"/>\n  </joint>'
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "xmate3_pro.urdf"
        path.write_text("\n".join([*parts, "</robot>"]))
        return sy.load_model(path, base="fixed")


def solo12(files: Sequence[Path]) -> RealLog:
    """Read a simulated, trotting Solo 12 at 100 Hz.

    Nothing measures where its feet touch the ground. The log has no IMU either, so its readings are
    computed from the pose of the base.
    """
    *rows, urdf = files
    robot = sy.load_model(urdf, base="floating")
    state, effort = (np.loadtxt(one, delimiter="\t").T[:2000] for one in rows)
    time = 0.01 * np.arange(len(state))
    names = [f"{leg}_{joint}" for leg in SOLO_LEGS for joint in ("HAA", "HFE", "KFE")]
    order = [names.index(name) for name in robot.measured_joint_names]
    velocity = np.gradient(state[:, :3], time, axis=0)
    imu = imu_readings(time, Rotation.from_quat(state[:, 3:7]), velocity)
    log = Recording("solo12", time, state[:, 7:][:, order], effort[:, order], imu=imu)
    feet = tuple(f"{leg}_FOOT" for leg in SOLO_LEGS)
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=10.0, contacts=feet)


def _split(
    robot: sy.RobotModel, time: FloatArray, position: FloatArray, effort: FloatArray, cutoff: float
) -> RealLog:
    """Return a log whose last quarter is held out."""
    later = np.concatenate([[True], np.diff(time) > 0])
    log = Recording(robot.name, time[later], position[later], effort[later])
    return RealLog(robot, log.part(0.0, 0.75), log.part(0.75, 1.0), cutoff=cutoff)


LABORATORY_DATA = {
    "double_pendulum": RealData(
        "Double pendulum of DFKI, 2 joints, 500 Hz, 10 s",
        "https://github.com/dfki-ric-underactuated-lab/double_pendulum commit 1e8544e",
        "BSD-3-Clause",
        {
            "data/experiment_records/design_A.0/20220815/sys_id/trajectory_00.csv": ""
            "3ea9f330443c902711faaf7f99059dd43e42ea30bb4e2d310d78aa1ec897532d",
            "data/urdfs/design_A.0/model_1.0/double_pendulum.urdf": ""
            "6d5fbdc003bc9151dd7a950e23f0862b8147e40e24b40108093e7ff87aa8ff4f",
        },
        double_pendulum,
        "The repository publishes no held-out error.",
    ),
    "gen3": RealData(
        "Kinova Gen3 of RAPTOR, 7 joints, link-side torques, 100 Hz, 14 s",
        "https://github.com/roahmlab/RAPTOR commit 6da2d77; kinova.urdf: commit 04daa66",
        "GPL-3.0",
        {
            f"{GEN3}/q_downsampled_1.csv": ""
            "701741bcbf89d6d4a77c238775e93f75c7fb4709c6764529709764065a38d09b",
            f"{GEN3}/tau_downsampled_1.csv": ""
            "0cc043c20bcadefc5354d0e327e3fd766bd90980feb78fe176ee5c6de143e673",
            f"{GEN3}/t_downsampled_1.csv": ""
            "f7284e402782933b28864db12a46d7ea6630e21a38ab94ed4ff8c4a35b96a699",
            "Robots/kinova-gen3/kinova.urdf": ""
            "7be86d56bd722efb71f489d913f4f771a8f848cf910600e1cf2c2faec17b8296",
        },
        gen3,
        "The repository publishes no held-out error for this run.",
    ),
    "airbot": RealData(
        "AIRBOT Play, 6 joints, 100 Hz, 30 s",
        "https://github.com/liuyurong129/figaroh_kinova commit 24b73ff",
        "no licence stated",
        {
            f"{AIRBOT}/identification/chirp_motion/identification_q_real.csv": ""
            "85bfc46028d4d19a9983910e90d70a6db53c9e5f636cb2f4a880b7376c481306",
            f"{AIRBOT}/identification/chirp_motion/identification_tau_real.csv": ""
            "76b7e695fa078907a1a2023cc80fb98241f5822beae235f2b2715341f3666cd2",
            f"{AIRBOT}/urdf/airbot_play_v3_0_gripper.urdf": ""
            "0dd3f923a465eaf7c4e7bec405c87ccdd406f50ced2202114bf774bb3691b0e1",
        },
        airbot,
        "The repository publishes no held-out error for this run.",
    ),
    "xmate": RealData(
        "Rokae xMate3 Pro, 7 joints, torque sensors, 1 kHz, 20 s",
        "https://github.com/YanjunLIU-ac/Dynamic_Parameter_Identification_for_Rokae_xMate "
        "commit d5855f4",
        "no licence stated",
        {
            f"{XMATE}/excit_ang_record.txt": ""
            "5f572aa951b826a2cc28bcf4fd81ac9c6dc33e7d487b415fe99fa819e74e79ba",
            f"{XMATE}/excit_torque_record.txt": ""
            "04dcbc3d9f01f5b853a0800c3a629fe20bedf6f97c8ea2a6e3b07bbf577dce88",
        },
        xmate,
        "The repository publishes no held-out error.",
    ),
    "xmate_motors": RealData(
        "Rokae xMate3 Pro, 7 joints, torques of the motors, 1 kHz, 20 s",
        "https://github.com/YanjunLIU-ac/Dynamic_Parameter_Identification_for_Rokae_xMate "
        "commit d5855f4",
        "no licence stated",
        {
            f"{XMATE}/excit_ang_record.txt": ""
            "5f572aa951b826a2cc28bcf4fd81ac9c6dc33e7d487b415fe99fa819e74e79ba",
            f"{XMATE}/excit_motor_record.txt": ""
            "bfc42d68614dae12587860649b5e9e3719f9fe1bd3a965cd97a2c00165d189c0",
        },
        xmate,
        "The repository publishes no held-out error.",
    ),
    "solo12": RealData(
        "Solo 12, simulated, 12 joints, trot, no sensors in the feet, 100 Hz, 20 s",
        "https://github.com/ShahramKhorshidi/system_identification commit 519ca70",
        "no licence stated",
        {
            "data/solo_robot_q.dat": ""
            "9763b1ac03b7652c7385177a36dca4ba4c7564e7ea3b057ed37db0631e20cedb",
            "data/solo_robot_tau.dat": ""
            "efffe8bc5c8e4482c36889523a9b9da2ad9ece7e600dcb105f2004c4e9e3439a",
            "urdf/solo12.urdf": "430f8e786870fecb508af01b4dae125f0f9ce13f3d15b2da55de4062a65d3515",
        },
        solo12,
        "The commit says that the data are simulated.",
    ),
}
