"""Windowed rows against explicit sums, for exact motions of random trees."""

import itertools
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from analytic_log import analytic_segment, noisy
from expected_errors import raises_code
from random_robots import random_robot, with_drives
from scipy.sparse import csr_array

from symbid_ros.dynamics.friction import is_slipping
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sampled_rows import SampledRows, least_slipping, valid_coordinates
from symbid_ros.signals.sensor_samples import smoothed
from symbid_ros.signals.weak_form import (
    ALL_WINDOWS,
    BLOCK,
    INFLATION,
    PREFILTER,
    REPLAYED_BLOCKS,
    SETTLING,
    WINDOWS,
    block_length,
    check_windows,
    equation_rows,
    prefilter,
    represented_blocks,
    suitable_windows,
    windowed_rows,
)
from symbid_ros.signals.window_averages import average

NOISE = {"position": 1e-5, "rate": 5e-3, "acceleration": 0.03, "effort": 0.1, "wrench": 1.0}


def trees(*seeds, **options):
    return [
        pytest.param(ParameterSet(random_robot(seed, links=4 + seed, **options)), id=f"tree {seed}")
        for seed in seeds
    ]


def rows_of(segment, parameters, windows=WINDOWS, **options):
    """Return the rows of a whole segment for each window: mean, noise, valid."""
    blocks = list(windowed_rows(segment, equation_rows(parameters), windows, **options))
    return [
        (
            Rows(*(np.concatenate([getattr(b.mean, x) for b in parts]) for x in ("K", "y"))),
            Rows(*(np.concatenate([getattr(b.noise, x) for b in parts]) for x in ("K", "y"))),
            np.concatenate([b.valid for b in parts]),
        )
        for parts in zip(*blocks, strict=True)
    ]


def assert_closes(parameters, mean, tolerance):
    error = mean.K @ parameters.values - mean.y
    assert np.all(np.linalg.norm(error, axis=0) <= tolerance * np.linalg.norm(mean.y))


@pytest.mark.parametrize("parameters", [*trees(0, 3, 5), *trees(2, floating=False)])
@pytest.mark.parametrize("window", [0.081, 0.32])
def test_averages_equal_the_weak_form_without_accelerations(parameters, window):
    rng = np.random.default_rng(1)
    segment = noisy(analytic_segment(parameters, 0.1 + 2.6 * window, 1), rng, **NOISE)
    ((mean, _, _),) = rows_of(segment, parameters, [window], full_rate=True)
    edge = int(SETTLING * segment.rate / PREFILTER)
    readings = smoothed(segment, LowPass(PREFILTER, passes=1), edge)
    strict = strict_weak_form(readings, parameters, window)
    assert len(strict) == len(mean.K) == 4
    np.testing.assert_allclose(mean.K, strict, atol=1e-10 * np.abs(strict).max())


def strict_weak_form(readings, parameters, window):
    """Return Σ w K (W, n, p) from positions and rates alone, Σ w A q̈ = -Σ Δ(w A)/Δt q̇."""

    def K(acceleration, alpha):
        changed = replace(readings, acceleration=acceleration, angular_acceleration=alpha)
        return np.concatenate([part.rows.K for part in equation_rows(parameters)(changed)])

    still = np.zeros_like(readings.acceleration)
    rest = np.zeros_like(readings.angular_acceleration)
    uniform = K(still, rest)
    rates, coefficients = [], []
    for joint in range(still.shape[1]):
        unit = still.copy()
        unit[:, joint] = 1.0
        rates.append(readings.velocity[:, joint])
        coefficients.append(K(unit, rest) - uniform)
    for imu, axis in np.ndindex(rest.shape[1:]):
        unit = rest.copy()
        unit[:, imu, axis] = 1.0
        rates.append(readings.angular_velocity[:, imu, axis])
        coefficients.append(K(still, unit) - uniform)
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    averages = []
    for centre in np.arange(window / 2, time[-1] - window / 2 + 1e-9, window / 2):
        apart = np.abs(time - centre) / window
        w = np.where(apart < 0.5, np.cos(np.pi * apart) ** 2, 0.0)[:, None, None]
        w /= w.sum()
        average = np.sum(w * uniform, axis=0)
        for rate, A in zip(rates, coefficients, strict=True):
            weighted = np.pad(w * A, [(1, 1), (0, 0), (0, 0)])
            slope = (weighted[2:] - weighted[:-2]) / (2 * time[1])
            average -= np.sum(slope * rate[:, None, None], axis=0)
        averages.append(average)
    return np.array(averages)


