"""Information in vibrations, against logs whose motion, forces and noise are known."""

from dataclasses import replace

import analytic_log
import numpy as np
import pytest
from analytic_log import analytic_segment, noisy
from random_robots import random_robot

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset, observe
from symbid_ros.identification.rows.fast_motion import _fast_rows, _FastMotion, with_fast_motion
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_samples import probed
from symbid_ros.signals.weak_form import equation_rows

ROBOT = ParameterSet(random_robot(11, 4))
NOISE = {"position": 1e-5, "rate": 5e-3, "acceleration": 0.03, "effort": 0.1, "wrench": 1.0}
JOINTS = len(ROBOT.model.joints)
SEEDS = range(4)


@pytest.fixture(autouse=True)
def slow_moves(monkeypatch):
    monkeypatch.setattr(analytic_log, "SLOWEST", 0.1)
    monkeypatch.setattr(analytic_log, "FASTEST", 0.3)


def log(seed, *, robot=ROBOT, shaking=5.0, noise=NOISE, spoil=lambda segment: segment):
    """Return a solution from slow motion, and its log."""
    segment = analytic_segment(robot, 12, seed, shaking=shaking)
    segment = spoil(noisy(segment, np.random.default_rng(seed), **noise))
    layout = RowLayout.of(robot)
    observations = observe([segment], equation_rows(robot), layout, (0.161,))
    prior = draw_prior(robot, "percent", 25.0, seed)
    solved = SolvedProblem.of(Problem(observations, robot, prior))
    return solved, Dataset("log", (segment,), probed(segment, robot.model), observations)


def normalised_square(solved):
    """Return the mean square of the errors in standard deviations, and their volume in bits."""
    L = np.linalg.cholesky(solved.posterior.deviation_factor @ solved.posterior.deviation_factor.T)
    error = np.linalg.solve(L, solved.posterior.mean - ROBOT.values)
    return np.mean(error**2), float(np.sum(np.log2(L.diagonal())))


def test_vibrations_add_information_and_deviations_stay_right():
    pairs = []
    for seed in SEEDS:
        solved, dataset = log(seed)
        pairs.append(
            [normalised_square(one) for one in (solved, with_fast_motion(solved, dataset))]
        )
    (slow, before), (fast, after) = np.mean(pairs, axis=0)
    assert before - after > 25
    # 4 draws of 40 directions: the standard deviation of a mean square is 0.11.
    assert 0.6 < slow < 1.4
    assert 0.6 < fast < 1.4


def test_noise_of_the_motion_is_known_from_the_forces():
    solved, dataset = log(0)
    motion = _FastMotion.of(tuple(_fast_rows(solved, dataset)), solved)
    expected = np.repeat([NOISE["position"], NOISE["rate"], NOISE["acceleration"]], [JOINTS, 3, 3])
    assert np.allclose(np.sqrt(motion.variance[: len(expected)]), expected, rtol=0.1)


def test_slow_motion_takes_no_further_step():
    solved, dataset = log(0, shaking=0.0)
    assert with_fast_motion(solved, dataset) is solved


def test_dry_friction_is_not_taken_for_fast_motion():
    """Where a joint reverses, its friction changes at once, which all frequencies contain."""
    joint = 2

    def rub(segment):
        effort = segment.effort.copy()
        velocity = np.gradient(segment.position[:, joint])
        effort[:, joint] += 50.0 * np.sign(velocity)
        return replace(segment, effort=effort)

    model = replace(
        ROBOT.model,
        joints=tuple(
            replace(each, friction_loss=50.0 * (index == joint))
            for index, each in enumerate(ROBOT.model.joints)
        ),
    )
    robot = ParameterSet(model, terms=("coulomb",))
    solved, dataset = log(0, robot=robot, shaking=0.0, spoil=rub)
    assert not list(_fast_rows(solved, dataset))


def test_readings_without_noise_are_solved_from_slow_motion_alone():
    solved, dataset = log(0, noise={})
    assert with_fast_motion(solved, dataset) is solved


def test_logs_at_another_rate_than_the_first_are_left_out():
    solved, dataset = log(0)
    slower = analytic_segment(ROBOT, 8, 1, rate=500.0, start=100.0, shaking=5.0)
    slower = noisy(slower, np.random.default_rng(1), **NOISE)
    both = replace(dataset, segments=(*dataset.segments, slower))
    expected = with_fast_motion(solved, dataset).posterior.mean
    assert np.allclose(with_fast_motion(solved, both).posterior.mean, expected, rtol=1e-9)


def test_bands_that_contradict_the_slow_motion_are_left_out():
    """Efforts that are a millisecond late matter to fast motion alone."""

    def late(segment):
        return replace(segment, effort=np.roll(segment.effort, 1, axis=0))

    solved, dataset = log(0, spoil=late)
    motion = _FastMotion.of(tuple(_fast_rows(solved, dataset)), solved)
    factor = solved.posterior.deviation_factor
    found = [one.contradiction(factor) for one in motion.scores(solved.posterior.mean, 5)]
    assert max(found) > 3.0
    square, _ = normalised_square(with_fast_motion(solved, dataset))
    assert square < 2.0


@pytest.mark.parametrize(
    "change",
    [
        {"floating": False},
        {"links": 1},
    ],
)
def test_other_robots_are_solved_from_slow_motion_alone(change):
    robot = ParameterSet(random_robot(11, **{"links": 4} | change))
    segment = analytic_segment(robot, 5, 1, shaking=5.0)
    segment = noisy(segment, np.random.default_rng(0), **NOISE)
    observations = observe([segment], equation_rows(robot), RowLayout.of(robot), (0.161,))
    solved = SolvedProblem.of(Problem(observations, robot, draw_prior(robot, "percent", 25.0, 1)))
    dataset = Dataset("log", (segment,), probed(segment, robot.model), observations)
    assert with_fast_motion(solved, dataset) is solved
