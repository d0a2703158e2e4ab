"""What identification leaves out of a log: messages of a frozen sensor, or of one at its limit."""

from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.sensor_faults import (
    ExtremeCounts,
    FreezeDetector,
    SaturationDetector,
    _largest,
    mask_faulty_messages,
)
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

COUNT = 2000


@pytest.fixture
def streams() -> Streams:
    """Noise at 1 kHz on every channel, of joints that move."""
    rng = np.random.default_rng(3)
    stamp = np.arange(COUNT, dtype=np.int64) * 1_000_000

    def noise(width: int) -> np.ndarray:
        return rng.normal(size=(COUNT, width))

    joints = JointStream("/joint_states", ("a", "b"), stamp, noise(2), noise(2), noise(2))
    joints.position[:] += 100 * np.sin(2 * np.pi * 1.3e-9 * stamp)[:, None]
    imu = ImuStream("/imu", "imu", stamp, noise(4), noise(3), noise(3))
    wrench = WrenchStream("/wrench", "tool", stamp, noise(3), noise(3))
    return Streams("log", joints, (imu,), (wrench,))


def test_whole_streams_pass_untouched(streams) -> None:
    left, findings = mask_faulty_messages(streams)
    assert left is streams
    assert findings == ()


def come_to_rest(joints) -> None:
    """Let joints slow down before 0.8 s, and start slowly again at 1.2 s."""
    speed = np.maximum(np.abs(np.arange(COUNT) - 1000.0) - 200.0, 0.0)
    joints.position[:] = 1e-6 * np.cumsum(speed)[:, None]


def test_a_frozen_sensor_leaves_a_gap(streams) -> None:
    (imu,) = streams.imus
    imu.angular_velocity[500:700] = imu.angular_velocity[500]
    imu.linear_acceleration[500:700] = imu.linear_acceleration[500]
    left, (finding,) = mask_faulty_messages(streams)
    assert (finding.kind, finding.stream) == (Kind.FROZEN, "/imu")
    kept = np.delete(np.arange(COUNT), np.arange(500, 700))
    np.testing.assert_array_equal(left.imus[0].stamp, imu.stamp[kept])
    np.testing.assert_array_equal(left.imus[0].orientation, imu.orientation[kept])
    np.testing.assert_array_equal(left.joints.position, streams.joints.position)
    np.testing.assert_array_equal(left.wrenches[0].force, streams.wrenches[0].force)


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


HOLDS = (np.arange(COUNT) + 200) % 400 < 120  # 0.12 s each


def test_a_joint_that_sticks_is_not_frozen(streams) -> None:
    """A slow servo stops between two messages and later continues from the same position."""
    streams.joints.position[:, 0] = 0.01 * np.cumsum(~HOLDS * np.sin(np.arange(COUNT) * 2e-2))
    assert mask_faulty_messages(streams)[1] == ()


def test_an_encoder_that_freezes_as_often_jumps_and_is_left_out(streams) -> None:
    last = np.maximum.accumulate(np.where(HOLDS, 0, np.arange(COUNT)))
    streams.joints.position[:, 0] = 1e-3 * last
    left, (finding,) = mask_faulty_messages(streams)
    assert finding.kind is Kind.FROZEN
    assert "position of a is frozen" in finding.message
    assert np.isin(left.joints.stamp, streams.joints.stamp[~HOLDS]).mean() > 0.99


def test_an_unloaded_sensor_without_noise_is_not_frozen(streams) -> None:
    (wrench,) = streams.wrenches
    wrench.force[400:600] = wrench.torque[400:600] = 0.0
    assert mask_faulty_messages(streams)[1] == ()


def test_a_robot_at_rest_without_noise_is_not_frozen(streams) -> None:
    come_to_rest(streams.joints)
    everything = [streams.joints.position, streams.joints.effort]
    everything += [streams.imus[0].angular_velocity, streams.imus[0].linear_acceleration]
    everything += [streams.wrenches[0].force, streams.wrenches[0].torque]
    for values in everything:
        values[800:1200] = values[800]
    assert mask_faulty_messages(streams)[1] == ()


def test_a_driver_that_repeats_its_last_message_is_frozen(streams) -> None:
    """All joints stop abruptly, and nothing else of the robot moves either."""
    streams.joints.position[:] = 0.3 * np.sin(np.arange(COUNT) * 1e-2)[:, None]
    for values in (streams.joints.position, streams.joints.effort):
        values[800:1200] = values[800]
    alone = replace(streams, imus=(), wrenches=())
    left, (finding,) = mask_faulty_messages(alone)
    assert finding.kind is Kind.FROZEN
    assert "position of a, b are frozen for 0.399 s" in finding.message
    assert len(left.joints.stamp) == COUNT - 400


@pytest.mark.parametrize("step", [0.5, 0.01])
def test_a_coarse_sensor_is_not_saturated(streams, step) -> None:
    (wrench,) = streams.wrenches
    wrench.force[:] = step * np.round(wrench.force / step)
    assert mask_faulty_messages(streams)[1] == ()


