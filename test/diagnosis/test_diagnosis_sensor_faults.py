"""What identification leaves out of a log: messages of a frozen sensor, or of one at its limit."""

import numpy as np
import pytest

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

COUNT = 2000


@pytest.fixture
def streams() -> Streams:
    """Noise at 1 kHz on every channel."""
    rng = np.random.default_rng(3)
    stamp = np.arange(COUNT, dtype=np.int64) * 1_000_000

    def noise(width: int) -> np.ndarray:
        return rng.normal(size=(COUNT, width))

    joints = JointStream("/joint_states", ("a", "b"), stamp, noise(2), noise(2), noise(2))
    imu = ImuStream("/imu", "imu", stamp, noise(4), noise(3), noise(3))
    wrench = WrenchStream("/wrench", "tool", stamp, noise(3), noise(3))
    return Streams("log", joints, (imu,), (wrench,))


def test_whole_streams_pass_untouched(streams) -> None:
    left, findings = mask_faulty_messages(streams)
    assert left is streams
    assert findings == ()


def test_a_frozen_sensor_leaves_a_gap(streams) -> None:
    (imu,) = streams.imus
    imu.angular_velocity[500:700] = imu.angular_velocity[500]
    imu.linear_acceleration[500:700] = imu.linear_acceleration[500]
    left, (finding,) = mask_faulty_messages(streams)
    assert (finding.kind, finding.stream) == (Kind.FROZEN, "/imu")
    kept = np.delete(np.arange(COUNT), np.arange(500, 700))
    np.testing.assert_array_equal(left.imus[0].stamp, imu.stamp[kept])
    np.testing.assert_array_equal(left.imus[0].orientation, imu.orientation[kept])
    assert left.joints is streams.joints
    assert left.wrenches[0] is streams.wrenches[0]


def test_messages_at_a_limit_are_left_out(streams) -> None:
    (wrench,) = streams.wrenches
    wrench.force[300:320, 2] = wrench.force[900:930, 2] = 4.0
    left, (finding,) = mask_faulty_messages(streams)
    assert (finding.kind, finding.stream) == (Kind.SATURATED, "/wrench")
    assert finding.figures == {"limit": 4.0, "messages": 50}
    assert len(left.wrenches[0].stamp) == COUNT - 50
    assert not np.any(left.wrenches[0].force[:, 2] == 4.0)


def test_an_encoder_that_counts_slow_steps_is_not_frozen(streams) -> None:
    streams.joints.position[:, 0] = np.round(np.linspace(0, 5, COUNT))
    assert mask_faulty_messages(streams)[1] == ()


def test_an_unloaded_sensor_without_noise_is_not_frozen(streams) -> None:
    (wrench,) = streams.wrenches
    wrench.force[400:600] = wrench.torque[400:600] = 0.0
    assert mask_faulty_messages(streams)[1] == ()


def test_a_robot_at_rest_without_noise_is_not_frozen(streams) -> None:
    everything = [streams.joints.position, streams.joints.effort]
    everything += [streams.imus[0].angular_velocity, streams.imus[0].linear_acceleration]
    everything += [streams.wrenches[0].force, streams.wrenches[0].torque]
    for values in everything:
        values[800:1200] = values[800]
    assert mask_faulty_messages(streams)[1] == ()


@pytest.mark.parametrize("step", [0.5, 0.01])
def test_a_coarse_sensor_is_not_saturated(streams, step) -> None:
    (wrench,) = streams.wrenches
    wrench.force[:] = step * np.round(wrench.force / step)
    assert mask_faulty_messages(streams)[1] == ()


def test_a_channel_of_nan_does_not_make_the_others_look_frozen(streams) -> None:
    """A robot at rest, without noise, whose driver knows nothing of one joint."""
    streams.joints.position[:, 0] = streams.joints.effort[:, 0] = np.nan
    everything = [streams.joints.position, streams.joints.effort]
    everything += [streams.imus[0].angular_velocity, streams.imus[0].linear_acceleration]
    everything += [streams.wrenches[0].force, streams.wrenches[0].torque]
    for values in everything:
        values[800:1200] = values[800]
    streams.joints.effort[800:1200, 1] = streams.joints.effort[:, 1].max() + 1
    assert mask_faulty_messages(streams)[1] == ()


def test_a_sensor_frozen_for_the_shortest_time_up_to_the_end_is_masked(streams) -> None:
    (imu,) = streams.imus
    imu.angular_velocity[-101:] = imu.angular_velocity[-101]  # 0.1 s
    imu.linear_acceleration[-101:] = imu.linear_acceleration[-101]
    left, (finding,) = mask_faulty_messages(streams)
    assert finding.figures["frozen_s"] == pytest.approx(0.1)
    assert len(left.imus[0].stamp) == COUNT - 101
