"""Spikes: readings that jump away for a few messages and back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from symbid_ros.signals.defects import Defect, DefectCounts
from symbid_ros.signals.spikes import LONGEST, without_spikes
from symbid_ros.signals.streams import JointStream, WrenchStream

COUNT = 2000
RATE = 250


def joints(rate: float = RATE, seed: int = 0) -> JointStream:
    """Two joints in quick motion, whose drives rub, with noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(COUNT) / rate
    phase = 2 * np.pi * np.outer(time, [0.7, 2.3]) + rng.uniform(0, 6, 2)
    position = np.sin(phase) + rng.normal(0, 1e-5, phase.shape)
    velocity = 2 * np.pi * np.array([0.7, 2.3]) * np.cos(phase)
    effort = 20 * np.cos(phase) + 5 * np.sign(velocity) + rng.normal(0, 0.5, phase.shape)
    stamp = np.round(time * 1e9).astype(np.int64)
    return JointStream("/joint_states", ("a", "b"), stamp, position, velocity, effort)


def wrench(seed: int = 0) -> WrenchStream:
    rng = np.random.default_rng(seed)
    stamp = np.arange(COUNT, dtype=np.int64) * 4_000_000
    force = rng.normal([0, 0, 150], 30, (COUNT, 3))
    return WrenchStream("/wrench", "sole", stamp, force, rng.normal(0, 5, (COUNT, 3)))


def dropped(stream, *, warning: str = "") -> list[int]:
    """Return the indices of the messages that are left out."""
    tally = DefectCounts("log", stream.topic)
    tally.count_messages(stream.stamp)
    left = without_spikes(stream, tally)
    missing = np.flatnonzero(~np.isin(stream.stamp, left.stamp)).tolist()
    assert tally.counts.get(Defect.SPIKE, 0) == len(missing)
    if warning:
        assert tally.description(Defect.SPIKE) == warning
    return missing


@pytest.mark.parametrize("rate", [20, 100, 250, 1000])
def test_quick_motion_has_no_spike(rate) -> None:
    stream = joints(rate)
    tally = DefectCounts("log", stream.topic)
    assert without_spikes(stream, tally) is stream
    assert len(without_spikes(wrench(), tally).stamp) == COUNT
    assert tally.counts == {}


@settings(deadline=None, max_examples=40)
@given(
    first=st.integers(0, COUNT - LONGEST - 1),
    length=st.integers(1, LONGEST),
    joint=st.sampled_from([0, 1]),
    jump=st.sampled_from([-3.0, -0.5, 0.5, 1.2, 40.0]),
    seed=st.integers(0, 3),
)
def test_a_position_that_jumps_away_and_back_is_dropped(first, length, joint, jump, seed) -> None:
    stream = joints(seed=seed)
    stream.position[first : first + length, joint] += jump
    at_end = first < LONGEST or first + length > COUNT - LONGEST
    found = dropped(stream)
    # At the ends of a log nothing may show that the joint was elsewhere before or after.
    assert found == list(range(first, first + length)) or (at_end and not found)


def test_a_dropout_is_named_with_its_joint_and_time() -> None:
    stream = joints()
    stream.position[[700, 900], 1] = 0.0
    stream.position[700, 1] = stream.position[699, 1] + 0.5
    text = "have a spike in position of b, the first at 2.800 s, and were dropped"
    assert 700 in dropped(stream, warning=text)


@pytest.mark.parametrize("value", [400.0, -1e4, 1e6])
@pytest.mark.parametrize("count", [1, 20])
def test_efforts_beyond_all_others_are_dropped(value, count) -> None:
    stream = joints()
    places = np.sort(np.random.default_rng(1).choice(COUNT, count, replace=False))
    stream.effort[places, 0] = value
    assert dropped(stream) == places.tolist()


def test_forces_beyond_all_others_are_dropped() -> None:
    stream = wrench()
    stream.force[500::200, 2] = 5000.0
    text = "have a spike in wrench.force, the first at 2.000 s, and were dropped"
    assert dropped(stream, warning=text) == list(range(500, COUNT, 200))


def test_missing_readings_do_not_hide_a_spike() -> None:
    stream = joints()
    stream.position[100:300, 0] = np.nan
    stream.effort[::3, 0] = np.nan
    stream.position[700, 0] += 1.0
    stream.effort[901, 0] = 1e5
    assert dropped(stream) == [700, 901]


def test_a_step_is_not_a_spike() -> None:
    """Of an encoder that slips, or of an effort when a brake closes or an impact lasts longer."""
    stream = joints()
    stream.position[800:, 0] += 0.5
    stream.effort[1200:1210, 1] = 1e4
    assert dropped(stream) == []


def test_frequent_readings_are_not_spikes() -> None:
    stream = joints()
    stream.effort[::50, 0] = 1e4
    stream.position[::50, 1] += 1.0
    assert dropped(stream) == []


def test_a_resting_joint_may_flicker() -> None:
    stream = joints()
    stream.position[:, 0] = 0.3
    stream.position[500, 0] += 0.001
    stream.effort[:, 0] = 0.0
    stream.effort[600, 0] = 0.5
    assert dropped(stream) == []


def test_messages_between_two_gaps_are_not_a_spike() -> None:
    """The joint moved in both."""
    stream = joints(1000)
    kept = np.r_[0:800, 1000:1003, 1200:COUNT]
    fields = {name: getattr(stream, name)[kept] for name in ("position", "velocity", "effort")}
    assert dropped(replace(stream, stamp=stream.stamp[kept], **fields)) == []
