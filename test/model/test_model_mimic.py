"""Mimic joints follow their leaders; ignored elements of an MJCF are reported."""

import re
from dataclasses import astuple, replace

import mujoco
import numpy as np
import pytest
from random_robots import random_samples

from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.imu import BaseMotion
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion, known_force
from symbid_ros.errors import ModelError
from symbid_ros.identification.api import regressor
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Mimic

INERTIAL = (
    '<inertial><origin xyz=".1 0 .2"/><mass value="1.5"/>'
    '<inertia ixx=".02" iyy=".03" izz=".04" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def joint(name, parent, child, kind="revolute", mimic=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        '<origin xyz=".1 .2 .3" rpy=".3 .2 .1"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="10" velocity="1"/>'
        f'<dynamics damping=".2" friction=".1"/>{mimic}</joint>'
    )


# The follower of a follower comes before its master, slides, and branches off elsewhere.
GRIPPER = (
    '<robot name="gripper">'
    + "".join(f'<link name="{name}">{INERTIAL}</link>' for name in "abcd")
    + joint("far", "a", "d", "prismatic", '<mimic joint="near" multiplier="-2" offset=".5"/>')
    + joint("master", "a", "b")
    + joint("near", "b", "c", "continuous", '<mimic joint="master" multiplier="1.5" offset=".1"/>')
    + "</robot>"
)


@pytest.fixture(params=["floating", "fixed"])
def gripper(request, tmp_path):
    (tmp_path / "gripper.urdf").write_text(GRIPPER)
    return load_model(tmp_path / "gripper.urdf", request.param)


def following(robot, count, seed=0):
    """Random samples with the positions of mimic joints computed by hand."""
    samples = random_samples(robot, count, np.random.default_rng(seed), ())
    far, master, near = (robot.joint_names.index(name) for name in ("far", "master", "near"))
    for values, shift in ((samples.position, 1), (samples.velocity, 0), (samples.acceleration, 0)):
        values[:, near] = 1.5 * values[:, master] + 0.1 * shift
        values[:, far] = -2 * values[:, near] + 0.5 * shift
    samples.effort[:, [far, near]] = 0.0
    return samples


def test_a_chain_of_mimic_joints_is_bound_to_its_leader(gripper):
    far, master, near = (gripper.joint_names.index(name) for name in ("far", "master", "near"))
    assert gripper.joints[near].mimic == Mimic(master, 1.5, 0.1)
    bound = gripper.joints[far].mimic
    assert bound.leader == master
    assert bound.multiplier == pytest.approx(-3.0)
    assert bound.offset == pytest.approx(0.5 - 2 * 0.1)
    assert gripper.measured_joint_names == ("master",)
    samples = following(gripper, 5)
    motion = [samples.position, samples.velocity, samples.acceleration]
    others = [one.copy() for one in motion]
    for one in others:
        one[:, [far, near]] = 7.0
    base = BaseMotion(
        samples.base_angular_velocity,
        samples.base_angular_acceleration,
        samples.base_specific_force,
    )
    expected, found = (regressor(gripper, *one, base=base) for one in (motion, others))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(gripper.apply_mimics(samples.position), samples.position, atol=1e-15)
    rates = gripper.apply_mimics(samples.velocity, rates=True)
    np.testing.assert_allclose(rates, samples.velocity, atol=1e-15)


def test_the_leaders_row_is_the_virtual_work_of_all_its_followers(gripper):
    samples = following(gripper, 8)
    parameters = ParameterSet(gripper)
    rows = equation_of_motion(parameters, samples)
    needed = rows.K @ parameters.values + known_force(parameters, samples)
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(gripper))
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if gripper.floating:
        compiled.opt.gravity[:] = 0
    data = mujoco.MjData(compiled)
    first = 6 * gripper.floating
    far, master, near = (gripper.joint_names.index(name) for name in ("far", "master", "near"))
    for k in range(len(samples)):
        data.qpos[compiled.nq - 3 :] = samples.position[k]
        data.qvel[compiled.nv - 3 :] = samples.velocity[k]
        data.qacc[compiled.nv - 3 :] = samples.acceleration[k]
        if gripper.floating:
            data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
            data.qvel[3:6] = samples.base_angular_velocity[k]
            data.qacc[3:6] = samples.base_angular_acceleration[k]
            data.qacc[:3] = samples.base_specific_force[k]
        mujoco.mj_inverse(compiled, data)
        speed = samples.velocity[k]
        force = data.qfrc_inverse[first:] + 0.1 * np.clip(speed / 0.02, -1, 1)
        work = force[master] + 1.5 * force[near] - 3.0 * force[far]
        assert needed[k, first + master] == pytest.approx(work, rel=1e-9, abs=1e-9)
    np.testing.assert_array_equal(needed[:, [first + far, first + near]], 0.0)
    np.testing.assert_allclose(
        rows.y[:, first + master] + known_force(parameters, samples)[:, first + master],
        samples.effort[:, master],
    )


