"""Friction and armature of joints: read from both formats, identified, written back."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from random_robots import CONFIG, random_robot, with_drives

from symbid_ros.choices import TERMS as ALL_TERMS
from symbid_ros.errors import ModelError
from symbid_ros.model.export_mjcf import mjcf_text, replaced_values
from symbid_ros.model.export_urdf import unwritten, urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet, terms_in

# Without Stribeck friction, which neither a model file nor MuJoCo has.
TERMS = ALL_TERMS[:4]

MJCF = """<mujoco model="arm">
  <default><default class="drive"><joint damping="0.30" armature="0.010"/></default></default>
  <worldbody>
    <body name="base"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <body name="arm">
        <joint name="knee" class="drive" frictionloss="0.50"/>
        <joint name="lift" type="slide" axis="1 0 0"/>
        <inertial pos=".1 .2 .3" mass="2" diaginertia=".1 .2 .25"/>
        <body name="hand"><joint name="wrist" class="drive" damping="0.700" armature="0"/>
          <inertial pos="0 0 .1" mass=".5" diaginertia=".01 .01 .01"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="knee" joint="knee"/></actuator>
</mujoco>
"""

URDF = """<robot name="arm"><link name="base"/><link name="arm"/><link name="hand"/>
  <joint name="knee" type="continuous"><parent link="base"/><child link="arm"/>
    <dynamics damping="0.30" friction="0.50"/></joint>
  <joint name="lift" type="prismatic"><parent link="arm"/><child link="hand"/>
    <limit lower="-1" upper="1" effort="5" velocity="1"/>{}</joint>
