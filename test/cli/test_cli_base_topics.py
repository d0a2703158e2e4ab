"""`symbid init` finds flags of contacts, measured poses and the odometry of a wheeled base."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from quadruped_log import FEET, quadruped_urdf, record_log, standing_log
from random_logs import LogPlan, random_streams, write_bag
from random_robots import random_robot
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.bags import bag_log, read_streams
from symbid_ros.messages.topics import Topic, TopicSelection
from symbid_ros.messages.types import BOOL, ODOMETRY, POSE, fill_stamp, odometry_layout, pose_layout
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import load_robot
from symbid_ros.offline.robot_file import load_robot_file
from symbid_ros.offline.robot_setup import contact_flags, inspect_robot


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return path


@pytest.fixture(scope="module")
def steps(urdf):
    log = standing_log(load_model(urdf), 5.0, 3, friction=0.0, steps=True)
    return {topic: columns for topic, columns in log.items() if not topic.endswith("/wrench")}


def test_flags_are_matched_to_feet(urdf):
    robot = load_model(urdf)
    others = [Topic("/LF_foot/enabled", BOOL), Topic("/charger/contact", BOOL)]
    for form in ("/contact/{}", "/{}_foot/in_contact", "/{}_touches_ground"):
        topics = {Topic(form.format(foot[:2].lower()), BOOL): foot for foot in FEET}
        found = contact_flags([*others, *topics], robot)
        assert found == {topic.name: foot for topic, foot in topics.items()}


def test_contacts_of_a_legged_robot_are_listed(urdf, steps, tmp_path):
    bag = record_log(steps, load_model(urdf), tmp_path / "bag")
    setup = inspect_robot(urdf, [bag])
    assert setup.base == "floating"
    assert sorted(setup.options["contact"]) == sorted(f"{foot}:point" for foot in FEET)
    assert sorted(setup.options["contact_flag"]) == sorted(
        f"/{foot}/contact:={foot}" for foot in FEET
    )
    setup.write(tmp_path / "robot.yaml")
    read = load_robot_file(tmp_path / "robot.yaml")
    assert read["contact_flag"] == setup.options["contact_flag"]
    assert "CHECK: true must mean that it touches." in (tmp_path / "robot.yaml").read_text()


def test_a_measured_pose_replaces_an_imu(urdf, steps, tmp_path):
    robot = load_model(urdf)
    joints = {topic: one for topic, one in steps.items() if topic == "/joint_states"}
    plain = read_streams([record_log(joints, robot, tmp_path / "plain")])
    records = pose_layout("map").records(len(plain.joints.stamp))
    fill_stamp(records, plain.joints.stamp)
    records["pose.orientation"][...] = [0, 0, 0, 1]
    further = [("/mocap/pose", POSE, plain.joints.stamp, records)]
    setup = inspect_robot(urdf, [write_bag(plain, tmp_path / "bag", further)])
    assert setup.base == "floating"
    assert setup.options["pose_topic"] == ["/mocap/pose"]
    setup.write(tmp_path / "robot.yaml")
    text = yaml.safe_load((tmp_path / "robot.yaml").read_text())
    assert text["/**"]["ros__parameters"]["pose_frame"] == "base"
    assert setup.log_options.pose_frame == "base"


@pytest.mark.parametrize(("tracked", "has_imu"), [("base", False), ("imu_link", True)])
def test_force_plates_in_world_axes_are_named_with_the_feet_on_them(
    urdf, tmp_path, tracked, has_imu
):
    robot = load_model(urdf)
    readings = standing_log(robot, 5.0, 3, friction=0.0, captured=True)
    place, turn = np.split(readings["/base/pose"]["pose"], [3], axis=1)
    frame, turn = robot.frame(tracked), Rotation.from_quat(turn)
    place, turn = place + turn.apply(frame.translation), turn * Rotation.from_matrix(frame.rotation)
    pose = {"time": readings["/base/pose"]["time"], "pose": np.hstack([place, turn.as_quat()])}
    log = {"/joint_states": readings["/joint_states"], "/base/pose": pose}
    if has_imu:
        log["/imu"] = readings["/imu"]
    standing = dict(zip((2, 0, 3), FEET, strict=False))
    plates = {f"/map/plate_{number}": foot for number, foot in standing.items()}
    log |= {topic: readings[f"/{foot}/plate"] for topic, foot in plates.items()}
    # The force of two feet together passes between them.
    both = [readings[f"/{foot}/plate"]["wrench"] for foot in FEET[2:]]
    log["/map/plate_3"] = readings[f"/{FEET[2]}/plate"] | {"wrench": sum(both)}
    bag = record_log(log, robot, tmp_path / "bag")
    setup = inspect_robot(urdf, [bag])
    assert setup.options["pose_topic"] == ["/base/pose"]
    assert setup.options["pose_frame"] == [tracked]
    assert setup.options["wrench_topic"] == [f"/map/plate_{number}" for number in (0, 2, 3)]
    del plates["/map/plate_3"]
    assert dict(one.split(":=") for one in setup.options["plate_link"]) == plates
    assert "rename_frame" not in setup.options
    open_ = [line for line in setup.comments["plate_link"] if "/map/plate_3" in line]
    assert len(open_) == 1
    assert open_[0].startswith("CHECK: ")
    setup.write(tmp_path / "robot.yaml")
    read = load_robot_file(tmp_path / "robot.yaml")
    assert read["plate_link"] == setup.options["plate_link"]


def test_legs_without_an_imu_leave_the_base_open(symbid_here, urdf, steps, tmp_path):
    """A robot with legs hardly ever has a fixed base."""
    joints = {topic: one for topic, one in steps.items() if topic == "/joint_states"}
    bag = record_log(joints, load_model(urdf), tmp_path / "bag")
    out = tmp_path / "robot.yaml"
    ended = symbid_here("init", "--model", urdf, "--bag", bag, "--out", out)
    assert (ended.returncode, ended.stderr) == (1, "")
    lines = out.read_text().splitlines()
    asked = lines[lines.index("    base: fixed") - 1]
    assert asked.startswith("    # CHECK: the model has legs (")
    assert "no IMU and no pose of the base" in asked
    # Forces that move the base would look like efforts in other units.
    found = load_robot_file(out)
    assert not {"effort_scale", "drive_gain", "flip_joint", "gravity"} & set(found)
    # Who says that the base is fixed is not asked.
    assert not inspect_robot(urdf, [bag], "fixed").has_open_question


def test_feet_without_sensors_are_named_instead_of_units(urdf, tmp_path):
    model = load_model(urdf)
    log = standing_log(model, 20.0, 3)
    for foot in FEET[:2]:
        log.pop(f"/{foot}/wrench")
    setup = inspect_robot(urdf, [record_log(log, model, tmp_path / "bag")])
    assert any("the log has no wrench at" in line for line in setup.comments[""])
    assert not {"effort_scale", "drive_gain"} & set(setup.options)


def rolling_arm():
    """Return an arm whose last joint is a wheel, and streams in which it rolls."""
    arm = random_robot(3, links=3, floating=False, wrench_frames=0)
    *others, last = arm.joints
    wheel = replace(last, name="front_Wheel_joint", kind="revolute", lower=-np.inf, upper=np.inf)
    arm = replace(arm, joints=(*others, wheel))
    streams = random_streams(arm, LogPlan(rate=100.0, count=2000), 1)
    joints = streams.joints
    seconds = (joints.stamp - joints.stamp[0]) * 1e-9
    position, velocity = joints.position.copy(), joints.velocity.copy()
    position[:, -1] += 4.0 * seconds
    velocity[:, -1] += 4.0
    return arm, replace(streams, joints=replace(joints, position=position, velocity=velocity))


def test_wheels_that_roll_on_the_ground_are_named(tmp_path, caplog):
    arm, streams = rolling_arm()
    (tmp_path / "arm.urdf").write_text(urdf_text(arm))
    bag = write_bag(streams, tmp_path / "bag")
    setup = inspect_robot(tmp_path / "arm.urdf", [bag])
    (note,) = setup.comments["wheel_topic"]
    assert "on the ground: front_Wheel_joint;" in note
    assert "give wheel_topic" in note
    for robot, is_named in ((arm, True), (arm_without_wheel(arm), False)):
        caplog.clear()
        sy.identify(robot, sy.load_bag(bag, robot), unchecked=True, no_holdout=True)
        assert ("on the ground: front_Wheel_joint;" in caplog.text) is is_named


def arm_without_wheel(arm):
    """Return the arm with an end of its last joint's range, far away."""
    *others, last = arm.joints
    return replace(arm, joints=(*others, replace(last, lower=-500.0, upper=500.0)))


