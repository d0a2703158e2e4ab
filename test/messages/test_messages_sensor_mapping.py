"""Logs with other names, units, signs and axes than the model's read like the model's own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from hypothesis import given
from hypothesis import strategies as st
from live_feed import feed_of
from scipy.spatial.transform import Rotation

from symbid_ros import LogOptions, load_bag
from symbid_ros.errors import ModelError, OptionError
from symbid_ros.messages.name_check import ModelNames, check_model_names
from symbid_ros.messages.sensor_mapping import SAME, HeldJoints, SensorMapping
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.package_paths import config_file
from symbid_ros.signals.alignment import align_checked
from symbid_ros.signals.streams import JointStream

MOUNTING = Rotation.from_euler("xyz", [170, -20, 65], degrees=True)
SCALE = 0.04


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated("smooth", moves=2, motion_seed=7, noise_seed=3)


@pytest.fixture(scope="module")
def names(bag) -> dict[str, str]:
    """Names of frames and joints in the log that a foreign driver gives other names."""
    streams = load_bag(bag).streams()
    left = next(one.frame_id for one in streams.wrenches if "left" in one.topic)
    return {"imu": streams.imus[0].frame_id, "left": left, "joint": streams.joints.names[3]}


@pytest.fixture(scope="module")
def foreign(bag, names, tmp_path_factory) -> Path:
    """The bag as a driver with other names, currents, a reversed plate and a turned IMU writes."""

    def joints(messages: Messages) -> None:
        column = messages.joints.index(names["joint"])
        messages.records["effort"][:, column] *= -SCALE
        renamed = [f"motor_{i}" if i == column else one for i, one in enumerate(messages.joints)]
        everything = np.ones(len(messages.records), dtype=bool)
        messages.rename(everything, range(len(renamed)), renamed)

    def imu(messages: Messages) -> None:
        for field in ("angular_velocity", "linear_acceleration"):
            messages.records[field] = MOUNTING.inv().apply(messages.records[field])
        messages.reframe("xsens")

    def plate(messages: Messages) -> None:
        for field in ("wrench.force", "wrench.torque"):
            messages.records[field] *= -1
        messages.reframe("ft_left")

    out = tmp_path_factory.mktemp("foreign") / "bag"
    edits = {"/joint_states": joints, "/imu/data": imu, "/left_foot/wrench": plate}
    return edit_bag(bag, out, edits)


@pytest.fixture(scope="module")
def options(names) -> LogOptions:
    return LogOptions(
        rename_joint=(f"motor_3:={names['joint']}",),
        rename_frame=(f"xsens:={names['imu']}", f"ft_left:={names['left']}"),
        effort_scale=(f"{names['joint']}:={-1 / SCALE}",),
        flip_wrench=(names["left"],),
        rotate_imu=(f"{names['imu']}:=170,-20,65",),
    )


def test_a_foreign_log_reads_as_the_models_own(bag, foreign, model, options) -> None:
    original, converted = (
        load_bag(path, model, given).streams()
        for path, given in ((bag, LogOptions()), (foreign, options))
    )
    assert set(converted.joints.names) == set(original.joints.names)
    (before,), (after,) = (align_checked(one, model) for one in (original, converted))
    assert after.imu_frames == before.imu_frames
    assert after.wrench_frames == before.wrench_frames
    for field in ("position", "effort", "angular_velocity", "linear_acceleration", "wrenches"):
        np.testing.assert_allclose(getattr(after, field), getattr(before, field), atol=1e-9)


def test_wrapped_degrees_become_continuous_radians(bag, model, names, tmp_path) -> None:
    """As of a joint that turns past 180 degrees."""
    joint = names["joint"]

    def in_degrees(messages: Messages) -> None:
        place = messages.joints.index(joint)
        angle = np.degrees(messages.records["position"][:, place]) + 170.0
        angle += 20.0 * np.sin(np.linspace(0.0, 20.0, len(angle)))
        messages.records["position"][:, place] = (angle + 180.0) % 360.0 - 180.0
        messages.records["velocity"][:, place] *= 180.0 / np.pi

    recorded = edit_bag(bag, tmp_path / "bag", {"/joint_states": in_degrees})
    scale = (f"{joint}:={np.radians(1.0)}",)
    original = load_bag(bag, model).streams().joints
    converted = load_bag(recorded, model, position_scale=scale).streams().joints
    column = converted.names.index(joint)
    turned = np.radians(170.0 + 20.0 * np.sin(np.linspace(0.0, 20.0, len(converted.stamp))))
    added = converted.position[:, column] - original.position[:, column] - turned
    np.testing.assert_allclose(added, added[0], atol=1e-9)
    np.testing.assert_allclose(converted.velocity, original.velocity, atol=1e-9)


def test_live_messages_of_a_foreign_driver_are_accepted(foreign, model, options) -> None:
    feed = feed_of(foreign)
    mapping = SensorMapping.of(options)
    for is_mapped in (True, False):
        checks = {
            topic: MessageCheck(topic, model, mapping if is_mapped else SAME)
            for topic in feed.selected.all
        }
        for _, topic, payload in feed.messages[:400]:
            checks[topic].take(payload)
        dropped = {topic.name for topic, check in checks.items() if check.dropped}
        assert dropped == (set() if is_mapped else {"/imu/data", "/left_foot/wrench"})


def test_a_joint_that_is_not_recorded_is_held(bag, model, names, tmp_path, caplog) -> None:
    missing = names["joint"]

    def drop(messages: Messages) -> None:
        columns = [i for i, name in enumerate(messages.joints) if name != missing]
        kept = [messages.joints[i] for i in columns]
        messages.rename(np.ones(len(messages.records), dtype=bool), columns, kept)

    short = edit_bag(bag, tmp_path / "bag", {"/joint_states": drop})
    held = load_bag(short, model, hold_joint=(f"{missing}:=0.3",)).streams().joints
    assert not caplog.records
    assert held.held == (missing,)
    column = held.names.index(missing)
    assert (held.position[:, column] == 0.3).all()
    assert np.isnan(held.effort[:, column]).all()
    default = load_bag(short, model).streams().joints
    assert (default.position[:, default.names.index(missing)] == 0).all()
    (record,) = caplog.records
    assert f"`hold_joint` {missing}:=POSITION" in record.getMessage()


def stream(*names: str) -> JointStream:
    values = np.zeros((3, len(names)))
    return JointStream("joint_states", names, np.arange(3), values, values, values)


def test_a_flipped_joint_keeps_its_effort() -> None:
    """A wrong axis reverses all three; `effort_scale` reverses the effort."""
    read = JointStream(
        "joint_states", ("a", "m"), np.arange(3), *np.random.default_rng(1).random((3, 3, 2))
    )
    options = LogOptions(rename_joint=("m:=b",), flip_joint=("b",))
    found = SensorMapping.of(options).converted_joints(read)
    np.testing.assert_array_equal(found.position, read.position * [1, -1])
    np.testing.assert_array_equal(found.velocity, read.velocity * [1, -1])
    np.testing.assert_array_equal(found.effort, read.effort)


def test_a_joint_that_falls_silent_is_not_held() -> None:
    held = HeldJoints(("a", "b", "c"))
    assert held.added_to(stream("a", "b"), "log").names == ("a", "b", "c")
    assert held.added_to(stream("a"), "log").names == ("a", "c")


def test_live_only_named_joints_are_held() -> None:
    """A driver may start later."""
    held = HeldJoints(("a", "b", "c"), {"c": 0.5}, is_live=True)
    assert held.added_to(stream("a"), "log").names == ("a", "c")


def test_joints_of_another_robot_are_refused_not_held(bag, model) -> None:
    streams = load_bag(bag, model).streams()
    others = replace(streams.joints, names=tuple(f"x{i}" for i in range(len(streams.joints.names))))
    held = HeldJoints(model.measured_joint_names).added_to(others, "log")
    with pytest.raises(ModelError, match="rename_joint"):
        align_checked(replace(streams, joints=held), model)


@pytest.mark.parametrize(
    ("option", "entry"),
    [
        ("rename_joint", "a"),
        ("rename_joint", ":=b"),
        ("rename_frame", "a:="),
        ("position_scale", "a:=0"),
        ("position_scale", "a:=-1"),
        ("effort_scale", "a:=0"),
        ("effort_scale", "a:=nan"),
        ("effort_scale", "a:=1e300"),
        ("effort_scale", "a:=1e-300"),
        ("hold_joint", "a:=one"),
        ("rotate_imu", "a:=1,2"),
        ("rotate_imu", "a:=1,2,inf"),
    ],
)
def test_an_invalid_entry_is_named_with_an_example(option: str, entry: str) -> None:
    with pytest.raises(OptionError, match=f"`{option}`: {entry!r} is not valid; give .*such as"):
        TopicSelection.of(LogOptions(**{option: (entry,)}))


def test_messages_without_a_frame_may_be_given_one() -> None:
    mapping = SensorMapping.of(LogOptions(rename_frame=(":=imu_link",)))
    assert [mapping.frame(name) for name in ("", "tool")] == ["imu_link", "tool"]


def test_a_repeated_name_is_refused() -> None:
    with pytest.raises(OptionError, match="repeats"):
        TopicSelection.of(LogOptions(hold_joint=("a:=1", "a:=2")))


UNKNOWN = [
    ("rename_joint", "nosuch:={joint}"),
    ("rename_joint", "{joint}:=nosuch"),
    ("hold_joint", "nosuch:=0.5"),
    ("position_scale", "nosuch:=2"),
    ("effort_scale", "nosuch:=2"),
    ("flip_joint", "nosuch"),
    ("flip_wrench", "nosuch"),
    ("rotate_imu", "nosuch:=0,0,0"),
    ("rename_frame", "nosuch:={imu}"),
    ("rename_frame", "{imu}:=nosuch"),
    ("frame_prefix", "nosuch/"),
    ("pose_frame", "nosuch"),
    ("plate_link", "/left_foot/wrench:=nosuch"),
    ("plate_link", "/nosuch:={left}"),
]
# Of these names, another log of the robot may have some.
OF_LOGS = [one for one in UNKNOWN if one[1].startswith(("nosuch:={", "nosuch/", "/nosuch"))]


def with_option(option: str, entry: str, names: dict[str, str]) -> LogOptions:
    entry = entry.format(**names)
    is_text = option in ("frame_prefix", "pose_frame")
    return LogOptions(**{option: entry if is_text else (entry,)})


@pytest.mark.parametrize(("option", "entry"), UNKNOWN)
def test_an_unknown_name_is_refused_with_the_known_ones(bag, model, names, option, entry) -> None:
    log = load_bag(bag, model, with_option(option, entry, names))
    with pytest.raises(OptionError, match=f"^`{option}`: .* has (no|a) .*nosuch") as refused:
        list(log.slices(warn=False))
    known = [names["joint"], names["imu"], "/left_foot/wrench"]
    assert any(name in str(refused.value) for name in known)


@pytest.mark.parametrize(("option", "entry"), OF_LOGS)
def test_a_robot_file_may_name_what_a_log_lacks(bag, model, names, caplog, option, entry) -> None:
    options = with_option(option, entry, names)
    log = load_bag(bag, model, replace(options, of_robot=(option,)))
    for _ in range(2):
        list(log.slices(warn=False))
    (record,) = caplog.records
    assert record.getMessage().startswith(f"`{option}`: ")


def test_a_joint_of_the_model_need_not_be_recorded(bag, model, names, caplog) -> None:
    (actual,) = load_bag(bag, model, effort_scale=(f"{names['joint']}:=2",)).slices(warn=False)
    assert actual.streams is not None
    options = LogOptions(hold_joint=(f"{names['joint']}:=0.3",))
    with pytest.raises(OptionError, match=r"`hold_joint` .* has no effect"):
        load_bag(bag, model, options).streams()
    load_bag(bag, model, options.of_any_log()).streams()  # another log may lack it
    assert not caplog.records


def test_live_options_name_the_models_joints_and_frames(model, names) -> None:
    known = ModelNames.of(model)
    live = [one for one in UNKNOWN if one not in OF_LOGS]
    for option, entry in live:
        mapping = SensorMapping.of(with_option(option, entry, names))
        with pytest.raises(OptionError, match=f"`{option}`: .* has no .*'nosuch'"):
            check_model_names(mapping, known, has_poses=False)
    world = SensorMapping.of(LogOptions(flip_wrench=("world",)))
    check_model_names(world, known, has_poses=True)


@given(st.tuples(*[st.floats(-180, 180)] * 3))
def test_imu_angles_are_those_of_urdf(angles: tuple[float, float, float]) -> None:
    entry = "imu:=" + ",".join(map(repr, angles))
    mapping = SensorMapping.of(LogOptions(rotate_imu=(entry,)))
    expected = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    np.testing.assert_allclose(mapping.rotations["imu"], expected, atol=1e-12)
