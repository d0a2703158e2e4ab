"""Offsets and biases that drift during a log: their columns, their choice, and predictions."""

import re
from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_segment, dataset_of, noisy, spoilt
from random_robots import random_robot

from symbid_ros.choices import TYPICAL_ERRORS
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.calibration.extended_problem import SensorErrorRequest, calibrate
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.sensor_drift import MINUTE, SensorDrift, final_drifts, is_drift
from symbid_ros.signals.sensor_errors import SensorErrors
from symbid_ros.signals.weak_form import windowed_rows

# Pieces of a log of 144 s, with gaps so that the test is short. Its knots are 72 s apart.
STARTS = 20.0 * np.arange(8) + 0.05
LEVELS = {"position": 1e-5, "rate": 2e-3, "acceleration": 0.02, "effort": 0.05, "wrench": 0.3}


@pytest.fixture(scope="module")
def parameters():
    return ParameterSet(random_robot(1, links=3))


@pytest.fixture(scope="module")
def perfect(parameters):
    return [analytic_segment(parameters, 3.9, 1, rate=500.0, start=start) for start in STARTS]


@pytest.fixture(scope="module")
def errors(parameters, perfect):
    frames = perfect[0].wrench_frames, perfect[0].imu_frames
    return SensorErrors.of(TYPICAL_ERRORS, parameters.model, *frames)


@pytest.fixture(scope="module")
def possible(errors, perfect):
    return SensorDrift.possible(errors, int(perfect[0].stamp[0]), int(perfect[-1].stamp[-1]))


def drifting(segment, errors, possible, changes):
    """Return the segment with offsets and biases changed by (K, d), linear between the knots."""
    now = np.zeros((len(segment), len(errors)))
    knots = np.vstack([np.zeros(len(possible.places)), changes])
    for column, place in enumerate(possible.places):
        now[:, place] = np.interp(segment.stamp, possible.knots, knots[:, column])
    offset = now[:, errors.places["wrench_offset"]].reshape(segment.wrenches.shape)
    bias = now[:, errors.places["imu_bias"]].reshape(len(segment), -1, 6)
    return replace(
        segment,
        wrenches=segment.wrenches + offset,
        angular_velocity=segment.angular_velocity + bias[..., :3],
        linear_acceleration=segment.linear_acceleration + bias[..., 3:],
    )


def calibrated(parameters, segments):
    log = dataset_of(parameters, segments)
    problem = Problem((), parameters, draw_prior(parameters, "percent", 25, 1))
    return calibrate(problem, log, SensorErrorRequest(TYPICAL_ERRORS, {}))


def test_knots_are_a_minute_apart_or_spread_over_a_long_log(errors):
    def knots(minutes):
        found = SensorDrift.possible(errors, 7, 7 + round(minutes * MINUTE))
        return None if found is None else (found.knots - 7) / MINUTE

    assert knots(1.9) is None
    np.testing.assert_allclose(knots(2.0), [0, 1, 2])
    np.testing.assert_allclose(knots(5.2), np.linspace(0, 5.2, 6))
    np.testing.assert_allclose(knots(60), np.linspace(0, 60, 7))


def test_the_prior_is_that_of_a_random_walk(possible):
    size = len(possible.places)
    covariance = possible.covariance_factor @ possible.covariance_factor.T
    minutes = (possible.knots[1:] - possible.knots[0]) / MINUTE
    for i, one in enumerate(minutes):
        for j, other in enumerate(minutes):
            block = covariance[i * size : (i + 1) * size, j * size : (j + 1) * size]
            np.testing.assert_allclose(block, min(one, other) * np.diag(possible.std**2))


def test_the_first_knot_differs_from_the_start_of_a_walk_as_its_fitted_line_does():
    rng, steps = np.random.default_rng(0), 400
    walks = np.cumsum(rng.standard_normal((4000, steps)), axis=1) / np.sqrt(steps)
    time = np.arange(1, steps + 1) / steps
    starts = np.polynomial.polynomial.polyfit(time, walks.T, 1)[0]
    errors = SensorErrors(("imu_bias",), (), ("imu",), (), np.zeros(0, dtype=bool))
    one = SensorDrift.possible(errors, 0, 2 * MINUTE)
    np.testing.assert_allclose(starts.std() * one.std, one.start_std, rtol=0.05)


def test_rows_hold_for_sensors_that_drift(parameters, perfect, errors, possible):
    rng = np.random.default_rng(3)
    theta = 0.1 * errors.std * rng.standard_normal(len(errors))
    changes = possible.covariance_factor @ rng.standard_normal(len(possible.names(errors)))
    segment = spoilt(perfect[5], errors, theta)
    segment = drifting(segment, errors, possible, changes.reshape(len(possible.knots) - 1, -1))
    point = LinearizationPoint(parameters.values, theta)

    def residual(drift, *more):
        build = CalibratingRows(parameters, errors, point, drift)
        ((rows,),) = windowed_rows(segment, build, [0.321], ())
        unknowns = np.concatenate([parameters.values, theta, *more])
        return np.sqrt(np.mean((rows.mean.y - rows.mean.K @ unknowns) ** 2))

    assert residual(possible, changes) < 0.02 * residual(None)