def test_the_odometry_of_a_wheeled_base_is_listed(tmp_path):
    arm = random_robot(3, links=3, floating=False, wrench_frames=0)
    (tmp_path / "arm.urdf").write_text(urdf_text(arm))
    streams = random_streams(arm, LogPlan(rate=100.0, count=400), 1)
    stamp = streams.joints.stamp
    records = odometry_layout("odom", "base_link").records(len(stamp))
    fill_stamp(records, stamp)
    bag = write_bag(streams, tmp_path / "bag", [("/odom", ODOMETRY, stamp, records)])
    setup = inspect_robot(tmp_path / "arm.urdf", [bag])
    assert setup.base == "fixed"
    assert setup.options["wheel_topic"] == ["/odom"]
    log = bag_log([bag], arm, TopicSelection.of(setup.log_options))
    assert log.streams().driving == ()


LINK = (
    '<link name="{0}"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" '
    'ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
    '<axis xyz="0 1 0"/></joint>'
)


@pytest.mark.parametrize(
    ("parents", "pose", "is_floating"),
    [
        (("foot", "arm"), "", False),
        (("foot", "arm"), "/mocap/pose", True),
        (("foot", "arm"), "/ground_truth/pose", False),  # of a simulation
        (("foot", "foot"), "", True),  # two limbs, as of a robot that stands
    ],
)
def test_the_base_of_an_arm_without_motion_sensors_counts_as_fixed(
    parents, pose, is_floating, tmp_path, caplog
):
    links = "".join(LINK.format(name) for name in ("foot", "arm", "hand"))
    joints = JOINT.format("first", parents[0], "arm") + JOINT.format("second", parents[1], "hand")
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(f'<robot name="arm">{links}{joints}</robot>')
    streams = random_streams(load_model(urdf, "fixed"), LogPlan(rate=100.0, count=100), 1)
    records = pose_layout("map").records(len(streams.joints.stamp))
    fill_stamp(records, streams.joints.stamp)
    further = [(pose, POSE, streams.joints.stamp, records)] if pose else []
    bag = write_bag(streams, tmp_path / "bag", further)
    assert load_robot(urdf, "auto", [bag]).floating == is_floating
    assert ("its base counts as fixed" in caplog.text) != is_floating
    assert load_robot(urdf, "floating", [bag]).floating