@pytest.mark.parametrize(
    "parameters", [*trees(0, 1, 4, 6), *trees(2, 5, floating=False, wrench_frames=1)]
)
def test_rows_of_exact_motion_close_the_equation_of_motion(parameters):
    for mean, _, valid in rows_of(analytic_segment(parameters, 3.0, 7), parameters):
        assert valid.all()
        # The remaining error is the central difference of a 1.5 Hz sine sampled at 1 kHz.
        assert_closes(parameters, mean, 1e-4)


def test_several_imus_give_the_same_base_motion():
    parameters = ParameterSet(random_robot(8, links=6, wrench_frames=1))
    frames = ("imu_link", "link_5", "link_0")
    segment = analytic_segment(parameters, 1.5, 3, imu_frames=frames)
    for mean, _, _ in rows_of(segment, parameters):
        assert_closes(parameters, mean, 1e-4)


@pytest.mark.parametrize(
    ("rate", "tolerance"), [(200.0, 3e-3), (1e9 / 3e6, 2e-3), (700.0, 1e-3), (2500.0, 1e-4)]
)
def test_rows_close_at_any_sampling_rate(rate, tolerance):
    parameters = ParameterSet(random_robot(3, links=4))
    segment = analytic_segment(parameters, 2.4, 5, rate=rate)
    settled = 2 * SETTLING / min(PREFILTER, 0.1 * rate)
    for window, (mean, _, _) in zip(WINDOWS, rows_of(segment, parameters), strict=True):
        assert_closes(parameters, mean, tolerance)
        expected = 2 * (2.4 - settled - window) / window
        assert expected - 2 < len(mean.y) < expected + 2


