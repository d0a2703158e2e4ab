"""Conversions of rotations against SciPy's."""

import numpy as np
import pytest
from random_robots import random_rotation
from scipy.spatial.transform import Rotation

from symbid_ros.model.rotation import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    rotation_from_xyzw,
    rpy_from_rotation,
)

rotations = [random_rotation(np.random.default_rng(seed)) for seed in range(8)]
# Turns by nearly 180° about each axis: another component of the quaternion is the largest.
turns = [Rotation.from_rotvec(3.1 * axis).as_matrix() for axis in np.eye(3)]
turns += [Rotation.from_rotvec(-3.1 * axis).as_matrix() for axis in np.eye(3)]


@pytest.mark.parametrize("rotation", [np.eye(3), *turns, *rotations])
def test_conversions_are_scipys(rotation):
    truth = Rotation.from_matrix(rotation)
    w, x, y, z = quaternion_from_rotation(rotation)
    np.testing.assert_allclose([x, y, z, w], truth.as_quat(canonical=True), atol=1e-14)
    rpy = rpy_from_rotation(rotation)
    np.testing.assert_allclose(rpy, truth.as_euler("xyz"), atol=1e-12)
    np.testing.assert_allclose(rotation_from_rpy(rpy), rotation, atol=1e-13)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_quaternions_of_any_length_are_normalised(shape):
    xyzw = 3 * np.random.default_rng(1).normal(size=(*shape, 4))
    truth = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix().reshape(*shape, 3, 3)
    np.testing.assert_allclose(rotation_from_xyzw(xyzw), truth, atol=1e-14)
    wxyz = xyzw[..., [3, 0, 1, 2]]
    np.testing.assert_allclose(rotation_from_quaternion(wxyz), truth, atol=1e-14)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_roll_is_zero_at_gimbal_lock(pitch):
    roll, found, yaw = rpy_from_rotation(rotation_from_rpy(np.array([0.25, pitch, 0.75])))
    assert (roll, found) == (0.0, pytest.approx(pitch))
    assert yaw == pytest.approx(0.75 - np.sign(pitch) * 0.25)
