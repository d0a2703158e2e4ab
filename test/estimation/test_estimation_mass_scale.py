"""The weighing against the data, and the gain of all forces, against linear algebra by hand."""

from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.estimation.alarms import SUSPICIOUS_MODEL_SCALE, alarms
from symbid_ros.estimation.mass_scale import (
    DEVIATIONS,
    LEAST_DIFFERENCE,
    WeighingResidual,
    common_gain,
    weighing_residual,
)
from symbid_ros.estimation.posterior import Posterior, PseudoMeasurements
from symbid_ros.estimation.prior import Prior

COUNT = 5
SCALE = np.array([2.0, 1.0, 0.3, 0.2, 0.5])  # the last is a joint term
IS_ANCHOR = np.arange(COUNT) < COUNT - 1


class Case:
    """Rows K φ = y + noise of unit variance, a prior, and perhaps a weighing of the first two."""

    def __init__(self, seed, weighed=None):
        rng = np.random.default_rng(seed)
        self.prior = Prior(
            "robot", "test", None, tuple("abcde"), SCALE * rng.uniform(0.8, 1.2, COUNT), 0.2 * SCALE
        )
        self.K = 30 * rng.normal(size=(60, COUNT)) / SCALE
        self.y = self.K @ SCALE + rng.normal(size=60)
        row = np.array([1.0, 1.0, 0, 0, 0])
        self.measurements = None
        if weighed is not None:
            self.measurements = PseudoMeasurements(
                row[None] / 0.02, np.array([weighed / 0.02]), True
            )

    def posterior(self, measurements=None) -> Posterior:
        H = self.K.T @ self.K + np.diag(self.prior.std**-2)
        g = self.K.T @ self.y + self.prior.mean / self.prior.std**2
        if measurements is not None:
            H += measurements.rows.T @ measurements.rows
            g += measurements.rows.T @ measurements.targets
        factor = np.linalg.cholesky(H).T
        return Posterior(np.linalg.solve(H, g), factor, self.prior, np.eye(1), 1.0, 0.0)


@pytest.mark.parametrize("correlated", [False, True])
def test_the_weighing_is_compared_with_the_mass_without_it(correlated) -> None:
    case = Case(1, weighed=3.2)
    alone, both = case.posterior(), case.posterior(case.measurements)
    if correlated:
        excess = 4 * np.linalg.cholesky(case.K.T @ case.K)
        alone, both = (replace(one, excess_score=excess) for one in (alone, both))
    found = weighing_residual(both, case.measurements)
    row = np.array([1.0, 1.0, 0, 0, 0])
    assert found.weighed == pytest.approx(3.2)
    assert found.weighed_std == pytest.approx(0.02)
    assert found.implied == pytest.approx(row @ alone.mean)
    assert found.implied_std == pytest.approx(np.linalg.norm(row @ alone.deviation_factor))
    assert weighing_residual(alone, None) is None
    assert weighing_residual(alone, replace(case.measurements, has_weighing=False)) is None


def test_only_a_clear_difference_is_a_contradiction() -> None:
    def differs(by, std) -> bool:
        return WeighingResidual(40.0 + by, 0.6 * std, 40.0, 0.8 * std).is_contradiction

    assert differs(-1.0, 0.99 / DEVIATIONS)
    assert not differs(1.0, 1.01 / DEVIATIONS)
    # Gravity at another place changes what a scale reads.
    assert not differs(0.99 * LEAST_DIFFERENCE * 40, 1e-3)
    assert differs(1.02 * LEAST_DIFFERENCE * 40, 1e-3)


def alarms_of(found, measurements=None):
    return alarms(found, found.mean, COUNT, whiteness=0.0, measurements=measurements)


def test_a_contradicted_weighing_is_an_alarm_with_its_numbers() -> None:
    wrong = Case(2, weighed=3.3)
    (alarm,) = alarms_of(wrong.posterior(wrong.measurements), wrong.measurements)
    assert "3.30 ± 0.02 kg contradicts" in alarm
    assert "say 3.00 ±" in alarm
    assert "the weighing or a gain of the forces is wrong" in alarm
    right = Case(2, weighed=3.0)
    assert alarms_of(right.posterior(right.measurements), right.measurements) == ()


def test_data_that_imply_a_negative_mass_do_not_blame_the_weighing() -> None:
    reversed_forces = Case(2, weighed=3.0)
    reversed_forces.y *= -1
    found = reversed_forces.posterior(reversed_forces.measurements)
    (alarm,) = (one for one in alarms_of(found, reversed_forces.measurements) if "weighing" in one)
    assert "say -3.0" in alarm
    assert "no mass is negative, so the forces have the wrong sign" in alarm
    assert "the weighing or a gain" not in alarm


@pytest.mark.parametrize("weighed", [None, 3.0])
@pytest.mark.parametrize("std", [0.01, 0.2])
def test_the_common_gain_is_a_further_unknown(weighed, std) -> None:
    """With a column for the gain, the normal equations give the same covariance."""
    case = Case(3, weighed)
    found = case.posterior(case.measurements)
    gain = common_gain(found, found.mean, case.measurements, std, IS_ANCHOR)
    A = np.diag(np.where(IS_ANCHOR, case.prior.std, np.inf) ** -2)
    if weighed is not None:
        A += case.measurements.rows.T @ case.measurements.rows
    wide = np.column_stack([case.K, -case.K @ found.mean])
    information = wide.T @ wide
    information[:COUNT, :COUNT] += A
    information[COUNT, COUNT] += std**-2
    covariance = np.linalg.inv(information)
    assert gain.std == pytest.approx(np.sqrt(covariance[COUNT, COUNT]), rel=2e-2)
    widened = np.hypot(found.std, gain.std * gain.direction)
    expected = np.sqrt(covariance.diagonal()[:COUNT])
    np.testing.assert_allclose(widened, expected, rtol=2e-2)
    # A weighing checks the gain; without one it keeps nearly all of its deviation.
    assert (gain.std < 0.7 * std) == (weighed is not None or std > 0.1)


def test_a_prior_that_the_data_widened_a_hundredfold_is_named_by_its_factor() -> None:
    found = replace(Case(4).posterior(), is_scaled=True, chosen_scale=97.0)
    (alarm,) = alarms_of(found)
    assert "widened the prior of the inertias by a factor of 97.0" in alarm
    assert alarms_of(replace(found, chosen_scale=0.99 * SUSPICIOUS_MODEL_SCALE)) == ()