def test_a_contact_on_a_followers_link_loads_the_leader(gripper):
    samples = following(gripper, 4)
    poses = link_poses(gripper, samples.position)
    jacobian = contact_jacobian(gripper, ("d",), poses)
    # The velocity of the link's origin, by finite differences of the master alone.
    master = gripper.joint_names.index("master")
    moved = samples.position.copy()
    moved[:, master] += 1e-6
    later = link_poses(gripper, gripper.apply_mimics(moved))
    link = gripper.link_names.index("d")
    shift = (later.position[:, link] - poses.position[:, link]) / 1e-6
    in_link = np.einsum("nji,nj->ni", poses.rotation[:, link], shift)
    column = 6 * gripper.floating + master
    np.testing.assert_allclose(jacobian[:, 3:, column], in_link, atol=1e-5)


def test_both_formats_write_mimic_joints(gripper, tmp_path):
    again = tmp_path / "again.urdf"
    again.write_text(urdf_text(gripper))
    base = "floating" if gripper.floating else "auto"
    assert load_model(again, base).followers == gripper.followers
    own = tmp_path / "again.xml"
    own.write_text(mjcf_text(gripper))
    found = load_model(own).followers
    assert found.keys() == gripper.followers.keys()
    for joint, mimic in gripper.followers.items():
        assert astuple(found[joint]) == pytest.approx(astuple(mimic))
    assert load_model(own).measured_joint_names == ("master",)
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(gripper))
    data = mujoco.MjData(compiled)
    first = compiled.nq - 3
    data.qpos[first:] = gripper.apply_mimics(np.array([[0.0, 0.3, 0.0]]))[0]
    mujoco.mj_forward(compiled, data)
    equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    assert equal.sum() == 2
    np.testing.assert_allclose(data.efc_pos[equal], 0.0, atol=1e-12)


def test_mimic_joints_follow_in_mujoco_whatever_their_references(gripper):
    """MuJoCo's equality measures both positions from their references."""
    joints = tuple(
        replace(joint, reference=0.4 - 0.3 * index) for index, joint in enumerate(gripper.joints)
    )
    robot = replace(gripper, joints=joints)
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(robot))
    data = mujoco.MjData(compiled)
    for angle in (-0.5, 0.0, 0.7):
        leader = np.full((1, 3), angle)
        data.qpos[compiled.nq - 3 :] = robot.apply_mimics(leader)[0]
        mujoco.mj_forward(compiled, data)
        equal = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        np.testing.assert_allclose(data.efc_pos[equal], [0, 0], atol=1e-12)


HAND = """<mujoco><default><equality solref=".001 1" solimp=".9999 .9999"/></default>
  <option gravity="0 0 -9.81"/>
  <worldbody><body name="palm"><geom size=".1" contype="0" conaffinity="0"/>
    <body name="left"><joint name="l" axis="0 1 0" ref=".2" damping=".3"/>
      <geom size=".02" pos=".1 0 0"/>
      <body name="tip" pos=".2 0 0"><joint name="t" type="slide" axis="1 0 0"/>
        <geom size=".02"/></body></body>
    <body name="right"><joint name="r" axis="0 1 0" ref="-.1"/>
      <geom size=".03" pos=".1 .2 0"/></body></body></worldbody>
  <equality><joint joint1="t" joint2="r" polycoef=".01 .1 0 0 0"/>
    <joint name="pair" joint1="l" joint2="r" polycoef=".05 -2 0 0 0"/></equality>
  <actuator><motor name="drive" joint="l" ctrlrange="-5 5"/></actuator></mujoco>"""


def test_joints_that_an_mjcf_couples_follow_the_one_with_a_motor_as_in_mujoco(tmp_path, caplog):
    (tmp_path / "hand.xml").write_text(HAND)
    robot = load_model(tmp_path / "hand.xml")
    assert robot.measured_joint_names == ("l",)
    assert caplog.text == ""
    compiled = mujoco.MjModel.from_xml_string(HAND)
    data = mujoco.MjData(compiled)
    compiled.opt.timestep = 1e-4
    data.ctrl[:] = 1.0
    parameters = ParameterSet(robot)
    for step in range(2000):
        mujoco.mj_step(compiled, data)
        if step < 200 or step % 100:
            continue
        mujoco.mj_forward(compiled, data)
        motion = [array.copy()[None] for array in (data.qpos, data.qvel, data.qacc)]
        np.testing.assert_allclose(robot.apply_mimics(motion[0]), motion[0], atol=1e-3)
        rows = regressor(robot, *motion) @ parameters.values[: parameters.inertial]
        motor = 1.0 - 0.3 * data.qvel[0]
        assert rows[0, robot.joint_names.index("l")] == pytest.approx(motor, abs=2e-3)
    assert abs(data.qpos[0] - 0.2) > 0.05


