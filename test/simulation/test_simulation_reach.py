"""Moves grow and shrink without a jump, and only as far as the robot is known."""

import numpy as np
import pytest

from symbid_ros.simulation.reach import (
    CHANGE_DURATION,
    LARGEST_DISTANCE,
    MARGIN,
    Reach,
    ScaledMotion,
    least_reach,
    safe_reach,
)
from symbid_ros.simulation.trajectory import MoveRange, draw_trajectory

STEP = 1e-4


@pytest.fixture
def scaled() -> tuple[Reach, ScaledMotion]:
    span = MoveRange(np.zeros(3), np.full(3, 0.08), (0.02, 0.08), 0.07)
    motion = draw_trajectory(np.ones(3), 6, span, np.random.default_rng(1))
    reach = Reach(0.25)
    return reach, ScaledMotion(motion, np.array([0.0, 0.01, 0.0]), reach.at)


def test_velocity_and_acceleration_belong_to_the_position(scaled):
    reach, motion = scaled
    reach.change(1.0, 2.0)
    for time in np.linspace(2.1, 2.4 + CHANGE_DURATION, 40):
        before, now, after = (motion.at(time + step) for step in (-STEP, 0.0, STEP))
        # Moves are cubic: their acceleration jumps from one move to the next.
        assert (after[0] - before[0]) / (2 * STEP) == pytest.approx(now[1], abs=1e-4)
        if np.allclose(after[2], before[2], atol=0.01):
            assert (after[1] - before[1]) / (2 * STEP) == pytest.approx(now[2], abs=1e-3)


def test_moves_have_their_share_before_and_their_size_after_a_change(scaled):
    reach, motion = scaled
    start, plain = motion.at(0.0)[0], ScaledMotion(motion._motion, np.zeros(3), Reach().at)
    np.testing.assert_allclose(motion.displacement(1.0), 0.25 * plain.displacement(1.0))
    reach.change(1.0, 1.0)
    later = 1.0 + CHANGE_DURATION
    np.testing.assert_allclose(motion.at(later)[0], start + plain.displacement(later))
    np.testing.assert_allclose(motion.at(later)[1:], plain.at(later)[1:])


def test_a_change_under_way_is_finished_before_the_next(scaled):
    reach, _ = scaled
    reach.change(1.0, 0.0)
    reach.change(0.5, 1.0)
    assert reach.wanted == 0.5
    assert reach.at(CHANGE_DURATION)[0] == 1.0
    times = np.linspace(0.0, 2 * CHANGE_DURATION, 600)
    shares = np.array([reach.at(time)[0] for time in times if time >= CHANGE_DURATION])
    assert np.all(np.diff(shares) <= 0.0)
    assert shares[-1] == 0.5
    reach.change(1.0, 7.0)
    reach.restart()
    assert reach.at(0.0) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("size", [0.08, 0.096])
def test_the_move_and_two_deviations_fit_into_the_support(size):
    allowed = (LARGEST_DISTANCE - size) / 2
    assert safe_reach(0.0, 0.0, size) == safe_reach(0.0, 0.99 * allowed, size) == 1.0
    for com_std in (0.015, 0.02, 0.03):
        move = safe_reach(0.0, com_std, size) * size
        assert move + 2 * com_std == pytest.approx(LARGEST_DISTANCE)
    # A mass that is wrong by a share lowers the robot by that share of gravity over stiffness.
    by_mass = safe_reach(0.1, 0.0, size)
    assert by_mass == pytest.approx(safe_reach(0.0, 0.1 * 9.81 / 60, size))
    assert safe_reach(0.0, 1.0, size) == safe_reach(np.nan, 0.01, size) == least_reach(size)
    assert least_reach(size) * size == pytest.approx(MARGIN)