def test_a_constant_load_at_rest_is_no_limit(streams) -> None:
    """Only a channel that stops while others of its topic move is at its limit."""
    for values in (streams.joints.position, streams.joints.effort):
        values[800:1200] = values[800]
    streams.joints.effort[800:1200, 1] = streams.joints.effort[:, 1].max() + 1
    detector = SaturationDetector()
    detector.add(streams)
    assert detector.limits == {}


def test_a_channel_of_nan_does_not_make_the_others_look_frozen(streams) -> None:
    """A robot at rest, without noise, whose driver knows nothing of one joint."""
    come_to_rest(streams.joints)
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


@pytest.mark.parametrize(("length", "is_frozen"), [(100, False), (101, True)])
@pytest.mark.parametrize("start", [0, 500, -101])
def test_a_frozen_reading_lasts_a_tenth_of_a_second(streams, length, is_frozen, start) -> None:
    """From its first message to its last, at any place of the log."""
    (wrench,) = streams.wrenches
    first = start if start >= 0 else COUNT - length
    wrench.force[first : first + length] = wrench.force[first]
    wrench.torque[first : first + length] = wrench.torque[first]
    left, findings = mask_faulty_messages(streams)
    assert len(findings) == is_frozen
    assert len(left.wrenches[0].stamp) == COUNT - length * is_frozen
    for one in findings:
        assert one.figures == pytest.approx({"frozen_s": 0.1, "since_s": first * 1e-3})


@pytest.mark.parametrize(("length", "is_frozen"), [(19, False), (20, True)])
def test_a_frozen_reading_repeats_twenty_times(streams, length, is_frozen) -> None:
    """At 100 Hz a tenth of a second is eleven messages."""
    slow = np.arange(0, COUNT, 10)
    joints = streams.joints
    fewer = {name: getattr(joints, name)[slow] for name in ("stamp", "position", "velocity")}
    joints = replace(joints, effort=joints.effort[slow], **fewer)
    joints.effort[50 : 50 + length, 1] = 0.1
    _, findings = mask_faulty_messages(replace(streams, joints=joints))
    assert [one.kind for one in findings] == [Kind.FROZEN] * is_frozen
    for one in findings:
        assert one.figures["frozen_s"] == pytest.approx(0.19)
        assert "effort of b is frozen" in one.message


@pytest.mark.parametrize(("period", "is_frozen"), [(8, False), (12, True)])
def test_a_reading_that_often_repeats_is_not_frozen(streams, period, is_frozen) -> None:
    """It must change with nine of ten messages outside of its runs."""
    effort = streams.joints.effort
    effort[::period, 0] = effort[np.arange(0, COUNT, period) - 1, 0]
    effort[1000:1200, 0] = 3.0
    _, findings = mask_faulty_messages(streams)
    assert [one.kind for one in findings] == [Kind.FROZEN] * is_frozen


@pytest.mark.parametrize(("share", "is_frozen"), [(0.45, False), (0.55, True)])
def test_another_reading_must_move_while_one_is_frozen(streams, share, is_frozen) -> None:
    come_to_rest(streams.joints)
    rest = slice(800, 1200)
    everything = [streams.joints.position, streams.joints.effort]
    everything += [streams.imus[0].angular_velocity, streams.imus[0].linear_acceleration]
    everything += [streams.wrenches[0].force, streams.wrenches[0].torque]
    for values in everything:
        values[rest] = values[800]
    moves = (np.arange(400) * share).astype(int)  # changes with this share of the messages
    streams.joints.position[rest, 0] = 10 + moves
    _, findings = mask_faulty_messages(streams)
    assert bool(findings) is is_frozen


@pytest.mark.parametrize("name", ["position", "effort"])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_frozen_reading_is_found_in_each_slice(streams, name, joint) -> None:
    """Any reading, whichever others come before or after it."""
    getattr(streams.joints, name)[400:800, joint] = 0.1
    detector = FreezeDetector()
    millisecond = 1_000_000
    for start, stop in ((0, 600), (600, COUNT)):
        detector.add(streams, (start * millisecond, stop * millisecond))
    found = {key for key, counts in detector.readings.items() if counts.is_frozen}
    (key,) = found
    assert key == ("/joint_states", f"{name} of {'ab'[joint]}")
    counts = detector.readings[key]
    runs = [(400, 599), (600, 799)]
    assert counts.runs == [(a * millisecond, b * millisecond) for a, b in runs]
    assert (counts.frozen_messages, counts.changes) == (400, COUNT - 399)


@pytest.mark.parametrize(("sway", "is_frozen"), [(4.0, False), (8.0, True)])
def test_a_constant_effort_is_frozen_if_its_joint_moves(streams, sway, is_frozen) -> None:
    """Also if the joint returns to where it was; the limit is a twentieth of its usual speed."""
    joints = streams.joints
    time = np.arange(COUNT) * 1e-3
    joints.position[:, 0] = 100 * np.sin(2 * np.pi * time)
    joints.position[500:1000, 0] = sway * np.sin(4 * np.pi * time[500:1000])
    typical = np.sqrt(np.mean(np.diff(joints.position[:, 0]) ** 2))
    assert 2 * 4.0 < 0.05 * typical * 500 < 2 * 8.0
    joints.effort[500:1000, 0] = 3.0
    _, findings = mask_faulty_messages(streams)
    assert [one.kind for one in findings] == [Kind.FROZEN] * is_frozen


