"""A wheeled base: the times at which it drives are left out."""

import numpy as np
import pytest
from random_logs import LogPlan, random_streams, write_bag
from random_robots import random_robot

from symbid_ros.errors import DataError
from symbid_ros.identification.rows.aligned_log import AlignedLog, joined_segments
from symbid_ros.messages.types import (
    IMU,
    ODOMETRY,
    fill_message,
    fill_stamp,
    imu_layout,
    odometry_layout,
)
from symbid_ros.offline.bags import load_bag
from symbid_ros.signals.driving import SETTLING, driving_intervals, is_accelerating, is_driving
from symbid_ros.signals.log import Log

SECOND = 10**9


@pytest.fixture(scope="module")
def arm():
    return random_robot(3, links=3, floating=False)


@pytest.fixture(scope="module")
def streams(arm):
    return random_streams(arm, LogPlan(rate=200.0, count=3000), 1)


def segments_of(log, arm):
    return joined_segments(AlignedLog(log, arm))


def test_speeds_of_a_parked_base_are_those_of_noise():
    linear = np.array([[0, 0, 0], [0.004, 0, 0], [0.006, 0, 0], [0, 0, 0], [np.nan, 0, 0]])
    angular = np.array([[0, 0, 0], [0, 0, 0.009], [0, 0, 0], [0, 0, -0.02], [0, 0, 0]])
    np.testing.assert_array_equal(is_driving(linear, angular), [False, False, True, True, True])
    stamp = np.arange(5) * SECOND
    expected = ((2 * SECOND - SETTLING, 4 * SECOND + SETTLING),)
    assert driving_intervals(stamp, is_driving(linear, angular)) == expected
    assert driving_intervals(stamp, np.zeros(5, bool)) == ()


# Start and end of each time that is left out on the base of `imu_on_base`, s.
LEFT_OUT = np.array([[1.9, 4.9], [5.4, 8.4], [9.4, 11.6]])


def imu_on_base(stamp, seed=1):
    """Return readings on a base that starts at 3 s, stops at 6.5 s, and turns from 10 to 11 s.

    The sensor is tilted and has offsets. An arm shakes the base a little all the time.
    """
    rng = np.random.default_rng(seed)
    seconds = stamp * 1e-9
    rate = 0.01 + 3e-3 * rng.standard_normal((len(stamp), 3))
    force = [0.3, -0.2, 9.7] + 0.05 * rng.standard_normal((len(stamp), 3))
    force[:, 0] += 0.2 * np.sin(2 * np.pi * 11 * seconds)
    for begin, change in ((3.0, 0.4), (6.5, -0.4)):
        force[(seconds >= begin) & (seconds < begin + 0.8), 0] += change
    rate[(seconds >= 10.0) & (seconds < 11.0), 2] += 0.1
    return rate, force


@pytest.mark.parametrize("rate", [50, 200, 1000])
def test_an_imu_tells_when_a_base_accelerates_or_turns(rate):
    stamp = np.arange(0, 15 * SECOND, SECOND // rate)
    moves = driving_intervals(stamp, is_accelerating(stamp, *imu_on_base(stamp)))
    # At constant velocity it counts as parked.
    np.testing.assert_allclose(1e-9 * np.array(moves), LEFT_OUT, atol=0.2)


def test_a_bag_with_an_imu_on_the_base_leaves_out_its_driving_times(arm, streams, tmp_path):
    stamp = streams.joints.stamp
    records = imu_layout("base_imu").records(len(stamp))
    rate, force = imu_on_base(stamp)
    fill_message(records, stamp, angular_velocity=rate, linear_acceleration=force)
    bag = write_bag(streams, tmp_path / "bag", [("/base/imu", IMU, stamp, records)])
    log = load_bag(bag, arm, wheel_topic=("/base/imu",))
    assert log.streams().imus == ()
    ends = [1e-9 * one.stamp[[0, -1]] for one in segments_of(log, arm)]
    parked = np.concatenate([[0.0], LEFT_OUT.ravel(), [15.0]]).reshape(-1, 2)
    np.testing.assert_allclose(ends, parked, atol=0.2)


def test_arrays_and_bags_leave_out_the_same_times(arm, streams, tmp_path):
    joints = streams.joints
    seconds = joints.stamp * 1e-9
    driving = (seconds >= 4.0) & (seconds < 7.0) | (seconds >= 14.0)
    arrays = Log.from_arrays(
        arm, time=joints.stamp, position=joints.position, effort=joints.effort, driving=driving
    )
    first, second = segments_of(arrays, arm)
    assert first.stamp[-1] * 1e-9 == pytest.approx(3.5, abs=0.01)
    assert second.stamp[0] * 1e-9 == pytest.approx(7.5, abs=0.01)
    assert second.stamp[-1] * 1e-9 == pytest.approx(13.5, abs=0.01)

    records = odometry_layout("odom", "base_link").records(len(joints.stamp))
    fill_stamp(records, joints.stamp)
    records["twist.twist.linear"][...] = 0.2 * driving[:, None] * [1, 0, 0]
    bag = write_bag(streams, tmp_path / "bag", [("/odom", ODOMETRY, joints.stamp, records)])
    recorded = segments_of(load_bag(bag, arm, wheel_topic=("/odom",)), arm)
    assert [len(one) for one in recorded] == [len(first), len(second)]
    np.testing.assert_allclose(recorded[1].position, second.position, atol=1e-9)
    (whole,) = segments_of(load_bag(bag, arm), arm)
    assert len(whole) == len(joints.stamp)


def test_a_base_that_never_stands_is_refused(arm, streams):
    joints = streams.joints
    arrays = Log.from_arrays(
        arm,
        time=joints.stamp,
        position=joints.position,
        effort=joints.effort,
        driving=np.ones(len(joints.stamp), bool),
    )
    with pytest.raises(DataError, match="drives all the time") as caught:
        segments_of(arrays, arm)
    assert caught.value.code == "E367"
