"""An arm whose driver wraps its angles is identified as if it did not, from bags and live."""

import logging
import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arm_log import arm_streams
from live_feed import feed_of
from random_logs import joint_layout, write_bag

import symbid_ros as sy
from symbid_ros.bags import bag_log
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.messages.types import JOINT_STATE, fill_stamp
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.signals.alignment import align
from symbid_ros.signals.wrapped_angles import TURN

LINK = """
  <link name="{name}">
    <inertial>
      <origin xyz="{com}"/><mass value="{mass}"/>
      <inertia ixx=".02" iyy=".03" izz=".025" ixy=".001" ixz="-.002" iyz=".001"/>
    </inertial>
  </link>"""
JOINT = """
  <joint name="{}" type="{}">
    <parent link="{}"/><child link="{}"/>
    <origin xyz="{}"/><axis xyz="{}"/>{}
  </joint>"""
LIMIT = '<limit lower="-1.6" upper="1.6" effort="40" velocity="9"/>'
FREE = '<limit effort="40" velocity="9"/>'
URDF = "".join(
    [
        '<robot name="arm">\n  <link name="world"/>',
        LINK.format(name="upper", com="0.1 0.02 0.05", mass=2.0),
        LINK.format(name="lower", com="0.12 -0.03 0.01", mass=1.5),
        LINK.format(name="hand", com="0.05 0.02 0.06", mass=0.8),
        JOINT.format("shoulder", "continuous", "world", "upper", "0 0 1", "1 0 0", FREE),
        JOINT.format("elbow", "revolute", "upper", "lower", ".3 0 0", "0 1 0", LIMIT),
        JOINT.format("wrist", "continuous", "lower", "hand", ".25 0 0", "0 0 1", FREE),
        "\n</robot>\n",
    ]
)
WRAPPED = ("shoulder", "wrist")
CHOSEN = {
    "prior_percent": 25.0,
    "method": "map",
    "joint_terms": ("none",),
    "no_holdout": True,
}
SELECTION = TopicSelection(joints=("/joint_states",))


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture(scope="module")
def streams(urdf):
    """Return the log of an arm whose continuous joints move around half a turn."""
    model = load_model(urdf, "fixed")
    joints = [
        replace(joint, lower=np.pi - 1.5, upper=np.pi + 1.5) if joint.name in WRAPPED else joint
        for joint in model.joints
    ]
    return arm_streams(replace(model, joints=tuple(joints)), seconds=70.0, rate=100.0)


@pytest.fixture(scope="module")
def wrapped_streams(streams):
    position = np.mod(streams.joints.position + np.pi, TURN) - np.pi
    jumps = (np.abs(np.diff(position, axis=0)) > 6).sum(axis=0)
    assert min(jumps[0], jumps[2]) > 10
    assert jumps[1] == 0
    return replace(streams, joints=replace(streams.joints, position=position))


