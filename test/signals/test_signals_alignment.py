"""Alignment of topics with different rates, against the sines that they sample."""

import logging
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from analytic_log import analytic_samples, imu_motion, readings_of, stacked
from expected_errors import raises_code
from hypothesis import given
from hypothesis import strategies as st
from random_robots import random_robot

from symbid_ros.dynamics.imu import BaseMotion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.alignment import (
    SHORTEST_SEGMENT,
    _merged,
    align,
    resampling_margin,
    warn_once,
)
from symbid_ros.signals.required_sensors import suggested_prefix
from symbid_ros.signals.sensor_samples import at_base
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

MILLISECOND = 1_000_000
SECONDS = 2.0
# Interpolated at a hundredth of a second, a sine of 4 Hz is known to 5 (2π 4/100)⁴ / 384 = 5e-5.
FREQUENCY = 4.0


@pytest.fixture(scope="module")
def model():
    return random_robot(1, links=4, wrench_frames=1)


def wave(stamp, columns):
    """Return sines (N, columns) at stamps, ns."""
    return np.sin(2 * np.pi * FREQUENCY * stamp[:, None] * 1e-9 + np.arange(columns))


def ticks(period, first=0):
    """Return stamps of a topic, ns."""
    return np.arange(first, round(SECONDS * 1e9), period, dtype=np.int64)


def without(stamp, start, stop):
    """Return the stamps outside of a gap, s."""
    return stamp[(stamp < start * 1e9) | (stamp >= stop * 1e9)]


def streams(model, joints, imu, wrench):
    """Return sines sampled at the stamps of each topic."""
    names, nothing = model.joint_names, np.zeros((len(joints), len(model.joints)))
    values = wave(joints, 2 * len(names))
    position, effort = values[:, : len(names)], values[:, len(names) :]
    rate, force = wave(imu, 6)[:, :3], wave(imu, 6)[:, 3:]
    moment, push = wave(wrench, 6)[:, :3], wave(wrench, 6)[:, 3:]
    return Streams(
        "sines",
        JointStream("/joint_states", names, joints, position, nothing, effort),
        (ImuStream("/imu/data", "imu_link", imu, None, rate, force),),
        (WrenchStream("/wrench", "wrench_0", wrench, push, moment),),
    )


def assert_sampled(segments, tolerance):
    """Compare every channel with its sine."""
    for segment in segments:
        joints = wave(segment.stamp, 2 * segment.position.shape[1])
        found = np.concatenate([segment.position, segment.effort], axis=1)
        np.testing.assert_allclose(found, joints, atol=tolerance)
        sensors = wave(segment.stamp, 6)
        imu = np.concatenate([segment.angular_velocity, segment.linear_acceleration], axis=2)
        np.testing.assert_allclose(imu[:, 0], sensors, atol=tolerance)
        np.testing.assert_allclose(segment.wrenches[:, 0], sensors, atol=tolerance)


@pytest.mark.parametrize("phase", [0, 3_700_000])
def test_a_topic_at_a_tenth_of_the_rate_cuts_nothing(model, phase) -> None:
    fast, slow = ticks(MILLISECOND), ticks(10 * MILLISECOND, phase)
    (segment,) = align(streams(model, fast, fast, slow), model)
    inside = (fast >= slow[0]) & (fast <= slow[-1])
    np.testing.assert_array_equal(segment.stamp, fast[inside])
    assert segment.sensor_rates == pytest.approx((1000.0, 100.0))
    # A spline is less accurate at its ends.
    assert_sampled([segment], 1e-2)
    assert_sampled([segment.cut(50, len(segment) - 50)], 1e-4)


def test_a_gap_is_measured_by_the_period_of_its_own_topic(model) -> None:
    fast, slow = ticks(MILLISECOND), ticks(10 * MILLISECOND)
    bridged = without(slow, 0.505, 0.545)  # 50 ms from one message to the next
    assert len(align(streams(model, fast, fast, bridged), model)) == 1
    cut = align(streams(model, fast, fast, without(slow, 0.505, 0.555)), model)
    edges = [(one.stamp[0], one.stamp[-1]) for one in cut]
    last = slow[-1]
    assert edges == [(0, 500 * MILLISECOND), (560 * MILLISECOND, last)]
    # The same interval is a gap in a fast topic.
    assert len(align(streams(model, fast, without(fast, 0.505, 0.545), slow), model)) == 2


def test_where_another_topic_has_a_gap_splines_reach_beyond_the_cut(model) -> None:
    """The ends of a segment are as accurate as its middle where the slow topic continues."""
    fast, slow = ticks(MILLISECOND), ticks(10 * MILLISECOND, 3_700_000)
    found = align(streams(model, fast, without(fast, 0.8, 1.2), slow), model)
    assert len(found) == 2
    first, second = found
    assert_sampled([first.cut(50, len(first)), second.cut(0, len(second) - 50)], 1e-4)


