"""Links beyond joints that do not move are parts of the links that carry them."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.held_joints import with_held_joints, without_held_joints
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Mimic

HAND = """<robot name="hand">
  <link name="base"/>
  <link name="arm"><inertial><mass value="3"/><origin xyz=".1 0 .2"/>
    <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
  <link name="palm"><inertial><mass value="1"/><origin xyz="0 .1 0"/>
    <inertia ixx=".02" ixy="0" ixz="0" iyy=".02" iyz="0" izz=".02"/></inertial></link>
  <link name="finger"><inertial><mass value=".3"/><origin xyz="0 0 .03"/>
    <inertia ixx=".002" ixy="0" ixz="0" iyy=".002" iyz="0" izz=".001"/></inertial></link>
  <joint name="a" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="90" velocity="2"/></joint>
  <joint name="b" type="{kind}"><parent link="arm"/><child link="palm"/><axis xyz="0 0 1"/>
    <origin xyz="0 0 .4" rpy="0 0 {turn}"/><limit lower="-2" upper="2" effort="5" velocity="2"/>
  </joint>
  <joint name="c" type="revolute"><parent link="palm"/><child link="finger"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 .1"/><limit lower="-2" upper="2" effort="2" velocity="2"/></joint>
</robot>
"""


def held_positions(model, rng):
    """Return positions of about half of a robot's joints."""
    return {name: float(rng.uniform(-1, 1)) for name in model.joint_names if rng.random() < 0.5}


def forces(model, samples):
    parameters = ParameterSet(model)
    return equation_of_motion(parameters, samples).K @ parameters.values


@pytest.mark.parametrize("seed", range(6))
def test_it_needs_the_forces_of_the_robot_whose_joints_rest(seed):
    model, rng = random_robot(seed, links=9), np.random.default_rng(seed)
    positions = held_positions(model, rng)
    held = np.isin(model.joint_names, list(positions))
    samples = random_motions(model, 5)
    position, velocity, acceleration = (
        getattr(samples, name).copy() for name in ("position", "velocity", "acceleration")
    )
    position[:, held] = [positions[name] for name in np.array(model.joint_names)[held]]
    velocity[:, held] = acceleration[:, held] = 0.0
    resting = replace(samples, position=position, velocity=velocity, acceleration=acceleration)
    fields = "position", "velocity", "acceleration", "effort"
    some = {name: getattr(resting, name)[:, ~held] for name in fields}
    rigid = with_held_joints(model, positions)
    assert rigid.joint_names == tuple(np.array(model.joint_names)[~held])
    kept = np.append(np.ones(6, bool), ~held)
    np.testing.assert_allclose(
        forces(rigid, replace(resting, **some)), forces(model, resting)[:, kept], atol=1e-10
    )


def test_it_is_the_robot_of_a_file_with_a_fixed_joint(tmp_path):
    moving, fixed = tmp_path / "moving.urdf", tmp_path / "fixed.urdf"
    moving.write_text(HAND.format(kind="revolute", turn=0.2))
    fixed.write_text(HAND.format(kind="fixed", turn=0.2 + 0.7))
    rigid = with_held_joints(load_model(moving, "fixed"), {"b": 0.7})
    other = load_model(fixed, "fixed")
    assert rigid.link_names == other.link_names
    np.testing.assert_allclose(rigid.phi, other.phi, atol=1e-12)
    for one, two in zip(
        (*rigid.joints, *rigid.frames), (*other.joints, *other.frames), strict=True
    ):
        assert one.name == two.name
        np.testing.assert_allclose(one.rotation, two.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, two.translation, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_changes_of_a_rigid_link_are_those_of_its_parts(seed):
    model, rng = random_robot(seed, links=9), np.random.default_rng(seed)
    positions = held_positions(model, rng)
    rigid = with_held_joints(model, positions)
    phi = rigid.phi * rng.uniform(0.8, 1.2, (len(rigid.links), 1))
    joints = tuple(replace(one, damping=rng.uniform(1, 2)) for one in rigid.joints)
    changed = replace(rigid.with_phi(phi), joints=joints)
    found = without_held_joints(changed)
    assert found.joint_names == model.joint_names
    assert all(is_consistent(one) for one in found.phi)
    np.testing.assert_allclose(with_held_joints(found, positions).phi, phi, rtol=1e-9, atol=1e-12)
    damping = {joint.name: joint.damping for joint in joints}
    assert all(one.damping == damping.get(one.name, 0.0) for one in found.joints)


def test_an_unchanged_robot_stays_as_it_is():
    model = random_robot(3)
    found = without_held_joints(with_held_joints(model, {"joint_2": 0.4, "joint_5": -0.2}))
    np.testing.assert_array_equal(found.phi, model.phi)


def test_a_joint_that_follows_a_held_one_is_held_where_it_follows():
    model = random_robot(1, links=5)
    leader, last = model.joint_names[1], model.joint_names[3]
    follower = replace(model.joints[3], mimic=Mimic(1, 2.0, 0.1), effort=0.0)
    following = replace(model, joints=(*model.joints[:3], follower))
    rigid = with_held_joints(following, {leader: 0.3})
    both = with_held_joints(model, {leader: 0.3, last: 0.7})
    assert rigid.joint_names == both.joint_names == (model.joint_names[0], model.joint_names[2])
    np.testing.assert_allclose(rigid.phi, both.phi)
