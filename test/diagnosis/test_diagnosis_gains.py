"""Gains and delays against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.gain_problem import (
    GAIN_STD,
    GainEstimate,
    GainProblem,
    estimate_of,
    loads,
)
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout
from symbid_ros.diagnosis.gains import (
    estimate_delays,
    estimate_gains,
    find_late_streams,
    fit_imu_rotation,
)
from symbid_ros.diagnosis.joint_efforts import effort_scale
from symbid_ros.dynamics.regressor import Rows

LAYOUT = GainLayout(("left",), ("imu",), (0, 1), ("hip", "knee"))
NAMES = ("base/moment_x", "base/moment_y", "base/force_x", "base/force_z", "hip", "knee")
UNITS = ("Nm", "Nm", "N", "N", "Nm", "Nm")


def problem(seed=0, count=200, noise=0.0, theta=None, size=1.0):
    """Return rows K φ - C θ = y with known unknowns, and φ."""
    rng = np.random.default_rng(seed)
    p, r, n = 4, len(LAYOUT), len(NAMES)
    K = size * rng.normal(size=(count, n, p + r))
    mean = rng.uniform(1, 2, p)
    true = np.append(mean, np.zeros(r) if theta is None else theta)
    y = K @ true + noise * rng.normal(size=(count, n))
    rows = CoordinateRows(NAMES, UNITS, np.ones((n, p + r), dtype=bool))
    rows.fold(Rows(K, y))
    return GainProblem(rows, mean, np.full(p, 0.3), LAYOUT), K, y


def test_the_solution_is_that_of_stacked_rows_and_priors():
    given, K, y = problem(noise=0.5)
    std = np.linspace(0.1, 2.0, len(LAYOUT))
    left = np.linspace(0.2, 3.0, len(NAMES))
    found, root = given.solve(std, left)
    weight = 1 / np.sqrt(4 / 3 * left)
    W = (K * weight[:, None]).reshape(-1, K.shape[2])
    deviation = np.append(given.std, std)
    precision = W.T @ W + np.diag(deviation**-2)
    moment = W.T @ (y * weight).ravel() + deviation**-2 * given.expected
    np.testing.assert_allclose(found, np.linalg.solve(precision, moment), rtol=1e-9)
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(precision), rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(given.expected, np.append(given.mean, np.zeros(len(LAYOUT))))
    # The first parameter is the mass of the only link.
    anchored, _ = given.solve(std, left, mass_std=1e-9)
    assert given.mass_ratio(found) == pytest.approx(found[0] / given.mean[0])
    assert given.mass_ratio(anchored) == pytest.approx(1.0)


def test_gains_are_found_and_imus_are_trusted():
    theta = np.zeros(len(LAYOUT))
    theta[LAYOUT.wrench(0)] = 0.5 * np.random.default_rng(1).normal(size=9)
    theta[LAYOUT.efforts] = [-2.0, 0.7]
    theta[LAYOUT.wrench(0).stop], theta[LAYOUT.effort_delay] = 0.02, -0.01
    given, K, y = problem(theta=theta, noise=0.01)
    found = estimate_gains(given)
    np.testing.assert_allclose(found.mean, theta, atol=0.02)
    A, covariance = found.matrix(LAYOUT.wrench(0))
    np.testing.assert_allclose(A, np.eye(3) + theta[:9].reshape(3, 3), atol=0.02)
    assert covariance.shape == (9, 9)
    assert found.effort(0)[0] == pytest.approx(-1.0, abs=0.02)
    assert found.effort(1)[0] == pytest.approx(1.7, abs=0.02)
    place = LAYOUT.efforts.start + 1
    assert found.effort(1)[1] == pytest.approx(np.sqrt(found.covariance[place, place]))
    delay, std = found.delay(LAYOUT.effort_delay)
    assert delay == pytest.approx(-0.01, abs=0.02)
    assert std == pytest.approx(np.sqrt(found.covariance[-1, -1]))
    forces = [2, 3]
    before = np.mean((y - K @ given.expected) ** 2, axis=0)[forces]
    assert found.before == pytest.approx(np.sqrt(before.sum()))
    assert found.after == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    np.testing.assert_allclose(np.sqrt(found.left), 0.01, rtol=0.2)
    # An IMU's matrix is held.
    theta[LAYOUT.imu(0)] = 0.3
    pinned = estimate_gains(problem(theta=theta)[0])
    np.testing.assert_allclose(pinned.mean[LAYOUT.imu(0)], 0, atol=1e-6)


@pytest.mark.parametrize("gain", [1.0, 0.5, -1.0])
def test_noise_of_wrenches_does_not_attenuate_the_efforts_of_a_joint(gain):
    """The load on a joint is the measured force times its lever, noise included."""
    rng = np.random.default_rng(3)
    count, p, noise = 4000, 4, 0.5
    K = np.zeros((count, len(NAMES), p + len(LAYOUT)))
    K[:, :, :p] = rng.normal(size=(count, len(NAMES), p))
    load, mean = rng.normal(size=count), np.full(p, 1.5)
    y = K[:, :, :p] @ mean
    effort = (y[:, 4] - load) / gain
    K[:, 4, p + LAYOUT.efforts.start] = -effort
    y[:, 4] = load + noise * rng.normal(size=count) + effort
    rows = CoordinateRows(NAMES, UNITS, np.ones((len(NAMES), p + len(LAYOUT)), dtype=bool))
    rows.fold(Rows(K, y))
    given = GainProblem(rows, mean, np.full(p, 1e-6), LAYOUT)
    deviation = np.zeros((p + len(LAYOUT), 1))
    gains = estimate_of(given, given.expected, deviation, np.zeros(len(NAMES)))
    attenuated, _ = effort_scale(given, gains, 0)
    known = replace(given, load_noise=np.array([[noise**2, 0.0]]))
    ratio, std = effort_scale(known, gains, 0)
    assert ratio == pytest.approx(1 / gain, rel=0.02)
    assert abs(attenuated) < abs(ratio) - 2 * std / 3
    assert std > abs(ratio - attenuated)
    # Of a load that is mostly noise nothing is known.
    hidden = replace(given, load_noise=np.array([[load.var() + y.var(), 0.0]]))
    assert effort_scale(hidden, gains, 0) == (1.0, GAIN_STD)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 1.5])
def test_the_rotation_of_an_imu_is_found_beside_gains(sign, angle):
    """Its scale is held at one, whatever the readings say."""
    rotation = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
    theta = np.zeros(len(LAYOUT))
    theta[LAYOUT.imu(0)] = (sign * rotation - np.eye(3)).ravel()
    theta[LAYOUT.efforts] = 0.3
    given = problem(theta=theta, noise=0.01)[0]
    found = fit_imu_rotation(given, estimate_gains(given), 0)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.sign * found.rotation, sign * rotation, atol=0.01)
    assert found.cost < 40
    if sign < 0 or angle:
        assert found.plain > 1000


def test_delays_are_found_with_gains_of_one():
    theta = np.zeros(len(LAYOUT))
    theta[LAYOUT.is_delay] = [0.02, -0.03, 0.05]
    found = estimate_delays(problem(theta=theta, noise=0.001)[0])
    np.testing.assert_allclose(found.mean, theta, atol=1e-3)
    # Gains are all but held, those of the IMU entirely.
    theta = np.zeros(len(LAYOUT))
    theta[LAYOUT.wrench(0)] = theta[LAYOUT.imu(0)] = 0.5
    found = estimate_delays(problem(theta=theta, noise=0.001)[0])
    assert np.abs(found.mean[LAYOUT.imu(0)]).max() < 1e-6
    assert np.abs(found.mean[LAYOUT.wrench(0)]).max() < 0.3


def test_loads_are_the_largest_of_their_kind():
    rows = CoordinateRows(NAMES, UNITS, np.ones((6, 1), dtype=bool))
    y = np.array([[3.0, 4, 10, 20, 5, 1e-9]])
    rows.fold(Rows(np.zeros((1, 6, 1)), y))
    np.testing.assert_allclose(loads(rows, np.zeros(1)), [4, 4, 20, 20, 5, 5])
    # What the unknowns imply counts if it is more.
    rows = CoordinateRows(NAMES, UNITS, np.ones((6, 1), dtype=bool))
    rows.fold(Rows(np.full((1, 6, 1), 7.0), np.zeros((1, 6))))
    np.testing.assert_allclose(loads(rows, np.array([2.0])), 14)
    np.testing.assert_allclose(loads(rows, np.array([0.0])), 1)
    mixed = CoordinateRows(NAMES, (*UNITS[:5], "N"), np.ones((6, 1), dtype=bool))
    mixed.fold(Rows(np.zeros((1, 6, 1)), np.array([[3.0, 4, 10, 20, 5, 1800]])))
    np.testing.assert_allclose(loads(mixed, np.zeros(1)), [4, 4, 20, 20, 5, 1800])
    small = CoordinateRows(NAMES, UNITS, np.ones((6, 1), dtype=bool))
    small.fold(Rows(np.zeros((1, 6, 1)), np.array([[0.0, 0, 100, 0, 0, 0]])))
    np.testing.assert_allclose(loads(small, np.zeros(1)), [0.01, 0.01, 100, 100, 0.01, 0.01])


def delays(values, covariance):
    mean = np.zeros(len(LAYOUT))
    mean[LAYOUT.is_delay] = values
    full = np.eye(len(LAYOUT))
    full[np.ix_(LAYOUT.is_delay, LAYOUT.is_delay)] = covariance
    return GainEstimate(LAYOUT, mean, full, np.zeros(0), 0.0, 0.0)


PLACES = np.flatnonzero(LAYOUT.is_delay).tolist()


@pytest.mark.parametrize(
    ("values", "late"),
    [
        ([0, 0, 0], []),
        ([4.9, 0, 0], []),
        ([5.1, 0, 0], [0]),
        ([5.1, 0, -6], [2, 0]),
        ([5.1, 8, -6], [1, 2, 0]),
        ([6, 30, 0], [1]),  # 36 of 936 squared deviations are too little
        ([11, 30, 0], [1, 0]),
    ],
)
def test_independent_delays_are_chosen_one_by_one(values, late):
    """In units of their deviations, as many as explain 25 and a tenth of all."""
    std = 1e-3 * np.array([1.0, 2.0, 0.5])
    found = find_late_streams(delays(values * std, np.diag(std**2)))
    assert list(found) == [PLACES[i] for i in late]
    for i in late:
        assert found[PLACES[i]] == pytest.approx((values[i] * std[i], std[i]))


def test_one_late_stream_is_found_though_all_others_look_early():
    """Relative delays are known ten times as well as absolute ones."""
    covariance = 1e-8 * np.eye(3) + 1e-6 * np.ones((3, 3))
    truth = np.array([0.0, 5e-3, 0.0])
    # The common error is the least certain direction.
    seen = truth - 1.6e-3
    found = find_late_streams(delays(seen, covariance))
    assert list(found) == [PLACES[1]]
    precision = np.linalg.inv(covariance)
    value = (precision @ seen)[1] / precision[1, 1]
    assert found[PLACES[1]] == pytest.approx((value, precision[1, 1] ** -0.5))
    assert value == pytest.approx(5e-3, rel=0.1)
