"""Rows with efforts as columns: any factors, checked against rows that are folded densely."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from symbid_ros.dynamics.regressor import Rows
from symbid_ros.estimation.effort_columns import EffortColumns
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.signals.weak_form import WindowedRows

COORDINATES, COUNT = ("a", "b", "c"), 90
STRUCTURE = np.array([[1, 1, 1, 0], [0, 1, 1, 1], [1, 0, 0, 1]], bool)
# Readings of b and c have unknown factors; those of a are in Nm.
GAINED = np.array([1, 2])


def layout():
    factors = np.zeros((3, 2), bool)
    factors[GAINED, [0, 1]] = True
    plain = RowLayout(COORDINATES, ("p0", "p1", "p2", "p3"), STRUCTURE)
    return plain, plain.extended(("k_b", "k_c"), factors)


def drawn(rng):
    """Return K (N, n, p), readings u (N, 2) and other forces w (N, n)."""
    K = rng.normal(size=(COUNT, 3, 4)) * STRUCTURE
    return K, rng.normal(size=(COUNT, 2)), rng.normal(size=(COUNT, 3))


def with_readings(K, u):
    columns = np.zeros((*K.shape[:2], 2))
    columns[:, GAINED, [0, 1]] = -u
    return np.concatenate([K, columns], axis=2)


def folded(of, mean, noise, *, candidates):
    """Return observations of rows (K, y) and of their noise, with slipping ones among them."""
    stamp = np.arange(COUNT) * 137_000_000
    valid = np.ones((COUNT, 3), bool)
    slips = valid.copy()
    slips[::3, 1] = False
    rows = WindowedRows(Rows(*mean), Rows(*noise), valid, stamp, slips if candidates else None)
    return Observations.empty(of, 0.1, candidates=candidates).fold([rows])


def same(one, other, scale):
    """Compare all that solutions use of two observations, up to rounding of numbers of a size."""
    precision = np.diag([1.0, 2.0, 3.0]) + 0.1
    for rows, wanted in ((one.rows, other.rows), (one.noise, other.noise)):
        assert rows.layout.parameters == wanted.layout.parameters
        np.testing.assert_allclose(
            rows.whitened_moment(precision),
            wanted.whitened_moment(precision),
            rtol=1e-9,
            atol=1e-9 * scale,
        )
    np.testing.assert_array_equal(one.counts, other.counts)


def same_groups(one, other):
    phi = np.linspace(-1, 1, len(one.layout.parameters))
    np.testing.assert_allclose(one.correlation(phi), other.correlation(phi), rtol=1e-7)


factors_of = st.lists(st.floats(0.1, 10.0), min_size=2, max_size=2).map(np.array)
signs_of = st.lists(st.sampled_from([-1.0, 1.0]), min_size=2, max_size=2).map(np.array)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 1000), size=factors_of, sign=signs_of, candidates=st.booleans())
def test_rows_of_any_factors_are_those_of_converted_readings(seed, size, sign, candidates) -> None:
    rng, factors = np.random.default_rng(seed), size * sign
    plain, extended = layout()
    parts = [drawn(rng), drawn(rng)]
    raw = folded(extended, *[(with_readings(K, u), w) for K, u, w in parts], candidates=candidates)
    found = EffortColumns(extended, 2).converted(raw, factors)
    converted = []
    for K, u, w in parts:
        y = w.copy()
        y[:, GAINED] += factors * u
        converted.append((K, y))
    wanted = folded(plain, *converted, candidates=candidates)
    same(found, wanted, scale=1e4)
    same_groups(found, wanted)
    if candidates:
        same(found.slipping, wanted.slipping, scale=1e4)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 1000), size=factors_of, sign=signs_of, candidates=st.booleans())
def test_linearised_rows_have_the_predicted_effort_as_column(seed, size, sign, candidates) -> None:
    rng, factors = np.random.default_rng(seed), size * sign
    _, extended = layout()
    phi = rng.normal(size=4)
    parts = [drawn(rng), drawn(rng)]
    raw = folded(extended, *[(with_readings(K, u), w) for K, u, w in parts], candidates=candidates)
    found = EffortColumns(extended, 2).linearised(raw, phi, factors)
    linear = []
    for K, u, w in parts:
        predicted = (K @ phi - w)[:, GAINED]
        y = w.copy()
        y[:, GAINED] += factors * u - predicted
        linear.append((with_readings(K, predicted / factors), y))
    wanted = folded(extended, *linear, candidates=candidates)
    same(found, wanted, scale=1e6)
    if candidates:  # otherwise the factors' scores are not compared
        same_groups(found, wanted)


def test_exact_readings_leave_no_residual_at_the_linearisation_point() -> None:
    rng = np.random.default_rng(3)
    _, extended = layout()
    K, _, w = drawn(rng)
    phi, factors = rng.normal(size=4), np.array([3.0, -0.2])
    w[:, 0] = K[:, 0] @ phi
    u = (K @ phi - w)[:, GAINED] / factors
    nothing = with_readings(np.zeros_like(K), np.zeros_like(u)), np.zeros_like(w)
    raw = folded(extended, (with_readings(K, u), w), nothing, candidates=False)
    found = EffortColumns(extended, 2).linearised(raw, phi, factors)
    residual = found.rows.residual_moment(np.append(phi, factors))
    assert np.abs(residual).max() < 1e-18 * found.rows.target_squares.max() + 1e-18


@pytest.mark.parametrize("candidates", [False, True])
def test_efforts_that_are_all_forces_need_no_columns_before(candidates) -> None:
    rng = np.random.default_rng(6)
    structure = np.eye(3, dtype=bool)
    plain, _ = layout()
    extended = plain.extended(("k_a", "k_b", "k_c"), structure)
    phi = rng.normal(size=4)
    parts = [(K, rng.normal(size=(COUNT, 3))) for K in (drawn(rng)[0], drawn(rng)[0])]
    rows = folded(plain, *parts, candidates=candidates)
    found = EffortColumns(extended, 3).beside(rows, phi)
    linear = []
    for K, u in parts:
        predicted = K @ phi
        columns = -predicted[..., None] * structure
        linear.append((np.concatenate([K, columns], axis=2), u - predicted))
    wanted = folded(extended, *linear, candidates=candidates)
    same(found, wanted, scale=1e4)
    if candidates:
        same(found.slipping, wanted.slipping, scale=1e4)


def test_restricted_columns_keep_all_factors() -> None:
    rng = np.random.default_rng(4)
    plain, extended = layout()
    parts = [drawn(rng), drawn(rng)]
    raw = folded(extended, *[(with_readings(K, u), w) for K, u, w in parts], candidates=True)
    columns, kept = EffortColumns(extended, 2), ("p0", "p2")
    some = columns.restricted(kept)
    assert some.parameters == kept
    assert columns.parameters == plain.parameters
    factors = np.array([2.0, -3.0])
    one = some.converted(raw.restricted(some.layout.parameters), factors)
    other = columns.converted(raw, factors).restricted(kept)
    same(replace(one, slipping=None), other, scale=1e4)


@pytest.mark.parametrize("count", [1, 5])
def test_few_rows_are_enough(count) -> None:
    rng = np.random.default_rng(5)
    _, extended = layout()
    K, u, w = (each[:count] for each in drawn(rng))
    rows = WindowedRows(
        Rows(with_readings(K, u), w),
        None,
        np.ones((count, 3), bool),
        np.arange(count) * 1_000_000,
        None,
    )
    raw = Observations.empty(extended, 0.1).fold([rows])
    found = EffortColumns(extended, 2).converted(raw, np.array([2.0, 3.0]))
    y = w.copy()
    y[:, GAINED] += u * [2.0, 3.0]
    phi = np.arange(4.0)
    e = y - K @ phi
    np.testing.assert_allclose(found.rows.residual_moment(phi), e.T @ e, atol=1e-10)
