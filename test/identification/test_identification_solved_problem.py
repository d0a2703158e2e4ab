"""Identification of short logs of the Symbitron: methods, merged runs, pseudo-measurements."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from random_robots import CONFIG

import symbid_ros as sy
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import EstimateError, OptionError
from symbid_ros.estimation.alarms import SUSPICIOUS_WHITENESS, Alarm
from symbid_ros.estimation.constraints import total_mass_row
from symbid_ros.estimation.observations import Observations, whiteness
from symbid_ros.estimation.posterior import CONVERGED, posterior
from symbid_ros.estimation.prior import Prior, default_prior, draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.result_files import write_identification
from symbid_ros.identification.rows.dataset import Processing
from symbid_ros.identification.rows.window_comparison import solve_window
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest
from symbid_ros.signals.weak_form import BLOCK, WindowedRows
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.settings import load_friction
from symbid_ros.simulation.simulator import Simulator

MODEL = CONFIG / "symbitron.xml"
TRUNCATED = ["ols", "wls_r", "wls_c", "wls_rc"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log in two bags, cut at a multiple of the block, one at rest, and a prior."""
    folder = tmp_path_factory.mktemp("logs")
    moving = Simulator(SimulateOptions("smooth", moves=2, motion_seed=31, noise_seed=5))
    steps, first = moving.steps, BLOCK // moving.period_ns - 1
    moving.steps = first
    record(moving, folder / "first")
    moving.steps = steps - first
    record(moving, folder / "second")
    resting = Simulator(SimulateOptions("tare", noise_seed=6))
    resting.steps = 2000
    record(resting, folder / "rest")
    write_prior(
        folder / "prior.json", draw_prior(ParameterSet(load_model(MODEL)), "percent", 25, 3)
    )
    return folder


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(MODEL))


def load(folder, *bags, **options):
    # The robot has no friction; a choice of terms is tested by itself.
    fixed = {"prior": folder / "prior.json"}
    if not {"friction", "armature", "offset"} & options.keys():
        fixed["joint_terms"] = ("none",)
    options = IdentifyOptions(**(fixed | options))
    return BagRequest(tuple(folder / bag for bag in bags), MODEL, options).load()


@pytest.fixture(scope="module")
def whole(folder):
    return load(folder, "first", "second")


def square_of_normalised_errors(found, truth):
    """Return (φ̂ - φ)ᵀ Σ⁻¹ (φ̂ - φ), whose expectation is the number of parameters."""
    L = found.deviation_factor
    scale = found.estimate.std
    covariance = (L / scale[:, None]) @ (L / scale[:, None]).T
    error = (found.estimate.value - truth) / scale
    return float(error @ np.linalg.solve(covariance, error))


def test_errors_agree_with_the_posterior_covariance(whole, symbitron):
    found = whole.solve("map")
    count = len(symbitron)
    # Chi-square with 110 degrees of freedom; the prior's part is drawn uniformly.
    assert 70 < square_of_normalised_errors(found, symbitron.values) < 160
    estimate = found.estimate
    z = (estimate.value - symbitron.values) / estimate.std
    assert np.sqrt(np.mean(z[estimate.determined] ** 2)) < 1.5
    prior = whole.prior
    off = np.linalg.norm((prior.mean - symbitron.values) / prior.std)
    assert np.linalg.norm((estimate.value - symbitron.values) / prior.std) < off
    assert 10 < estimate.determined.sum() < 0.5 * count


def test_a_clean_log_raises_no_alarm(whole):
    verdict = whole.solve("map_lmi").estimate.verdict
    assert verdict.alarms == ()
    assert verdict.prior_scale == pytest.approx(1.0, abs=0.4)
    assert verdict.window in Processing().windows
    assert 15 < verdict.effective < 50
    assert len(verdict.base) == 80


def test_map_lmi_is_the_nearest_physically_possible_estimate(whole, symbitron):
    free, possible = whole.solve("map"), whole.solve("map_lmi")
    assert not all(free.estimate.consistent.values())
    assert all(possible.estimate.consistent.values())
    for phi in symbitron.link_phi(possible.estimate.value):
        assert is_consistent(phi)
    np.testing.assert_array_equal(possible.estimate.std, free.estimate.std)
    # The truth is also possible, so the projection reduces the error.
    factor = whole.solved.posterior.factor
    errors = [
        np.linalg.norm(factor @ (found.estimate.value - symbitron.values))
        for found in (free, possible)
    ]
    assert errors[1] < errors[0]


