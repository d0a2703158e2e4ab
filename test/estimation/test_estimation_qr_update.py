"""The QR update against the sum of moments."""

import numpy as np
import pytest

from symbid_ros.estimation.qr_update import fold_rows


@pytest.mark.parametrize("width", [1, 5, 70])
@pytest.mark.parametrize("count", [0, 1, 40, 200])
def test_the_moment_grows_by_that_of_the_rows(width, count):
    rng = np.random.default_rng(width + count)
    factor = np.asfortranarray(np.triu(rng.standard_normal((width, width))))
    rows = np.asfortranarray(rng.standard_normal((count, width)))
    expected = factor.T @ factor + rows.T @ rows
    fold_rows(factor, rows)
    np.testing.assert_allclose(factor.T @ factor, expected, atol=1e-12 * expected.max())
    assert not np.tril(factor, -1).any()


def test_arrays_that_lapack_would_misread_are_refused():
    square = np.eye(3)[:, ::-1].copy()
    with pytest.raises(ValueError, match="Fortran"):
        fold_rows(np.asfortranarray(square), np.ones((2, 3)))
    with pytest.raises(ValueError, match="Fortran"):
        fold_rows(np.asfortranarray(square), np.ones((2, 3), dtype=np.float32, order="F"))
