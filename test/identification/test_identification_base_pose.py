"""A robot tracked by motion capture on force plates in world axes, without an IMU."""

import numpy as np
import pytest
from live_feed import feed_of
from quadruped_log import FEET, inaccurate, load_quadruped, standing_log
from scipy.spatial.transform import Rotation

from symbid_ros.bags import BagWriter
from symbid_ros.errors import DataError, ModelError
from symbid_ros.identification.api import identify
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.messages.types import (
    JOINT_STATE,
    ODOMETRY,
    POSE,
    WRENCH,
    fill_message,
    fill_wrench,
    joint_state_layout,
    odometry_layout,
    pose_layout,
    wrench_layout,
)
from symbid_ros.offline.bags import load_bag
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.signals.base_pose import PoseStream
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import WrenchStream

FAST = {"joint_terms": ("none",), "no_holdout": True, "window": 0.321}
PLATES = {"plate_link": tuple(f"/{foot}/wrench:={foot}" for foot in FEET)}


@pytest.fixture(scope="module")
def true_robot(tmp_path_factory):
    return load_quadruped(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def robot(true_robot):
    return inaccurate(true_robot)


@pytest.fixture(scope="module")
def readings(true_robot):
    return standing_log(true_robot, 14.0, 3, friction=0.0, captured=True)


@pytest.fixture(scope="module")
def found(robot, readings):
    joints = readings["/joint_states"]
    log = Log.from_arrays(
        robot,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"],
        poses={"base": readings["/base/pose"]["pose"]},
        wrenches={f"world@{foot}": readings[f"/{foot}/plate"]["wrench"] for foot in FEET},
    )
    return identify(robot, log, **FAST)


def record(readings, robot, path, *, kind=ODOMETRY, child="base"):
    """Write a bag with the pose of the base, and wrenches in the frame of the pose."""
    stamp = 10**18 + np.round(readings["/joint_states"]["time"] * 1e9).astype(np.int64)
    joints = {name: readings["/joint_states"][name] for name in ("position", "velocity", "effort")}
    pose = readings["/base/pose"]["pose"]
    if kind == ODOMETRY:
        layout, part = odometry_layout("map", child), "pose.pose"
    else:
        layout, part = pose_layout("map"), "pose"
    topics = [("/joint_states", JOINT_STATE, joint_state_layout(robot.joint_names), joints)]
    topics.append(
        (
            "/tracker",
            kind,
            layout,
            {f"{part}.position": pose[:, :3], f"{part}.orientation": pose[:, 3:]},
        )
    )
    with BagWriter(path) as writer:
        messages = []
        for topic, msgtype, layout, columns in topics:
            records = layout.records(len(stamp))
            fill_message(records, stamp, **columns)
            channel = writer.add_topic(topic, msgtype)
            messages += zip(stamp.tolist(), [channel] * len(stamp), records, strict=True)
        for foot in FEET:
            records = wrench_layout("map").records(len(stamp))
            fill_wrench(records, stamp, readings[f"/{foot}/plate"]["wrench"])
            channel = writer.add_topic(f"/{foot}/wrench", WRENCH)
            messages += zip(stamp.tolist(), [channel] * len(stamp), records, strict=True)
        for when, channel, one in sorted(messages, key=lambda each: each[0]):
            writer.write(channel, when, one.tobytes())
    return path


def test_a_pose_gives_what_an_imu_would_read():
    time = np.arange(1000) / 100.0
    turn = np.stack([0.4 * np.sin(2 * time), 0.3 * np.cos(1.5 * time), 0.5 * time], axis=1)
    rotation = Rotation.from_rotvec(turn)
    place = np.stack([0.3 * np.sin(3 * time), 0.2 * np.cos(2 * time), 0.1 * np.sin(time)], axis=1)
    quaternion = rotation.as_quat() * np.where(time < 5, 1.0, -1.0)[:, None]
    stamp = np.round(time * 1e9).astype(np.int64)
    pose = PoseStream("pose", "base", "world", stamp, place, quaternion)
    imu = pose.imu()
    used = np.searchsorted(stamp, imu.stamp)
    step = 1e-4

    def at(moments):
        angle = [0.4 * np.sin(2 * moments), 0.3 * np.cos(1.5 * moments), 0.5 * moments]
        return Rotation.from_rotvec(np.stack(angle, axis=1))

    rate = (at(time - step).inv() * at(time + step)).as_rotvec() / (2 * step)
    acceleration = np.stack(
        [-2.7 * np.sin(3 * time), -0.8 * np.cos(2 * time), -0.1 * np.sin(time)], axis=1
    )
    felt = rotation.inv().apply(acceleration + np.array([0, 0, 9.81]))
    assert len(used) > 0.9 * len(time)
    inside = used[20:-20]
    np.testing.assert_allclose(imu.angular_velocity[20:-20], rate[inside], atol=2e-3)
    np.testing.assert_allclose(imu.linear_acceleration[20:-20], felt[inside], atol=5e-3)
    # A force at a point of the world, as a wrench about the tracked frame's origin.
    point, force = np.array([1.0, 2.0, 0.0]), np.tile([3.0, -4.0, 50.0], (1000, 1))
    plate = WrenchStream("plate", "world", stamp, force, np.cross(point, force))
    found = pose.on_robot(plate, "foot")
    assert found.frame_id == "base@foot"
    np.testing.assert_allclose(found.force, rotation.inv().apply(force), atol=1e-9)
    lever = rotation.inv().apply(point - place)
    np.testing.assert_allclose(found.torque, np.cross(lever, found.force), atol=1e-7)


def test_a_tracked_robot_on_plates_is_identified(found, true_robot):
    assert found.robot.phi[:, 0].sum() == pytest.approx(true_robot.phi[:, 0].sum(), rel=2e-3)
    assert not found.alarms
    # Each plate loads the joints of its own leg.
    assert max(found.estimate.residual_rmse[name] for name in true_robot.joint_names) < 0.1


@pytest.mark.parametrize("kind", [ODOMETRY, POSE])
def test_a_bag_gives_the_same(found, robot, readings, tmp_path, kind):
    bag = record(readings, robot, tmp_path / "bag", kind=kind)
    named = {} if kind == ODOMETRY else {"pose_frame": "base"}
    log = load_bag(bag, robot, pose_topic=("/tracker",), **PLATES, **named)
    again = identify(robot, log, **FAST)
    error = np.abs(again.estimate.value - found.estimate.value)
    assert np.all(error < 0.5 * found.estimate.std)


def test_live_messages_give_the_same_as_a_bag(robot, readings, tmp_path):
    bag = record(readings, robot, tmp_path / "bag")
    options = LogOptions(pose_topic=("/tracker",), **PLATES)
    own = IdentifyOptions(**FAST)
    offline = load_problem(robot, load_bag(bag, robot, options), own).solve().estimate
    feed = feed_of(bag, TopicSelection.of(options))
    live = OnlineIdentification(InitialState.of(robot, own), feed.selected, Pace(share=1.0))
    try:
        approximate = feed.into(live, solving=3.0)
        found = live.solve(exactly=True).found.estimate
        assert not live.faults
        assert not any(check.dropped for check in live.intake.checks.values())
    finally:
        live.close()
    assert sum(one is not None for one in approximate) >= 2
    error = np.abs(found.value - offline.value)
    assert np.all(error < 0.05 * offline.std)


def test_a_pose_of_an_unknown_frame_is_refused(robot, readings, tmp_path):
    bag = record(readings, robot, tmp_path / "bag", kind=POSE)
    with pytest.raises(DataError, match="give `pose_frame`"):
        identify(robot, load_bag(bag, robot, pose_topic=("/tracker",)), **FAST)
    log = load_bag(bag, robot, pose_topic=("/tracker",), pose_frame="head")
    with pytest.raises(ModelError, match="head"):
        identify(robot, log, **FAST)


def test_a_pose_beside_an_imu_is_kept_for_the_geometry_and_moves_nothing(robot, readings):
    """Its second derivative is far noisier than an accelerometer, and a gap cuts no log."""
    joints, pose = readings["/joint_states"], readings["/base/pose"]["pose"].copy()
    imu = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (len(pose), 1))
    gap = (joints["time"] > 5.0) & (joints["time"] < 6.0)
    pose[gap] = np.nan
    log = Log.from_arrays(
        robot,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"],
        imus={"base": imu},
        poses={"base": pose},
    )
    (segment,) = AlignedLog(log, robot).contiguous_segments()
    assert segment.imu_frames == ("base",)
    np.testing.assert_array_equal(segment.linear_acceleration[:, 0], imu[:, 3:])
    assert segment.pose_frames == ("base",)
    stamp = np.round(joints["time"] * 1e9).astype(np.int64)
    inside = np.isin(stamp, segment.stamp)
    measured = inside & ~gap
    here = np.isin(segment.stamp, stamp[measured])
    np.testing.assert_allclose(segment.poses[here, 0, :3], pose[measured, :3], atol=1e-9)
    assert np.isnan(segment.poses[np.isin(segment.stamp, stamp[inside & gap])]).all()