@pytest.mark.parametrize("method", TRUNCATED)
def test_truncated_methods_choose_z_from_the_data(whole, symbitron, method):
    estimate = whole.solve(method).estimate
    # The number of directions about which the data say more than the prior.
    told = len(whole.solve("map").estimate.verdict.directions)
    assert abs(estimate.rank - told) <= 3
    first_force = whole.solved.chosen.rows.residual_rmse(estimate.value)
    before = whole.solved.chosen.rows.residual_rmse(whole.prior.mean)
    assert sum(first_force.values()) < 0.2 * sum(before.values())
    assert estimate.verdict is None
    if method == "wls_rc":
        error = (estimate.value - symbitron.values) / whole.prior.std
        off = (whole.prior.mean - symbitron.values) / whole.prior.std
        assert np.linalg.norm(error) < 1.2 * np.linalg.norm(off)


def test_rows_are_weighted_by_given_sensor_noise(whole, symbitron):
    sensors = SensorNoise(effort=0.5, force=3.0, moment=0.2)
    options = IdentifyOptions(method="wls_r", rank=20, sensor_std=(0.5, 3.0, 0.2))
    given = replace(whole, options=options)
    sigma = sensor_row_std(symbitron.model, whole.dataset.samples, sensors)
    assert sigma.max() > 5 * sigma.min()
    # Dense: the weighted normal equations about the prior, and their 20 largest eigenvalues.
    rows, prior = whole.solved.chosen.rows, whole.prior.mean
    normal, target = np.zeros((len(prior), len(prior))), np.zeros(len(prior))
    for index, columns in enumerate(rows.layout.columns):
        factor = rows.coordinate_factors[index] / sigma[index]
        A, b = factor[:, :-1], factor[:, -1]
        normal[np.ix_(columns, columns)] += A.T @ A
        target[columns] += A.T @ (b - A @ prior[columns])
    values, directions = np.linalg.eigh(normal)
    kept = directions[:, -20:]
    expected = prior + kept @ (kept.T @ target / values[-20:])
    np.testing.assert_allclose(given.solve("wls_r").estimate.value, expected, rtol=1e-6, atol=1e-8)
    unweighted = replace(given, options=replace(options, sensor_std=None))
    assert not np.allclose(unweighted.solve("wls_r").estimate.value, expected, rtol=1e-3)


def test_truncated_methods_use_a_given_rank_or_validation(whole):
    given = replace(whole, options=IdentifyOptions(method="wls_rc", rank=12))
    assert given.solve("wls_rc").estimate.rank == 12
    validated = replace(whole, validation=whole.dataset)
    chosen = validated.solve("wls_rc").estimate
    rows = whole.solved.chosen.rows

    def error(estimate):
        return np.linalg.norm(list(rows.residual_rmse(estimate.value).values()))

    # The smallest rank that predicts these rows about as well as the best one.
    assert chosen.rank < whole.solve("wls_rc").estimate.rank
    assert error(chosen) < 1.5 * error(whole.solve("wls_rc").estimate)
    excessive = replace(whole, options=IdentifyOptions(method="ols", rank=500))
    with pytest.raises(EstimateError, match="500 is not between 1 and"):
        excessive.solve("ols")


def test_truncated_methods_refuse_unsupported_options(folder):
    weighed = load(folder, "second", total_mass=41.05, total_mass_std=0.02)
    for method in TRUNCATED:
        with pytest.raises(EstimateError, match=f"{method} supports neither"):
            weighed.solve(method)
    row, target = total_mass_row(weighed.parameters, 41.05, 0.02)
    found = weighed.solve("map")
    assert np.linalg.norm(row @ found.deviation_factor) < 1.0
    assert row @ found.estimate.value == pytest.approx(target, abs=2.0)


@pytest.fixture(scope="module")
def begun(folder):
    return load(folder, "first")


@pytest.fixture(scope="module")
def chained(folder, begun):
    write_identification(begun.solve("map_lmi"), begun.parameters, folder / "begun")
    return load(folder, "second", information=folder / "begun/information.npz")


def test_two_merged_halves_give_the_estimate_of_the_whole(whole, chained):
    one, two = (prepared.solve("map").estimate for prepared in (whole, chained))
    assert one.verdict.window == two.verdict.window
    assert one.samples == two.samples
    assert np.abs((one.value - two.value) / one.std).max() < 1e-7
    np.testing.assert_allclose(two.std, one.std, rtol=1e-7)


def test_merging_uses_the_information_before_the_projection(whole, chained):
    one, two = (prepared.solve("map_lmi").estimate for prepared in (whole, chained))
    assert np.abs((one.value - two.value) / one.std).max() < 1e-4


def test_half_a_log_has_larger_standard_deviations(begun, chained):
    half, all_of_it = (prepared.solve("map").estimate for prepared in (begun, chained))
    assert half.verdict.gain < all_of_it.verdict.gain
    assert half.verdict.effective < all_of_it.verdict.effective


def test_rows_of_other_windows_are_refused(folder, chained):
    with pytest.raises(EstimateError, match="averaged over other windows"):
        load(folder, "second", information=chained.options.information, window=0.1)


