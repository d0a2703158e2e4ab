"""Standard deviations of priors from the sizes of links, written out."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.choices import JOINT_TERMS, TERMS
from symbid_ros.estimation.prior_std import (
    absolute_std,
    is_stated,
    link_extent,
    payload_std,
    percent_floor,
    percent_std,
)
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.parameters import ParameterSet

LEVER = 0.1  # m, at which a slide's drive is compared with a hinge's


def point(mass, *place):
    return phi_from_com(mass, np.array(place), np.zeros((3, 3)))


@pytest.fixture(scope="module")
def parameters():
    """A heavy link, a tiny one and one without parameters, a hinge and a slide."""
    model = random_robot(0, links=3)
    hinge, slide = model.joints
    joints = (
        replace(hinge, kind="revolute", damping=-0.5, friction_loss=2.0),
        replace(slide, kind="prismatic", armature=1e-9),
    )
    phi = np.array([point(4.0, 0.3, 0, 0.4), point(2.0, 0.0, 0.01, 0), np.zeros(10)])
    return ParameterSet(replace(model.with_phi(phi), joints=joints), TERMS)


def term_std(term, kind):
    each = JOINT_TERMS[term]
    return each.std / (LEVER**each.lever_power if kind == "prismatic" else 1.0)


def test_the_extent_is_the_root_mean_square_distance_from_the_origin():
    assert link_extent(point(4.0, 0.3, 0, 0.4)) == pytest.approx(0.5)
    two = point(1.0, 1.0, 0, 0) + point(3.0, 0, 0, 2.0)
    assert link_extent(two) == pytest.approx(np.sqrt((1 + 3 * 4) / 4))
    assert link_extent(np.zeros(10)) == 0
    assert link_extent(-two) == 0
    massless = np.array([0.0, 0, 0, 0, 1, 0, 0, 1, 0, 1])
    assert link_extent(massless) == 0


def test_a_payload_weighs_a_tenth_of_the_robot_at_each_links_extent(parameters):
    found = payload_std(parameters, np.append(parameters.values, 7.0))
    mass = 0.1 * 6.0
    for row, extent in zip(found, (0.5, 0.05, 0.05), strict=True):
        powers = [1.0, *[extent] * 3, *[extent**2] * 6]
        np.testing.assert_allclose(row, mass * np.array(powers))


def test_floors_are_a_hundredth_of_the_deviation_at_the_links_scale(parameters):
    floor = percent_floor(parameters, 30.0)
    unit = 0.01 * 0.3 / np.sqrt(3)
    scales = [(4.0, 0.5), (2.0, 0.01), (1.0, 0.1)]
    for index, (mass, extent) in enumerate(scales):
        scale = np.array([mass, *[mass * extent] * 3, *[mass * extent**2] * 6])
        np.testing.assert_allclose(floor[10 * index : 10 * index + 10], unit * scale)
    for term, columns in parameters.term_columns.items():
        expected = [unit * term_std(term, kind) for kind in ("revolute", "prismatic")]
        np.testing.assert_allclose(floor[columns], expected)


def test_values_of_links_and_terms_that_are_not_zero_are_stated(parameters):
    stated = is_stated(parameters)
    assert stated[: parameters.inertial].all()
    found = {term: stated[columns].tolist() for term, columns in parameters.term_columns.items()}
    expected = {
        **{term: [False, False] for term in TERMS},
        "viscous": [True, False],
        "coulomb": [True, False],
        "armature": [False, True],
    }
    assert found == expected


def test_deviations_are_those_of_a_uniform_error_or_of_the_term(parameters):
    values = parameters.values
    percent, absolute = percent_std(parameters, values, 30.0), absolute_std(parameters, 0.2)
    uniform = 0.3 * np.abs(values) / np.sqrt(3)
    floor = percent_floor(parameters, 30.0)
    inertial = slice(parameters.inertial)
    np.testing.assert_allclose(percent[inertial], np.maximum(uniform, floor)[inertial])
    np.testing.assert_allclose(absolute[inertial], 0.2 / np.sqrt(3))
    stated = is_stated(parameters)
    for term, columns in parameters.term_columns.items():
        for column, kind in zip(
            range(columns.start, columns.stop), ("revolute", "prismatic"), strict=True
        ):
            if stated[column]:
                assert percent[column] == pytest.approx(max(uniform[column], floor[column]))
                assert absolute[column] == pytest.approx(0.2 / np.sqrt(3))
            else:
                assert percent[column] == absolute[column] == term_std(term, kind)
