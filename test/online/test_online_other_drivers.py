"""Other robots' drivers: joints in parts, no stamps, missing joints, prefixed frames."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from foreign_bags import STORE
from live_feed import feed_of
from split_joints import JOINTS, Part, left, right, split_joints, stamped

from symbid_ros.bags import bag_log, read_streams
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.messages.types import IMU, read_leading_stamp
from symbid_ros.model.load import load_model
from symbid_ros.online.block_scheduler import BlockScheduler
from symbid_ros.package_paths import config_file
from symbid_ros.signals.alignment import align_checked

ALL = TopicSelection()
APART = TopicSelection(joints=("/left/joint_states", "/right/joint_states"))
JUST_LATER, LATE = 1000, 300_000  # ns between the stamps of two drivers
FIELDS = ("stamp", "position", "effort", "angular_velocity", "linear_acceleration", "wrenches")


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated("smooth", moves=2, motion_seed=7, noise_seed=3)


@pytest.fixture(scope="module")
def feed(bag):
    return feed_of(bag)


@dataclass
class Heard:
    """What came of a feed: aligned arrays of all blocks and of the pieces, faults, counts."""

    blocks: dict[str, np.ndarray]
    pieces: dict[str, np.ndarray]
    faults: list[str]
    missing: int
    unstamped: dict[str, int]


def heard(feed, model, prefix="") -> Heard:
    """Feed a scheduler and take its blocks each second."""
    scheduler = BlockScheduler(
        replace(feed.selected, mapping=SensorMapping(prefix)), model, 1.0, "live topics"
    )
    due = feed.messages[0][0]
    blocks, pieces = [], []
    for stamp, topic, payload in feed.messages:
        now = read_leading_stamp(payload)
        assert not scheduler.streams.jumps_back(topic, now)
        scheduler.streams.add(topic, now, payload)
        if stamp >= due:
            blocks += scheduler.complete_blocks()
            pieces += scheduler.partial_blocks()
            due = stamp + 1_000_000_000
    blocks.append(scheduler.open_block())
    buffers = scheduler.streams.buffers
    assert sum(buffer.stale + buffer.disordered for buffer in buffers.values()) == 0
    return Heard(
        joined(segment for block in blocks if block for segment in block.segments),
        joined(segment for piece in pieces for segment in piece.segments),
        [block.fault for block in blocks if block and block.fault],
        sum(buffer.missing for buffer in buffers.values()),
        {topic.name: buffer.unstamped for topic, buffer in buffers.items()},
    )


def joined(segments) -> dict[str, np.ndarray]:
    parts = list(segments)
    return {
        name: np.concatenate([getattr(part, name) for part in parts]) if parts else np.empty(0)
        for name in FIELDS
    }


def assert_equal(found, expected) -> None:
    assert len(expected["stamp"]) > 0
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def changed(feed, change):
    """Return a feed with each message's payload as ``change(stamp, topic name, payload)``."""
    return replace(
        feed,
        messages=tuple(
            (stamp, topic, change(stamp, topic.name, payload))
            for stamp, topic, payload in feed.messages
        ),
    )


SPLITS = {
    "one topic": ([Part(JOINTS, left), Part(JOINTS, right)], TopicSelection()),
    "one topic, two clocks": (
        [Part(JOINTS, left), Part(JOINTS, right, JUST_LATER)],
        TopicSelection(),
    ),
    "two topics": (
        [Part("/left/joint_states", left), Part("/right/joint_states", right)],
        APART,
    ),
    "two clocks": (
        [Part("/left/joint_states", left), Part("/right/joint_states", right, LATE)],
        APART,
    ),
    "two rates": (
        [Part("/left/joint_states", left, every=4), Part("/right/joint_states", right)],
        APART,
    ),
    "efforts apart": (
        [
            Part(JOINTS, lambda _: True, fields=("position", "velocity")),
            Part("/left/efforts", left, fields=("effort",)),
            Part("/right/efforts", right, fields=("effort",)),
        ],
        TopicSelection(joints=(JOINTS, "/left/efforts", "/right/efforts")),
    ),
}


