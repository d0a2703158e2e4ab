"""Window lengths are compared again as data arrive, without delaying an estimate."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log, prior_of

from symbid_ros.estimation.alarms import SUSPICIOUS_NOISE
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.window_comparison import (
    COMPARABLE,
    WindowComparison,
    WindowSelector,
    solve_window,
)
from symbid_ros.offline.bags import BagRequest
from symbid_ros.package_paths import config_file


@pytest.fixture(scope="module")
def problem(simulated):
    bag = simulated("smooth", moves=2, motion_seed=7, noise_seed=3)
    options = IdentifyOptions(prior_percent=25.0, method="map")
    return BagRequest((bag,), config_file("symbitron.xml"), options).load().solved.problem


def test_comparisons_after_the_first_are_spread_over_estimates(problem) -> None:
    best = WindowComparison(problem).finish()[0].window
    selector = WindowSelector()
    assert selector.update(problem, 3) == best
    assert selector.update(problem, 5) is None
    told = [selector.update(problem, 6) for _ in range(len(problem.observations) + 1)]
    assert told == [None] * len(problem.observations) + [best]
    assert [selector.update(problem, blocks) for blocks in range(6, 12)] == [None] * 6


def test_a_comparison_in_steps_equals_one_at_once(problem) -> None:
    at_once, in_steps = WindowComparison(problem), WindowComparison(problem)
    chosen, near = at_once.finish()
    steps = 0
    while not in_steps.is_done:
        in_steps.step()
        steps += 1
    assert steps == len(problem.observations) > 1
    other, same = in_steps.finish()
    assert other is chosen
    assert (same.mean == near.mean).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("factor", "chosen"), [(1.0, 0.321), (1.02, 0.321), (1.5, 0.081)])
def test_long_windows_are_not_chosen_if_they_miss_fast_motion(seed, factor, chosen) -> None:
    """Long windows have less noise, but may average an effect that short ones show."""
    rng, log = np.random.default_rng(seed), gaussian_log(seed, count=400)
    force = log.K @ log.truth
    size = np.sqrt(np.mean(force**2))

    def averaged(window, share, gain):
        y = gain * force + share * size * rng.normal(size=force.shape)
        return replace(log, y=y, window=window).observations()

    rows = averaged(0.081, 0.3, 1.0), averaged(0.321, 0.01, 1 / factor)
    problem = Problem(rows, log.parameters, prior_of(log, seed))
    assert WindowComparison(problem).finish()[0].window == chosen


@pytest.mark.parametrize("seed", range(4))
def test_windows_that_tell_nothing_are_not_chosen_for_their_little_noise(seed) -> None:
    rng, log = np.random.default_rng(seed), gaussian_log(seed, count=400)
    few = replace(log[:3], window=0.321).observations()
    rows = log.with_noisy_regressor(rng, 1.0).observations(), few
    prior = prior_of(log, seed, percent=300.0)
    problem = Problem(rows, log.parameters, prior)
    short, long = (solve_window(problem, one, None, COMPARABLE) for one in rows)
    assert short.noise_share > SUSPICIOUS_NOISE > long.noise_share
    assert WindowComparison(problem).finish()[0].window == log.window
