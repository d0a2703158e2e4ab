"""An IMU on a base that counts as fixed."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError

OFFSET = 0.1  # rad/s, of a gyroscope at rest


@pytest.fixture(scope="module")
def joints():
    robot = arm()
    return log_of(robot, drives(robot, viscous=0.4), seconds=12.0).streams().joints


def log_with_imu(joints, *, swing, share=1.0, link=0, sign=1.0):
    """Return a log with an IMU that turns by a swing (rad/s) in a share of the time."""
    robot, time = arm(), 1e-9 * (joints.stamp - joints.stamp[0])
    imu = np.random.default_rng(0).normal(0.0, [2e-3] * 3 + [2e-2] * 3, (len(time), 6))
    imu += np.append([OFFSET, 0.0, 0.0], -robot.gravity)
    imu[:, 1] += swing * np.sin(4 * time) * (time < share * time[-1])
    arrays = {"position": joints.position, "effort": sign * joints.effort}
    imus = {robot.link_names[link]: imu}
    return robot, sy.Log.from_arrays(robot, time=time, imus=imus, **arrays)


def base_motions(robot, log):
    return [one for one in sy.diagnose(robot, log).findings if one.kind is Kind.BASE_MOTION]


def test_a_base_that_moves_is_named(joints):
    robot, log = log_with_imu(joints, swing=0.2)
    (found,) = base_motions(robot, log)
    assert found.figures["moving_share"] > 0.5
    assert "give `base` floating" in found.message
    assert any("counts as fixed" in one for one in sy.identify(robot, log).alarms)


@pytest.mark.parametrize("kw", [{"swing": 0.0}, {"swing": 0.2, "link": -1}, {"swing": 0.01}])
def test_a_base_at_rest_and_a_sensor_elsewhere_are_not(joints, kw):
    assert not base_motions(*log_with_imu(joints, **kw))


def test_a_base_that_drives_a_fifth_of_the_time(joints):
    (found,) = base_motions(*log_with_imu(joints, swing=0.2, share=0.2))
    assert found.figures["moving_share"] == pytest.approx(0.2, abs=0.1)


def test_a_moving_base_comes_before_contradicting_efforts(joints):
    """The efforts seem to be reversed."""
    robot, log = log_with_imu(joints, swing=0.2, sign=-1.0)
    with pytest.raises(DataError, match=r"^arrays: \S+ the base turns .* also"):
        sy.identify(robot, log)
