"""Deadlines at a fixed rate, on a clock that the test sets."""

import pytest

from symbid_ros.ros import mujoco_bridge
from symbid_ros.ros.mujoco_bridge import FixedRate

MILLISECOND = 1_000_000


class ManualClock:
    """A clock that advances by sleeping and by the test's simulated work."""

    def __init__(self) -> None:
        self.now = 5_000_000_000

    def monotonic_ns(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> ManualClock:
    manual = ManualClock()
    monkeypatch.setattr(mujoco_bridge, "time", manual)
    return manual


def periods_taken(schedule: FixedRate, clock: ManualClock, work: list[int]) -> list[float]:
    """Return how long each period took in milliseconds, given the work (ms) in it."""
    taken = []
    for milliseconds in work:
        start = clock.now
        clock.now += round(milliseconds * MILLISECOND)
        schedule.wait()
        taken.append((clock.now - start) / MILLISECOND)
    return taken


def test_the_first_deadline_is_now_and_work_does_not_delay_later_ones(clock: ManualClock) -> None:
    schedule = FixedRate(2.0 * MILLISECOND)
    assert periods_taken(schedule, clock, [0, 1, 0, 1.5, 1]) == [0, 2, 2, 2, 2]
    assert (schedule.late, schedule.elapsed_ns) == (0, 8 * MILLISECOND)


def test_a_short_delay_is_caught_up(clock: ManualClock) -> None:
    schedule = FixedRate(2.0 * MILLISECOND)
    assert periods_taken(schedule, clock, [0, 7, 1, 1, 1, 1, 1, 1]) == [0, 7, 1, 1, 1, 1, 1, 2]
    assert schedule.late == 4
    assert schedule.elapsed_ns == 14 * MILLISECOND


def test_a_long_delay_is_not_caught_up(clock: ManualClock) -> None:
    schedule = FixedRate(2.0 * MILLISECOND)
    assert periods_taken(schedule, clock, [0, 500, 0, 0]) == [0, 500, 2, 2]
    assert schedule.late == 1


def test_a_pause_counts_neither_as_delay_nor_as_elapsed_time(clock: ManualClock) -> None:
    schedule = FixedRate(2.0 * MILLISECOND)
    assert periods_taken(schedule, clock, [0, 1]) == [0, 2]
    clock.now += 3600 * 10**9
    schedule.restart()
    assert periods_taken(schedule, clock, [0, 1, 1]) == [0, 2, 2]
    assert (schedule.late, schedule.elapsed_ns) == (0, 6 * MILLISECOND)