</robot>
"""


def drives(model):
    """Return (J, 3) damping, friction loss and armature."""
    return np.array([(j.damping, j.friction_loss, j.armature) for j in model.joints])


def load_text(text, path):
    path.write_text(text)
    return load_model(path)


@pytest.fixture
def arm(tmp_path):
    return load_text(MJCF, tmp_path / "arm.xml")


@pytest.fixture
def urdf_arm(tmp_path):
    return load_text(URDF.format(""), tmp_path / "arm.urdf")


def test_an_mjcf_gives_all_three_terms_also_through_classes(arm):
    assert arm.joint_names == ("knee", "lift", "wrist")
    np.testing.assert_array_equal(drives(arm), [[0.3, 0.5, 0.01], [0, 0, 0], [0.7, 0, 0]])


def test_a_urdf_gives_friction_and_a_missing_value_is_zero(urdf_arm):
    np.testing.assert_array_equal(drives(urdf_arm), [[0.3, 0.5, 0], [0, 0, 0]])


@pytest.mark.parametrize("value", ["nan", "inf", "much"])
def test_invalid_friction_is_rejected(value, tmp_path):
    text = URDF.format(f'<dynamics damping="{value}"/>')
    with pytest.raises(ModelError, match=r"arm\.urdf: .*(not finite|not a number)"):
        load_text(text, tmp_path / "arm.urdf")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("floating", [True, False])
def test_joint_terms_of_random_trees_survive_both_formats(seed, floating, tmp_path):
    robot = random_robot(seed, links=3 + seed, floating=floating)
    robot = with_drives(robot, np.random.default_rng(seed))
    again = load_text(mjcf_text(robot), tmp_path / "robot.xml")
    np.testing.assert_array_equal(drives(again), drives(robot))
    urdf = load_text(urdf_text(robot), tmp_path / "robot.urdf")
    np.testing.assert_array_equal(drives(urdf)[:, :2], drives(robot)[:, :2])


def test_terms_that_a_urdf_cannot_hold_are_listed(arm, urdf_arm):
    assert "armature, not part of a URDF: knee 0.01 " in urdf_text(arm)
    knee = replace(arm.joints[-1], armature=-0.02, damping=-0.03)
    negative = replace(arm, joints=(*arm.joints[:-1], knee))
    zeros, armature = unwritten(negative)
    assert zeros == f"negative, written as zero: {knee.name} damping -0.03"
    assert f"{knee.name} -0.02" in armature
    assert "armature" not in urdf_text(urdf_arm)


def test_parameters_of_joints_follow_the_links(arm):
    parameters = ParameterSet(arm, ("offset", "armature", "viscous", "coulomb"))
    assert parameters.terms == TERMS
    assert parameters == ParameterSet(arm, TERMS)
    names = [f"{joint}/{term}" for term in TERMS for joint in arm.joint_names]
    assert parameters.names[30:] == tuple(names)
    assert parameters.units[30:] == (
        *("Nm s/rad", "N s/m", "Nm s/rad"),
        *("Nm", "N", "Nm"),
        *("kg m^2", "kg", "kg m^2"),
        *("Nm", "N", "Nm"),
    )
    stated = np.r_[drives(arm).T.ravel(), np.zeros(3)]
    np.testing.assert_array_equal(parameters.values[30:], stated)
    assert parameters.term_columns["armature"] == slice(36, 39)
    assert terms_in(parameters.names) == TERMS
    assert terms_in(parameters.names[:30]) == ()


def test_only_terms_in_use_have_columns_and_unknown_terms_are_rejected(arm):
    parameters = ParameterSet(arm, ("offset", "coulomb"))
    assert parameters.term_columns == {"coulomb": slice(30, 33), "offset": slice(33, 36)}
    assert len(ParameterSet(arm)) == 30
    with pytest.raises(ModelError, match="no term 'inertance'; choose from viscous, coulomb"):
        ParameterSet(arm, ("viscous", "inertance"))


def test_stated_terms_that_are_not_identified_are_known(arm):
    assert ParameterSet(arm, TERMS).known_values == {}
    stated = {"knee/viscous": 0.3, "wrist/viscous": 0.7, "knee/coulomb": 0.5, "knee/armature": 0.01}
    assert ParameterSet(arm).known_values == stated
    frictions = ParameterSet(arm, ("viscous", "coulomb"))
    assert frictions.known_values == {"knee/armature": 0.01}
    others = frictions.with_known_values({"lift/armature": 0.5, "knee/viscous": 9.0})
    assert others.known_values == {"lift/armature": 0.5}
    np.testing.assert_array_equal(others.values, frictions.values)
    assert ParameterSet(load_model(CONFIG / "symbitron.xml")).known_values == {}


@pytest.mark.parametrize("terms", [(), ("viscous",), ("coulomb", "offset"), TERMS])
def test_applied_values_become_the_robots_and_other_terms_stay(arm, terms):
    parameters = ParameterSet(arm, terms)
    changed = parameters.values + np.arange(len(parameters)) / 7
    robot = parameters.apply(changed)
    stated = np.array(["/offset" not in name for name in parameters.names])
    np.testing.assert_array_equal(ParameterSet(robot, terms).values[stated], changed[stated])
    for column, term in enumerate(("viscous", "coulomb", "armature")):
        if term not in terms:
            np.testing.assert_array_equal(drives(robot)[:, column], drives(arm)[:, column])


def test_identified_terms_are_written_into_the_users_mjcf(arm, tmp_path):
    parameters = ParameterSet(arm, ("viscous", "armature"))
    values = parameters.values.copy()
    values[parameters.term_columns["viscous"]] = 0.3, 1.25, 2.5
    values[parameters.term_columns["armature"]] = 0.02, 0.03, 0.0
    text = mjcf_text(parameters.apply(values), tmp_path / "arm.xml", tmp_path)
    again = load_text(text, tmp_path / "identified.xml")
    expected = [[0.3, 0.5, 0.02], [1.25, 0, 0.03], [2.5, 0, 0]]
    np.testing.assert_array_equal(drives(again), expected)
    # The file's own wording stays wherever its value does.
    joint = {element.get("name"): element.attrib for element in ET.fromstring(text).iter("joint")}
    assert "damping" not in joint["knee"]
    assert joint["knee"]["frictionloss"] == "0.50"
    assert joint["wrist"]["armature"] == "0"
    assert '<joint damping="0.30" armature="0.010"/>' in text


def test_identified_terms_are_written_into_the_users_urdf(urdf_arm, tmp_path):
    parameters = ParameterSet(urdf_arm, ("viscous", "coulomb"))
    values = parameters.values.copy()
    values[-4:] = 0.3, 4.0, 0.75, 0.0
    text = urdf_text(parameters.apply(values), tmp_path / "arm.urdf")
    again = load_text(text, tmp_path / "identified.urdf")
    np.testing.assert_array_equal(drives(again), [[0.3, 0.75, 0], [4.0, 0, 0]])
    assert 'damping="0.30"' in text
    np.testing.assert_array_equal(
        drives(load_text(urdf_text(urdf_arm, tmp_path / "arm.urdf"), tmp_path / "same.urdf")),
        drives(urdf_arm),
    )


def test_negligible_friction_is_not_written(arm, urdf_arm, tmp_path):
    for model, write, file in ((arm, mjcf_text, "arm.xml"), (urdf_arm, urdf_text, "arm.urdf")):
        lift = replace(model.joints[1], damping=8.9e-17, friction_loss=3e-12, armature=2e-16)
        robot = replace(model, joints=(model.joints[0], lift, *model.joints[2:]))
        own = (
            write(robot, tmp_path / file)
            if write is urdf_text
            else write(robot, tmp_path / file, tmp_path)
        )
        assert own == (tmp_path / file).read_text()
        np.testing.assert_array_equal(
            drives(load_text(write(robot), tmp_path / f"again_{file}"))[1], 0.0
        )


@pytest.mark.parametrize("own", [True, False])
def test_negative_terms_are_written_as_zero_and_named(own, arm, urdf_arm, tmp_path):
    for model, write, file in ((arm, mjcf_text, "arm.xml"), (urdf_arm, urdf_text, "arm.urdf")):
        knee = replace(model.joints[0], damping=-0.2, friction_loss=-0.1)
        robot = replace(model, joints=(knee, *model.joints[1:]))
        text = write(robot, tmp_path / file if own else None, comment="first")
        remark = "negative, written as zero: knee damping -0.2, knee friction -0.1"
        assert (f"first; {remark} " in text) == (not own)  # a user's own file gets no comment
        assert remark in unwritten(robot)[0]
        assert remark in replaced_values(robot)[-1]
        again = load_text(text, tmp_path / f"again_{file}")
        expected = drives(model)
        expected[0, :2] = 0.0
        np.testing.assert_array_equal(drives(again), expected)


def test_an_mjcf_with_written_drives_is_the_same_in_mujoco(tmp_path):
    robot = load_model(CONFIG / "symbitron.xml")
    robot = with_drives(robot, np.random.default_rng(1))
    (tmp_path / "symbitron.xml").write_text(mjcf_text(robot, CONFIG / "symbitron.xml", tmp_path))
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "symbitron.xml"))
    fields = compiled.dof_damping, compiled.dof_frictionloss, compiled.dof_armature
    np.testing.assert_array_equal(np.transpose(fields)[:6], 0)
    np.testing.assert_array_equal(np.transpose(fields)[6:], drives(robot))