def test_a_weighing_that_contradicts_the_prior_is_refused_in_one_line(folder):
    for mass in (20.0, 80.0):
        with pytest.raises(EstimateError) as caught:
            load(folder, "first", total_mass=mass, total_mass_std=0.02)
        message = str(caught.value)
        assert f"a total mass of {mass:g} kg contradicts the prior" in message
        assert "check `total_mass`" in message
        assert "\n" not in message


def test_two_priors_are_refused(folder):
    with pytest.raises(OptionError, match="give only one of `prior`, `prior_percent`"):
        IdentifyOptions(prior=folder / "prior.json", prior_percent=25)


def test_a_log_at_rest_determines_only_weight_and_balance(folder, symbitron):
    """Without motion, second moments keep their prior values and standard deviations."""
    prepared = load(folder, "rest")
    for method in ("map", "map_lmi"):
        estimate = prepared.solve(method).estimate
        inertia = np.array([name.partition("/")[2].startswith("I") for name in estimate.names])
        assert not estimate.determined[inertia].any()
        assert np.all(estimate.std[inertia] > 0.95 * prepared.prior.std[inertia])
        # A hanging robot at rest has one equation per coordinate.
        assert len(estimate.verdict.directions) <= symbitron.model.dof
        assert estimate.determined.sum() <= symbitron.model.dof
    moved = np.abs(prepared.solve("map").estimate.value - prepared.prior.mean) / prepared.prior.std
    assert moved[inertia].max() < 0.2
    errors = (prepared.solve("map").estimate.value - symbitron.values) / prepared.prior.std
    off = (prepared.prior.mean - symbitron.values) / prepared.prior.std
    assert np.linalg.norm(errors) < np.linalg.norm(off)


def test_window_lengths_dominated_by_noise_are_not_chosen(whole):
    """With a wide prior, short windows seem more informative because of noise in the regressor."""
    prior = draw_prior(whole.parameters, "absolute", 0.125, 1)
    problem = replace(whole.solved.problem, prior=prior)
    each = [solve_window(problem, one, None, CONVERGED) for one in problem.observations]
    chosen = SolvedProblem.of(problem)
    gains = [one.gain(len(whole.parameters)) for one in each]
    shares = [one.noise_share for one in each]
    assert np.argmax(gains) == 0
    assert shares[0] > 0.9
    assert chosen.chosen is problem.observations[-1]
    assert chosen.posterior.noise_share == pytest.approx(min(shares), rel=1e-3)

    def mean_square(found):
        return np.mean((found.factor @ (found.mean - whole.parameters.values)) ** 2)

    assert mean_square(chosen.posterior) < 1.4 < mean_square(each[0])


@pytest.mark.parametrize("scale", [1 / 3, 1.0, 3.0])
def test_the_evidence_recovers_the_scale_of_the_prior(whole, scale):
    """The data correct a prior that is too narrow or too wide."""
    count = len(whole.parameters)
    stated = whole.prior.widened(np.full(count, 1 / scale))
    problem = Problem((whole.solved.chosen,), whole.parameters, stated, is_empirical=True)
    found = SolvedProblem.of(problem).posterior
    np.testing.assert_allclose(found.prior.std, scale * stated.std, rtol=0.3)
    # The evidence accepts the scale of the widened prior, and corrects the stated one.
    assert found.prior_scale == pytest.approx(1.0, rel=0.02)
    as_stated = SolvedProblem.of(replace(problem, is_empirical=False)).posterior
    assert as_stated.prior_scale == pytest.approx(scale, rel=0.4)


def test_the_prior_of_an_exact_model_shrinks(folder, symbitron):
    prepared = load(folder, "second", prior=None)
    estimate = prepared.solve("map").estimate
    believed = default_prior(symbitron, 25)
    assert np.all(prepared.solved.posterior.prior.std < 0.5 * believed.std)
    assert np.abs((estimate.value - symbitron.values) / believed.std).max() < 0.5


def test_rows_of_a_given_window_are_solved_and_compared_with_the_others(whole):
    problem = whole.solved.problem
    for one in problem.observations:
        solved = SolvedProblem.of(problem, window=one.window)
        assert solved.chosen.window == one.window
        assert solved.whiteness > 0
        alone = SolvedProblem.of(replace(problem, observations=(one,))).posterior
        assert np.abs((solved.posterior.mean - alone.mean) / alone.std).max() < 1e-5


