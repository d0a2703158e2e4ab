"""A hand whose many joints a log lacks is a rigid part of the link that carries it."""

import logging

import numpy as np
import pytest
from arm_log import arm_streams

import symbid_ros as sy
from symbid_ros.bags import BagWriter
from symbid_ros.identification.log_reading import with_rigid_joints
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.result_files import load_estimated_model
from symbid_ros.messages.types import JOINT_STATE, fill_message, joint_state_layout

FINGERS = 8
LINK = """<link name="{name}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial>
</link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{place}" rpy="0.3 0 {turn}"/><axis xyz="{axis}"/>
<limit lower="-2" upper="2" effort="{effort}" velocity="3"/></joint>"""


def urdf(path, *, fingers):
    """Write an arm of three joints with a hand of many fingers."""
    parts, parent = ['<robot name="arm"><link name="base"/>'], "base"
    for index, axis in enumerate(("0 0 1", "0 1 0", "0 1 0")):
        name = f"arm_{index}"
        size = {"mass": 3 - index, "com": "0 0.02 0.15", "inertia": 0.03}
        parts.append(LINK.format(name=name, **size))
        place = {"place": "0 0 0.3", "turn": 0, "axis": axis, "effort": 50}
        parts.append(
            JOINT.format(name=f"a{index}", kind="revolute", parent=parent, child=name, **place)
        )
        parent = name
    for index in range(FINGERS):
        name = f"finger_{index}"
        parts.append(LINK.format(name=name, mass=0.05, com="0 0 0.02", inertia=1e-4))
        place = {"place": "0.05 0 0.3", "turn": 0.7 * index, "axis": "1 0 0", "effort": 1}
        parts.append(
            JOINT.format(name=f"f{index}", kind=fingers, parent=parent, child=name, **place)
        )
    path.write_text("\n".join((*parts, "</robot>")))
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A model file with fingers that move, one with fingers that do not, and a bag of the arm."""
    folder = tmp_path_factory.mktemp("hand")
    moving = urdf(folder / "moving.urdf", fingers="revolute")
    fixed = urdf(folder / "fixed.urdf", fingers="fixed")
    joints = arm_streams(sy.load_model(fixed, "fixed"), 20.0).joints
    layout = joint_state_layout(joints.names)
    records = layout.records(len(joints.stamp))
    fields = {name: getattr(joints, name) for name in ("position", "velocity", "effort")}
    fill_message(records, joints.stamp, **fields)
    with BagWriter(folder / "bag") as bag:
        channel = bag.add_topic("/joint_states", JOINT_STATE)
        for stamp, record in zip(joints.stamp.tolist(), records, strict=True):
            bag.write(channel, stamp, record.tobytes())
    return moving, fixed, folder / "bag"


def identified(model, bag, **options):
    robot = sy.load_model(model, "fixed")
    return sy.identify(robot, sy.load_bag(bag, robot), joint_terms=("none",), **options)


@pytest.fixture(scope="module")
def found(files):
    moving, _, bag = files
    return identified(moving, bag)


def test_it_is_identified_like_a_hand_without_joints(files, found):
    _, fixed, bag = files
    other = identified(fixed, bag)
    assert found.estimate.names == other.estimate.names
    difference = np.abs(found.estimate.value - other.estimate.value) / other.estimate.std
    assert difference.max() < 1e-6
    np.testing.assert_allclose(found.estimate.std, other.estimate.std, rtol=1e-6)
    assert found.estimate.held_joints == {f"f{index}": 0.0 for index in range(FINGERS)}
    assert any("8 joints that the log lacks are rigid" in one for one in found.estimate.remarks)


def test_the_robot_found_has_all_joints(files, found):
    moving, _, bag = files
    robot = sy.load_model(moving, "fixed")
    assert found.robot.joint_names == robot.joint_names
    assert found.robot.phi[:, 0].sum() == pytest.approx(
        sum(found.parameters[f"arm_{index}/m"].value for index in range(3))
    )
    assert found.predict(sy.load_bag(bag, robot)).predicted.shape[1] == 3


def test_a_saved_result_is_read_with_the_same_rigid_joints(files, found, tmp_path, caplog):
    moving, _, _ = files
    with caplog.at_level(logging.ERROR):
        found.save(tmp_path / "result")
    for name in ("model.urdf", "model.xml"):
        saved = sy.load_model(tmp_path / "result" / name, "fixed")
        np.testing.assert_allclose(saved.phi, found.robot.phi, rtol=1e-6, atol=1e-9)
    read = load_estimated_model(tmp_path / "result", sy.load_model(moving, "fixed"))
    assert read.parameters.names == found.estimate.names
    np.testing.assert_array_equal(read.values, found.estimate.value)


@pytest.mark.parametrize(
    "options",
    [{"drive_gain": ("f0",)}, {"payload": ("finger_0,0.1",)}, {"effort_side": ("f3=link",)}],
)
def test_joints_that_options_name_are_not_rigid(files, options):
    moving, _, bag = files
    robot = sy.load_model(moving, "fixed")
    log = sy.load_bag(bag, robot)
    assert with_rigid_joints(robot, log, IdentifyOptions()).dof == 3
    assert with_rigid_joints(robot, log, IdentifyOptions(**options)) is robot
