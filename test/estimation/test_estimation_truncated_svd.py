"""Truncated methods against dense solves; sensor row weights against MuJoCo (Eq. 28)."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_samples

from symbid_ros.choices import TERMS
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.estimation.truncated_svd import (
    METHODS,
    LeastSquares,
    SensorNoise,
    prediction_errors,
    select_rank,
    sensor_row_std,
)
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sampled_rows import SampledRows


class Case:
    """Noisy rows of a random robot, stacked for the dense reference."""

    def __init__(self, seed, *, links=4, count=80, floating=True, terms=()):
        rng = np.random.default_rng(seed)
        self.parameters = ParameterSet(random_robot(seed, links, floating=floating), terms)
        self.samples = random_samples(self.parameters.model, count, rng)
        rows = equation_of_motion(self.parameters, self.samples)
        n = rows.K.shape[1]
        truth = self.parameters.values
        noise = rng.normal(size=rows.y.shape) * rng.uniform(0.1, 10, n)
        # The measured force becomes what the true parameters need, plus noise.
        efforts = self.samples.effort.copy()
        rows = type(rows)(rows.K, rows.K @ truth + noise)
        self.rows, self.n, self.efforts = rows, n, efforts
        self.information = Information.empty(RowLayout.of(self.parameters)).fold([rows])
        self.prior = draw_prior(self.parameters, "percent", 25, seed)
        self.W = rows.K.reshape(-1, len(self.parameters))
        self.y = rows.y.ravel()

    def dense(self, method, z):
        """Solve as the thesis writes it: stacked, scaled, Eq. 15-23."""
        W, y, prior = self.W, self.y, self.prior.mean
        count = len(self.rows.y)
        if method in ("wls_r", "wls_rc"):
            U, s, Vt = np.linalg.svd(W, full_matrices=False)
            m = int(np.sum(s > 1e-11 * s[0]))
            hat = np.sum(U[:, :m] ** 2, axis=1).reshape(count, self.n).sum(axis=0)
            ols = prior + Vt[:m].T @ ((U[:, :m].T @ (y - W @ prior)) / s[:m])
            residual = (y - W @ ols).reshape(count, self.n)
            sigma = np.sqrt(np.sum(residual**2, axis=0) / (count - hat))
            weights = np.tile(1 / sigma, count)
            W, y = W * weights[:, None], y * weights
        if method in ("wls_c", "wls_rc"):
            H = np.where(prior != 0, np.abs(prior), self.prior.std)
            U, s, Vt = np.linalg.svd(W * H, full_matrices=False)
            return prior + H * (Vt[:z].T @ ((U[:, :z].T @ (y - W @ prior)) / s[:z]))
        U, s, Vt = np.linalg.svd(W, full_matrices=False)
        alpha = (U[:, :z].T @ y) / s[:z]
        essential, null = Vt[:z].T, Vt[z:].T
        return essential @ alpha + null @ (null.T @ (prior - essential @ alpha))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("floating", [True, False])
def test_the_factor_solves_as_the_stacked_problem_does(method, seed, floating):
    terms = tuple(term for term in TERMS if term != "presliding")
    case = Case(seed, floating=floating, terms=terms if seed == 1 else ())
    problem = LeastSquares(case.information).scaled(case.prior, method)
    for z in (1, problem.rank // 2, problem.rank):
        expected = case.dense(method, z)
        np.testing.assert_allclose(
            problem.solution(z), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max()
        )
    np.testing.assert_allclose(problem.solutions()[:, -1], problem.solution(problem.rank))


@given(st.integers(0, 1000), st.lists(st.integers(1, 79), max_size=4))
@settings(max_examples=15, deadline=None)
def test_information_is_independent_of_blocks(seed, cuts):
    case = Case(seed % 5)
    edges = [0, *sorted(set(cuts)), 80]
    parts = [
        Information.empty(case.information.layout).fold(
            [type(case.rows)(case.rows.K[a:b], case.rows.y[a:b])]
        )
        for a, b in pairwise(edges)
    ]
    merged = parts[0]
    for part in parts[1:]:
        merged = merged.merge(part)
    whole = case.information.factor.T @ case.information.factor
    np.testing.assert_allclose(
        merged.factor.T @ merged.factor, whole, atol=1e-13 * np.abs(whole).max()
    )
    assert merged.samples == 80


def test_two_halves_merged_give_the_same_estimate():
    case = Case(7, count=200)
    halves = [
        Information.empty(case.information.layout).fold(
            [type(case.rows)(case.rows.K[s], case.rows.y[s])]
        )
        for s in (slice(0, 100), slice(100, 200))
    ]
    merged = halves[0].merge(halves[1])
    for method in METHODS:
        whole = LeastSquares(case.information).scaled(case.prior, method)
        parts = LeastSquares(merged).scaled(case.prior, method)
        z = whole.rank // 2
        np.testing.assert_allclose(parts.solution(z), whole.solution(z), rtol=1e-8, atol=1e-10)


def test_a_full_residual_covariance_needs_no_second_pass():
    case = Case(3)
    rng = np.random.default_rng(0)
    whitening = rng.normal(size=(case.n, case.n))
    stacked = np.concatenate([case.rows.K, case.rows.y[..., None]], axis=2)
    dense = (whitening @ stacked).reshape(-1, case.W.shape[1] + 1)
    factor = case.information.whitened(whitening)
    np.testing.assert_allclose(
        factor.T @ factor, dense.T @ dense, atol=1e-12 * np.abs(dense.T @ dense).max()
    )


def test_residuals_are_those_of_the_rows():
    case = Case(4)
    phi = case.prior.mean
    residual = case.rows.y - case.rows.K @ phi
    np.testing.assert_allclose(case.information.residual_moment(phi), residual.T @ residual)
    expected = np.sqrt(np.mean(residual**2, axis=0))
    found = case.information.residual_rmse(phi)
    assert list(found) == list(case.parameters.model.coordinates)
    np.testing.assert_allclose(list(found.values()), expected)


def test_residual_deviation_finds_each_coordinates_noise():
    case = Case(5, links=3, count=4000)
    truth = case.rows.y - case.rows.K @ case.parameters.values
    sigma = LeastSquares(case.information).row_deviation
    # Where the noise is small the error of the OLS estimate itself shows, so that one is freed.
    loud = truth.std(axis=0) > 1
    assert loud.sum() == 7
    np.testing.assert_allclose(sigma[loud], truth.std(axis=0)[loud], rtol=0.03)


def test_partly_masked_coordinates_keep_their_noise_and_weight():
    """A joint that sticks half the time is as noisy as one that slips throughout."""
    case = Case(5, links=3, count=8000)
    valid = np.random.default_rng(5).random(case.rows.y.shape) < np.linspace(0.3, 1.0, case.n)
    sampled = SampledRows(np.arange(8000), case.rows, valid)
    found = Observations.unwindowed(case.information.layout, [sampled], 1.0)
    np.testing.assert_array_equal(found.counts.diagonal(), valid.sum(axis=0))
    dense = (case.rows.K * valid[..., None]).reshape(-1, case.W.shape[1])
    factor = found.rows.whitened(np.eye(case.n))[:, :-1]
    moment = dense.T @ dense
    np.testing.assert_allclose(factor.T @ factor, moment, atol=1e-11 * np.abs(moment).max())
    truth = case.rows.y - case.rows.K @ case.parameters.values
    sigma = LeastSquares(found.rows, counts=found.counts.diagonal()).row_deviation
    loud = truth.std(axis=0) > 1
    np.testing.assert_allclose(sigma[loud], truth.std(axis=0)[loud], rtol=0.05)


@pytest.mark.parametrize("criterion", ["gen_force", "torque", "com"])
def test_z_is_the_smallest_that_predicts_the_validation_rows_well(criterion):
    training, validation = Case(6), Case(6, count=60)
    problem = LeastSquares(training.information).scaled(training.prior, "wls_rc")
    errors = []
    for z in range(1, problem.rank + 1):
        phi = problem.solution(z)
        residual = validation.rows.y - validation.rows.K @ phi
        used = {"gen_force": residual, "torque": residual[:, 6:], "com": residual[:, :3]}[criterion]
        mass = phi[0 : training.parameters.inertial : 10].sum()
        scale = 9.81 * abs(mass) if criterion == "com" else 1.0
        errors.append(np.sqrt(np.mean(np.sum((used / scale) ** 2, axis=1))))
    z = select_rank(problem, validation.information, criterion)
    assert errors[z - 1] <= 1.5 * min(errors)
    assert all(error > 1.5 * min(errors) for error in errors[: z - 1])


def test_std_covers_the_error_of_a_linear_problem():
    # Rows scaled to equal noise, regressor exact: Eq. 34 must then be calibrated.
    ratios = []
    for seed in range(30):
        case = Case(2, links=3, count=400)
        rng = np.random.default_rng(seed)
        y = case.rows.K @ case.parameters.values + rng.normal(size=case.rows.y.shape)
        information = Information.empty(case.information.layout).fold(
            [type(case.rows)(case.rows.K, y)]
        )
        prior = draw_prior(case.parameters, "percent", 25, seed)
        problem = LeastSquares(information, np.ones(case.n)).scaled(prior, "wls_c")
        z = problem.rank // 2
        error = problem.solution(z) - case.parameters.values
        ratios.append(error / problem.std(z, prior.std))
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2


@pytest.mark.parametrize("method", ["ols", "wls_c"])
@pytest.mark.parametrize(("count", "z"), [(80, 1), (80, 17), (9, 8), (9, 9), (9, 12)])
def test_std_is_that_of_the_data_and_of_the_prior_where_truncated(method, count, z):
    """Eq. 33 and 34 with dense matrices."""
    case = Case(4, count=count)
    problem = LeastSquares(case.information).scaled(case.prior, method)
    prior = case.prior
    H = np.ones(len(prior.mean))
    if method == "wls_c":
        H = np.where(prior.mean != 0, np.abs(prior.mean), prior.std)
    _, s, Vt = np.linalg.svd(case.W * H, full_matrices=False)
    residual = case.y - case.W @ problem.solution(z)
    variance = residual @ residual / max(count - z, 1)
    V = Vt[:z].T
    data = (H[:, None] * V / s[:z]) @ (H[:, None] * V / s[:z]).T * variance
    unused = np.eye(len(H)) - V @ V.T
    rest = H[:, None] * unused * (prior.std / H)
    expected = np.sqrt(np.diag(data + rest @ rest.T))
    np.testing.assert_allclose(problem.std(z, prior.std), expected, rtol=1e-6)


@pytest.mark.parametrize("criterion", ["gen_force", "torque", "com"])
@pytest.mark.parametrize("floating", [True, False])
def test_prediction_errors_are_root_mean_squares_of_the_rows(criterion, floating):
    case = Case(6, floating=floating, count=30)
    rng = np.random.default_rng(0)
    solutions = case.prior.mean[:, None] + 0.1 * rng.normal(size=(len(case.prior.mean), 3))
    if criterion == "com" and not floating:
        with pytest.raises(EstimateError, match="needs a floating base"):
            prediction_errors(case.information, solutions, criterion)
        return
    error = case.rows.y[..., None] - case.rows.K @ solutions
    if criterion == "torque":
        error = error[:, 6 * floating :]
    elif criterion == "com":
        error = error[:, :3] / (9.81 * np.abs(solutions[::10].sum(axis=0)))
    expected = np.sqrt(np.mean(np.sum(error**2, axis=1), axis=0))
    found = prediction_errors(case.information, solutions, criterion)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("wrong", ["effort", "force", "moment"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_sensor_deviations_are_positive(wrong, value):
    given_values = {"effort": 1.0, "force": 1.0, "moment": 1.0, wrong: value}
    with pytest.raises(EstimateError, match="must all be positive"):
        SensorNoise(**given_values)


def test_errors_name_the_cause():
    case = Case(8)
    bad = type(case.rows)(case.rows.K.copy(), case.rows.y.copy())
    bad.y[3, 2] = np.nan
    with pytest.raises(DataError, match="not finite"):
        case.information.fold([bad])
    with pytest.raises(DataError, match="different robots"):
        case.information.merge(Case(9, links=5).information)
    few = Information.empty(case.information.layout).fold(
        [type(case.rows)(case.rows.K[:3], case.rows.y[:3])]
    )
    with pytest.raises(EstimateError, match="too few"):
        _ = LeastSquares(few).row_deviation
    still = Information.empty(case.information.layout).fold(
        [type(case.rows)(np.zeros_like(case.rows.K), case.rows.y)]
    )
    with pytest.raises(EstimateError, match="excites no"):
        select_rank(LeastSquares(still).scaled(case.prior, "ols"), still)


def test_a_robot_that_cannot_move_is_refused(tmp_path):
    path = tmp_path / "vase.urdf"
    path.write_text(
        '<robot name="vase"><link name="world"/><link name="body"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="glue" type="fixed"><parent link="world"/><child link="body"/></joint></robot>'
    )
    parameters = ParameterSet(load_model(path))
    with pytest.raises(EstimateError, match=r"vase\.urdf: its base is fixed and no joint moves"):
        RowLayout.of(parameters)


SENSORS = SensorNoise(effort=0.3, force=2.0, moment=0.7)


def generalised_forces(model, position, frame, rng):
    """Return what unit moments and forces on a frame do in MuJoCo (6, n), in our rows."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(model))
    data = mujoco.MjData(compiled)
    base = np.eye(3)
    if model.floating:  # noise is the same however the base lies
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mju_quat2Mat(flat := np.empty(9), data.qpos[3:7])
        base = flat.reshape(3, 3)
    data.qpos[data.qpos.size - len(position) :] = position
    mujoco.mj_kinematics(compiled, data)
    mujoco.mj_comPos(compiled, data)
    axes, place = data.site(frame).xmat.reshape(3, 3), data.site(frame).xpos
    responses = []
    for component in range(6):
        moment, force = np.zeros((2, 3))
        (moment, force)[component // 3][component % 3] = 1.0
        response = np.zeros(compiled.nv)
        body = compiled.site(frame).bodyid[0]
        mujoco.mj_applyFT(compiled, data, axes @ force, axes @ moment, place, body, response)
        if model.floating:  # MuJoCo: force first, in world axes
            response[:6] = np.r_[response[3:6], base.T @ response[:3]]
        responses.append(response)
    return np.array(responses)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("floating", [True, False])
def test_row_deviations_are_the_responses_to_noise(seed, floating) -> None:
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=3 + seed, floating=floating, wrench_frames=1 + seed)
    samples = random_samples(model, 5, rng)
    variance = np.zeros((len(samples), model.dof))
    variance[:, 6 * floating :] = SENSORS.effort**2
    components = np.repeat([SENSORS.moment, SENSORS.force], 3)
    for instant, position in enumerate(samples.position):
        for frame in samples.wrench_frames:
            responses = components[:, None] * generalised_forces(model, position, frame, rng)
            variance[instant] += np.sum(responses**2, axis=0)
    found = sensor_row_std(model, samples, SENSORS)
    np.testing.assert_allclose(found, np.sqrt(variance.mean(axis=0)), rtol=1e-9)
