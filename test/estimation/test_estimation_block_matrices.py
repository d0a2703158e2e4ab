"""Products and decompositions by blocks are those of the whole matrices."""

import numpy as np
from scipy.linalg import block_diag

from symbid_ros.estimation.block_matrices import independent_blocks, without_zeros


def test_blocks_are_found_in_any_order():
    rng = np.random.default_rng(0)
    matrix = block_diag(*(np.tril(rng.normal(size=(count, count))) for count in (3, 1, 4, 1)))
    order = rng.permutation(len(matrix))
    shuffled = matrix[np.ix_(order, order)]
    found = {frozenset(order[block].tolist()) for block in independent_blocks(shuffled)}
    assert found == {frozenset({0, 1, 2}), frozenset({3}), frozenset({4, 5, 6, 7}), frozenset({8})}


def test_one_matrix_may_couple_what_another_does_not():
    first, second = np.eye(4), np.eye(4)
    first[0, 1], second[3, 1] = 1.0, 1.0
    sizes = sorted(len(block) for block in independent_blocks(first, second))
    assert sizes == [1, 3]


def test_products_with_few_entries_are_those_with_all():
    rng = np.random.default_rng(1)
    sparse = block_diag(*(rng.normal(size=(10, 10)) for _ in range(12)))
    dense = rng.normal(size=(120, 120))
    for matrix in (sparse, dense):
        product = without_zeros(matrix).T @ dense @ without_zeros(matrix)
        np.testing.assert_allclose(product, matrix.T @ dense @ matrix, rtol=0, atol=1e-11)
