"""Gaps, order and clock jumps found in header stamps."""

from itertools import pairwise

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import imu
from hypothesis import given
from hypothesis import strategies as st

from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.signals.defects import (
    CLOCK_JUMP,
    Defect,
    DefectCounts,
    check_clock,
    find_gaps,
    kept_in_order,
    seconds,
    typical_period,
)

PERIOD = 1_000_000


@given(st.integers(20, 200), st.data())
def test_every_removed_message_is_counted(count: int, data: st.DataObject) -> None:
    inner = st.lists(st.integers(1, count - 2), max_size=count // 4, unique=True)
    lost = data.draw(inner)
    stamps = np.delete(np.arange(count) * PERIOD, lost)
    gaps = find_gaps(stamps)
    runs = sum(1 for place in lost if place - 1 not in lost)
    assert (gaps.period, gaps.missing, gaps.gaps) == (PERIOD, len(lost), runs)
    assert gaps.disordered == 0


@given(st.integers(20, 200), st.data())
def test_a_message_with_the_stamp_of_its_neighbour_is_no_gap(count: int, data: st.DataObject):
    places = st.lists(st.integers(1, count // 2 - 2), max_size=count // 6, unique=True)
    repeated = 2 * np.array(data.draw(places), dtype=np.int64)
    stamps = np.arange(count) * PERIOD
    stamps[repeated] += data.draw(st.sampled_from([-PERIOD, PERIOD]))
    gaps = find_gaps(stamps)
    assert (gaps.period, gaps.missing, gaps.gaps) == (PERIOD, 0, 0)
    assert gaps.disordered == len(repeated)
    # Lost messages beside it still count.
    lost = np.delete(stamps, [count - 4, count - 3])
    assert find_gaps(lost).missing == 2


def test_jitter_below_half_a_period_is_not_a_gap() -> None:
    jitter = np.random.default_rng(0).integers(-200_000, 200_000, 1000)
    gaps = find_gaps(np.arange(1000) * PERIOD + jitter)
    assert (gaps.gaps, gaps.missing, gaps.disordered) == (0, 0, 0)


def test_order_of_arrival_is_counted_apart_from_gaps() -> None:
    gaps = find_gaps(np.array([0, 2, 1, 3, 3, 4]) * PERIOD)
    assert (gaps.missing, gaps.disordered, gaps.longest) == (0, 2, PERIOD)


def test_single_message_has_no_period() -> None:
    assert find_gaps(np.array([5])).period == 0


def test_stamp_is_read_from_the_bytes() -> None:
    assert read_leading_stamp(imu(12_000_000_345)) == 12_000_000_345
    assert has_stamp("sensor_msgs/msg/Imu")
    assert has_stamp("rosgraph_msgs/msg/Clock")
    assert not has_stamp("std_msgs/msg/String")


def test_a_clock_that_jumps_back_by_more_than_a_second_is_an_error() -> None:
    start = 7 * CLOCK_JUMP
    stamps = start + np.array([0, 2, 4, 5]) * CLOCK_JUMP
    check_clock("log", "/imu", stamps)
    check_clock("log", "/imu", np.append(stamps, stamps[-1] - CLOCK_JUMP))
    back = np.r_[stamps, stamps[-1] - CLOCK_JUMP - PERIOD, stamps[0]]
    with raises_code("E314", r"/imu.* back by 1\.001 s after 12\.000 s"):
        check_clock("log", "/imu", back)
    assert seconds(1_234_567_890) == "1.235 s"


@given(st.lists(st.integers(0, 30), min_size=2, max_size=40).filter(lambda one: len(set(one)) > 1))
def test_the_first_message_of_each_stamp_is_kept_in_order(numbers: list[int]) -> None:
    tally = DefectCounts("log", "/imu")
    kept = kept_in_order(np.array(numbers) * PERIOD, tally)
    assert kept.tolist() == [numbers.index(number) for number in sorted(set(numbers))]
    disordered = sum(b < a for a, b in pairwise(numbers))
    assert tally.counts.get(Defect.DISORDER, 0) == disordered
    assert tally.counts.get(Defect.DUPLICATE, 0) == len(numbers) - len(kept)


def test_stamps_that_are_all_equal_are_an_error() -> None:
    with raises_code("E315", r"/imu.*0\.005 s"):
        kept_in_order(np.full(3, 5 * PERIOD), DefectCounts("log", "/imu"))
    assert kept_in_order(np.array([5]), DefectCounts("log", "/imu")).tolist() == [0]


@pytest.mark.parametrize("lost", [0, 40])
def test_jitter_is_no_loss(lost: int) -> None:
    rng = np.random.default_rng(0)
    index = np.arange(4000)
    index += index // 100 if lost else 0  # every hundredth is lost
    early = rng.uniform(-0.5, 0.5, len(index))
    found = find_gaps(np.rint((index + early) * PERIOD).astype(np.int64))
    assert np.sum(np.diff(index + early) >= 1.5) > 300
    assert 0.8 * lost <= found.missing <= lost


@pytest.mark.parametrize("jitter", [0.0, 0.3, 5.0, 10.0])
def test_the_period_is_right_where_stamps_jitter_by_several_periods(jitter: float) -> None:
    rng = np.random.default_rng(1)
    index = np.arange(5000) + 40 * (np.arange(5000) // 1000)  # with pauses
    stamps = np.sort(np.rint((index + rng.uniform(-jitter, jitter, 5000)) * PERIOD))
    assert typical_period(stamps) == pytest.approx(PERIOD, rel=0.01 if jitter else 1e-12)


def test_the_period_is_not_that_of_messages_within_a_burst() -> None:
    index = np.arange(4000)
    stamps = (index // 8 * 8) * PERIOD + index % 8 * (PERIOD // 50)
    assert typical_period(stamps) == pytest.approx(PERIOD, rel=0.05)


def test_jitter_by_several_periods_is_hardly_any_loss() -> None:
    jitter = np.random.default_rng(2).uniform(-2.5, 2.5, 10_000)
    stamps = np.sort(np.rint((np.arange(10_000) + jitter) * PERIOD).astype(np.int64))
    assert find_gaps(stamps).missing < 150


@pytest.mark.parametrize(("step", "gaps", "missing"), [(1.4, 0, 0), (1.5, 1, 1), (2.6, 1, 2)])
def test_a_gap_is_at_least_one_and_a_half_periods(step: float, gaps: int, missing: int) -> None:
    stamps = np.concatenate([np.arange(10), 9 + step + np.arange(10)]) * PERIOD
    found = find_gaps(stamps.astype(np.int64))
    assert (found.period, found.gaps, found.missing) == (PERIOD, gaps, missing)
    assert found.longest == round(max(step, 1) * PERIOD)