@pytest.mark.parametrize("first", [250, 350])
def test_an_encoder_frozen_for_several_slices_is_found(streams, first) -> None:
    """The later slices do not show how it began."""
    streams.joints.position[first : first + 1150, 0] = 0.1
    detector = FreezeDetector()
    for start in range(0, COUNT, 400):
        detector.add(streams, (start * 1_000_000, (start + 400) * 1_000_000))
    counts = detector.readings["/joint_states", "position of a"]
    assert counts.is_frozen
    # Less than a tenth of a second within a slice does not count.
    assert counts.frozen_messages == 1150 - (50 if first == 350 else 0)


def test_readings_are_counted_from_the_first_stamp_up_to_the_second(streams) -> None:
    detector = FreezeDetector()
    millisecond = 1_000_000
    detector.add(streams, (0, 100 * millisecond))
    detector.add(streams, (100 * millisecond, 150 * millisecond))
    assert set(detector.readings) == {
        ("/joint_states", "position of a"),
        ("/joint_states", "position of b"),
        ("/joint_states", "effort of a"),
        ("/joint_states", "effort of b"),
        ("/imu", ""),
        ("/wrench", ""),
    }
    for counts in detector.readings.values():
        assert (counts.messages, counts.changes, counts.frozen_messages) == (150, 150, 0)
        assert not counts.is_frozen
    saturation = SaturationDetector()
    saturation.add(streams, (0, 100 * millisecond))
    # The first message of a slice has no change.
    assert set(saturation.values.values()) == {99}
    assert saturation.limits == {}


@pytest.mark.parametrize(
    ("lengths", "is_limit"),
    [
        ([10], True),
        ([9], False),
        ([5, 5], True),
        ([4, 4, 4], False),
        ([5, 1, 4], True),
        ([5, 1, 3], False),
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_limit_is_reached_ten_times_and_five_in_a_row(streams, lengths, is_limit, sign) -> None:
    (imu,) = streams.imus
    start = 100
    for length in lengths:
        imu.angular_velocity[start : start + length, 1] = 5.0 * sign
        start += length + 50
    found = SaturationDetector()
    found.add(streams)
    key = ("/imu", "angular_velocity.y", sign)
    assert found.limits == ({key: (5.0 * sign, sum(lengths))} if is_limit else {})
    for one in found.findings():
        assert f"is exactly {5 * sign} in {sum(lengths)} messages" in one.message
        assert ("never more" if sign > 0 else "never less") in one.message


def test_extreme_values_are_kept_with_their_longest_runs() -> None:
    counts = ExtremeCounts()
    counts.add(np.array([1.0, 1, 2, 1, 3, 3, 3]), np.array([1.0, 2.0, 3.0]))
    counts.add(np.array([3.0, 2, 3]), np.array([3.0, 2.0]))
    assert dict(counts.counts) == {1.0: 3, 2.0: 2, 3.0: 5}
    assert counts.longest == {1.0: 2, 2.0: 1, 3.0: 3}
    counts.add(np.array([3.0]), np.array([4.0]))
    assert (counts.counts[4.0], counts.longest[4.0]) == (0, 0)
    for sign, kept in ((1, range(4, 21)), (-1, range(17))):
        counts = ExtremeCounts()
        values = np.arange(21.0)
        counts.add(values, values)
        counts.keep(sign)
        assert sorted(counts.counts) == sorted(counts.longest) == list(kept)


@pytest.mark.parametrize(
    ("at_limit", "next_value", "is_limit"), [(10, 2, True), (14, 3, False), (15, 3, True)]
)
def test_a_limit_is_five_times_as_frequent_as_the_next_values(
    at_limit, next_value, is_limit
) -> None:
    for sign in (1, -1):
        counts = ExtremeCounts()
        values = sign * np.repeat([9.0, 8.0, 7.0], [at_limit, next_value, 1])
        counts.add(values, np.unique(values))
        assert counts.limit(sign) == ((9.0 * sign, at_limit) if is_limit else None)


@pytest.mark.parametrize(("levels", "is_limit"), [(49, False), (50, True)])
def test_a_coarse_channel_has_no_limit(streams, levels, is_limit) -> None:
    force = streams.wrenches[0].force
    force[:, 0] = np.arange(COUNT) % (levels - 1)
    force[500:1000, 0] = levels - 1
    found = SaturationDetector()
    found.add(streams)
    assert (("/wrench", "wrench.force.x", 1) in found.limits) is is_limit


@pytest.mark.parametrize("distinct_values", [1, 10, 40, 10**6])
def test_largest_values_are_those_of_all_sorted(distinct_values):
    values = np.random.default_rng(7).integers(distinct_values, size=30_000) / 8
    for some in (values, values[:17], values[:300], np.sort(values), np.sort(values)[::-1]):
        assert _largest(some, 17).tolist() == np.unique(some)[-17:].tolist()
