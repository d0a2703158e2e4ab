"""The size of unexplained forces, against errors of known size beside noise."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log

from symbid_ros.estimation.alarms import SUSPICIOUS_WHITENESS, is_coloured
from symbid_ros.estimation.unexplained import (
    LEAST_FORCE,
    SMALL,
    UnexplainedForce,
    unexplained_forces,
)

RATIO, COUNT = 4, 2000
UNITS = ("Nm",) * 3 + ("N",) * 3 + ("Nm",) * 2


def logs(lasting, noise=1.0, seed=0):
    """Return observations over short and four times longer windows.

    The residuals are noise and errors (n,) that last longer than either window.
    """
    rng = np.random.default_rng(seed)
    short = gaussian_log(seed, count=COUNT)
    errors = np.repeat(rng.normal(size=(COUNT // 20, short.y.shape[1])), 20, axis=0) * lasting
    # Means of short windows make up the long ones, as if these did not overlap.
    y = short.K @ short.truth + noise * rng.normal(size=short.y.shape) + errors
    short = replace(short, y=y)
    long = replace(
        short[::RATIO],
        K=short.K.reshape(COUNT // RATIO, RATIO, *short.K.shape[1:]).mean(axis=1),
        y=y.reshape(COUNT // RATIO, RATIO, -1).mean(axis=1),
        window=RATIO * short.window,
    )
    return short.observations(), long.observations(), short.truth, y


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_errors_that_last_are_told_from_noise(size):
    lasting = np.zeros(8)
    lasting[[2, 6]] = size
    found = {one.coordinate: one for one in unexplained_forces(*logs(lasting)[:3], UNITS)}
    assert len(found) == 8
    assert next(iter(found)) == max(found, key=lambda name: found[name].share)
    names = list(gaussian_log(0, count=COUNT).layout.coordinates)
    for index, name in enumerate(names):
        expected = lasting[index]
        assert found[name].size == pytest.approx(expected, rel=0.2, abs=0.25)
        assert found[name].unit == UNITS[index]


def test_shares_are_those_of_the_wrench_or_of_the_joints():
    short, long, truth, y = logs(np.full(8, 2.0))
    found = {one.coordinate: one for one in unexplained_forces(short, long, truth, UNITS)}
    rms = np.sqrt(np.mean(y**2, axis=0))
    force = np.linalg.norm(rms[3:6])
    largest = max(np.linalg.norm(rms[:3]), *rms[6:])
    for axis, one in zip("xyz", rms[3:6], strict=True):
        base = found[f"base/force_{axis}"]
        assert base.measured == pytest.approx(force)
        assert base.share == pytest.approx(base.size / force)
        assert one <= force
    for name, one in zip(list(short.layout.coordinates)[6:], rms[6:], strict=True):
        assert found[name].measured == pytest.approx(one)
        assert found[name].share == pytest.approx(
            found[name].size / max(one, LEAST_FORCE * largest)
        )


def test_only_large_and_coloured_residuals_raise_an_alarm():
    assert UnexplainedForce("knee", "Nm", 19.0, 9.7, 2.0).is_gross  # of the wrong sign
    assert not UnexplainedForce("knee", "Nm", 9.5, 9.7, 0.98).is_gross  # all of it is friction
    small, large = (UnexplainedForce("knee", "Nm", 1.0, 80.0, f * SMALL) for f in (0.99, 1.01))
    above, below = 1.01 * SUSPICIOUS_WHITENESS, 0.99 * SUSPICIOUS_WHITENESS
    assert is_coloured(above, (large, small))
    assert is_coloured(above, ())
    assert not is_coloured(above, (small,))
    assert not is_coloured(below, (large,))
    assert str(large) == "1 Nm of 80 Nm unexplained on knee"
    assert str(replace(large, measured=1234.0)) == "1 Nm of 1200 Nm unexplained on knee"


def test_a_large_error_of_one_coordinate_with_few_rows_raises_an_alarm():
    """It hardly shows in the whiteness of all coordinates."""
    white = 0.5 * SUSPICIOUS_WHITENESS
    lasting = np.zeros(8)
    lasting[7] = 30.0
    assert is_coloured(white, unexplained_forces(*logs(lasting)[:3], UNITS))
    # Neither does noise, however large it is, nor what is smaller than half of the force.
    for seed in range(10):
        noise = np.where(np.arange(8) == 7, 300.0, 1.0)
        found = unexplained_forces(*logs(np.zeros(8), noise, seed)[:3], UNITS)
        assert not is_coloured(white, found)
    lasting[7] = 1.0
    assert not is_coloured(white, unexplained_forces(*logs(lasting)[:3], UNITS))


def test_a_clear_error_of_a_weak_joint_is_not_small():
    """Its share of the largest force is far below that which raises an alarm for other joints."""
    above, below = 1.01 * SUSPICIOUS_WHITENESS, 0.99 * SUSPICIOUS_WHITENESS
    weak = UnexplainedForce("wrist", "Nm", 0.01, 0.1, 0.4 * SMALL, deviations=6.0)
    strong = UnexplainedForce("knee", "Nm", 0.2, 50.0, 0.9 * SMALL, deviations=6.0)
    assert is_coloured(above, (weak, strong))
    assert not is_coloured(below, (weak, strong))
    for other in (
        replace(weak, deviations=3.0),  # chance
        replace(weak, size=0.004),  # small by itself as well
        replace(weak, share=0.05 * SMALL),  # rounding errors of a joint without load
        strong,
    ):
        assert not is_coloured(above, (other, strong))


def test_a_small_error_that_lasts_comes_before_larger_ones_that_may_be_chance():
    lasting, noise = np.zeros(8), np.ones(8)
    lasting[7], noise[[6, 7]] = 0.2, (30.0, 0.05)
    names = list(gaussian_log(0, count=COUNT).layout.coordinates)
    found = [unexplained_forces(*logs(lasting, noise, seed)[:3], UNITS) for seed in range(6)]
    assert all(one[0].coordinate == names[7] for one in found)
    assert any(max(each.share for each in one) > one[0].share for one in found)
