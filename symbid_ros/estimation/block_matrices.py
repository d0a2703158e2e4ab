"""Matrices whose parameters fall into independent blocks, such as the priors of links.

A robot with many links has many parameters, of which the prior couples those of one link. Products
and decompositions by blocks take time in proportion to the number of links, instead of its cube.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from symbid_ros.arrays import FloatArray, IntArray

# Share of entries that are not zero, above which a product with a dense matrix is as fast.
FEW = 0.1


def independent_blocks(*matrices: FloatArray) -> list[IntArray]:
    """Return the smallest sets of indices between which all matrices (m, m) are zero."""
    pattern = csr_array(sum(one != 0 for one in matrices))
    count, labels = connected_components(pattern, directed=False)
    order = np.argsort(labels, kind="stable")
    ends = np.searchsorted(labels[order], np.arange(1, count))
    return np.split(order, ends)


def without_zeros(matrix: FloatArray) -> FloatArray | csr_array:
    """Return a matrix as a sparse one, if few of its entries are not zero."""
    if np.count_nonzero(matrix) > FEW * matrix.size:
        return matrix
    return csr_array(matrix)
