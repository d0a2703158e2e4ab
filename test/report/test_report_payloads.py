"""Payloads behind wrist sensors, as robot controllers ask for them."""

from dataclasses import replace

import numpy as np
import pytest
from report_pages import content_of_a_log, estimate

from symbid_ros.model.inertia import com_from_phi, phi_from_com
from symbid_ros.report.inertia_shapes import com_covariance
from symbid_ros.report.page import render
from symbid_ros.report.payloads import payloads

PHI = phi_from_com(1.7, np.array([0.03, -0.02, 0.08]), np.diag([0.009, 0.011, 0.006]))


@pytest.fixture(scope="module")
def carrying():
    shown = estimate(("arm", "tool0"), ("joint",))
    value = np.concatenate([shown.value[:10], PHI])
    return replace(shown, value=value, wrist_sensors=("-tool0:tool0",))


def numbers(text):
    return [float(one) for one in text.replace("−", "-").split(" ± ")]


def test_values_and_deviations_are_those_of_the_parameters(carrying):
    rng = np.random.default_rng(0)
    factor = np.zeros((20, 10))
    factor[10:] = 2e-3 * rng.normal(size=(10, 10)) * np.abs(PHI).clip(1e-3)[:, None]
    (found,) = payloads(carrying, factor)
    assert (found.sensor, found.link) == ("tool0", "tool0")
    rows = {name: numbers(text) for name, text, _ in found.rows}
    assert rows["mass"] == pytest.approx([1.7, np.linalg.norm(factor[10])], rel=0.05)
    std = 1e3 * np.sqrt(np.diag(com_covariance(PHI, factor[10:] @ factor[10:].T)))
    for axis, expected in zip("xyz", std, strict=True):
        assert rows[f"centre of mass {axis}"][1] == pytest.approx(expected, rel=0.05)
    drawn = PHI + rng.normal(size=(4000, 10)) @ factor[10:].T
    inertia = np.array([com_from_phi(one)[2][1, 1] for one in drawn])
    assert rows["inertia yy"][0] == pytest.approx(0.011, abs=3 * np.std(inertia))
    assert rows["inertia yy"][1] == pytest.approx(np.std(inertia), rel=0.1)


def test_values_stand_alone_without_covariance(carrying):
    (found,) = payloads(carrying, None)
    rows = {name: text for name, text, _ in found.rows}
    assert (rows["mass"], rows["centre of mass y"], rows["inertia zz"]) == (
        "1.70",
        "−20.0",
        "0.00600",
    )


def test_the_page_has_a_section_of_them(carrying):
    base = content_of_a_log(2)
    page = render(replace(base, payloads=payloads(carrying, None)))
    assert "Beyond tool0" in page
    assert 'href="#payload"' in page
    assert 'href="#payload"' not in render(base)