@pytest.mark.parametrize("rate", [1000.0, 400.0])
def test_a_log_cut_at_a_block_boundary_has_the_same_rows(rate):
    parameters = ParameterSet(random_robot(1, links=4))
    segment = noisy(
        analytic_segment(parameters, 6.5, 2, rate=rate, start=3.1),
        np.random.default_rng(0),
        **NOISE,
    )
    cuts = np.flatnonzero(np.diff(segment.stamp // BLOCK)) + 1
    assert len(cuts) == 2
    edges = [0, *cuts.tolist(), len(segment)]
    pieces = [rows_of(segment.cut(a, b), parameters) for a, b in pairwise(edges)]
    for index, (mean, noise, valid) in enumerate(rows_of(segment, parameters)):
        for whole, name in ((mean, 0), (noise, 1)):
            for field in ("K", "y"):
                parts = [getattr(piece[index][name], field) for piece in pieces]
                np.testing.assert_array_equal(np.concatenate(parts), getattr(whole, field))
        np.testing.assert_array_equal(np.concatenate([p[index][2] for p in pieces]), valid)


@pytest.mark.parametrize(("rate", "least"), [(1000.0, 4), (2000.0, 8), (500.0, 3)])
@pytest.mark.parametrize("terms", [(), ("viscous", "coulomb")])
def test_rows_at_a_lower_rate_differ_by_little_of_their_noise(rate, least, terms):
    parameters = ParameterSet(random_robot(3, links=5, wrench_frames=1), terms)
    exact = analytic_segment(parameters, 4.0, 6, rate=rate)
    segment = noisy(exact, np.random.default_rng(2), **NOISE)
    built = {"fewer": 0, "all": 0}

    def counted(name):
        def build(readings):
            for part in equation_rows(parameters)(readings):
                built[name] += len(part.stamp)
                yield part

        return build

    some = list(windowed_rows(segment, counted("fewer"), WINDOWS))
    every = list(windowed_rows(segment, counted("all"), WINDOWS, full_rate=True))
    assert built["all"] > (least - 0.1) * built["fewer"]
    clean = list(windowed_rows(exact, equation_rows(parameters), WINDOWS, full_rate=True))
    for few, full, true in zip(some[0], every[0], clean[0], strict=True):
        np.testing.assert_array_equal(few.stamp, full.stamp)
        # Whether a joint slips for long enough is decided by fewer samples.
        assert np.mean(few.valid != full.valid) < 0.01
        used = few.valid & full.valid & true.valid
        for matrix in (
            lambda rows, used=used: rows.mean.K[used],
            lambda rows, used=used: rows.mean.y[used][:, None],
        ):
            change = np.std(matrix(few) - matrix(full), axis=0)
            noise = np.std(matrix(full) - matrix(true), axis=0)
            signal = np.std(matrix(true), axis=0)
            assert np.all(change <= 0.02 * noise + 1.5e-3 * signal)


def averaging(segment, window):
    """Return the weight (W, N) of each instant in each row: rows that are unit impulses."""
    stamps = segment.stamp

    def build(readings):
        y = (readings.stamp[:, None] == stamps).astype(float)
        yield SampledRows(
            readings.stamp, Rows(np.zeros((*y.shape, 1)), y), np.ones(y.shape, dtype=bool)
        )

    ((rows,),) = windowed_rows(segment, build, [window])
    return rows.mean.y


@pytest.mark.parametrize("window", [0.081, 0.161, 0.32])
def test_overlapping_windows_inflate_the_information_by_a_third(window):
    parameters = ParameterSet(random_robot(2, links=2, floating=False))
    segment = analytic_segment(parameters, 2.0, 0, rate=500.0)
    weights = averaging(segment, window)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    # The covariance of the averages of white noise.
    covariance = weights @ weights.T
    middle = len(covariance) // 2
    correlation = covariance[middle] / covariance[middle, middle]
    assert correlation[middle - 1] == pytest.approx(1 / 6, rel=0.05)
    assert correlation.sum() == pytest.approx(INFLATION, rel=0.02)
    assert np.abs(np.delete(correlation, [middle - 1, middle, middle + 1])).max() == 0


@pytest.mark.parametrize("terms", [("viscous", "coulomb"), ("viscous", "armature"), ()])
@pytest.mark.parametrize("stated", [True, False])
def test_rows_of_sticking_joints_with_coulomb_friction_are_left_out(terms, stated):
    size = {"friction_loss": 2.0 * stated}
    robot = with_drives(random_robot(4, links=4), np.random.default_rng(2), **size)
    parameters = ParameterSet(robot, terms)
    segment = analytic_segment(parameters, 4.0, 8)
    windows = (0.081,)
    ((mean, noise, valid),) = rows_of(segment, parameters, windows)
    assert valid[:, :6].all()
    assert_closes(parameters, mean, 1e-4)
    edge = int(SETTLING * segment.rate / PREFILTER)
    readings = smoothed(segment, LowPass(PREFILTER, passes=1), edge)
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    sticks = ~is_slipping(readings.velocity, robot.joints)
    centres = 0.5 * windows[0] * (1 + np.arange(len(valid)))
    inside = np.abs(time - centres[:, None]) < 0.5 * windows[0]
    if "coulomb" not in terms and not stated:
        assert valid.all()
        return
    never = ~(inside[:, :, None] & sticks).any(axis=1)
    always = (~inside[:, :, None] | sticks).all(axis=1)
    assert valid[:, 6:][never].all()
    assert not valid[:, 6:][always].any()
    assert 0 < (~valid).sum() < 0.5 * valid[:, 6:].size
    for rows in (mean, noise):
        assert not rows.K[~valid].any()
        assert not rows.y[~valid].any()


@pytest.mark.parametrize("seconds", [0.07, 0.1, 0.14])
def test_a_log_shorter_than_a_window_has_no_rows(seconds):
    parameters = ParameterSet(random_robot(1, links=3))
    segment = analytic_segment(parameters, seconds, 1)
    blocks = list(windowed_rows(segment, equation_rows(parameters), WINDOWS))
    assert sum(len(rows.mean.y) for block in blocks for rows in block) == 0


@pytest.mark.parametrize("levels", [{"position": 2e-5}, {"rate": 5e-3}])
def test_noise_rows_have_the_moments_of_the_regressors_noise(levels):
    parameters = ParameterSet(random_robot(6, links=5))
    exact = analytic_segment(parameters, 11.9, 4, start=0.05)
    without = rows_of(exact, parameters)
    noise = rows_of(noisy(exact, np.random.default_rng(3), **levels), parameters)
    for (clean, none, _), (mean, more, _) in zip(without, noise, strict=True):
        # 70 long windows of a few joints tell a variance to some 20 %.
        replayed, done = np.sum(more.K**2), np.sum((mean.K - clean.K) ** 2)
        assert 0.6 < replayed / done < 1.6
        # Perfect sensors have no noise to replay, and forces are none of the regressor's.
        assert np.linalg.norm(none.K) < 1e-3 * np.linalg.norm(more.K)
        assert np.abs(more.y).max() < 1e-3 * np.abs(mean.y).max()


def test_added_noise_is_reproducible():
    parameters = ParameterSet(random_robot(6, links=3))
    segment = noisy(analytic_segment(parameters, 1.0, 4), np.random.default_rng(3), **NOISE)
    (_, first, _), (_, again, _) = (rows_of(segment, parameters, [0.081])[0] for _ in range(2))
    np.testing.assert_array_equal(first.K, again.K)


@pytest.mark.parametrize(
    ("rate", "windows"),
    [
        (1000.0, (0.081, 0.161, 0.321)),
        (6 / 0.081, (0.081, 0.161, 0.321)),
        (6 / 0.0811, (0.161, 0.321, 0.641)),
        (20.0, (0.321, 0.641, 1.281)),
        (5.0, (1.281, 2.561)),
        (2.0, ()),
    ],
)
def test_windows_hold_at_least_six_samples(rate, windows):
    assert suitable_windows(ALL_WINDOWS, rate) == windows
    if windows:
        check_windows(ALL_WINDOWS, rate, "log")
    else:
        with raises_code("E319", "81, 161, .*6 samples at 2 Hz.* at least 3 s"):
            check_windows(ALL_WINDOWS, rate, "log")


@pytest.mark.parametrize(
    ("rate", "seconds"), [(1000, 4), (70, 4), (69.9, 12), (23.4, 12), (23.3, 20), (14, 20), (5, 20)]
)
def test_blocks_are_the_shortest_that_hold_enough_samples(rate, seconds):
    assert block_length(rate) == seconds * 1_000_000_000


@pytest.mark.parametrize(
    ("rate", "cutoff", "edge"),
    [(4000, 100, 160), (1000, 100, 40), (500, 50, 40), (100, 20, 20), (80, 20, 16), (50, 12.5, 16)],
)
def test_the_low_pass_before_differentiation_follows_the_rate(rate, cutoff, edge):
    low_pass, discarded = prefilter(rate)
    assert (low_pass.cutoff, discarded) == (pytest.approx(cutoff), edge)


@pytest.mark.parametrize("terms", [(), ("viscous", "coulomb", "load", "armature", "offset")])
@pytest.mark.parametrize("full_rate", [True, False])
def test_averages_without_single_rows_equal_those_of_single_rows(terms, full_rate):
    parameters = ParameterSet(random_robot(5, links=6), terms)
    exact = analytic_segment(parameters, 4.0, 6, rate=500.0)
    if "load" in terms:
        stop = int(exact.stamp[900])
        payload = Payload(3, np.array([2.0, 0.2, 0.0, 0.1, 0.1, 0, 0, 0.1, 0, 0.1]), stop=stop)
        parameters = replace(parameters, payloads=(payload,))
    segment = noisy(exact, np.random.default_rng(3), **NOISE)
    segment.effort[700:720, 1] = np.nan
    build = equation_rows(parameters)
    assert build.skips_samples
    some, others = (
        list(windowed_rows(segment, each, WINDOWS, full_rate=full_rate))
        for each in (build, build.__call__)
    )
    for one, other in zip(itertools.chain(*some), itertools.chain(*others), strict=True):
        np.testing.assert_array_equal(one.valid, other.valid)
        for sums, singles in ((one.mean, other.mean), (one.noise, other.noise)):
            np.testing.assert_allclose(sums.K, singles.K, atol=1e-12 * np.abs(one.mean.K).max())
            np.testing.assert_allclose(sums.y, singles.y, atol=1e-12 * np.abs(one.mean.y).max())


def test_replayed_blocks_represent_all_blocks_evenly():
    represented = np.array([represented_blocks(index) for index in range(-3, 2000)])[3:]
    assert (represented[:REPLAYED_BLOCKS] == 1).all()
    assert set(represented.tolist()) == {0, 1, 2, 4, 8}
    seen = np.cumsum(represented) - np.arange(1, len(represented) + 1)
    assert np.abs(seen).max() < 8
    # Half of the time is replayed in two minutes, and an eighth in the long run.
    assert np.count_nonzero(represented[:30]) > 15
    assert np.count_nonzero(represented) == pytest.approx(2000 / 8, rel=0.1)
    # Motion that repeats itself is replayed in all its phases.
    places = np.flatnonzero(represented == 8)
    for period in (2, 3, 4, 5, 8, 16, 24):
        count = np.bincount(places % period, minlength=period)
        assert count.min() > 0.7 * count.mean()


def test_blocks_before_the_log_are_replayed():
    assert [represented_blocks(index) for index in (-1000, -1, 0)] == [1, 1, 1]


def test_a_joint_that_sticks_at_the_end_of_a_window_has_no_row():
    """Friction that is off by twice the Coulomb friction for a tenth of the time would matter."""
    parameters = ParameterSet(random_robot(1, links=2), ("coulomb",))
    window, rate = 0.32, 500.0
    stamp = np.arange(round(window * rate)) * round(1e9 / rate)
    weights = np.hanning(len(stamp))
    weights /= weights.sum()
    for share, is_valid in ((0.1, False), (0.02, True)):
        sticks = np.cumsum(weights) < share
        velocity = np.where(sticks, 0.0, 1.0)[:, None]
        obeys = valid_coordinates(parameters, velocity)
        rows = Rows(np.zeros((len(stamp), 7, 1)), np.zeros((len(stamp), 7)))
        found = average(iter([SampledRows(stamp, rows, obeys)]), [csr_array(weights[None])])
        assert bool(found[0].valid[0, 6] > least_slipping(window)) == is_valid
