"""A robot that follows a trajectory: its log obeys the equation of motion of the true robot."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from documented_robots import ur5_urdf

from symbid_ros.errors import SimulationError
from symbid_ros.excitation.rehearsal import draw_truth
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.simulation.joint_sensors import JointSensorOptions
from symbid_ros.simulation.joint_trajectory import JointTrajectory, read_trajectory
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.tracking import TrackingSimulator, centre_damping, effort_capacity

NAMES = "shoulder_lift_joint", "elbow_joint", "wrist_2_joint"
TIME = np.linspace(0, 3.0, 301)


@pytest.fixture(scope="module")
def arm():
    return load_model(ur5_urdf(), "fixed")


@pytest.fixture(scope="module")
def trajectory():
    # At rest at the start, as a designed trajectory.
    wave = (1 - np.cos(2 * np.pi * TIME / 3.0)) ** 2
    return JointTrajectory(NAMES, TIME, np.outer(wave, [0.2, -0.3, 0.4]))


def run(arm, truth, trajectory, **options):
    sensors = JointSensorOptions(rate=500.0)
    capacity = effort_capacity(arm)
    simulator = TrackingSimulator(
        truth, arm, trajectory, sensors=sensors, capacity=capacity, **options
    )
    return [simulator.step() for _ in range(simulator.steps)]


def column(instants, name):
    return np.array([getattr(instant, name) for instant in instants])


def test_efforts_are_mujocos_inverse_dynamics_of_the_true_robot(arm, trajectory):
    truth = draw_truth(arm, percent=25, seed=1, has_friction=False)
    instants = run(arm, truth, trajectory, seed=None)
    model = mujoco.MjModel.from_xml_string(mjcf_text(truth))
    data = mujoco.MjData(model)
    for instant in instants[::50]:
        data.qpos[:], data.qvel[:] = instant.true_position, instant.true_velocity
        data.qacc[:] = instant.true_acceleration
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(instant.joint_effort, data.qfrc_inverse, atol=1e-9)


def test_drives_have_friction_and_armature(arm, trajectory):
    truth = draw_truth(arm, percent=0, seed=1, has_friction=True)
    instants = run(arm, truth, trajectory, seed=None)
    model = mujoco.MjModel.from_xml_string(mjcf_text(arm))
    data = mujoco.MjData(model)
    elbow = arm.joint_names.index("elbow_joint")
    joint = truth.joints[elbow]
    checked = 0
    for instant in instants:
        speed = instant.true_velocity[elbow]
        if abs(speed) < 0.1:
            continue
        data.qpos[:], data.qvel[:] = instant.true_position, instant.true_velocity
        data.qacc[:] = instant.true_acceleration
        mujoco.mj_inverse(model, data)
        added = (
            joint.damping * speed
            + joint.friction_loss * np.sign(speed)
            + joint.armature * instant.true_acceleration[elbow]
        )
        assert instant.joint_effort[elbow] - data.qfrc_inverse[elbow] == pytest.approx(
            added, abs=0.02 * joint.friction_loss
        )
        checked += 1
    assert checked > 100


def test_damping_acts_on_the_velocity_that_positions_show():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option integrator='Euler'><flag eulerdamp='disable'/></option><worldbody><body>"
        "<joint damping='0.5'/><geom size='0.1' mass='1'/></body></worldbody></mujoco>"
    )
    inertia = float(model.dof_M0[0])
    centre_damping(model)
    data, period = mujoco.MjData(model), model.opt.timestep
    data.qfrc_applied[0] = torque = 0.02
    positions = []
    for _ in range(30):
        positions.append(float(data.qpos[0]))
        mujoco.mj_step(model, data)
    before, now, after = (np.array(positions[i : i + 28]) for i in range(3))
    velocity = (after - before) / (2 * period)
    acceleration = (after - 2 * now + before) / period**2
    np.testing.assert_allclose(inertia * acceleration + 0.5 * velocity, torque, rtol=1e-6)


def test_the_robot_follows_although_its_model_is_wrong(arm, trajectory):
    truth = draw_truth(arm, percent=25, seed=2, has_friction=True)
    instants = run(arm, truth, trajectory, seed=3)
    time = column(instants, "stamp") * 1e-9
    wanted = trajectory.at(time)[0]
    places = [arm.joint_names.index(name) for name in NAMES]
    error = column(instants, "true_position")[:, places] - wanted
    assert np.abs(error).max() < 0.05
    assert np.diff(column(instants, "stamp")).tolist() == [2_000_000] * (len(instants) - 1)


def test_noise_is_that_of_the_options(arm, trajectory):
    instants = run(arm, arm, trajectory, seed=3)
    effort = column(instants, "joint_effort") - column(instants, "true_effort")
    position = column(instants, "joint_position") - column(instants, "true_position")
    # 1500 readings: five standard errors of a standard deviation are 9 %.
    np.testing.assert_allclose(effort.std(axis=0), 1e-3 * np.array([150] * 3 + [28] * 3), rtol=0.1)
    np.testing.assert_allclose(position.std(axis=0), 2e-5, rtol=0.1)


def test_a_trajectory_is_read_from_csv(tmp_path):
    file = tmp_path / "any.csv"
    rows = [f"{t:.2f},{np.sin(t):.9f},0" for t in np.arange(2.0, 4.0, 0.05)]
    file.write_text("time,b,a/velocity\n" + "\n".join(rows) + "\n")
    found = read_trajectory(file, ("a", "b"))
    assert (found.names, found.time[0]) == (("b",), 0.0)
    np.testing.assert_allclose(found.at(np.array([1.0]))[1], np.cos(3.0), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks a column"),
        ("time,c\n0,0\n", "column 'c' is not a joint"),
        ("time,a\n0,0\n0,1\n1,1\n2,1\n3,1\n4,1\n", "increasing"),
        ("time,a\n0,x\n", "something else than 2 numbers"),
        ("time,a\n0,0\n1,nan\n2,1\n3,1\n4,1\n5,1\n", "finite"),
    ],
)
def test_an_invalid_trajectory_is_refused(tmp_path, text, message):
    file = tmp_path / "trajectory.csv"
    file.write_text(text)
    with pytest.raises(SimulationError, match=message) as error:
        read_trajectory(tmp_path, ("a", "b"))
    assert error.value.code == "E681"


def test_a_missing_trajectory_and_a_floating_base_are_refused(tmp_path, trajectory):
    with pytest.raises(SimulationError, match="cannot be read") as error:
        read_trajectory(tmp_path / "none.csv", ("a",))
    assert error.value.code == "E680"
    floating = load_model(ur5_urdf(), "floating")
    with pytest.raises(SimulationError) as error:
        TrackingSimulator(
            *(floating, floating, trajectory),
            sensors=JointSensorOptions(),
            capacity=np.ones(6),
            seed=None,
        )
    assert error.value.code == "E682"


def with_damping(arm, damping):
    joints = tuple(replace(joint, damping=damping) for joint in arm.joints)
    return replace(arm, joints=joints)


@pytest.mark.parametrize("has_friction", [False, True])
def test_light_joints_follow_although_the_file_states_placeholders(arm, trajectory, has_friction):
    stated = with_damping(arm, 1.0)
    truth = draw_truth(stated, percent=25, seed=1, has_friction=has_friction)
    instants = run(stated, truth, trajectory, seed=None)
    time = column(instants, "stamp") * 1e-9
    places = [arm.joint_names.index(name) for name in NAMES]
    error = column(instants, "true_position")[:, places] - trajectory.at(time)[0]
    assert np.abs(error).max() < 0.1


def test_damping_out_of_proportion_is_refused(arm, trajectory):
    stated = with_damping(arm, 1e4)
    with pytest.raises(SimulationError, match="out of proportion") as error:
        run(stated, stated, trajectory, seed=None)
    assert error.value.code == "E684"


def test_noise_that_exceeds_the_efforts_is_named(arm, trajectory, tmp_path, caplog):
    """A wrist that carries little may have a drive with a large limit."""
    named = []
    for percent in (0.1, 20.0):
        sensors = JointSensorOptions(effort_noise=percent)
        options = {"sensors": sensors, "capacity": effort_capacity(arm), "seed": 0}
        caplog.clear()
        record(TrackingSimulator(arm, arm, trajectory, **options), tmp_path / f"log_{percent}")
        named.append(caplog.text)
    assert named[0] == ""
    assert "noise of efforts exceeds the efforts: " in named[1]
    assert "wrist_2_joint" in named[1]
    assert "shoulder_lift_joint" not in named[1]