@pytest.fixture(scope="module")
def truth(errors, possible):
    """Sensor errors at the start (r,), and their changes (K, d): of the plates alone."""
    rng = np.random.default_rng(4)
    theta = errors.std * rng.standard_normal(len(errors))
    shape = len(possible.knots) - 1, len(possible.std)
    changes = 0.3 * possible.std * rng.uniform(0.5, 1.5, shape) * rng.choice([-1.0, 1.0], shape)
    changes[:, possible.places >= errors.places["imu_bias"].start] = 0.0
    return theta, changes


@pytest.fixture(scope="module")
def found(parameters, perfect, errors, possible, truth):
    rng = np.random.default_rng(6)
    segments = [
        noisy(drifting(spoilt(one, errors, truth[0]), errors, possible, truth[1]), rng, **LEVELS)
        for one in perfect
    ]
    return calibrated(parameters, segments)


def test_walks_are_identified_of_the_sensors_that_drift(found, parameters, errors, possible, truth):
    theta, changes = truth
    plates = np.flatnonzero(changes.any(axis=0))
    names = tuple(
        f"{errors.names[possible.places[i]]}_drift_{seconds}s"
        for seconds in (72, 144)
        for i in plates
    )
    assert found.sensor_names == errors.names + names
    units = ("Nm", "Nm", "Nm", "N", "N", "N")
    assert found.sensor_units[len(errors) :] == units * (len(names) // 6)
    after = posterior(found.observations[-1], found.prior, count=len(parameters))
    unknowns = np.concatenate([parameters.values, theta, changes[:, plates].ravel()])
    z = (after.mean - unknowns) / after.std
    assert np.sqrt(np.mean(z**2)) < 1.6
    known = after.std[-len(names) :] < DETERMINED * found.prior.std[-len(names) :]
    assert known.sum() > 6
    assert np.sqrt(np.mean(z[-len(names) :][known] ** 2)) < 1.6


def test_masses_are_not_too_small_beside_a_noisy_accelerometer(
    parameters, perfect, errors, possible, truth, monkeypatch
):
    """Offsets that drift resemble weights, so accelerations tell the masses, and their noise."""
    # Gaps would let the usual choice of blocks represent more or fewer than there are.
    monkeypatch.setattr("symbid_ros.signals.weak_form.represented_blocks", lambda _: 1)
    theta, changes = truth
    total = np.zeros(len(parameters))
    total[: parameters.inertial : 10] = 1.0
    deviations = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        segments = [
            drifting(spoilt(one, errors, theta), errors, possible, changes) for one in perfect
        ]
        segments = [noisy(one, rng, **LEVELS | {"acceleration": 2.0}) for one in segments]
        found = calibrated(parameters, segments)
        after = posterior(found.observations[-1], found.prior, count=len(parameters))
        error = after.mean[: len(parameters)] - parameters.values
        std = np.linalg.norm(total @ after.independent_factor[: len(parameters)])
        deviations.append(total @ error / std)
    # The mean of four has a deviation of 0.5; without the noise of the accelerometer it is -1.7.
    assert np.abs(np.mean(deviations)) < 1.2


def test_predictions_use_the_values_at_the_end(found, parameters, errors, possible, truth):
    identified = SolvedProblem.of(found).map()
    predictor = ForcePredictor.of(identified, parameters)
    later = analytic_segment(parameters, 3.9, 1, rate=500.0, start=STARTS[-1] + 400.0)
    later = drifting(spoilt(later, errors, truth[0]), errors, possible, truth[1])
    changes = np.array([is_drift(name) for name in predictor.sensor_names])
    at_start = predictor.unknowns.copy()
    at_start[len(parameters) :][changes] = 0.0

    def error(unknowns):
        (rows,) = predictor.rows([later], "later")
        residual = rows.rows.y - rows.rows.K @ unknowns
        return np.linalg.norm(residual)

    assert error(predictor.unknowns) < 0.1 * error(at_start)
    said = identified.estimate.verdict.describe_drift()
    assert re.match(r"12 sensor errors drift, most clearly wrench_\d/wrench_offset_force_.: ", said)
    # Saved results are read again by these shapes.
    assert identified.calibration.factor.shape[0] == len(predictor.sensor_names)
    assert len(identified.calibration.linearization) == len(identified.unknowns)


def test_sensors_that_do_not_drift_have_constant_errors(parameters, perfect, errors, monkeypatch):
    rng = np.random.default_rng(5)
    theta = errors.std * rng.standard_normal(len(errors))
    segments = [noisy(spoilt(one, errors, theta), rng, **LEVELS) for one in perfect]
    found = calibrated(parameters, segments)
    assert found.sensor_names == errors.names
    monkeypatch.setattr(SensorDrift, "possible", lambda *_: None)
    before = calibrated(parameters, segments)
    one, other = (posterior(each.observations[-1], each.prior) for each in (found, before))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-4 * other.std.min(), rtol=0)
    np.testing.assert_array_equal(found.prior.std, before.prior.std)


def test_the_last_change_of_each_error_is_found_by_name(possible, errors):
    names = (*errors.names, *possible.names(errors))
    final = final_drifts(names)
    assert list(final) == [errors.names[place] for place in possible.places]
    assert [names[index] for index in final.values()] == [f"{one}_drift_144s" for one in final]
