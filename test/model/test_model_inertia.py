"""Inertial parameters against sums over point masses, and what MuJoCo compiles."""

import mujoco
import numpy as np
import pytest
from random_robots import random_rotation

from symbid_ros.model.export_mjcf import full_inertia
from symbid_ros.model.inertia import (
    LEAST_MASS,
    TINY_MASS,
    _projected,
    com_from_phi,
    inertia_matrix,
    is_consistent,
    nearest_consistent,
    phi_from_com,
    phi_from_pseudo_inertia,
    pseudo_inertia,
    second_moments,
    transform_phi,
)


def points(seed, count=6):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 1, count), rng.normal(size=(count, 3)) * 0.2 + rng.normal(size=3) * 0.1


def summed(masses, places):
    """Return φ of point masses, written out."""
    x, y, z = places.T
    products = [y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y]
    return np.array([masses.sum(), *(masses @ places), *(masses @ each for each in products)])


@pytest.mark.parametrize("seed", range(4))
def test_parameters_are_sums_over_point_masses(seed):
    masses, places = points(seed)
    phi, mass = summed(masses, places), masses.sum()
    centre = masses @ places / mass
    central = summed(masses, places - centre)[4:]
    inertia = central[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    np.testing.assert_allclose(phi_from_com(mass, centre, inertia), phi, atol=1e-15)
    found = com_from_phi(phi)
    assert found[0] == mass
    np.testing.assert_allclose(found[1], centre, atol=1e-15)
    np.testing.assert_allclose(found[2], inertia, atol=1e-15)
    np.testing.assert_allclose(second_moments(phi), (places.T * masses) @ places, atol=1e-15)
    homogeneous = np.c_[places, np.ones(len(masses))]
    J = (homogeneous.T * masses) @ homogeneous
    np.testing.assert_allclose(pseudo_inertia(phi), J, atol=1e-15)
    np.testing.assert_allclose(phi_from_pseudo_inertia(J), phi, atol=1e-15)
    rotation, shift = random_rotation(np.random.default_rng(seed)), np.array([0.3, -0.2, 0.5])
    moved = transform_phi(phi, rotation, shift)
    np.testing.assert_allclose(moved, summed(masses, places @ rotation.T + shift), atol=1e-14)


def test_stacks_of_links_give_stacks_of_matrices():
    phi = np.array([[summed(*points(3 * i + j)) for j in range(3)] for i in range(2)])
    for function in (inertia_matrix, second_moments, pseudo_inertia):
        stacked = function(phi)
        assert stacked.shape[:2] == (2, 3)
        np.testing.assert_array_equal(stacked[1, 2], function(phi[1, 2]))
    np.testing.assert_allclose(phi_from_pseudo_inertia(pseudo_inertia(phi)), phi, atol=1e-15)


def test_a_link_without_mass_keeps_its_inertia():
    phi = np.array([0, 0.1, 0.2, 0.3, 4, 5, 6, 7, 8, 9])
    mass, com, inertia = com_from_phi(phi)
    assert mass == 0
    np.testing.assert_array_equal(com, 0)
    np.testing.assert_array_equal(inertia, inertia_matrix(phi))


def compiles(phi):
    """Return whether MuJoCo accepts a moving body with these parameters."""
    mass, com, inertia = com_from_phi(phi)
    text = (
        f'<mujoco><compiler boundmass="0"/><worldbody><body><joint/><inertial mass="{mass!r}" '
        f'pos="{" ".join(map(repr, com.tolist()))}" fullinertia="{full_inertia(inertia)}"/>'
        "</body></worldbody></mujoco>"
    )
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError:
        return False
    return True


def central_moments(phi):
    mass, com, _ = com_from_phi(phi)
    return second_moments(phi) - mass * np.outer(com, com)


@pytest.mark.parametrize("seed", range(4))
def test_a_consistent_link_is_its_own_nearest(seed):
    phi = summed(*points(seed))
    np.testing.assert_array_equal(nearest_consistent(phi), phi)


@pytest.mark.parametrize("seed", range(4))
def test_a_link_with_mass_keeps_it_and_loses_its_negative_moments(seed):
    """The nearest positive semi-definite matrix keeps the positive eigenvalues."""
    masses, places = points(seed)
    phi = summed(masses, places)
    moments, axes = np.linalg.eigh(central_moments(phi))
    moments[0] = -0.5 * moments[1]
    changed = axes @ np.diag(moments) @ axes.T
    com = phi[1:4] / phi[0]
    wrong = phi_from_com(phi[0], com, np.trace(changed) * np.eye(3) - changed)
    assert not is_consistent(wrong)
    right = nearest_consistent(wrong)
    assert is_consistent(right)
    assert compiles(right)
    np.testing.assert_allclose(right[:4], phi[:4], rtol=1e-14)
    moments[0] = 0.0
    np.testing.assert_allclose(central_moments(right), axes @ np.diag(moments) @ axes.T, atol=1e-10)


@pytest.mark.parametrize(
    "phi",
    [
        np.zeros(10),
        -summed(*points(0)),
        np.array([1.0, 0, 0, 0, -1, 0, 0, -1, 0, -1]),
        np.array([0.1 * LEAST_MASS, 0, 0, 0, 1, 0, 0, 1, 0, 1]),
        np.array([-1.0, 0.2, 0, 0, 1, 0, 0, 2, 0, 2.5]),
        np.array([0.0, 1.0, 0, 0, 0, 0, 0, 0, 0, 0]),
        phi_from_com(2.0, np.array([0.1, 0.2, 0.3]), np.zeros((3, 3))),
        phi_from_com(1e-3, np.zeros(3), np.diag([1e-5, 1e-5, 0.0])),
    ],
)
def test_any_link_becomes_one_that_mujoco_compiles(phi):
    right = nearest_consistent(phi)
    assert is_consistent(right)
    assert compiles(right)
    assert right[0] >= min(TINY_MASS, 1.0)


def test_a_link_without_parameters_becomes_a_tiny_one():
    right = nearest_consistent(np.zeros(10))
    np.testing.assert_allclose(right, phi_from_com(1e-9, np.zeros(3), 1e-12 * np.eye(3)))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("length", [1e-3, 0.1, 5.0])
def test_a_projection_onto_the_cone_is_moreaus(seed, length):
    """The positive part and what was removed are both semi-definite, and orthogonal."""
    rng = np.random.default_rng(seed)
    phi = rng.normal(size=10) * np.repeat([1, length, length**2], [1, 3, 6])
    before, after = pseudo_inertia(phi), pseudo_inertia(_projected(phi))
    size = np.sqrt(abs(np.trace(before[:3, :3])) / abs(before[3, 3]))
    unit = np.diag([1, 1, 1, min(max(size, 0.01), 1.0)])
    before, after = unit @ before @ unit, unit @ after @ unit
    scale = np.abs(before).max()
    assert np.linalg.eigvalsh(after)[0] > -1e-12 * scale
    assert np.linalg.eigvalsh(after - before)[0] > -1e-12 * scale
    assert np.sum(after * (after - before)) == pytest.approx(0, abs=1e-12 * scale**2)
