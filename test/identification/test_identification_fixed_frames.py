"""Sensors whose frames are not in the model, but fixed to its links by /tf_static of the bag."""

from dataclasses import replace

import numpy as np
import pytest
from random_logs import LogPlan, random_streams, write_bag
from random_robots import random_robot
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.errors import ModelError
from symbid_ros.identification.api import identify
from symbid_ros.identification.predictions.validation import validate
from symbid_ros.messages.layout import typestore
from symbid_ros.messages.static_transforms import TF_MESSAGE, static_transforms
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.fixed_frames import FixedTransform, with_fixed_frames
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import load_bag

OPTIONS = {"joint_terms": ("none",), "no_holdout": True, "window": 0.161}
SENSORS = "imu_link", "wrench_0"
MOUNT = FixedTransform(
    "",
    "",
    Rotation.from_euler("xyz", [0.4, -0.2, 1.1]).as_matrix(),
    np.array([0.05, -0.02, 0.11]),
)


def tf_message(transforms):
    """Return a serialised TFMessage."""
    types = typestore().types
    time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    stamped = [
        types["geometry_msgs/msg/TransformStamped"](
            header=types["std_msgs/msg/Header"](stamp=time, frame_id=one.parent),
            child_frame_id=one.child,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*one.translation.tolist()),
                rotation=types["geometry_msgs/msg/Quaternion"](
                    *Rotation.from_matrix(one.rotation).as_quat().tolist()
                ),
            ),
        )
        for one in transforms
    ]
    return bytes(typestore().serialize_cdr(types[TF_MESSAGE](transforms=stamped), TF_MESSAGE))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "robot.urdf"
    path.write_text(urdf_text(random_robot(5, links=4, wrench_frames=1, floating=True)))
    return load_model(path, "floating")


@pytest.fixture(scope="module")
def streams(robot):
    return random_streams(robot, LogPlan(rate=250.0, count=2500), 3)


def with_foreign_sensors(streams):
    """Return the streams of sensors with frames of their own."""
    imus = tuple(replace(one, frame_id=f"driver/{one.frame_id}") for one in streams.imus)
    wrenches = tuple(replace(one, frame_id=f"driver/{one.frame_id}") for one in streams.wrenches)
    return replace(streams, imus=imus, wrenches=wrenches)


def transforms_to(robot, frame):
    """Return a chain of two transforms from a link to ``driver/<frame>``, the second reversed."""
    at = robot.frame(frame)
    link = robot.link_names[at.link]
    own = FixedTransform(link, f"driver/{frame}", at.rotation, at.translation)
    away = replace(MOUNT, parent=f"driver/{frame}", child=f"{frame}_housing")
    turned = own.rotation @ away.rotation
    first = FixedTransform(
        link, f"{frame}_housing", turned, own.rotation @ away.translation + own.translation
    )
    return [first, away]


def write(streams, path, transforms):
    rows = [np.frombuffer(tf_message(transforms), dtype=np.uint8)]
    stamp = streams.joints.stamp[:1]
    return write_bag(streams, path, [("/tf_static", TF_MESSAGE, stamp, rows)])


def test_messages_are_read_and_damaged_ones_ignored(robot):
    sent = transforms_to(robot, "imu_link")
    payload = tf_message(sent)
    for one, read in zip(sent, static_transforms(payload), strict=True):
        assert (one.parent, one.child) == (read.parent, read.child)
        np.testing.assert_allclose(read.rotation, one.rotation, atol=1e-12)
        np.testing.assert_allclose(read.translation, one.translation)
    assert list(static_transforms(payload[: len(payload) // 2])) == []
    invalid = replace(sent[0], translation=np.array([np.nan, 0, 0]))
    assert len(list(static_transforms(tf_message([invalid, sent[1]])))) == 1


def test_chains_in_both_directions_reach_a_link(robot):
    sent = [one for frame in SENSORS for one in transforms_to(robot, frame)]
    apart = FixedTransform("map", "camera", np.eye(3), np.zeros(3))
    found = with_fixed_frames(robot, [*sent[::-1], apart])
    for frame in SENSORS:
        one, own = found.frame(f"driver/{frame}"), robot.frame(frame)
        assert one.link == own.link
        np.testing.assert_allclose(one.rotation, own.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, own.translation, atol=1e-12)
    with pytest.raises(ModelError):
        found.frame("camera")
    # What the model says of a frame comes first.
    link = robot.link_names[0]
    moved = FixedTransform(link, "imu_link", np.eye(3), np.array([9.0, 0, 0]))
    same = with_fixed_frames(robot, [moved])
    np.testing.assert_array_equal(
        same.frame("imu_link").translation, robot.frame("imu_link").translation
    )


def test_such_sensors_identify_the_robot_as_those_of_the_model(robot, streams, tmp_path):
    sent = [one for frame in SENSORS for one in transforms_to(robot, frame)]
    bag = write(with_foreign_sensors(streams), tmp_path / "bag", sent)
    log = load_bag(bag, robot)
    expected = identify(robot, load_bag(write_bag(streams, tmp_path / "own"), robot), **OPTIONS)
    found = identify(robot, log, **OPTIONS)
    np.testing.assert_allclose(found.estimate.value, expected.estimate.value, rtol=1e-6, atol=1e-9)
    found.save(tmp_path / "result")
    judged, also = validate(tmp_path / "result", log), validate(expected, load_bag(bag, robot))
    assert judged.percent_after == pytest.approx(also.percent_after)
    assert "unknown_frame" not in {one.kind.value for one in diagnose(log, robot).findings}


def test_a_frame_that_nothing_fixes_to_the_robot_is_refused(robot, streams, tmp_path):
    sent = transforms_to(robot, "imu_link")
    bag = write(with_foreign_sensors(streams), tmp_path / "bag", sent)
    with pytest.raises(ModelError, match="driver/wrench_0") as caught:
        identify(robot, load_bag(bag, robot), **OPTIONS, unchecked=True)
    assert caught.value.code == "E308"