def test_several_imus_have_equal_weight() -> None:
    """Opposite errors at the base cancel in the mean of all IMUs."""
    parameters = ParameterSet(random_robot(2, links=5, wrench_frames=1))
    model, frame = parameters.model, parameters.model.links[0].name
    samples = analytic_samples(parameters, ticks(20 * MILLISECOND), 2)
    truth, other = imu_motion(model, samples, frame), imu_motion(model, samples, "imu_link")
    error = 0.1 * np.random.default_rng(2).normal(size=(3, len(samples), 3))
    exact = [truth.angular_velocity, truth.angular_acceleration, truth.specific_force]
    readings = readings_of(model, samples, (frame, "imu_link"))
    for imus, remaining in (
        ((BaseMotion(*(exact + error)), BaseMotion(*(exact - error)), other), 0.0),
        ((BaseMotion(*(exact + error)), other, other), 1 / 3),
        ((other, other, BaseMotion(*(exact + error))), 1 / 3),
    ):
        frames = tuple("imu_link" if imu is other else frame for imu in imus)
        found = at_base(replace(readings, imu_frames=frames, **stacked(imus, len(samples))), model)
        for name, was, wrong in zip(
            ("base_angular_velocity", "base_angular_acceleration", "base_specific_force"),
            exact,
            error,
            strict=True,
        ):
            np.testing.assert_allclose(getattr(found, name), was + remaining * wrong, atol=1e-9)


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 12)), max_size=8))
def test_merged_intervals_cover_the_same_instants_and_are_apart(intervals) -> None:
    cuts = [(begin, begin + length) for begin, length in intervals]
    merged = _merged(cuts)
    inside = {2 * t + half for a, b in cuts for t in range(a, b) for half in (0, 1)}
    assert {2 * t + half for a, b in merged for t in range(a, b) for half in (0, 1)} == inside
    assert all(one[1] < other[0] for one, other in pairwise(merged))


def test_overlapping_gaps_of_two_topics_are_one_cut(model) -> None:
    clock = ticks(MILLISECOND)
    imu, wrench = without(clock, 0.5, 0.9), without(clock, 0.6, 0.7)
    found = align(streams(model, clock, imu, wrench), model)
    edges = [(one.stamp[0], one.stamp[-1]) for one in found]
    assert edges == [(0, 499 * MILLISECOND), (900 * MILLISECOND, 1999 * MILLISECOND)]


@pytest.mark.parametrize("count", [SHORTEST_SEGMENT - 1, SHORTEST_SEGMENT])
def test_a_segment_has_at_least_fifty_samples(model, count) -> None:
    """Gaps of an IMU leave segments with the given numbers of samples."""
    clock = ticks(MILLISECOND)
    phase = np.arange(len(clock)) % 100
    given_streams = streams(model, clock, clock[phase < count], clock)
    if count < SHORTEST_SEGMENT:
        with raises_code("E303", "record longer"):
            align(given_streams, model)
        with raises_code("E303", "drivers"):
            align(replace(given_streams, is_live=True), model)
    else:
        assert {len(one) for one in align(given_streams, model)} == {count}


@pytest.mark.parametrize("count", [SHORTEST_SEGMENT - 1, SHORTEST_SEGMENT])
def test_a_log_has_at_least_fifty_joint_states(model, count) -> None:
    clock = ticks(MILLISECOND)[:count]
    given_streams = streams(model, clock, clock, clock)
    if count < SHORTEST_SEGMENT:
        with raises_code("E303", f"{count} joint states.*record longer"):
            align(given_streams, model)
        with raises_code("E303", "higher rate"):
            align(replace(given_streams, is_live=True), model)
    else:
        assert len(align(given_streams, model)) == 1


def test_a_topic_without_messages_is_named(model) -> None:
    clock = ticks(MILLISECOND)
    with raises_code("E301", "/wrench"):
        align(streams(model, clock, clock, clock[:0]), model)
    with raises_code("E301", "/imu/data"):
        align(streams(model, clock, clock[:0], clock), model)


@pytest.mark.parametrize(
    ("periods_ms", "margin_ms"),
    [([], 100), ([1], 100), ([5], 100), ([6], 120), ([10, 30, 1], 600), ([80], 1000)],
)
def test_the_margin_is_twenty_periods_of_the_slowest_topic(periods_ms, margin_ms) -> None:
    topics = [np.repeat(np.arange(9), 2)[::-1] * each * MILLISECOND for each in periods_ms]
    assert resampling_margin([*topics, np.array([7]), np.array([])]) == margin_ms * MILLISECOND


def test_the_prefix_that_hides_a_known_frame_is_suggested(model) -> None:
    for known in ("imu_link", "wrench_0", "link_2"):
        assert suggested_prefix(f"robot/{known}", model) == "robot/"
        assert suggested_prefix(f"lab/robot/{known}", model) == "lab/robot/"
        assert not suggested_prefix(f"robot_{known}", model)
    assert not suggested_prefix("robot/imu_link/raw", model)


@pytest.mark.parametrize("module", ["alignment", "efforts"])
def test_equal_warnings_of_slices_are_logged_once(caplog, module) -> None:
    source = logging.getLogger(f"symbid_ros.signals.{module}")

    def warn():
        for joint in ("hip", "knee", "hip"):
            source.warning("joint %s", joint)
        logged = [record.getMessage() for record in caplog.records]
        caplog.clear()
        return logged

    with caplog.at_level(logging.WARNING):
        with warn_once():
            assert [*warn(), *warn()] == ["joint hip", "joint knee"]
        with warn_once(muted=True):
            assert warn() == []
        assert len(warn()) == 3
