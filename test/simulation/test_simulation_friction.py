from dataclasses import asdict

import mujoco
import numpy as np
import pytest
import yaml

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.settings import load_friction
from symbid_ros.simulation.simulator import Simulator

STEPS = 4000
SLIPPING, STOPPED = 0.02, 0.003  # rad/s


@pytest.fixture(scope="module", params=["smooth", "squat", "vibrating", "suspended"])
def scenario(request):
    return request.param


@pytest.fixture(scope="module")
def rubbing(scenario):
    """The simulator and the first seconds of its motion."""
    simulator = Simulator(
        SimulateOptions(scenario, moves=1, motion_seed=2, friction=True, ideal=True)
    )
    return simulator, [simulator.step() for _ in range(STEPS)]


class Robot:
    """The simulated robot without contacts, driven by the forces in the log."""

    def __init__(self, simulator):
        self.sensors = simulator.wrench_sensors
        self.model = mujoco.MjModel.from_xml_string(simulator.robot)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.data = mujoco.MjData(self.model)

    def put(self, instant):
        """Set state and forces and return the true acceleration, (nv,)."""
        model, data = self.model, self.data
        wxyz = instant.base_orientation[[3, 0, 1, 2]]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, wxyz)
        to_world = rotation.reshape(3, 3)
        data.qpos[:] = np.concatenate([instant.base_position, wxyz, instant.true_position])
        data.qvel[:] = np.concatenate(
            [
                to_world @ instant.base_linear_velocity,
                instant.base_angular_velocity,
                instant.true_velocity,
            ]
        )
        data.qfrc_applied[:6], data.qfrc_applied[6:] = 0.0, instant.true_effort
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for sensor, wrench in zip(self.sensors, instant.wrenches, strict=True):
            site = model.site(sensor.frame_id).id
            axes = data.site_xmat[site].reshape(3, 3)
            mujoco.mj_applyFT(
                model,
                data,
                axes @ wrench[:3],
                axes @ wrench[3:],
                data.site_xpos[site],
                model.site_bodyid[site],
                data.qfrc_applied,
            )
        mujoco.mj_forward(model, data)
        return np.concatenate(
            [
                to_world @ instant.base_linear_acceleration,
                instant.base_angular_acceleration,
                instant.true_acceleration,
            ]
        )


def test_equation_of_motion_holds_for_the_exported_robot(rubbing):
    simulator, instants = rubbing
    robot = Robot(simulator)
    for instant in instants[::23]:
        acceleration = robot.put(instant)
        np.testing.assert_allclose(robot.data.qacc, acceleration, atol=1e-6)


def test_a_slipping_joint_has_its_coulomb_friction(rubbing):
    simulator, instants = rubbing
    robot = Robot(simulator)
    friction = load_friction(config_file("friction.yaml"))
    loss, damping, armature = (
        np.array([asdict(friction[joint])[name] for joint in simulator.joint_names])
        for name in ("frictionloss", "damping", "armature")
    )
    bare = mujoco.MjModel.from_xml_path(str(config_file("symbitron.xml")))
    inverse = mujoco.MjData(bare)
    seen = 0
    for instant in instants[::23]:
        robot.put(instant)
        # The part that rigid-body dynamics do not explain, for each joint.
        inverse.qpos[:], inverse.qvel[:] = robot.data.qpos, robot.data.qvel
        inverse.qacc[:] = robot.data.qacc
        bare.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        mujoco.mj_inverse(bare, inverse)
        lost = (robot.data.qfrc_applied - inverse.qfrc_inverse)[6:]
        velocity = instant.true_velocity
        explained = damping * velocity + armature * instant.true_acceleration
        afterwards = velocity + 1e-3 * instant.true_acceleration
        # Friction that stops a joint within the period is smaller than its full value.
        slips = (np.abs(velocity) > SLIPPING) & (afterwards * np.sign(velocity) > STOPPED)
        seen += slips.sum()
        np.testing.assert_allclose(
            (lost - explained)[slips], (loss * np.sign(velocity))[slips], atol=1e-5
        )
    assert seen > 100


def test_recorded_acceleration_is_the_derivative_of_the_velocity(rubbing):
    _, instants = rubbing
    velocity, acceleration = (
        np.array([getattr(instant, name) for instant in instants])
        for name in ("true_velocity", "true_acceleration")
    )
    np.testing.assert_allclose(np.diff(velocity, axis=0), 1e-3 * acceleration[:-1], atol=1e-12)


def test_effort_is_the_motor_torque(rubbing):
    simulator, instants = rubbing
    effort = np.array([instant.true_effort for instant in instants])
    driven = np.array([not name.endswith("_aie") for name in simulator.joint_names])
    assert not effort[:, ~driven].any()
    assert effort[:, driven].any(axis=0).all()


def test_friction_does_not_reduce_the_motion(scenario, rubbing):
    _, instants = rubbing
    acceleration = np.array([instant.true_acceleration for instant in instants])
    low, high = (8.0, 10.0) if scenario == "vibrating" else (0.02, 0.5)
    assert low < np.sqrt(np.mean(acceleration**2)) < high


def test_exported_robot_differs_from_the_file_in_its_joints_only():
    file = mujoco.MjModel.from_xml_path(str(config_file("symbitron.xml")))
    robot = mujoco.MjModel.from_xml_string(
        Simulator(SimulateOptions("tare", friction=True, ideal=True)).robot
    )
    values = yaml.safe_load(config_file("friction.yaml").read_text())
    assert set(values) == {file.joint(joint).name for joint in range(1, file.njnt)}
    for name, expected in values.items():
        joint = robot.joint(name)
        assert np.atleast_1d(joint.damping[0])[0] == expected["damping"]
        assert joint.frictionloss[0] == expected["frictionloss"]
        assert joint.armature[0] == expected["armature"]
    for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_pos", "jnt_range"):
        np.testing.assert_array_equal(getattr(robot, name), getattr(file, name), err_msg=name)


def test_without_options_the_exported_robot_is_the_file():
    assert Simulator(SimulateOptions("tare")).robot == config_file("symbitron.xml").read_text()


def friction_file(folder, text):
    path = folder / "friction.yaml"
    path.write_text(text)
    return path


def test_unnamed_joints_keep_their_friction(tmp_path):
    text = "L_kfe: {damping: 1.5, frictionloss: 0, armature: 0.25}"
    simulator = Simulator(SimulateOptions("tare", friction_file=friction_file(tmp_path, text)))
    robot = mujoco.MjModel.from_xml_string(simulator.robot)
    dof = robot.joint("L_kfe").dofadr[0]
    assert robot.dof_armature[dof] == 0.25
    assert np.flatnonzero(robot.dof_armature).tolist() == [dof]
    assert not robot.dof_frictionloss.any()


VALUES = "damping: 1, frictionloss: 1, armature: 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"knee: {{{VALUES}}}", "no joint knee"),
        ("L_kfe: {damping: 1, armature: 1}", "joint L_kfe: frictionloss missing"),
        (f"L_kfe: {{{VALUES}, stiffness: 1}}", "joint L_kfe: unknown entry stiffness"),
        (f"L_kfe: {{{VALUES.replace('ping: 1', 'ping: -1')}}}", "joint L_kfe: damping is -1"),
        ("L_kfe: 1", "joint L_kfe: not a mapping"),
        ("- L_kfe", "not a mapping"),
        ("L_kfe: {", "not valid YAML"),
    ],
)
def test_invalid_friction_raises_a_one_line_error(tmp_path, text, message):
    with pytest.raises(SimulationError) as caught:
        Simulator(SimulateOptions("tare", friction_file=friction_file(tmp_path, text)))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
