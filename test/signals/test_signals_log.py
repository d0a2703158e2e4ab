"""Logs of arrays are cut and aligned like a bag with the same measurements."""

from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.bags import bag_log, read_streams
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import TimeRange

SPAN = 1_000_000_000


@pytest.fixture(scope="module")
def bag(simulated):
    return simulated("smooth", moves=1, motion_seed=3, noise_seed=4)


@pytest.fixture(scope="module")
def robot():
    return load_model(config_file("symbitron.urdf"))


def test_a_time_range_is_the_whole_recording_by_default() -> None:
    assert TimeRange() == TimeRange(0.0, np.inf)


@pytest.mark.parametrize("part", [TimeRange(), TimeRange(0.75, 3.25)])
@pytest.mark.parametrize("span", [None, SPAN])
def test_streams_in_memory_are_cut_like_a_bag(bag, part, span) -> None:
    cut = list(Log.from_streams(read_streams([bag]), part).slices(span))
    read = list(bag_log([bag], part=part).slices(span))
    assert len(cut) == len(read) > 0
    for one, other in zip(cut, read, strict=True):
        inside = [
            slice(*np.searchsorted(s.stamp, [one.start, one.stop]))
            for s in (one.streams.joints, other.streams.joints)
        ]
        for name in ("stamp", "position", "effort"):
            ours, theirs = (
                getattr(s.joints, name)[i]
                for s, i in zip((one.streams, other.streams), inside, strict=True)
            )
            np.testing.assert_array_equal(ours, theirs)
        assert {t: s.tolist() for t, s in one.stamps.items()} == {
            t: s.tolist() for t, s in other.stamps.items()
        }


def arrays(robot, count=200):
    joints = len(robot.measured_joint_names)
    rng = np.random.default_rng(1)
    return {
        "time": 1.7e9 + np.arange(count) / 100,
        "position": rng.normal(size=(count, joints)),
        "effort": rng.normal(size=(count, joints)),
        "imus": {"imu_link": rng.normal(size=(count, 6))},
        "wrenches": {"left_sole": rng.normal(size=(count, 6))},
    }


def test_arrays_become_streams_in_the_models_order(robot) -> None:
    given = arrays(robot)
    given["imus"]["imu_link"][3, 2] = np.nan
    streams = Log.from_arrays(robot, **given).streams()
    np.testing.assert_array_equal(streams.joints.position, given["position"])
    assert streams.joints.names == robot.measured_joint_names
    np.testing.assert_array_equal(streams.wrenches[0].force, given["wrenches"]["left_sole"][:, :3])
    (imu,) = streams.imus
    assert len(imu.stamp) == 199  # the row with NaN is left out
    np.testing.assert_array_equal(
        imu.linear_acceleration[2:4], given["imus"]["imu_link"][[2, 4], 3:]
    )


def test_integer_instants_are_nanoseconds_and_sorted(robot) -> None:
    given = arrays(robot, 60)
    order = np.random.default_rng(2).permutation(60)
    stamp = 10_000_000 * order
    streams = Log.from_arrays(robot, **(given | {"time": stamp})).streams()
    np.testing.assert_array_equal(streams.joints.stamp, np.sort(stamp))
    np.testing.assert_array_equal(streams.joints.position, given["position"][np.argsort(order)])


@pytest.mark.parametrize(
    ("change", "error", "named"),
    [
        ({"position": np.zeros((200, 2))}, DataError, "position"),
        ({"effort": np.zeros(200)}, DataError, "effort"),
        ({"time": np.full(200, np.nan)}, DataError, "time"),
        ({"time": np.zeros((2, 2))}, DataError, "time"),
        ({"time": np.zeros(200)}, DataError, "time"),
        ({"imus": {"nowhere": np.zeros((200, 6))}}, ModelError, "nowhere"),
        ({"wrenches": {"left_sole": np.zeros((200, 3))}}, DataError, "left_sole"),
    ],
)
def test_invalid_arrays_are_named(robot, change, error, named) -> None:
    with pytest.raises(error, match=named):
        Log.from_arrays(robot, **(arrays(robot) | change))


def test_a_sensor_without_readings_is_named(robot) -> None:
    log = Log.from_arrays(robot, **arrays(robot))
    streams = log.streams()
    imu = replace(streams.imus[0], stamp=streams.imus[0].stamp + 10**12)
    (whole,) = Log.from_streams(replace(streams, imus=(imu,))).slices()
    assert whole.streams is None
    assert "imus['imu_link']" in whole.fault
