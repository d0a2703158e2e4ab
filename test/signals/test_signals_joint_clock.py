"""Times of samples whose stamps are wrong: copies, jitter, and clocks that run ahead."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.jitter import JitterCheck
from symbid_ros.signals.joint_clock import find_copies, sampled_joints
from symbid_ros.signals.streams import JointStream

JOINTS = 5


def motion(time, seed=0):
    rng = np.random.default_rng(seed)
    pace, phase = rng.uniform(1.0, 6.0, (2, JOINTS))
    return 0.6 * np.sin(np.outer(time, pace) + phase)


def stream(stamped, sampled, noise=1e-5, seed=0) -> JointStream:
    """Return joint states sampled at the second times (N,), s, and stamped with the first."""
    rng = np.random.default_rng(seed + 1)
    read = motion(sampled, seed) + noise * rng.standard_normal((len(sampled), JOINTS))
    stamp = np.round(1e9 * np.asarray(stamped)).astype(np.int64) + 10**18
    effort = 3 * read + 0.1 * rng.standard_normal(read.shape)
    return JointStream(
        "/joint_states", tuple("abcde"), stamp, read, np.gradient(read, axis=0), effort
    )


def error(stamp, sampled) -> float:
    """Return the deviation of stamps, ns, from times, s, apart from a common offset, in s."""
    return float(np.std(1e-9 * (stamp - 10**18) - sampled))


def republished(rate, own, seconds=20.0):
    """Return stamps of a publisher, and when its last sample at another rate was taken."""
    stamped = np.arange(0, seconds, 1 / own)
    latest = np.floor(stamped * rate + 1e-9).astype(int)
    return stamped, latest / rate, np.diff(latest, prepend=-1) == 0


@pytest.mark.parametrize(
    ("rate", "own"), [(29.4, 30.0), (97.0, 100.0), (490.0, 500.0), (97.0, 1000.0), (49.0, 500.0)]
)
def test_copies_are_dropped_and_the_clock_is_that_of_the_samples(rate, own) -> None:
    stamped, sampled, repeats = republished(rate, own)
    recorded = stream(stamped, sampled)
    fresh = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(repeats))))
    for values in (recorded.position, recorded.velocity, recorded.effort):
        values[:] = values[fresh]
    clock = sampled_joints(recorded)
    inner = slice(3, -3) if own < 2 * rate else slice(None)  # a copy at an end has no neighbour
    assert np.array_equal(clock.copies[inner], repeats[inner])
    times = sampled[~clock.copies]
    assert error(recorded.stamp[~clock.copies], times) > 0.25 / own
    assert error(clock.joints.stamp, times) < 0.05 / own
    assert clock.jitter > 0.25 / own


def test_a_frozen_topic_is_not_taken_for_copies() -> None:
    sampled = np.arange(0, 20, 0.01)
    recorded = stream(sampled, sampled)
    for values in (recorded.position, recorded.velocity, recorded.effort):
        values[500:1900] = values[499]  # most of the log
    assert not find_copies(recorded).any()


def test_stamps_that_jitter_about_uniform_samples_are_corrected() -> None:
    rng = np.random.default_rng(5)
    sampled = np.arange(0, 20, 0.004)
    sampled = sampled[rng.random(len(sampled)) > 0.01]  # lost messages leave holes
    recorded = stream(sampled + np.abs(0.8e-3 * rng.standard_normal(len(sampled))), sampled)
    clock = sampled_joints(recorded)
    assert error(recorded.stamp, sampled) > 0.4e-3
    assert error(clock.joints.stamp, sampled) < 0.05e-3


def spaced(stamped, apart):
    """Return stamps in order, s, each at least some time after the one before."""
    order = apart * np.arange(len(stamped))
    return np.maximum.accumulate(np.sort(stamped) - order) + order


@pytest.mark.parametrize("apart", [1e-8, 2e-5])
@pytest.mark.parametrize("rate", [200.0, 500.0, 1000.0, 2000.0])
def test_stamps_that_jitter_by_several_periods_are_corrected(rate, apart) -> None:
    sampled = np.arange(0, 20, 1 / rate)
    jitter = np.random.default_rng(5).uniform(-5e-3, 5e-3, len(sampled))
    recorded = stream(spaced(sampled + jitter, apart), sampled)
    clock = sampled_joints(recorded)
    assert error(recorded.stamp, sampled) > 0.8e-3
    assert error(clock.joints.stamp, sampled) < 0.15e-3
    assert clock.uncorrected == 0


@pytest.mark.parametrize("rate", [500.0, 1000.0])
def test_messages_that_wait_for_a_late_one_are_corrected(rate) -> None:
    """They come in bursts, so that most intervals are far shorter than a period."""
    sampled = np.arange(0, 20, 1 / rate)
    late = np.random.default_rng(6).exponential(2e-3, len(sampled))
    recorded = stream(spaced(np.maximum.accumulate(sampled + late), 2e-5), sampled)
    clock = sampled_joints(recorded)
    assert error(recorded.stamp, sampled) > 2e-3
    assert error(clock.joints.stamp, sampled) < 0.25e-3


@pytest.mark.parametrize("pause", [0.03, 0.1])
def test_pauses_are_kept_where_stamps_jitter_by_several_periods(pause) -> None:
    even = np.arange(0, 20, 0.002)
    sampled = even + pause * np.floor(even / 1.9)
    jitter = np.random.default_rng(7).uniform(-5e-3, 5e-3, len(sampled))
    recorded = stream(spaced(sampled + jitter, 2e-5), sampled)
    clock = sampled_joints(recorded)
    assert error(recorded.stamp, sampled) > 1.5e-3
    assert error(clock.joints.stamp, sampled) < 0.25e-3


def test_of_samples_with_nearly_equal_stamps_one_is_kept() -> None:
    """No smooth curve passes through both where the stamps stay as they are."""
    sampled = np.cumsum(np.random.default_rng(8).uniform(0.006, 0.014, 2000))
    stamped = sampled.copy()
    stamped[700] = stamped[699] + 1e-8
    recorded = stream(stamped, sampled)
    kept = np.delete(recorded.stamp, 700)
    assert np.array_equal(sampled_joints(recorded).joints.stamp, kept)


def test_a_part_that_keeps_its_jittering_stamps_beside_a_corrected_one_is_reported() -> None:
    rng = np.random.default_rng(9)
    even = np.arange(0, 10, 0.002)
    uneven = 11.0 + np.cumsum(rng.exponential(0.002, 2500))
    sampled = np.append(even, uneven)
    recorded = stream(spaced(sampled + rng.uniform(-5e-3, 5e-3, len(sampled)), 2e-5), sampled)
    check = JitterCheck("/joint_states")
    check.add(recorded)
    found = {one.kind: one for one in check.findings()}
    assert Kind.STAMP in found
    assert 0.25 < found[Kind.JITTER].figures["share"] < 0.34  # short pieces are not used


def test_a_clock_that_drifts_is_followed() -> None:
    rng = np.random.default_rng(6)
    sampled = np.arange(0, 60, 0.01)
    drift = 0.03 * np.sin(0.02 * sampled)  # up to 600 ppm
    recorded = stream(sampled + drift + 1e-3 * rng.random(len(sampled)), sampled + drift)
    clock = sampled_joints(recorded)
    inner = slice(500, -500)
    assert error(clock.joints.stamp[inner], (sampled + drift)[inner]) < 0.1e-3


def test_irregular_samples_with_right_stamps_stay() -> None:
    rng = np.random.default_rng(7)
    sampled = np.cumsum(rng.uniform(0.006, 0.014, 2000))
    recorded = stream(sampled, sampled)
    clock = sampled_joints(recorded)
    assert np.array_equal(clock.joints.stamp, recorded.stamp)
    assert clock.jitter == 0


@pytest.mark.parametrize("seconds", [4.0, 30.0])
def test_a_loop_that_changes_its_period_is_followed(seconds) -> None:
    rng = np.random.default_rng(8)
    count = round(seconds / 1.7e-3)
    sampled = np.cumsum(1.7e-3 + 0.2e-3 * np.sin(np.linspace(0, 3 * seconds / 4, count)))
    recorded = stream(sampled + 0.3e-3 * np.abs(rng.standard_normal(count)), sampled, 1e-6)
    clock = sampled_joints(recorded)
    assert error(clock.joints.stamp, sampled) < 0.25 * 1.7e-3  # of a period


def test_a_loop_that_pauses_keeps_its_stamps() -> None:
    """Its samples are smoother by number where they were read before the pause."""
    rng = np.random.default_rng(9)
    steps = np.full(3000, 1.6e-3)
    pauses = rng.choice(3000, 90, replace=False)
    steps[pauses] += 4e-3
    stamped = np.cumsum(steps) + 1e-4 * rng.random(3000)
    read = stamped.copy()
    read[pauses] -= 3.5e-3
    clock = sampled_joints(stream(stamped, read))
    assert not clock.copies.any()
    assert error(clock.joints.stamp, stamped) < 0.1e-3


def test_regular_logs_pass_as_they_are() -> None:
    sampled = np.arange(0, 5, 0.002)
    recorded = stream(sampled, sampled)
    assert sampled_joints(recorded).joints is recorded


def test_a_robot_at_rest_repeats_no_message_wrongly() -> None:
    """Coarse encoders give the same readings again and again while nothing moves."""
    sampled = np.arange(0, 10, 0.01)
    recorded = stream(sampled, np.full_like(sampled, 0.3), noise=3e-5)
    coarse = replace(
        recorded, position=np.round(recorded.position, 3), effort=np.round(recorded.effort, 0)
    )
    assert not find_copies(coarse).any()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_times_stay_in_order_and_near_their_stamps(seed) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 400))
    steps = rng.choice([1, 1, 1, 2, 40], count) * rng.uniform(0.2, 2.0, count) * 0.01
    stamped = np.cumsum(np.maximum(steps, 1e-6))
    recorded = stream(stamped, np.round(stamped, 2), seed=int(rng.integers(99)))
    clock = sampled_joints(recorded)
    kept = recorded.stamp[~clock.copies]
    assert len(clock.joints.stamp) == len(kept)
    assert (np.diff(clock.joints.stamp) > 0).all()
    assert np.abs(clock.joints.stamp - kept).max(initial=0) < 1e9


def test_the_doctor_tells_what_was_corrected() -> None:
    stamped, sampled, repeats = republished(97.0, 100.0, 60.0)
    recorded = stream(stamped, sampled)
    for values in (recorded.position, recorded.velocity, recorded.effort):
        values[repeats] = values[np.flatnonzero(repeats) - 1]
    check = JitterCheck("/joint_states")
    check.add(recorded)
    copy, stamp = check.findings()
    assert (copy.kind, stamp.kind) == (Kind.COPY, Kind.STAMP)
    assert copy.figures["messages"] == len(stamped)
    assert abs(copy.figures["copies"] - repeats.sum()) <= 2
    assert 2.0 < stamp.figures["jitter_ms"] < 4.0  # uniform within a period of 10 ms