@pytest.mark.parametrize("way", SPLITS)
def test_joints_in_parts_are_merged_by_stamp_live_as_from_a_bag(
    way, model, bag: Path, tmp_path: Path
) -> None:
    parts, topics = SPLITS[way]
    log = split_joints(bag, tmp_path / "log", parts)
    whole, merged = (
        joined(AlignedLog(bag_log([one], model, of), model))
        for one, of in ((bag, ALL), (log, topics))
    )
    if way in ("one topic", "two topics", "efforts apart"):
        assert_equal(merged, whole)
    else:
        assert abs(len(merged["stamp"]) - len(whole["stamp"])) <= 4
    live = heard(feed_of(log, topics), model)
    assert (live.faults, live.missing) == ([], 0)
    found = diagnose(bag_log([log], model, topics)).findings
    assert not [one for one in found if one.kind in (Kind.GAP, Kind.RATE)]
    for name, values in merged.items():  # splines over more data differ by rounding
        np.testing.assert_allclose(live.blocks[name], values, rtol=1e-9, atol=1e-9, err_msg=name)
    assert len(live.pieces["stamp"]) >= 0.8 * len(merged["stamp"])


def test_joints_of_other_machines_on_the_topic_are_ignored(model, bag: Path, tmp_path) -> None:
    legs = replace(model, joints=model.joints[:5])
    names = set(legs.joint_names)
    parts = [Part(JOINTS, names.__contains__), Part(JOINTS, lambda n: n not in names, every=50)]
    log = split_joints(bag, tmp_path / "log", parts)
    found, whole = (joined(AlignedLog(bag_log([one], legs, ALL), legs)) for one in (log, bag))
    assert_equal(found, whole)


@pytest.mark.parametrize("topic", [JOINTS, "/imu/data", "/left_foot/wrench"])
def test_messages_without_stamps_are_counted_and_ignored_until_the_driver_is_fixed(
    topic, feed, model
) -> None:
    cured = 2_500_000_000
    faulty = changed(
        feed,
        lambda stamp, name, payload: (
            stamped(payload, 0) if name == topic and stamp < cured else payload
        ),
    )
    wrong = sum(stamp < cured and one.name == topic for stamp, one, _ in feed.messages)
    clean = replace(
        feed, messages=tuple(m for m in feed.messages if m[0] >= cured or m[1].name != topic)
    )
    found = heard(faulty, model)
    assert wrong - 1 <= found.unstamped[topic] <= wrong
    assert_equal(found.blocks, heard(clean, model).blocks)


def test_a_missing_joint_loses_blocks_and_is_reported_until_it_is_published(feed, model) -> None:
    def renamed(stamp, name, payload):
        if name != JOINTS or stamp >= 4_000_000_000:
            return payload
        assert payload.count(b"L_kfe") == 1
        return payload.replace(b"L_kfe", b"L_KFE")

    found = heard(changed(feed, renamed), model)
    (fault,) = found.faults
    assert fault.startswith(f"live topics: {JOINTS} has no joint 'L_kfe' of model")
    assert "bag" not in fault
    assert found.blocks["stamp"][0] == 4_000_000_000


def test_a_prefix_of_frames_is_suggested_and_removed(feed, model) -> None:
    def prefixed(stamp, name, payload):
        if name != "/imu/data":
            return payload
        message = STORE.deserialize_cdr(payload, IMU)
        message.header.frame_id = f"robot1/{message.header.frame_id}"
        return bytes(STORE.serialize_cdr(message, IMU))

    clean = feed.between(0.0, 2.0)
    faulty = changed(clean, prefixed)
    (fault,) = heard(faulty, model).faults
    assert "/imu/data: frame 'robot1/imu_link' is not in model" in fault
    assert "`frame_prefix` robot1/" in fault
    assert_equal(heard(faulty, model, "robot1/").blocks, heard(clean, model).blocks)


def test_messages_about_live_topics_do_not_mention_bags(bag: Path, model) -> None:
    streams = read_streams([bag])
    absent = replace(streams.joints, position=np.full_like(streams.joints.position, np.nan))
    few = replace(
        streams.joints,
        **{name: getattr(streams.joints, name)[:40] for name in ("stamp", "position", "effort")},
    )
    for joints, recorded, live in (
        (absent, "leave out that part of the log", "let its driver publish it"),
        (few, "record longer", "publish at a higher rate"),
    ):
        for is_live, says in ((False, recorded), (True, live)):
            faulty = replace(streams, source="log", joints=joints, is_live=is_live)
            with pytest.raises(DataError, match=says) as raised:
                align_checked(faulty, model)
            assert ("bag" in str(raised.value)) <= (not is_live)
