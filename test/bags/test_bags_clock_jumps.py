"""A part of a bag before or after a jump of its clock is read as if it were a bag of its own."""

from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import IMU, JOINT_STATE, imu, joint_state, write_rosbags

from symbid_ros.bags.slices import iterate_slices
from symbid_ros.signals.streams import TimeRange

SECOND = 10**9
WALL = 1_700_000_000.0
# The first run is recorded from 3 s to 8 s, the second one begins when the clock is at 1 s.
FIRST, SECOND_RUN = np.arange(3.0, 8.0, 0.05), np.arange(1.0, 13.0, 0.05)

Messages = list[tuple[str, str, bytes]]


def run(ticks: np.ndarray, epoch: float = 0.0, imu_offset: float = 0.01) -> Messages:
    """Return joint states and, every second time, readings of an IMU."""
    found: Messages = []
    for index, tick in enumerate(ticks):
        stamp = round((epoch + tick) * 1000) * 1_000_000
        found.append(("/joint_states", JOINT_STATE, joint_state(stamp, ["hip"], [tick])))
        if index % 2 == 0:
            late = stamp + round(imu_offset * SECOND)
            found.append(("/imu/data", IMU, imu(late, gyro=(tick, 0.0, 0.0))))
    return found


def read(bag: Path, part: TimeRange, span: int | None) -> tuple[np.ndarray, ...]:
    """Return stamps (s, from the first one) and readings of joints and IMU in a part of a bag."""
    stamps, readings = [], []
    for one in iterate_slices([bag], span=span, part=part):
        assert one.streams is not None
        gyro = one.streams.imus[0]
        for stream, values in (
            (one.streams.joints, one.streams.joints.position),
            (gyro, gyro.angular_velocity),
        ):
            inside = (stream.stamp >= one.start) & (stream.stamp < one.stop)
            stamps.append(stream.stamp[inside])
            readings.append(values[inside, 0])
    begin = min(int(each[0]) for each in stamps if len(each))
    joints, imus = np.concatenate(stamps[::2]), np.concatenate(stamps[1::2])
    times = ((joints - begin) / SECOND, (imus - begin) / SECOND)
    return *times, np.concatenate(readings[::2]), np.concatenate(readings[1::2])


@pytest.mark.parametrize("epoch", [0.0, WALL])
@pytest.mark.parametrize("span", [None, 4 * SECOND])
@pytest.mark.parametrize(
    ("part", "alone", "part_alone"),
    [
        (TimeRange(0.0, 4.9), FIRST, TimeRange(0.0, 4.9)),
        (TimeRange(2.0, 4.9), FIRST, TimeRange(2.0, 4.9)),
        (TimeRange(5.1), SECOND_RUN, TimeRange()),
    ],
)
def test_a_part_on_one_side_of_a_jump_is_read_as_if_recorded_alone(
    tmp_path: Path,
    epoch: float,
    span: int | None,
    part: TimeRange,
    alone: np.ndarray,
    part_alone: TimeRange,
) -> None:
    both = write_rosbags(tmp_path / "both", run(FIRST, epoch) + run(SECOND_RUN, epoch))
    one = write_rosbags(tmp_path / "one", run(alone, epoch))
    for found, expected in zip(read(both, part, span), read(one, part_alone, span), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_time_of_a_part_counts_on_behind_a_jump(tmp_path: Path) -> None:
    bag = write_rosbags(tmp_path / "log", run(FIRST) + run(SECOND_RUN))
    _, _, position, _ = read(bag, TimeRange(5.1, 12.0), None)
    # The pause between the runs counts as one to two seconds.
    assert position[0] == 1.0
    assert 5.0 < position[-1] - position[0] < 6.0


@pytest.mark.parametrize(
    "part", [TimeRange(), TimeRange(0.0, 5.5), TimeRange(4.0), TimeRange(4.0, 7.0)]
)
def test_a_jump_within_the_requested_part_is_named_with_the_options_that_leave_it_out(
    tmp_path: Path, part: TimeRange
) -> None:
    bag = write_rosbags(tmp_path / "log", run(FIRST, WALL) + run(SECOND_RUN, WALL))
    advice = (
        r"/joint_states: header stamps jump back by 6\.950 s after 1700000007\.950 s, 5\.0 s from "
        r"the first joint state; give `stop` 4\.9 to use what comes before or `start` 5\.1 to use "
        r"what follows, or record each run in a bag of its own"
    )
    with raises_code("E314", advice):
        list(iterate_slices([bag], part=part))


def test_each_of_several_jumps_can_be_left_out(tmp_path: Path) -> None:
    third = np.arange(2.0, 6.0, 0.05)
    bag = write_rosbags(tmp_path / "log", run(FIRST) + run(SECOND_RUN) + run(third))
    with raises_code("E314", "`start` 5.1 to use what follows"):
        list(iterate_slices([bag]))
    # The first run has 5 s, the second one 12 s, and the pause counts as one to two seconds.
    with raises_code("E314", r"`stop` 17\.9 .* or `start` 18\.1"):
        list(iterate_slices([bag], part=TimeRange(5.1)))
    _, _, position, rate = read(bag, TimeRange(18.1), None)
    np.testing.assert_allclose(position, third)
    np.testing.assert_allclose(rate, third[::2])
    _, _, position, _ = read(bag, TimeRange(5.1, 17.9), None)
    np.testing.assert_allclose(position, SECOND_RUN[: len(position)])
    assert len(position) > 0.9 * len(SECOND_RUN)


def test_a_topic_that_jumps_alone_is_usable_before_that_only(tmp_path: Path) -> None:
    ticks = np.arange(3.0, 14.0, 0.05)
    early, late = run(ticks[:100]), run(ticks[100:], imu_offset=-4.0)
    bag = write_rosbags(tmp_path / "log", early + late)
    _, _, _, rate = read(bag, TimeRange(0.0, 4.9), None)
    np.testing.assert_allclose(rate, ticks[:98:2])
    with raises_code("E314", r"/imu/data.*; those of /joint_states do not; give `stop` 4\.9"):
        list(iterate_slices([bag], part=TimeRange(5.1)))
