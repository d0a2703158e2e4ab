"""A few rows kept beside a factor give the moments of all rows folded together."""

import numpy as np
import pytest
from gaussian_logs import gaussian_log

from symbid_ros.errors import DataError
from symbid_ros.estimation.unfolded_rows import UnfoldedRows


@pytest.fixture(scope="module")
def log():
    return gaussian_log(3, count=120)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_moments_are_those_of_folded_rows(log, share) -> None:
    first, second, third = (log[part] for part in (slice(80), slice(80, 100), slice(100, 120)))
    folded = first.observations().rows
    flat = [folded.layout.flatten([part.rows().mean]) for part in (second, third)]
    found = UnfoldedRows.added(UnfoldedRows.added(folded, flat[0]).discounted(share), flat[1])
    assert isinstance(found, UnfoldedRows)
    expected = folded.fold_flat(flat[0]).discounted(share).fold_flat(flat[1])
    rng = np.random.default_rng(0)
    n, p = log.y.shape[1], len(log.parameters)
    phi, root, matrix = rng.normal(size=p), rng.normal(size=(n, n)), rng.normal(size=(p + 1, p + 1))

    def close(one, two) -> None:
        np.testing.assert_allclose(one, two, atol=1e-9 * np.abs(two).max())

    close(found.whitened_moment(root @ root.T), expected.whitened_moment(root @ root.T))
    close(found.residual_moment(phi), expected.residual_moment(phi))
    close(found.quadratic_moment(matrix + matrix.T), expected.quadratic_moment(matrix + matrix.T))
    close(found.target_squares, expected.target_squares)
    some = log.parameters.names[:-3]
    close(
        found.restricted(some).whitened_moment(root @ root.T),
        expected.restricted(some).whitened_moment(root @ root.T),
    )
    coordinate, columns = next(
        (index, own) for index, own in enumerate(folded.layout.columns) if len(own)
    )
    close(
        found.column_squares(coordinate, int(columns[0])),
        expected.column_squares(coordinate, int(columns[0])),
    )
    close(found.factor.T @ found.factor, expected.factor.T @ expected.factor)
    assert found.samples == pytest.approx(expected.samples)


def test_many_rows_are_folded(log) -> None:
    folded = log[:20].observations().rows
    flat = folded.layout.flatten([log.rows().mean])
    found = folded
    for _ in range(6):
        found = UnfoldedRows.added(found, flat)
    assert found.samples == 20 + 6 * len(flat)
    assert found.fold_flat(flat).samples == found.samples + len(flat)


def test_a_row_that_is_not_finite_is_refused(log) -> None:
    folded = log[:20].observations().rows
    flat = folded.layout.flatten([log[:5].rows().mean])
    flat[2, 0] = np.nan
    with pytest.raises(DataError, match="not finite"):
        UnfoldedRows.added(folded, flat)
