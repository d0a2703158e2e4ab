"""Slices of a recording repeat and lose no message; late messages are counted."""

from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import IMU, JOINT_STATE, imu, joint_state, write_rosbags
from hypothesis import given, settings
from hypothesis import strategies as st

from symbid_ros.bags import slices
from symbid_ros.bags.slices import ReorderBuffer, iterate_slices
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import read_stamp
from symbid_ros.signals.defects import Defect, DefectCounts
from symbid_ros.signals.streams import TimeRange

SECOND = 10**9
SPAN = 4 * SECOND


def joints(*stamps: float) -> list[tuple[str, str, object]]:
    return [
        ("/joint_states", JOINT_STATE, joint_state(round(s * SECOND), ["hip"], [s])) for s in stamps
    ]


def gyro(*stamps: float) -> list[tuple[str, str, object]]:
    return [("/imu/data", IMU, imu(round(s * SECOND))) for s in stamps]


def test_every_message_is_in_one_slice_and_margins_overlap(tmp_path: Path) -> None:
    ticks = np.arange(2.0, 13.0, 0.05)
    bag = write_rosbags(tmp_path / "log", joints(*ticks) + gyro(*ticks))
    found = list(iterate_slices([bag], span=SPAN))
    assert [one.stop // SECOND for one in found] == [4, 8, 12, 16]
    assert [one.start // SECOND for one in found[1:]] == [4, 8, 12]
    stamps = [one.streams.joints.stamp for one in found]
    cores = [s[(s >= one.start) & (s < one.stop)] for s, one in zip(stamps, found, strict=True)]
    np.testing.assert_array_equal(np.concatenate(cores), np.rint(ticks * SECOND).astype(int))
    # Twenty periods of the slowest topic.
    assert stamps[1][0] == round(3.0 * SECOND)
    assert stamps[1][-1] == round(8.95 * SECOND)


@pytest.mark.parametrize(("rate", "ends"), [(250, [12, 24, 60]), (20, [60])])
def test_slices_of_logs_with_a_high_rate_are_short(
    rate: float, ends: list[int], tmp_path: Path
) -> None:
    ticks = np.arange(0.0, 25.0, 1 / rate)
    bag = write_rosbags(tmp_path / "log", joints(*ticks))
    found = list(iterate_slices([bag], span=60 * SECOND))
    assert [one.stop // SECOND for one in found] == ends
    cores = [one.stamps["/joint_states"] for one in found]
    np.testing.assert_array_equal(np.concatenate(cores), np.rint(ticks * SECOND).astype(int))


def test_repaired_defects_are_counted_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    near_the_cut = (2.0, 3.95, 3.95, 4.05, 4.0, 5.0)
    bag = write_rosbags(tmp_path / "log", joints(*near_the_cut) + gyro(*near_the_cut))
    first, second = iterate_slices([bag], span=SPAN)
    assert first.streams.joints.stamp[-1] > SPAN > second.streams.joints.stamp[0]
    for topic in ("/joint_states", "/imu/data"):
        assert f"{topic}: 1 of 6 messages repeat a stamp" in caplog.text
        assert f"{topic}: 1 of 6 messages are out of order" in caplog.text


def test_topics_recorded_one_after_the_other_are_merged(tmp_path: Path) -> None:
    ticks = np.arange(2.0, 9.0, 0.5)
    one = write_rosbags(tmp_path / "a", joints(*ticks))
    other = write_rosbags(tmp_path / "b", gyro(*ticks))
    for found in iterate_slices([one, other], span=SPAN):
        np.testing.assert_array_equal(found.streams.joints.stamp, found.streams.imus[0].stamp)


def test_late_messages_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slices, "MAX_BUFFERED", 0)
    one = write_rosbags(tmp_path / "a", joints(2.0, 3.0, 5.0))
    other = write_rosbags(tmp_path / "b", gyro(2.0, 5.0, 9.0) + joints(9.0))
    early, late, last = iterate_slices([one, other], span=SPAN)
    for silent in (early, late):
        assert silent.streams is None
        assert "/imu/data was silent up to" in silent.fault
    assert last.streams.imus[0].stamp.tolist() == [9 * SECOND]
    assert "/imu/data: 2 of 3 messages arrived after their block had been processed" in caplog.text


def test_reading_ends_after_the_requested_part(tmp_path: Path) -> None:
    ticks = np.arange(2.0, 9.0, 0.5)
    bag = write_rosbags(tmp_path / "log", joints(*ticks) + gyro(*ticks))
    (found,) = iterate_slices([bag], part=TimeRange(1.0, 3.0))
    inside = found.streams.joints.stamp[
        (found.streams.joints.stamp >= found.start) & (found.streams.joints.stamp < found.stop)
    ]
    assert inside.tolist() == [round(s * SECOND) for s in (3.0, 3.5, 4.0, 4.5)]


def filled(*blocks: list[int], **limits: int) -> ReorderBuffer:
    """Return a buffer of messages with these stamps, block by block."""
    topic = Topic("/imu/data", IMU)
    buffer = ReorderBuffer(TopicDecoder("log", topic), DefectCounts("log", topic.name))
    for stamps in blocks:
        payloads = [imu(stamp) for stamp in stamps]
        data = np.frombuffer(b"".join([b"", *payloads]), dtype=np.uint8)
        lengths = np.array([len(each) for each in payloads], dtype=np.int64)
        spans = np.stack([np.cumsum(lengths) - lengths, lengths], axis=1)
        buffer.add(data, spans, **limits)
    return buffer


def inside(buffer: ReorderBuffer, start: int, stop: int) -> list[int]:
    """Return the stamps of the messages between two stamps, in order of recording."""
    decoder = buffer.between(start, stop)
    found = np.zeros(decoder.count, dtype=np.int64)
    for batch in decoder.batches:
        found[batch.index] = read_stamp(batch.records)
    return found.tolist()


stamps = st.lists(st.lists(st.integers(1, 60), max_size=8), max_size=5)


@given(stamps, st.integers(0, 61), st.integers(0, 61), st.integers(0, 61))
@settings(max_examples=40)
def test_a_buffer_keeps_what_a_list_keeps(blocks, start, stop, dropped) -> None:
    buffer = filled(*blocks)
    expected = [stamp for block in blocks for stamp in block]
    assert inside(buffer, start, stop) == [each for each in expected if start <= each < stop]
    assert buffer.stamps.tolist() == expected
    assert buffer.newest == max(expected, default=None)
    later = [each for each in expected if each >= start]
    assert buffer.first_from(start) == min(later, default=None)
    size = buffer.size
    buffer.drop_before(dropped)
    left = [each for each in expected if each >= dropped]
    assert buffer.stamps.tolist() == left
    assert buffer.size * max(len(expected), 1) == size * len(left)
    assert inside(buffer, 0, 100) == left


@given(stamps, st.integers(0, 61), st.integers(0, 61))
@settings(max_examples=40)
def test_late_messages_count_if_they_were_asked_for(blocks, processed, requested) -> None:
    buffer = filled(*blocks, processed_until=processed, requested_from=requested)
    given_stamps = [stamp for block in blocks for stamp in block]
    assert buffer.stamps.tolist() == [each for each in given_stamps if each >= processed]
    late = sum(requested <= each < processed for each in given_stamps)
    assert buffer.tally.counts.get(Defect.LATE, 0) == late
    assert buffer.tally.messages == len(given_stamps)
    assert buffer.newest == max(given_stamps, default=None)


@pytest.mark.parametrize(("back", "is_jump"), [(SECOND, False), (SECOND + 1, True)])
def test_the_clock_is_compared_across_blocks(back: int, is_jump: bool) -> None:
    blocks = [5 * SECOND, 9 * SECOND], [9 * SECOND - back, 10 * SECOND]
    if is_jump:
        with raises_code("E314", "/imu/data"):
            filled(*blocks)
    else:
        assert len(filled(*blocks).stamps) == 4
