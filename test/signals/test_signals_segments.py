"""Fingerprints of seconds: independent of how a log was cut, different for other logs."""

from dataclasses import fields, replace

import numpy as np
import pytest

from symbid_ros.arrays import concatenated
from symbid_ros.signals.segments import Segment, cut_to, fingerprint

SECOND = 1_000_000_000
TODAY = 1_790_000_000 * SECOND + 123_456_789


def segment(start, seconds, *, rate=1000.0, seed=0):
    """Return random joint states that depend on the seed and not on the stamps."""
    stamp = start + np.rint(np.arange(int(seconds * rate)) * 1e9 / rate).astype(np.int64)
    joints = np.random.default_rng(seed).normal(size=(len(stamp), 2))
    nothing = np.zeros((len(stamp), 0, 3))
    wrenches = np.zeros((len(stamp), 0, 6))
    return Segment(stamp, rate, joints, joints, nothing, nothing, wrenches, (), ())


@pytest.mark.parametrize("rate", [20.0, 100.0, 333.0, 1000.0, 4000.0])
@pytest.mark.parametrize("start", [0, 250_000_000, TODAY])
def test_every_whole_second_has_its_own_fingerprint(rate, start):
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
    # Blocks are cut at whole seconds of the clock.
    edge = int(np.searchsorted(log.stamp, (start // SECOND + 4) * SECOND))
    assert fingerprint(log.cut(0, edge)) | fingerprint(log.cut(edge, len(log))) == whole


@pytest.mark.parametrize("start", [0, TODAY])
def test_consecutive_logs_share_no_fingerprint(start):
    log = segment(start, 10)
    for edge in (4321, 4999, 5000, 5001):
        assert not fingerprint(log.cut(0, edge)) & fingerprint(log.cut(edge, len(log)))


def test_simulated_logs_with_equal_stamps_and_other_motions_differ():
    assert not fingerprint(segment(0, 5)) & fingerprint(segment(0, 5, seed=1))
    assert fingerprint(segment(0, 5)) == fingerprint(segment(0, 5))


def test_jitter_and_phase_do_not_matter_with_a_wall_clock():
    one, other = segment(TODAY, 5), segment(TODAY + 400_000, 5, seed=1)
    assert fingerprint(one) == fingerprint(other)


@pytest.mark.parametrize("rate", [100.0, 1000.0])
@pytest.mark.parametrize(
    ("lost", "is_continued"), [(-1, False), (0, True), (0.4, True), (0.6, False), (1, False)]
)
def test_a_segment_is_continued_by_one_a_period_later(rate, lost, is_continued):
    """The next instant comes 1 + ``lost`` periods after the last one."""
    log = segment(TODAY, 1, rate=rate)
    first, second = log.cut(0, 40), log.cut(40, 90)
    later = replace(second, stamp=second.stamp + round(lost * 1e9 / rate))
    assert first.is_continued_by(later) is is_continued
    assert not first.is_continued_by(replace(later, wrench_frames=("sole",)))
    assert not first.is_continued_by(replace(later, imu_frames=("imu",)))


def test_segments_are_cut_by_stamp_and_joined_again():
    log = segment(TODAY, 1, rate=100.0)
    pieces = [log.cut(0, 30), log.cut(30, 60), log.cut(60, 100)]
    found = list(cut_to(pieces, int(log.stamp[10]), int(log.stamp[60])))
    assert [len(piece) for piece in found] == [20, 30]
    joined = concatenated(found)
    for field in fields(Segment):
        expected = getattr(log.cut(10, 60), field.name)
        np.testing.assert_array_equal(getattr(joined, field.name), expected)
    assert joined.nbytes == 50 * (8 + 2 * 8 + 2 * 8)
    assert replace(log, imu_frames=("a", "b"), wrench_frames=("c",)).frames == ("a", "b", "c")