@pytest.fixture(scope="module")
def bags(streams, wrapped_streams, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return write_bag(streams, folder / "continuous"), write_bag(wrapped_streams, folder / "wrapped")


def options():
    return IdentifyOptions(**CHOSEN)


def offline(bag, urdf):
    return BagRequest((bag,), urdf, options(), base="fixed").load().solve().estimate


def assert_same(found, expected) -> None:
    np.testing.assert_allclose(found.value, expected.value, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.std, expected.std, rtol=1e-9)


def test_a_wrapped_bag_gives_the_estimate_of_a_continuous_one(bags, urdf) -> None:
    expected, found = (offline(bag, urdf) for bag in bags)
    assert_same(found, expected)


def test_a_wrapped_live_run_gives_the_estimate_of_a_continuous_bag(bags, urdf, caplog) -> None:
    expected = offline(bags[0], urdf)
    with caplog.at_level(logging.INFO, "symbid_ros"):
        feed = feed_of(bags[1])
        live = OnlineIdentification(
            InitialState.of(load_model(urdf, "fixed"), options()), feed.selected, Pace(share=1.0)
        )
        try:
            feed.into(live, solving=3.0)
            exact = live.solve(exactly=True)
        finally:
            live.close()
    assert_same(exact.found.estimate, expected)
    said = [one for one in caplog.records if "wrapped" in one.getMessage()]
    assert {one.levelno for one in said} == {logging.INFO}
    assert sum(one.getMessage().count(name) for one in said for name in WRAPPED) == 2


def test_wrapped_arrays_give_the_estimate_of_continuous_ones(
    streams, wrapped_streams, urdf, caplog
) -> None:
    robot = load_model(urdf, "fixed")

    def found(joints):
        log = sy.Log.from_arrays(
            robot,
            time=joints.stamp,
            position=joints.position,
            velocity=joints.velocity,
            effort=joints.effort,
            start=20.0,
        )
        return sy.identify(robot, log, **CHOSEN)

    expected = found(streams.joints)
    with caplog.at_level(logging.INFO, "symbid_ros"):
        wrapped = found(wrapped_streams.joints)
    for name, one in expected.parameters.items():
        assert wrapped.parameters[name].value == pytest.approx(one.value, rel=1e-9, abs=1e-12)
    (said,) = [one for one in caplog.records if "wrapped" in one.getMessage()]
    assert said.getMessage() == (
        "arrays: joints: the angles of shoulder, wrist are wrapped to one turn and were unwrapped"
    )


def test_slices_of_a_wrapped_bag_continue_one_another_and_its_joints_are_named_once(
    bags, urdf, streams, caplog, tmp_path
) -> None:
    bag = shutil.copytree(bags[1], tmp_path / "unread")
    log = bag_log([bag], load_model(urdf, "fixed"))
    with caplog.at_level(logging.INFO, "symbid_ros"):
        slices = [one.streams.joints for one in log.slices(7_000_000_000, warn=False)]
        list(log.slices(7_000_000_000))
    assert len(slices) > 8
    for before, after in pairwise(slices):
        both = np.intersect1d(before.stamp, after.stamp)
        assert len(both) > 10
        np.testing.assert_allclose(
            before.position[np.isin(before.stamp, both)],
            after.position[np.isin(after.stamp, both)],
            atol=1e-9,
        )
    first = np.searchsorted(streams.joints.stamp, slices[0].stamp)
    turns = (slices[0].position - streams.joints.position[first]) / TURN
    np.testing.assert_allclose(turns, np.broadcast_to(np.rint(turns[0]), turns.shape), atol=1e-9)
    said = [one for one in caplog.records if "wrapped" in one.getMessage()]
    assert [one.levelno for one in said] == [logging.INFO]
    assert "shoulder, wrist are wrapped" in said[0].getMessage()


def test_the_doctor_finds_nothing_else_in_a_wrapped_bag(bags, urdf) -> None:
    model = load_model(urdf, "fixed")
    continuous, wrapped = (diagnose(bag_log([bag], model), model) for bag in bags)
    assert [one.kind for one in wrapped.findings] == [one.kind for one in continuous.findings]


def test_renamed_wrapped_joints_lead_their_mimics(wrapped_streams, streams, urdf, tmp_path) -> None:
    names = ("j1", "j2", "j3")
    joints = replace(wrapped_streams.joints, names=names)
    bag = write_bag(replace(wrapped_streams, joints=joints), tmp_path / "renamed")
    mimic = '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'
    follower = JOINT.format("follower", "continuous", "hand", "tip", "0 0 .1", "0 1 0", mimic)
    path = tmp_path / "mimic.urdf"
    tip = LINK.format(name="tip", com="0 0 .02", mass=0.1)
    path.write_text(URDF.replace("\n</robot>", f"{tip}{follower}\n</robot>"))
    model = load_model(path, "fixed")
    mapping = SensorMapping(joints=dict(zip(names, streams.joints.names, strict=True)))
    log = bag_log([bag], model, replace(SELECTION, mapping=mapping))
    (segment,) = align(log.streams(), model)
    shoulder, follower = (model.joint_names.index(name) for name in ("shoulder", "follower"))
    np.testing.assert_allclose(
        segment.position[:, follower], 0.2 - 0.5 * segment.position[:, shoulder]
    )
    assert np.abs(np.diff(segment.position, axis=0)).max() < 0.2


def test_joints_are_unwrapped_before_topics_with_different_stamps_are_merged(
    wrapped_streams, streams, urdf, tmp_path
) -> None:
    joints, late = wrapped_streams.joints, 3_000_000
    arm = replace(
        joints,
        topic="/arm",
        names=joints.names[:2],
        position=joints.position[:, :2],
        velocity=joints.velocity[:, :2],
        effort=joints.effort[:, :2],
    )
    position, velocity, effort = (
        joints.position[:, 2:],
        joints.velocity[:, 2:],
        joints.effort[:, 2:],
    )
    records = joint_layout(("wrist",), ("position", "velocity", "effort")).records(
        len(joints.stamp)
    )
    fill_stamp(records, joints.stamp + late)
    records["position"], records["velocity"], records["effort"] = position, velocity, effort
    bag = write_bag(
        replace(wrapped_streams, joints=arm),
        tmp_path / "split",
        [("/hand", JOINT_STATE, joints.stamp + late, records)],
    )
    topics = replace(SELECTION, joints=("/arm", "/hand"))
    found = bag_log([bag], load_model(urdf, "fixed"), topics).streams().joints
    true = streams.joints.position
    at = np.searchsorted(joints.stamp, found.stamp)
    expected = true[at, 2] - 1e-9 * late * streams.joints.velocity[at, 2]
    turns = (found.position[:, 2] - expected) / TURN
    np.testing.assert_allclose(turns, np.rint(turns[0]), atol=1e-3)


def test_renamed_prismatic_joints_are_lengths(wrapped_streams, urdf, tmp_path) -> None:
    joints = replace(wrapped_streams.joints, names=("j1", "j2", "j3"))
    bag = write_bag(replace(wrapped_streams, joints=joints), tmp_path / "renamed")
    path = tmp_path / "sliding.urdf"
    sliding = URDF.replace('name="wrist" type="continuous"', 'name="wrist" type="prismatic"')
    path.write_text(sliding.replace(FREE, '<limit lower="-9" upper="9" effort="40" velocity="9"/>'))
    mapping = SensorMapping(joints={"j1": "shoulder", "j2": "elbow", "j3": "wrist"})
    log = bag_log([bag], load_model(path, "fixed"), replace(SELECTION, mapping=mapping))
    found = log.streams().joints
    jumps = (np.abs(np.diff(found.position, axis=0)) > 6).sum(axis=0)
    assert found.names == ("shoulder", "elbow", "wrist")
    assert jumps[0] == jumps[1] == 0 < jumps[2]
