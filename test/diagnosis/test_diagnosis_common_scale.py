"""A unit of all forces or one of the model's masses: densities and effort limits tell."""

from dataclasses import replace

import numpy as np
import pytest
from arm_log import arm_streams
from documented_robots import ur5_urdf

from symbid_ros.diagnosis.common_scale import (
    KGF,
    Cause,
    ScaleEvidence,
    common_unit,
    model_density,
    unit_of,
)
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.load import load_model
from symbid_ros.signals.log import Log


@pytest.mark.parametrize(
    ("density", "times_limit", "factor", "cause"),
    [
        (500.0, 0.0, 1e-3, Cause.UNIT),  # efforts in mNm
        (500.0, 0.0, 1e3, Cause.UNIT),  # in kNm
        (500e3, 0.0, 1e3, Cause.MASSES),  # masses in g
        (0.5, 0.0, 1e-3, Cause.MASSES),
        (500.0, 0.2, 10.0, None),
        (500.0, 1.1, 10.0, Cause.MASSES),  # eleven times the limits if multiplied
        (500.0, 11.0, 0.1, Cause.UNIT),  # eleven times the limits as they are read
        (500e3, 11.0, 1e-3, Cause.UNIT),
        (4.0, 200.0, 1e-3, None),  # the density says the opposite
        (np.inf, 0.2, 1e3, Cause.MASSES),  # links are points: limits alone tell
        (np.nan, 1e-3, 1e3, None),
    ],
)
def test_densities_and_limits_tell_the_cause(density, times_limit, factor, cause):
    assert ScaleEvidence(density, times_limit).cause(factor) is cause


@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1.2, None), (9.0, KGF), (13.0, None), (80.1, 100.0), (0.00124, 1e-3), (-1e3, None)],
)
def test_units_are_powers_of_ten_or_kgf(factor, unit):
    assert unit_of(factor) == (None if unit is None else pytest.approx(unit))


@pytest.mark.parametrize(
    ("factors", "unit"),
    [
        ((0.000903, 0.000983, 0.00095), 1e-3),  # masses of the model err by some percent
        ((0.00085, 0.00122, 0.001), None),  # they differ from each other
        ((0.00130, 0.00132, 0.00131), None),  # they agree on something else
        ((0.001, 0.001), None),  # two may agree by chance
    ],
)
def test_factors_that_agree_on_a_power_of_ten_are_a_unit(factors, unit):
    assert common_unit(factors) == (None if unit is None else pytest.approx(unit))


def test_the_density_is_that_of_the_heavy_links():
    def ball(mass, radius):
        return phi_from_com(mass, np.ones(3), 0.4 * mass * radius**2 * np.eye(3))

    volume = 4 / 3 * np.pi * 0.1**3
    links = [ball(4.0, 0.1), ball(1e-3, 1.0), ball(2e-3, 1.0), np.zeros(10)]
    assert model_density(np.array(links)) == pytest.approx(4.0 / volume)
    assert np.isnan(model_density(np.zeros((2, 10))))


@pytest.mark.parametrize(
    ("masses", "efforts", "says"),
    [
        (1e3, 1.0, "masses in the model were in g;"),
        (1e-3, 1.0, "masses in the model were 1000 times too small;"),
        (1.0, 1e3, "in mNm (Nmm); give"),
        (1.0, 1 / KGF, "in kgf m, or as if the masses in the model were 10 times too large;"),
    ],
)
def test_an_arm_with_wrong_masses_keeps_its_efforts(masses, efforts, says):
    """Scaled efforts would give an arm of many tons, and leave nothing unexplained."""
    arm = load_model(ur5_urdf(), "fixed")
    streams = arm_streams(arm, 20.0, 1, friction=0.02)
    joints = replace(streams.joints, effort=efforts * streams.joints.effort)
    log = Log.from_streams(replace(streams, joints=joints))
    (finding,) = diagnose(log, arm.with_phi(masses * arm.phi)).findings
    assert finding.kind is Kind.TORQUE_GAIN
    assert says in finding.message
    assert ("effort_scale" in finding.message) == (efforts != 1.0)
    assert ("masses_times" in finding.figures) == (efforts != 1e3)
