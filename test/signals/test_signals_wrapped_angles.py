"""Wrapped angles are unwrapped; glitches, fast motion and prismatic joints stay as they are."""

import gc
import logging
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from symbid_ros.arrays import map_arrays
from symbid_ros.signals.streams import JointStream
from symbid_ros.signals.wrapped_angles import TURN, AngleUnwrapper, count_turns

RATE = 100.0
LOWEST = {"±π": -np.pi, "0 to 2π": 0.0}


def stream(angle, velocity=None, time=None, names=None):
    """Return the states of joints with angles (N,) or (N, J)."""
    position = np.asarray(angle, dtype=float)
    position = position[:, None] if position.ndim == 1 else position
    time = np.arange(len(position)) / RATE if time is None else time
    unknown = np.full_like(position, np.nan)
    return JointStream(
        "/joint_states",
        names or tuple(f"joint_{index}" for index in range(position.shape[1])),
        np.rint(time * 1e9).astype(np.int64),
        position,
        unknown if velocity is None else np.asarray(velocity, dtype=float).reshape(position.shape),
        unknown,
    )


def wrapped(angle, lowest):
    return np.mod(angle - lowest, TURN) + lowest


def assert_whole_turns(found, true) -> None:
    """Check that angles without NaN differ from the true ones by the same whole turns."""
    turns = (found - true)[np.isfinite(found)] / TURN
    np.testing.assert_allclose(turns, np.rint(turns[0]), atol=1e-9)