@pytest.mark.parametrize(
    ("equality", "motors"),
    [
        ('joint1="l" joint2="r" active="false"', ""),
        ('joint1="l" joint2="r" polycoef="0 1 2 0 0"', ""),
        ('joint1="l" polycoef=".1 0 0 0 0"', ""),
        ('joint1="l" joint2="r"', '<motor joint="r"/>'),
    ],
)
def test_an_equality_that_is_not_a_mimic_joint_is_named(equality, motors, tmp_path, caplog):
    pair = 'name="pair" joint1="l" joint2="r" polycoef=".05 -2 0 0 0"'
    text = HAND.replace(pair, f'name="pair" {equality}').replace(
        "</actuator>", f"{motors}</actuator>"
    )
    (tmp_path / "hand.xml").write_text(text)
    robot = load_model(tmp_path / "hand.xml")
    assert robot.measured_joint_names == ("l", "r")
    assert "<equality> are ignored: pair;" in caplog.text


def test_joints_coupled_in_a_circle_are_read_once(tmp_path, caplog):
    again = '</equality><equality><joint name="again" joint1="l" joint2="t"/></equality>'
    (tmp_path / "hand.xml").write_text(HAND.replace("</equality>", again))
    assert load_model(tmp_path / "hand.xml").measured_joint_names == ("l",)
    assert "<equality> are ignored: " in caplog.text
    assert len(caplog.records) == 1
    assert "move independently, except that t follows l, r follows l" in caplog.text


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ('<mimic joint="none"/>', "joint 'master' mimics 'none', which is not a moving joint"),
        ('<mimic joint="master"/>', "joint 'master' mimics 'master', which follows itself"),
        ("<mimic/>", "joint 'master' mimics '', which is not a moving joint"),
        ('<mimic joint="near" offset="x"/>', "offset='x' is not a number"),
    ],
)
def test_a_mimic_without_a_leader_is_rejected(mimic, message, tmp_path):
    text = GRIPPER.replace(joint("master", "a", "b"), joint("master", "a", "b", mimic=mimic))
    (tmp_path / "robot.urdf").write_text(text)
    with pytest.raises(ModelError, match=message):
        load_model(tmp_path / "robot.urdf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="left"', 'name="left" gravcomp="0.5"', "gravcomp is ignored: left; the motors"),
        ("<option/>", '<option density="1000"/>', "density of <option> is ignored"),
        ("<option/>", '<option density="1" viscosity="1"/>', "density and viscosity of <option>"),
        ("<option/>", '<option><flag gravity="disable"/></option>', "flag gravity=.* is ignored"),
        ("<option/>", '<option density="0" viscosity="0"/>', ""),
        ('name="left"', 'name="left" gravcomp="0"', ""),
    ],
)
def test_forces_that_the_equation_of_motion_lacks_are_named(old, new, message, tmp_path, caplog):
    text = """<mujoco><option/><worldbody>
      <body name="left"><joint name="l"/><geom size=".1"/></body></worldbody></mujoco>"""
    (tmp_path / "robot.xml").write_text(text.replace(old, new))
    load_model(tmp_path / "robot.xml")
    assert len(caplog.records) == bool(message)
    assert re.search(message, caplog.text)


def test_equalities_tendons_and_massless_links_are_reported(tmp_path, caplog):
    text = """<mujoco><worldbody><body name="base"><freejoint/>
      <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
      <body name="left"><joint name="l"/><geom size=".1"/></body>
      <body name="right"><joint name="r"/><geom size=".1"/></body></body></worldbody>
      <equality><joint name="same" joint1="l" joint2="r" polycoef="0 1 1"/></equality>
      <tendon><fixed name="cord"><joint joint="l" coef="1"/></fixed></tendon></mujoco>"""
    (tmp_path / "robot.xml").write_text(text)
    load_model(tmp_path / "robot.xml")
    assert "robot.xml: <equality> and <tendon> are ignored: same, cord" in caplog.text
    assert len(caplog.records) == 1
    caplog.clear()
    (tmp_path / "robot.urdf").write_text(GRIPPER.replace(INERTIAL, "", 3))
    load_model(tmp_path / "robot.urdf", "fixed")
    assert "robot.urdf: links b, c move but have no mass" in caplog.text
    caplog.clear()
    (tmp_path / "robot.urdf").write_text(GRIPPER)
    load_model(tmp_path / "robot.urdf")
    assert caplog.text == ""
