"""A wrist force/torque sensor divides a link; without sensors the robot is what it was."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import ModelError
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import sensor_names, with_wrist_sensors, without_wrist_sensors

ARM = """<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><mass value="3"/><origin xyz=".1 0 .2"/>
    <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
  <link name="hand"><inertial><mass value="1"/><origin xyz="0 .1 0"/>
    <inertia ixx=".02" ixy="0" ixz="0" iyy=".02" iyz="0" izz=".02"/></inertial></link>
  <link name="ft"><inertial><mass value=".3"/><origin xyz="0 0 .03"/>
    <inertia ixx=".002" ixy="0" ixz="0" iyy=".002" iyz="0" izz=".001"/></inertial></link>
  <link name="finger"><inertial><mass value=".2"/><origin xyz="0 .02 .03"/>
    <inertia ixx=".001" ixy="0" ixz="0" iyy=".001" iyz="0" izz=".001"/></inertial></link>
  <link name="bolt"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="90" velocity="2"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="hand"/><axis xyz="1 0 0"/>
    <origin xyz="0 0 .4"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="c" type="fixed"><parent link="hand"/><child link="ft"/>
    <origin xyz=".02 .01 .1" rpy=".3 -.2 .9"/></joint>
  <joint name="d" type="prismatic"><parent link="ft"/><child link="finger"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 .1"/><limit lower="-.1" upper=".1" effort="20" velocity="2"/></joint>
  <joint name="e" type="fixed"><parent link="hand"/><child link="bolt"/>
    <origin xyz="0 .05 .1" rpy="0 .4 0"/></joint>
</robot>
"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.urdf"
    path.write_text(ARM)
    return load_model(path, "fixed")


def rows(model):
    parameters = ParameterSet(model)
    return equation_of_motion(parameters, random_motions(model, 7)).K @ parameters.values


@pytest.mark.parametrize("sensor", ["ft", "-ft", "bolt:ft", "bolt", "hand:hand", "upper:tool"])
def test_a_divided_link_weighs_the_same_and_is_put_together_again(arm, sensor):
    divided = with_wrist_sensors(arm, [sensor])
    assert divided.measured_joint_names == arm.joint_names
    assert divided.phi[:, 0].sum() == pytest.approx(arm.phi[:, 0].sum())
    # Both are one tree: equal motion needs equal efforts of the moving joints.
    again = without_wrist_sensors(divided)
    assert (again.link_names, again.joint_names) == (arm.link_names, arm.joint_names)
    np.testing.assert_allclose(rows(again), rows(arm), rtol=1e-12, atol=1e-12)
    assert {one.name for one in again.frames} >= {one.name for one in arm.frames}
    for frame in arm.frames:
        np.testing.assert_allclose(again.frame(frame.name).translation, frame.translation)
        np.testing.assert_allclose(again.frame(frame.name).rotation, frame.rotation, atol=1e-12)
    assert with_wrist_sensors(arm, sensor_names(divided)).link_names == divided.link_names


def test_the_wrench_through_a_sensor_is_the_one_that_a_simulator_reads(arm):
    divided = with_wrist_sensors(arm, ["bolt:ft"])
    place = divided.wrist_sensors["bolt"]
    motion = random_motions(divided, 5)
    parameters = ParameterSet(divided)
    found = (equation_of_motion(parameters, motion).K @ parameters.values)[:, place]
    # In MuJoCo the sensor is a site of the first body beyond it.
    bolt, beyond = arm.frame("bolt"), arm.frame("ft")
    quaternion, position = np.empty(4), beyond.rotation.T @ (bolt.translation - beyond.translation)
    mujoco.mju_mat2Quat(quaternion, (beyond.rotation.T @ bolt.rotation).ravel())
    spec = mujoco.MjSpec.from_string(ARM)
    spec.compiler.fusestatic = False
    spec.body("ft").add_site(name="s", pos=position, quat=quaternion)
    for kind in (mujoco.mjtSensor.mjSENS_TORQUE, mujoco.mjtSensor.mjSENS_FORCE):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="s")
    m = spec.compile()
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    d = mujoco.MjData(m)
    for index in range(len(motion)):
        moving = list(divided.moving_joints)
        d.qpos[:] = motion.position[index, moving]
        d.qvel[:] = motion.velocity[index, moving]
        d.qacc[:] = motion.acceleration[index, moving]
        mujoco.mj_inverse(m, d)
        # MuJoCo reads the wrench of the robot on what lies beyond, an effort of the joints.
        np.testing.assert_allclose(found[index], d.sensordata, rtol=1e-6, atol=1e-6)


def test_exports_hold_the_robot_as_one_tree_and_the_user_file_its_own_links(arm, tmp_path):
    divided = with_wrist_sensors(arm, ["ft"])
    phi = divided.phi.copy()
    phi[divided.link_names.index("ft")] *= 2
    heavier = divided.with_phi(phi)
    (tmp_path / "own.urdf").write_text(urdf_text(heavier, Path(arm.source)))
    (tmp_path / "tree.urdf").write_text(urdf_text(heavier))
    (tmp_path / "tree.xml").write_text(mjcf_text(heavier))
    expected = without_wrist_sensors(heavier)
    for name in ("own.urdf", "tree.urdf", "tree.xml"):
        read = load_model(tmp_path / name, "fixed")
        np.testing.assert_allclose(read.phi[-3:], expected.phi[-3:], atol=1e-9)
    own = load_model(tmp_path / "own.urdf")
    (body,) = (one for one in own.bodies if one.name == "ft")
    assert body.phi[0] == pytest.approx(0.6)


def test_the_frames_that_a_message_offers_are_those_of_the_model(arm):
    with pytest.raises(ModelError) as caught:
        with_wrist_sensors(arm, ["ft"]).frame("nothing")
    assert "ft" in str(caught.value)
    assert "/moment_x" not in str(caught.value)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (["nothing"], "`wrist_sensor`: .* no frame or link 'nothing'"),
        (["ft:upper"], "link upper is not attached to hand"),
        (["base:base"], "not attached"),
        (["ft", "ft:ft"], "given twice"),
    ],
)
def test_a_sensor_that_does_not_fit_the_model_is_refused(arm, sensors, message):
    with pytest.raises(ModelError, match=message):
        with_wrist_sensors(arm, sensors)
