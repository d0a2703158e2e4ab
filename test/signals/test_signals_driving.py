"""A wheeled base: the times at which it drives are left out."""

import numpy as np
import pytest
from random_logs import LogPlan, random_streams, write_bag
from random_robots import random_robot

from symbid_ros.errors import DataError
from symbid_ros.identification.dataset import AlignedLog, joined_segments
from symbid_ros.messages.types import ODOMETRY, fill_stamp, odometry_layout
from symbid_ros.offline.bags import load_bag
from symbid_ros.signals.driving import SETTLING, driving_intervals, is_driving
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
    recorded = segments_of(load_bag(bag, arm, drive_topic=("/odom",)), arm)
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