@pytest.mark.parametrize("samples", [40, 400])
def test_white_residuals_raise_no_alarm_however_short_the_log(samples):
    """Coordinates share noise, as base and joints do for one plate."""
    rng = np.random.default_rng(1)
    n = 6
    layout = RowLayout(tuple("uvwxyz"), ("m",), np.ones((n, 1), dtype=bool))
    shared = np.eye(n) * 0.05 + 1.0
    ratios = []
    for _ in range(30):
        data = []
        for window, count in ((0.1, samples), (0.4, samples // 4)):
            y = rng.standard_normal((count, n)) @ shared / np.sqrt(window)
            rows = Rows(np.zeros((count, n, 1)), y)
            nothing = Rows(0 * rows.K, 0 * y)
            block = WindowedRows(rows, nothing, np.ones((count, n), dtype=bool), np.arange(count))
            data.append(Observations.empty(layout, window).fold([block]))
        ratios.append(whiteness(*data, np.zeros(1)))
    assert 0.1 < np.median(ratios) < 1.1
    assert max(ratios) < SUSPICIOUS_WHITENESS


def test_a_joint_with_few_rows_is_not_weighted_as_exact():
    """Coordinate 1 has as many rows as own unknowns, so its residual is zero."""
    rng = np.random.default_rng(0)
    structure = np.array([[True] * 3 + [False] * 3, [False] * 3 + [True] * 3])
    layout = RowLayout(("busy", "seldom"), tuple("abcdef"), structure)
    prior = Prior("none", "test", None, layout.parameters, np.zeros(6), np.ones(6))
    squares = []
    for _ in range(50):
        phi = rng.standard_normal(6)
        K = rng.standard_normal((200, 2, 6)) * structure
        y = K @ phi + 0.1 * rng.standard_normal((200, 2))
        valid = np.ones((200, 2), dtype=bool)
        valid[3:, 1] = False
        mean = Rows(K * valid[:, :, None], y * valid)
        noise = Rows(0 * K, 0 * y)
        data = Observations.empty(layout, 0.081).fold(
            [WindowedRows(mean, noise, valid, np.arange(len(valid)))]
        )
        found = posterior(data, prior)
        squares.append(((found.mean - phi) / found.std) ** 2)
    busy, seldom = np.mean(np.median(squares, axis=0).reshape(2, 3), axis=1)
    # The median of a squared standard normal number is .45.
    assert 0.2 < busy < 0.9
    assert 0.05 < seldom < 1.5


def test_friction_armature_and_offsets_agree_with_their_standard_deviations(folder):
    rubbing = Simulator(
        SimulateOptions("smooth", moves=2, motion_seed=32, noise_seed=6, friction=True)
    )
    record(rubbing, folder / "rubbing")
    prepared = load(folder, "rubbing", friction=True, armature=True, offset=True)
    parameters = prepared.parameters
    truth = with_friction(parameters)
    for method in ("map", "map_lmi"):
        estimate = prepared.solve(method).estimate
        z = (estimate.value - truth) / estimate.std
        for term, columns in parameters.term_columns.items():
            assert np.sqrt(np.mean(z[columns] ** 2)) < 1.8, term
            assert np.abs(z[columns]).max() < 4, term
            assert estimate.determined[columns].mean() > 0.5, term
        if method == "map_lmi":
            columns = slice(parameters.inertial, parameters.term_columns["offset"].start)
            assert estimate.value[columns].min() >= -1e-9
    assert 95 < square_of_normalised_errors(prepared.solve("map"), truth) < 215


def with_friction(parameters):
    """Return the parameters of the robot with the friction of config/friction.yaml."""
    friction = load_friction(CONFIG / "friction.yaml")
    truth = parameters.values.copy()
    for term, field in (
        ("viscous", "damping"),
        ("coulomb", "frictionloss"),
        ("armature", "armature"),
    ):
        truth[parameters.term_columns[term]] = [
            getattr(friction[joint], field) for joint in parameters.model.joint_names
        ]
    return truth


@pytest.mark.parametrize("push", [-1.5, 0.0])
def test_drives_that_cannot_be_passive_raise_an_alarm(push):
    """A torque along the speed is friction below zero, which no drive has."""
    robot = arm(seed=2)
    log = log_of(robot, drives(robot, viscous=0.1), extra=lambda velocity, _: push * velocity)
    result = sy.identify(robot, log, unchecked=True, no_holdout=True, joint_terms="viscous")
    assert any(Alarm.LIMITS in alarm for alarm in result.alarms) == bool(push)


def test_alarms_are_the_same_with_and_without_a_verdict():
    robot = arm(seed=2)
    log = log_of(robot, drives(robot, viscous=0.1), extra=lambda velocity, _: -1.5 * velocity)
    solved = load_problem(robot, log, IdentifyOptions(joint_terms=("viscous",))).solved
    found, quick = solved.map_lmi(), solved.map_lmi(with_verdict=False)
    assert solved.alarms(quick.unknowns) == found.alarms
    assert any(Alarm.LIMITS in alarm for alarm in found.alarms)
    assert quick.with_alarms(found.alarms).alarms == ()
