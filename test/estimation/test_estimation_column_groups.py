"""Moments of wide rows, against dense products of the rows themselves."""

import numpy as np
import pytest
from gaussian_logs import gaussian_log

from symbid_ros.estimation import column_groups, information
from symbid_ros.estimation.column_groups import ColumnGroups
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.prior import consistent_prior
from symbid_ros.estimation.row_layout import RowLayout


@pytest.fixture
def wide(monkeypatch):
    """Take the rows of every robot as wide, and a few rows at a time."""
    monkeypatch.setattr(information, "WIDE", 0)
    monkeypatch.setattr(column_groups, "NUMBERS_AT_ONCE", 1)
    monkeypatch.setattr(column_groups, "LEAST_ROWS", 7)


def dense(log):
    """[K y] (N, n, p + 1)."""
    rows = log.rows().mean
    return np.concatenate([rows.K, rows.y[..., None]], axis=2)


def symmetric(rng, size):
    root = rng.normal(size=(size, size))
    return root + root.T


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("count", [20, 400])
def test_moments_are_those_of_dense_rows(count, floating):
    """For few rows and for the triangle of many; a fixed base has parameters without any row."""
    terms = ("viscous", "armature")
    log = gaussian_log(4, links=6, count=count, floating=floating, terms=terms)
    rows, rng = dense(log), np.random.default_rng(0)
    found = Information.empty(log.layout).fold([log.rows().mean])
    some = log.layout.parameters[::2]
    kept = np.append(np.arange(0, len(log.layout.parameters), 2), len(log.layout.parameters))
    for information_, used in ((found, rows), (found.restricted(some), rows[..., kept])):
        n, q = used.shape[1:]
        precision, matrix, phi = symmetric(rng, n), symmetric(rng, q), rng.normal(size=q - 1)
        residual = used @ np.append(-phi, 1.0)
        for moment, expected in (
            (
                information_.whitened_moment(precision),
                np.einsum("tia,ij,tjb->ab", used, precision, used, optimize=True),
            ),
            (
                information_.quadratic_moment(matrix),
                np.einsum("tia,ab,tjb->ij", used, matrix, used, optimize=True),
            ),
            (information_.approximate_residual_moment(phi), residual.T @ residual),
        ):
            np.testing.assert_allclose(moment, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(3))
def test_later_coordinates_have_the_first_columns(seed):
    structure = np.random.default_rng(seed).random((5, 12)) < 0.4
    structure[:, 3] = False
    ends = np.cumsum(structure.sum(axis=1) + 1)
    flat = np.split(np.arange(ends[-1]), ends[:-1])
    groups = ColumnGroups(structure, flat)
    assert 3 not in groups.order
    assert set(groups.order) <= set(range(13))
    for first in range(5):
        later = np.append(np.flatnonzero(structure[first:].any(axis=0)), 12)
        assert set(groups.order[: len(later)]) == set(later)
    covered = np.concatenate([groups.order[one.place] for one in groups.groups])
    np.testing.assert_array_equal(covered, groups.order)
    for group in groups.groups:
        for column in groups.order[group.place]:
            if column < 12:
                np.testing.assert_array_equal(
                    np.flatnonzero(structure[:, column]), group.coordinates
                )


def test_an_estimate_from_wide_rows_needs_no_moments_of_all_pairs(request, monkeypatch):
    log = gaussian_log(2, links=5, count=200, terms=("viscous",))
    prior = consistent_prior(log.parameters)
    expected = posterior(log.observations(), prior, empirical=True)
    request.getfixturevalue("wide")
    monkeypatch.delattr(RowLayout, "moments_by_pair")
    found = posterior(log.observations(), prior, empirical=True)
    assert np.abs((found.mean - expected.mean) / expected.std).max() < 1e-7
    np.testing.assert_allclose(found.std, expected.std, rtol=1e-7)