@st.composite
def smooth_motions(draw):
    """Return time (N,), angle and velocity: slow, fast, far or to and fro; at most 30 rad/s."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    time = np.arange(draw(st.integers(60, 800))) / RATE
    omega = rng.uniform(0.1, 9.0, 3)
    speed = rng.uniform(-1, 1, 3) * draw(st.floats(0.01, 6.0))
    drift, start = draw(st.floats(-12.0, 12.0)), draw(st.floats(-7.0, 7.0))
    phase = np.multiply.outer(time, omega) + rng.uniform(0, 6, 3)
    angle = start + drift * time + np.sin(phase) @ (speed / omega)
    return time, angle, drift + np.cos(phase) @ speed


@settings(max_examples=150, deadline=None)
@given(
    motion=smooth_motions(),
    lowest=st.sampled_from(sorted(LOWEST.values())),
    velocities=st.sampled_from(["measured", "absent", "zero", "differences"]),
    seed=st.integers(0, 2**32 - 1),
    missing=st.sampled_from([0.0, 0.02, 0.3]),
)
def test_a_wrapped_smooth_angle_is_recovered_up_to_whole_turns(
    motion, lowest, velocities, seed, missing
) -> None:
    time, true, velocity = motion
    rng = np.random.default_rng(seed)
    angle = wrapped(true, lowest)
    given_velocity = {
        "measured": velocity + 0.02 * rng.standard_normal(len(time)),
        "absent": None,
        "zero": np.zeros_like(velocity),  # drivers that measure none may say 0
        "differences": np.gradient(angle, time),  # with spikes where the angle jumps
    }[velocities]
    joints = stream(angle, given_velocity, time)
    # Messages are lost and values are missing, at most three in a row.
    gaps = rng.random(len(time)) < missing
    for place in range(3, len(time)):
        gaps[place] &= not gaps[place - 3 : place].all()
    joints.position[gaps] = np.nan
    kept = ~gaps | (rng.random(len(time)) < 0.5)
    joints, true = map_arrays(joints, lambda values: values[kept]), true[kept]
    found = AngleUnwrapper().unwrapped(joints)
    assert np.array_equal(np.isnan(found.position), np.isnan(joints.position))
    assert_whole_turns(found.position[:, 0], true)
    assert found.velocity is joints.velocity
    assert found.effort is joints.effort


@settings(max_examples=150, deadline=None)
@given(
    motion=smooth_motions(),
    size=st.floats(-40.0, 40.0),
    place=st.floats(0.0, 1.0),
    length=st.integers(1, 3),
)
def test_glitches_are_no_turns(motion, size, place, length) -> None:
    time, angle, velocity = motion
    at = int(place * (len(time) - length))
    # A glitch of a turn to the other end of the joint's range is what a wrapped angle does.
    assume(abs(abs(size) - TURN) > 1.6)
    disturbed = angle.copy()
    disturbed[at : at + length] += size
    joints = stream(disturbed, velocity, time)
    assert AngleUnwrapper().unwrapped(joints) is joints


def test_a_single_glitch_of_one_turn_inside_the_range_of_a_joint_is_no_turn() -> None:
    angle = 1.5 * np.sin(np.arange(1000) / RATE)
    for size in (-TURN, TURN):
        disturbed = angle.copy()
        disturbed[630] += size
        joints = stream(disturbed)
        assert AngleUnwrapper().unwrapped(joints) is joints


def test_a_glitch_beside_jumps_hides_none_of_them() -> None:
    true = 3.0 * np.arange(1000) / RATE
    angle = wrapped(true, -np.pi)
    (jumps,) = np.nonzero(np.abs(np.diff(angle)) > 3)
    angle[jumps[1] + 3] = 0.4
    found = AngleUnwrapper().unwrapped(stream(angle)).position[:, 0]
    left = np.delete(np.arange(len(true)), jumps[1] + 3)
    assert_whole_turns(found[left], true[left])


@pytest.mark.parametrize("noise", [1e-4, 5e-3])
@pytest.mark.parametrize("lowest", LOWEST.values(), ids=LOWEST)
def test_a_joint_that_rests_at_the_end_of_the_turn_stays_there(lowest, noise) -> None:
    true = lowest + noise * np.random.default_rng(3).standard_normal(500)
    found = AngleUnwrapper().unwrapped(stream(wrapped(true, lowest))).position[:, 0]
    assert np.abs(np.diff(wrapped(true, lowest))).max() > 6
    assert_whole_turns(found, true)


def test_positions_of_prismatic_joints_are_no_angles() -> None:
    angle = wrapped(4.0 * np.arange(800) / RATE, -np.pi)
    joints = stream(np.stack([angle, angle], axis=1), names=("slide", "wheel"))
    unwrapper = AngleUnwrapper({"slide"})
    found = unwrapper.unwrapped(joints)
    assert np.array_equal(found.position[:, 0], angle)
    assert np.abs(np.diff(found.position[:, 1])).max() < 0.05
    assert list(unwrapper.found) == ["wheel"]


def test_half_a_turn_and_more_from_one_message_to_the_next_is_left_as_it_is() -> None:
    time = np.arange(200) / 10.0
    true = 2.8 * np.sin(28.0 * time)
    joints = stream(true, time=time)
    assert np.abs(np.diff(true)).max() > 5  # in one period, to the other end of its range
    assert AngleUnwrapper().unwrapped(joints) is joints
    spinning = stream(wrapped(31.0 * time, -np.pi), np.full(len(time), 31.0), time)
    assert AngleUnwrapper().unwrapped(spinning) is spinning


def test_a_jump_across_a_long_gap_is_left_as_it_is() -> None:
    time = np.arange(600) / RATE
    angle = wrapped(time, -np.pi)  # the end of the turn is reached after 3.14 s
    for missing, jumps in ((4, 0), (20, 1)):
        kept = np.delete(np.arange(len(time)), slice(312, 312 + missing))
        joints = stream(angle[kept], np.ones(len(kept)), time[kept])
        found = AngleUnwrapper().unwrapped(joints)
        assert np.count_nonzero(np.abs(np.diff(found.position[:, 0])) > 6) == jumps


@pytest.mark.parametrize("place", [0, 1, 97, 98])
def test_velocities_computed_from_the_wrapped_angle_hide_no_jump_at_the_ends(place) -> None:
    time = np.arange(100) / RATE
    true = np.pi + 1.5 * (time - (place + 0.5) / RATE)
    angle = wrapped(true, -np.pi)
    assert np.flatnonzero(np.abs(np.diff(angle)) > 6).tolist() == [place]
    found = AngleUnwrapper().unwrapped(stream(angle, np.gradient(angle, time), time))
    assert_whole_turns(found.position[:, 0], true)


def test_messages_that_arrive_in_bursts_are_unwrapped() -> None:
    time = np.arange(600) / RATE
    true = 12.0 * time
    # Stamped on arrival: every fifth message is late, 20 µs before the next one.
    stamps = time.copy()
    stamps[::5] = stamps[1::5] - 2e-5
    found = AngleUnwrapper().unwrapped(stream(wrapped(true, -np.pi), 12.0 + 0 * time, stamps))
    assert_whole_turns(found.position[:, 0], true)


def test_joints_of_several_turns_are_left_as_they_are() -> None:
    angle = np.linspace(-9.0, 20.0, 1000)
    angle[500:] -= TURN
    joints = stream(angle)
    assert AngleUnwrapper().unwrapped(joints) is joints


@pytest.mark.parametrize("lowest", LOWEST.values(), ids=LOWEST)
def test_slices_of_a_log_continue_one_another(lowest) -> None:
    time = np.arange(6000) / RATE
    true = np.stack([5 * np.sin(0.4 * time) + 2.0 * time, 0.3 * np.sin(time)], axis=1)
    joints = stream(wrapped(true, lowest), time=time)
    joints.position[:, 1] = true[:, 1]
    whole = AngleUnwrapper().unwrapped(joints)
    unwrapper = AngleUnwrapper()
    for start in range(0, 6000, 500):
        part = slice(max(0, start - 20), start + 520)
        found = unwrapper.unwrapped(map_arrays(joints, lambda values, part=part: values[part]))
        np.testing.assert_allclose(found.position, whole.position[part], atol=1e-9)


def test_after_a_restart_of_the_clock_the_turns_are_counted_anew() -> None:
    joints = stream(wrapped(4.0 * np.arange(800) / RATE, -np.pi))
    end = map_arrays(joints, lambda values: values[-100:])
    unwrapper = AngleUnwrapper()
    unwrapper.unwrapped(joints)
    assert unwrapper.unwrapped(end).position[0, 0] == pytest.approx(4.0 * 7.0)
    unwrapper.restart()
    assert unwrapper.unwrapped(end).position[0, 0] == end.position[0, 0]


def test_the_memory_of_an_endless_run_is_constant() -> None:
    unwrapper = AngleUnwrapper()
    time = np.arange(520) / RATE
    used = {}
    tracemalloc.start()
    try:
        for index, start in enumerate(range(0, 60_000, 500)):
            at = time + start / RATE
            found = unwrapper.unwrapped(stream(wrapped(3.0 * at, -np.pi), time=at))
            if index in (10, 119):
                gc.collect()  # NumPy's pad leaves cycles
                used[index] = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert found.position[-1, 0] > 1700
    # The stamps and turns of a slice take 8 kB, so that keeping all of them would take 900 kB more.
    assert used[119] < used[10] + 50_000


def test_wrapped_joints_are_named_once(caplog) -> None:
    joints = stream(wrapped(4.0 * np.arange(800) / RATE, -np.pi), names=("wheel",))
    unwrapper = AngleUnwrapper()
    with caplog.at_level(logging.INFO, "symbid_ros"):
        for _ in range(3):
            unwrapper.unwrapped(joints)
            unwrapper.report("log", joints.topic)
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert record.getMessage() == (
        "log: /joint_states: the angles of wheel are wrapped to one turn and were unwrapped"
    )


def test_too_few_messages_are_left_as_they_are() -> None:
    for count in (0, 1, 2):
        joints = stream(np.zeros(count))
        assert AngleUnwrapper().unwrapped(joints) is joints
    nothing = stream(np.full(10, np.nan))
    assert count_turns(replace(nothing)) is None
