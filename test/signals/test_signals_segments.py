"""Seconds are recognised however a log was cut, and told from those of other logs."""

import numpy as np
import pytest

from symbid_ros.signals.segments import Segment, fingerprint

SECOND = 1_000_000_000
TODAY = 1_790_000_000 * SECOND + 123_456_789


def segment(start, seconds, *, rate=1000.0, seed=0):
    """Return random joint states, those of one seed equal wherever the stamps are."""
    stamp = start + np.rint(np.arange(int(seconds * rate)) * 1e9 / rate).astype(np.int64)
    joints = np.random.default_rng(seed).normal(size=(len(stamp), 2))
    nothing = np.zeros((len(stamp), 0, 3))
    wrenches = np.zeros((len(stamp), 0, 6))
    return Segment(stamp, rate, joints, joints, nothing, nothing, wrenches, (), ())


@pytest.mark.parametrize("rate", [20.0, 100.0, 333.0, 1000.0, 4000.0])
@pytest.mark.parametrize("start", [0, 250_000_000, TODAY])
def test_every_whole_second_has_a_number_of_its_own(rate, start):
    log = segment(start, 10, rate=rate)
    assert len(fingerprint(log)) in ({10} if start == 0 else {9, 10})
    assert fingerprint(log.cut(0, 0)) == frozenset()


@pytest.mark.parametrize("start", [0, TODAY])
def test_parts_of_a_log_are_recognised_in_the_whole(start):
    log = segment(start, 10)
    whole = fingerprint(log)
    part = fingerprint(log.cut(2345, 7890))
    assert 4 <= len(part) <= 5
    assert part < whole
    # Blocks as they are worked on, cut at whole seconds of the clock.
    edge = int(np.searchsorted(log.stamp, (start // SECOND + 4) * SECOND))
    assert fingerprint(log.cut(0, edge)) | fingerprint(log.cut(edge, len(log))) == whole


@pytest.mark.parametrize("start", [0, TODAY])
def test_a_log_and_the_one_that_continues_it_have_nothing_in_common(start):
    log = segment(start, 10)
    for edge in (4321, 4999, 5000, 5001):
        assert not fingerprint(log.cut(0, edge)) & fingerprint(log.cut(edge, len(log)))


def test_simulated_logs_of_other_motions_differ_though_their_stamps_agree():
    assert not fingerprint(segment(0, 5)) & fingerprint(segment(0, 5, seed=1))
    assert fingerprint(segment(0, 5)) == fingerprint(segment(0, 5))


def test_by_a_wall_clock_jitter_and_another_phase_do_not_matter():
    one, other = segment(TODAY, 5), segment(TODAY + 400_000, 5, seed=1)
    assert fingerprint(one) == fingerprint(other)
