"""Joint states of several publishers on one clock, against the motion they were sampled from."""

import numpy as np
import pytest

from symbid_ros.errors import DataError
from symbid_ros.signals.joint_merging import merged_joints
from symbid_ros.signals.streams import JointStream

MS = 1_000_000


def angle(name: str, stamp) -> np.ndarray:
    return np.sin(2 * np.pi * 0.7 * stamp * 1e-9 + sum(map(ord, name)))


def part(stamp, *names: str, topic: str = "/joint_states") -> JointStream:
    stamp = np.asarray(stamp, dtype=np.int64)
    position = np.stack([angle(name, stamp) for name in names], axis=1)
    return JointStream(topic, names, stamp, position, position + 1.0, 10.0 * position)


def every(period: int, start: int = 0, stop: int = 2_000 * MS) -> np.ndarray:
    return np.arange(start, stop, period)


def assert_motion(merged: JointStream, names, *, within: float) -> None:
    assert merged.names == tuple(names)
    for column, name in enumerate(names):
        truth = angle(name, merged.stamp)
        assert np.max(np.abs(merged.position[:, column] - truth)) <= within
        assert np.max(np.abs(merged.velocity[:, column] - (truth + 1.0))) <= within
        assert np.max(np.abs(merged.effort[:, column] - 10.0 * truth)) <= 10 * within


def test_equal_stamps_are_merged_unchanged() -> None:
    arms, legs = part(every(MS), "arm"), part(every(MS), "hip", "knee")
    merged = merged_joints([arms, legs], "log")
    assert np.array_equal(merged.stamp, every(MS))
    assert_motion(merged, ("arm", "hip", "knee"), within=0.0)


@pytest.mark.parametrize(
    "legs", [every(MS, 300_000), every(10 * MS, 3 * MS), np.delete(every(MS), [500, 501, 502, 900])]
)
def test_other_stamps_are_interpolated(legs) -> None:
    merged = merged_joints([part(every(MS), "arm"), part(legs, "hip")], "log")
    assert merged.stamp[0] == -(-int(legs[0]) // MS) * MS
    assert np.all(np.diff(merged.stamp) == MS)
    assert_motion(merged, ("arm", "hip"), within=2e-6)
    (unchanged,) = np.nonzero(np.isin(merged.stamp, legs))
    assert np.array_equal(merged.position[unchanged, 1], angle("hip", merged.stamp[unchanged]))


def test_the_fastest_part_gives_the_clock_and_the_first_among_equals() -> None:
    slow, fast = part(every(8 * MS), "arm"), part(every(2 * MS), "hip")
    assert np.all(np.diff(merged_joints([slow, fast], "log").stamp) == 2 * MS)
    other = part(every(2 * MS + 7), "knee")
    assert np.all(np.diff(merged_joints([fast, other], "log").stamp) == 2 * MS)
    assert np.all(np.diff(merged_joints([other, fast], "log").stamp) == 2 * MS + 7)


def test_nothing_is_interpolated_across_a_gap() -> None:
    legs = every(MS)
    legs = legs[(legs <= 700 * MS) | (legs >= 760 * MS)]
    stamp = merged_joints([part(every(MS), "arm"), part(legs, "hip")], "log").stamp
    assert np.array_equal(stamp, legs)


def test_absent_values_stay_absent() -> None:
    legs = part(every(MS, 300_000), "hip", "toe")
    legs.effort[:, 1] = np.nan  # a passive joint
    legs.position[1000] = np.nan
    merged = merged_joints([part(every(MS), "arm"), legs], "log")
    assert np.isnan(merged.effort[:, 2]).all()
    assert np.isfinite(merged.effort[:, :2]).all()
    absent = np.isnan(merged.position[:, 1])
    assert merged.stamp[absent].tolist() == [1000 * MS, 1001 * MS]  # on both sides of it


def test_a_joint_is_taken_from_the_first_part_and_parts_without_needed_joints_are_ignored() -> None:
    arms, both = part(every(MS), "arm"), part(every(MS), "arm", "hip", topic="/other")
    both.position[:, 0] = 7.0
    merged = merged_joints([arms, both], "log")
    assert merged.topic == "/joint_states, /other"
    assert_motion(merged, ("arm", "hip"), within=0.0)
    gripper = part(every(100 * MS), "finger", topic="/gripper")
    assert merged_joints([arms, gripper], "log", ("arm",)) is arms


@pytest.mark.parametrize("absent", [np.nan, 0.0])
@pytest.mark.parametrize("first", [0, 1, 2])
def test_efforts_may_come_from_other_topics_than_positions(absent, first) -> None:
    """Drivers leave efforts out, or fill them with zeros."""
    states = part(every(MS), "arm", "hip")
    states.effort[:] = absent
    loads = [
        part(every(MS), "arm", topic="/arm/efforts"),
        part(every(2 * MS), "hip", topic="/hip/efforts"),
    ]
    for one in loads:
        one.position[:] = one.velocity[:] = np.nan
    parts = [states, *loads]
    merged = merged_joints(parts[first:] + parts[:first], "log", ("arm", "hip"))
    assert_motion(merged, sorted(merged.names, key=merged.names.index), within=2e-6)
    assert set(merged.names) == {"arm", "hip"}
    assert np.all(np.diff(merged.stamp) == MS)


def test_efforts_that_no_part_measures_are_those_of_the_first() -> None:
    states, again = part(every(MS), "arm"), part(every(MS), "arm", "hip")
    states.effort[:] = again.effort[:] = 0.0
    assert not merged_joints([states, again], "log").effort.any()


def test_parts_that_cannot_be_merged_are_named() -> None:
    arms = part(every(MS), "arm", topic="/arm")
    late = part(every(MS, 5_000 * MS, 6_000 * MS), "hip", topic="/leg")
    with pytest.raises(
        DataError, match=r"log: joint states of /arm \(arm\) and /leg \(hip\) do not overlap"
    ):
        merged_joints([arms, late], "log")
    with pytest.raises(DataError, match="log: /leg: fewer than two messages name hip"):
        merged_joints([arms, part([3 * MS], "hip", topic="/leg")], "log")


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_part_of_few_messages_is_interpolated_by_a_polynomial_through_all(count) -> None:
    stamp = np.arange(count) * 10 * MS
    legs = part(stamp, "hip")
    merged = merged_joints([legs, part(every(MS, 0, stamp[-1] + 1), "arm")], "log")
    expected = np.polyfit(stamp * 1e-9, legs.position[:, 0], count - 1)
    hip = merged.position[:, merged.names.index("hip")]
    np.testing.assert_allclose(hip, np.polyval(expected, merged.stamp * 1e-9), atol=1e-9)
