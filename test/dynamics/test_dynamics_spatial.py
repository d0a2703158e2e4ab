"""Vector algebra of blocks of samples, against NumPy's one vector at a time."""

import numpy as np
import pytest
from random_robots import random_rotation

from symbid_ros.dynamics.kinematics import (
    CACHE_BLOCK,
    cache_blocks,
    component_first,
    cross,
    matvec,
    rotate,
    rotate_inverse,
    sample_first,
    skew,
)


@pytest.mark.parametrize("links", [1, 3, 11, 40, 7 * CACHE_BLOCK])
@pytest.mark.parametrize("count", [0, 1, 290, 291, 3200, 6401])
def test_cache_blocks_cover_the_samples_and_are_as_long_as_the_cache_allows(count, links):
    blocks = list(cache_blocks(count, links))
    covered = [index for block in blocks for index in range(block.start, block.stop)]
    assert covered == list(range(count))
    lengths = [block.stop - block.start for block in blocks]
    assert all(length * links <= CACHE_BLOCK or length == 1 for length in lengths)
    assert all((length + 1) * links > CACHE_BLOCK for length in lengths[:-1])
    assert 0 not in lengths


def test_cross_and_skew_are_numpys_cross_product():
    a, b = np.random.default_rng(0).normal(size=(2, 3, 4, 5))
    expected = np.cross(a, b, axis=0)
    np.testing.assert_allclose(cross(a, b), expected, rtol=1e-14)
    np.testing.assert_allclose(cross(a, b[:, :1]), np.cross(a, b[:, :1], axis=0), rtol=1e-14)
    np.testing.assert_allclose(matvec(skew(a), b), expected, rtol=1e-14)
    np.testing.assert_array_equal(skew(a), -skew(a).swapaxes(0, 1))


def test_component_first_and_sample_first_are_inverse():
    x = np.random.default_rng(1).normal(size=(7, 4, 3, 2))
    moved = component_first(x)
    np.testing.assert_array_equal(moved, np.moveaxis(x, (0, 1), (-1, -2)))
    assert moved.flags.c_contiguous
    np.testing.assert_array_equal(sample_first(moved), x)


def test_rotations_apply_to_each_sample():
    rng = np.random.default_rng(2)
    rotations = np.array([random_rotation(rng) for _ in range(6)])
    vectors = rng.normal(size=(6, 3))
    expected = np.array([R @ x for R, x in zip(rotations, vectors, strict=True)])
    np.testing.assert_allclose(rotate(rotations, vectors), expected, rtol=1e-14)
    np.testing.assert_allclose(rotate_inverse(rotations, expected), vectors, rtol=1e-13)
    one = np.array([rotations[0] @ x for x in vectors])
    np.testing.assert_allclose(rotate(rotations[0], vectors), one, rtol=1e-14)
