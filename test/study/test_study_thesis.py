"""The values of the thesis's tables."""

import numpy as np
import pytest

from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.study import thesis
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Case

METHODS = (REFERENCE, "ols", "wls_r", "wls_c", "wls_rc")


def test_table_c1_has_every_prior_method_and_filter() -> None:
    filters = (0.0, 30.0, 50.0, 70.0, 100.0)
    cases = {
        Case(thesis.DATA, prior, method, cutoff)
        for prior in ("±12.5 %", "±25 %")
        for method in METHODS
        for cutoff in (filters if method != REFERENCE else (None,))
    }
    assert set(thesis.table_c1().means) == cases
    for case, means in thesis.table_c1().means.items():
        assert set(means) == {*METRICS, *((RANK,) if case.method != REFERENCE else ())}


@pytest.mark.parametrize("prior", [str(spread) for spread in thesis.PRIORS])
@pytest.mark.parametrize("method", METHODS)
def test_table_2_is_the_best_of_table_c1(prior: str, method: str) -> None:
    printed = thesis.table_2().best(thesis.DATA, prior, method)
    best = thesis.table_c1().best(thesis.DATA, prior, method)
    # Two printed digits of the millimetres, and means of rounded counts.
    assert best == pytest.approx(printed, rel=0.035)


def test_table_4_1_has_the_absolute_prior() -> None:
    assert thesis.table_4_1().at(thesis.DATA, "±0.125", "wls_rc", None) == {
        "gen_force_rmse": 12.8,
        "torque_rmse": 7.25,
        "com_position_rmse_mm": 3.7,
        "com_momentum_rmse": 0.094,
        "parameter_error_pct": 13200.0,
        RANK: 33.4,
    }


def test_real_parameters_equal_the_model() -> None:
    model = ParameterSet(load_model(config_file("symbitron.xml")))
    np.testing.assert_allclose(thesis.table_d1().real, model.values, rtol=1e-12)


def test_errors_of_table_d1_agree_with_the_mean_of_table_c1() -> None:
    # One draw against the mean of twenty: the well-behaved methods only.
    printed = thesis.table_d1()
    for method in ("wls_c", "wls_rc"):
        error = np.abs(printed.estimates[method] / printed.real - 1)
        mean = thesis.table_c1().at(thesis.DATA, "±25 %", method, 50.0)["parameter_error_pct"]
        assert 100 * error.mean() == pytest.approx(mean, rel=0.1)
