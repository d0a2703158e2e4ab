"""Slices of a recording repeat and lose no message; late messages are counted."""

from pathlib import Path

import numpy as np
import pytest
from foreign_bags import IMU, JOINT_STATE, imu, joint_state, write_rosbags

from symbid_ros.bags import slices
from symbid_ros.bags.slices import iterate_slices
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
