"""Boxes and ellipsoids against the bodies whose inertia they show."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.model.inertia import com_from_phi, phi_from_com
from symbid_ros.report.inertia_shapes import com_ellipsoid, inertia_box, principal_moments

SIZE = np.array([0.1, 0.25, 0.6])


def box_phi(mass, com, rotation):
    """Parameters of a homogeneous box, by the textbook's m (b² + c²)/12."""
    squares = SIZE**2
    moments = mass * (squares.sum() - squares) / 12
    return phi_from_com(mass, com, rotation @ np.diag(moments) @ rotation.T)


def test_a_box_is_found_again_with_its_pose() -> None:
    rotation = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    com = np.array([0.3, -0.2, 0.1])
    box = inertia_box(box_phi(3.5, com, rotation))
    assert box is not None
    assert box.mass == 3.5
    np.testing.assert_allclose(box.com, com, atol=1e-12)
    np.testing.assert_allclose(box.size, SIZE, rtol=1e-9)
    assert np.linalg.det(box.rotation) == pytest.approx(1.0)
    # Equal up to the signs of the axes.
    np.testing.assert_allclose(np.abs(box.rotation.T @ rotation), np.eye(3), atol=1e-9)


def test_the_box_of_any_possible_body_has_its_inertia() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        points, masses = rng.normal(size=(6, 3)), rng.uniform(0.1, 1, 6)
        com = masses @ points / masses.sum()
        arm = points - com
        inertia = sum(
            m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, arm, strict=True)
        )
        phi = phi_from_com(masses.sum(), com, inertia)
        box = inertia_box(phi)
        squares = box.size**2
        moments = box.mass * (squares.sum() - squares) / 12
        np.testing.assert_allclose(
            box.rotation @ np.diag(moments) @ box.rotation.T, inertia, atol=1e-9
        )
        np.testing.assert_allclose(principal_moments(phi), np.sort(moments), atol=1e-9)


def test_impossible_bodies_have_no_box_and_flat_ones_a_flat_one() -> None:
    assert inertia_box(phi_from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.1]))) is None
    assert inertia_box(phi_from_com(-1.0, np.zeros(3), np.eye(3))) is None
    assert inertia_box(np.zeros(10)) is None
    lamina = inertia_box(phi_from_com(1.0, np.ones(3), np.diag([1.0, 1.0, 2.0])))
    assert lamina is not None
    np.testing.assert_allclose(np.sort(lamina.size), [0, np.sqrt(12), np.sqrt(12)], atol=1e-6)


def test_the_ellipsoid_is_that_of_drawn_parameters() -> None:
    phi = box_phi(2.0, np.array([0.1, 0.2, -0.1]), np.eye(3))
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.normal(size=(10, 10))
    drawn = phi + rng.normal(size=(200_000, 10)) @ root.T
    spread = np.cov((drawn[:, 1:4] / drawn[:, :1]).T)
    ellipsoid = com_ellipsoid(phi, root @ root.T)
    found = ellipsoid.rotation @ np.diag(ellipsoid.std**2) @ ellipsoid.rotation.T
    np.testing.assert_allclose(found, spread, atol=0.02 * np.trace(spread))
    assert com_from_phi(phi)[0] == 2.0
