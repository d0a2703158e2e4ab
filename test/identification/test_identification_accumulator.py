"""Discounted rows equal dense weighted sums, also if blocks are lost in between."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_segment, noisy
from gaussian_logs import gaussian_log
from random_robots import random_robot

from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.rows.accumulator import (
    Accumulator,
    BlockAccumulator,
    BlockRows,
    TimeSpan,
)
from symbid_ros.identification.rows.dataset import observe
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.weak_form import WINDOWS, equation_rows, windowed_rows

SECOND = 1_000_000_000
BLOCK = 4 * SECOND
SPAN = 3.0
# The rows of each time span; the second block, from 4 s to 8 s, is lost.
FIRST, THIRD, PIECE = slice(0, 40), slice(40, 80), slice(80, 120)


@pytest.fixture(scope="module")
def log():
    return gaussian_log(3, count=120)


@pytest.fixture(scope="module")
def empty(log):
    return replace(log[:0].observations(), window=0.081)


def block_rows(log, start, stop, part):
    return BlockRows(start, stop, {0.081: [log[part].rows()]})


def dense(log, *weighted):
    """Return Σ weight [K y]ᵀ[K y] over parts of a log, all coordinates side by side."""
    count = len(log.parameters) + 1
    gram = np.zeros((log.K.shape[1], count, count))
    for weight, part in weighted:
        rows = np.concatenate([log.K[part], log.y[part][:, :, None]], axis=2)
        gram += weight * np.einsum("nip,niq->ipq", rows, rows)
    return gram


def assert_holds(observations, log, *weighted):
    """Compare the information of each coordinate with weighted sums of rows."""
    expected = dense(log, *weighted)
    for index, columns in enumerate(log.layout.columns):
        factor = observations.rows.coordinate_factors[index]
        kept = np.append(columns, len(log.parameters))
        wanted = expected[index][np.ix_(kept, kept)]
        np.testing.assert_allclose(factor.T @ factor, wanted, atol=1e-9 * np.abs(wanted).max())
    samples = sum(weight * len(log[part]) for weight, part in weighted)
    assert observations.rows.samples == pytest.approx(samples)


def test_rows_are_discounted_while_a_block_is_lost(log, empty) -> None:
    blocks = BlockAccumulator((empty,), SPAN).with_block(block_rows(log, 0, BLOCK, FIRST))
    assert_holds(blocks.observations[0], log, (1.0, FIRST))
    later = blocks.with_block(block_rows(log, 2 * BLOCK, 3 * BLOCK, THIRD))
    assert_holds(later.observations[0], log, (np.exp(-8 / SPAN), FIRST), (1.0, THIRD))
    # The initial information is discounted from the first block on.
    assert later.observations[0].kept == pytest.approx(np.exp(-12 / SPAN))
    assert (later.stop, later.count) == (3 * BLOCK, 2)


def test_rows_are_discounted_while_no_piece_arrives(log, empty) -> None:
    blocks = BlockAccumulator((empty,), SPAN).with_block(block_rows(log, 0, BLOCK, FIRST))
    accumulator = Accumulator(blocks, 0)
    accumulator.add(block_rows(log, 2 * BLOCK, 2 * BLOCK + SECOND, THIRD))
    accumulator.add(block_rows(log, 3 * BLOCK, 3 * BLOCK + SECOND, PIECE))
    ages = np.exp(-np.array([9.0, 4.0, 0.0]) / SPAN)
    assert_holds(accumulator.current, log, (ages[0], FIRST), (ages[1], THIRD), (ages[2], PIECE))
    # The block that replaces the first piece leaves the second unchanged.
    accumulator.update_blocks(blocks.with_block(block_rows(log, 2 * BLOCK, 3 * BLOCK, THIRD)))
    ages = np.exp(-np.array([9.0, 1.0, 0.0]) / SPAN)
    assert_holds(accumulator.current, log, (ages[0], FIRST), (ages[1], THIRD), (ages[2], PIECE))


def test_a_clock_that_jumps_back_does_not_discount_rows(log, empty) -> None:
    first = BlockAccumulator((empty,), SPAN).with_block(
        block_rows(log, 25 * BLOCK, 26 * BLOCK, FIRST)
    )
    again = first.with_new_clock().with_block(block_rows(log, BLOCK, 2 * BLOCK, THIRD))
    assert_holds(again.observations[0], log, (np.exp(-4 / SPAN), FIRST), (1.0, THIRD))


def test_an_infinite_time_constant_keeps_all_weights(log, empty) -> None:
    blocks = BlockAccumulator((empty,), np.inf).with_block(block_rows(log, 0, BLOCK, FIRST))
    later = blocks.with_block(block_rows(log, 2 * BLOCK, 3 * BLOCK, THIRD))
    assert_holds(later.observations[0], log, (1.0, FIRST), (1.0, THIRD))
    assert later.observations[0].kept == 1.0


def noise_moment(observations):
    """Return the moments of the replayed noise for each window length."""
    return [one.noise.factor.T @ one.noise.factor for one in observations]


def test_live_blocks_replay_noise_where_an_offline_run_does() -> None:
    parameters = ParameterSet(random_robot(1, links=3), ("viscous",))
    exact = analytic_segment(parameters, 100.0, 3, rate=150.0, start=1.5)
    segment = noisy(exact, np.random.default_rng(0), position=1e-4, rate=5e-3)
    build, layout = equation_rows(parameters), RowLayout.of(parameters)
    offline = observe([segment], build, layout, WINDOWS)
    empty = tuple(Observations.empty(layout, window) for window in WINDOWS)

    def live(time_constant):
        """Yield the information after each block."""
        blocks = BlockAccumulator(empty, time_constant)
        for start in range(0, 102 * SECOND, BLOCK):
            parts = tuple(cut_to([segment], start, start + BLOCK))
            span = TimeSpan(start, start + BLOCK, parts)
            blocks = blocks.with_block(blocks.rows(span, build, WINDOWS))
            yield blocks.observations

    found = list(live(np.inf))[-1]
    for one, two in zip(noise_moment(found), noise_moment(offline), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-10 * np.abs(two).max())
    # Fewer blocks are replayed, each with the weight of those that it represents.
    every = [Observations.empty(layout, window) for window in WINDOWS]
    for rows in windowed_rows(segment, build, WINDOWS):
        every = [one.fold([part]) for one, part in zip(every, rows, strict=True)]
    for one, two in zip(offline, every, strict=True):
        assert one.noise.samples < 0.75 * two.noise.samples
        shorter, longer = np.trace(noise_moment([one])[0]), np.trace(noise_moment([two])[0])
        assert shorter == pytest.approx(longer, rel=0.15)
        np.testing.assert_allclose(
            one.rows.factor.T @ one.rows.factor,
            two.rows.factor.T @ two.rows.factor,
            atol=1e-10 * np.abs(two.rows.factor.T @ two.rows.factor).max(),
        )
    # What is forgotten must be represented by newer rows, so each block is replayed.
    samples = [one[0].noise.samples for one in live(1000.0)]
    assert np.all(np.diff(samples) > 0)
