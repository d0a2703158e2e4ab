import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.trajectory import MoveRange, draw_trajectory

START = np.array([0.1, -0.2, 0.9])
SPAN = MoveRange(
    centre=np.array([0.0, 0.01, -0.02]),
    half_widths=np.array([0.05, 0.06, 0.02]),
    speeds=(0.01, 0.08),
    shortest=0.045,
)


def draw(seed=0, moves=20):
    return draw_trajectory(START, moves, SPAN, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(5))
def test_targets_are_in_range_and_separated(seed):
    reference = draw(seed)
    scaled = (reference.points[1:] - START - SPAN.centre) / SPAN.half_widths
    assert np.all(np.linalg.norm(scaled, axis=1) <= 1.0 + 1e-12)
    lengths = np.linalg.norm(np.diff(reference.points, axis=0), axis=1)
    assert np.all(lengths >= SPAN.shortest)


@pytest.mark.parametrize("moves", [1, 2, 7, 20])
def test_speed_grows_then_shrinks(moves):
    reference = draw(moves=moves)
    lengths = np.linalg.norm(np.diff(reference.points, axis=0), axis=1)
    speeds = lengths / np.diff(reference.starts)
    assert len(speeds) == moves
    peak = int(np.argmax(speeds))
    assert abs(peak - (moves - 1) / 2) <= 1
    assert np.all(np.diff(speeds[: peak + 1]) > -1e-12)
    assert np.all(np.diff(speeds[peak:]) < 1e-12)
    assert speeds[0] == pytest.approx(SPAN.speeds[0])


def test_moves_are_straight_cubic_and_at_rest_at_both_ends():
    reference = draw()
    for move in range(20):
        begin, end = reference.starts[move : move + 2]
        times = np.linspace(begin, end, 9)[:-1]
        path = np.array([reference.at(time)[0] for time in times])
        step = reference.points[move + 1] - reference.points[move]
        along = (path - reference.points[move]) @ step / (step @ step)
        np.testing.assert_allclose(path - reference.points[move], along[:, None] * step, atol=1e-14)
        u = (times - begin) / (end - begin)
        np.testing.assert_allclose(np.diff(along, 3) / np.diff(u)[0] ** 3, -12.0, rtol=1e-8)
        np.testing.assert_allclose(reference.at(begin)[1], 0.0, atol=1e-15)
        np.testing.assert_allclose(reference.at(end - 1e-12)[1], 0.0, atol=1e-10)


def test_velocity_and_acceleration_are_derivatives_of_position():
    reference, gap = draw(), 1e-4
    for time in (reference.starts[4] + 0.3, reference.starts[10] + 0.2):
        before, now, after = (reference.at(time + shift) for shift in (-gap, 0.0, gap))
        np.testing.assert_allclose((after[0] - before[0]) / (2 * gap), now[1], rtol=1e-5)
        np.testing.assert_allclose((after[1] - before[1]) / (2 * gap), now[2], rtol=1e-5)


def test_rests_before_the_first_move_and_after_the_last():
    reference = draw()
    assert reference.starts[0] == SPAN.rest
    assert reference.duration == pytest.approx(reference.starts[-1] + SPAN.rest)
    for time, point in ((-2.0, 0), (0.0, 0), (reference.starts[-1] + 0.1, -1)):
        position, velocity, acceleration = reference.at(time)
        np.testing.assert_array_equal(position, reference.points[point])
        assert not velocity.any()
        assert not acceleration.any()


def test_seed_decides_the_moves():
    np.testing.assert_array_equal(draw(7).points, draw(7).points)
    assert not np.allclose(draw(7).points, draw(8).points)


def test_zero_moves_raise_an_error():
    with pytest.raises(SimulationError, match="0 moves"):
        draw(moves=0)
