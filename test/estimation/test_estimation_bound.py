"""A log of the Symbitron, from sensors to estimates, against the Bayesian Cramér-Rao bound.

The bound is worked out apart: the ideal log's windowed rows, and the covariance, between
neighbouring windows too, of what the sensors' noise makes of the equation of motion at the truth.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
from random_robots import CONFIG
from scipy.linalg import cho_factor, cho_solve

from symbid_ros.choices import METHODS
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.rows.dataset import observe
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.weak_form import equation_rows, windowed_rows
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.settings import load_noise
from symbid_ros.simulation.simulator import Simulator

WINDOW = 0.161
NOISE_DRAWS, PRIOR_DRAWS = 3, 3


def ideal_segment():
    """Return what noise-free sensors say, without a bag in between."""
    simulator = Simulator(SimulateOptions("smooth", moves=2, motion_seed=41, ideal=True))
    instants = list(simulator)

    def stacked(name):
        return np.array([getattr(instant, name) for instant in instants])

    return Segment(
        stamp=stacked("stamp"),
        rate=1000.0,
        position=stacked("joint_position"),
        effort=stacked("joint_effort"),
        angular_velocity=stacked("imu_angular_velocity")[:, None],
        linear_acceleration=stacked("imu_linear_acceleration")[:, None],
        wrenches=np.roll(stacked("wrenches"), 3, axis=2),
        imu_frames=(simulator.imu_frame,),
        wrench_frames=tuple(sensor.frame_id for sensor in simulator.wrench_sensors),
    )


def with_noise(segment, model, seed):
    rng, noise = np.random.default_rng(seed), load_noise(CONFIG / "noise.yaml")
    driven = np.array([joint.effort > 0 for joint in model.joints])
    wrench = np.repeat([noise.moment, noise.force], 3)
    sizes = {
        "position": noise.joint_position,
        "effort": noise.joint_effort * driven,
        "angular_velocity": noise.angular_velocity,
        "linear_acceleration": noise.linear_acceleration,
        "wrenches": wrench,
    }
    noisy = {
        name: getattr(segment, name) + size * rng.normal(size=getattr(segment, name).shape)
        for name, size in sizes.items()
    }
    return replace(segment, **noisy)


@dataclass(frozen=True)
class Bound:
    """Windowed rows, block by block, and the information in them."""

    parameters: ParameterSet
    ideal: Segment

    def rows(self, segment):
        """Return the windowed rows of each block."""
        build = equation_rows(self.parameters)
        return [block[0].mean for block in windowed_rows(segment, build, (WINDOW,))]

    @cached_property
    def blocks(self):
        """Ideal regressors (W, n, p), one for each block."""
        return [rows.K for rows in self.rows(self.ideal)]

    @cached_property
    def covariances(self):
        """Σ of one window's noise and of two neighbours' (n, n), from draws of their own."""
        model, truth = self.parameters.model, self.parameters.values
        residuals = [
            rows.y - rows.K @ truth
            for seed in range(900, 903)
            for rows in self.rows(with_noise(self.ideal, model, seed))
        ]
        same = sum(e.T @ e for e in residuals) / sum(len(e) for e in residuals)
        next_one = sum(e[:-1].T @ e[1:] for e in residuals) / sum(len(e) - 1 for e in residuals)
        return same, next_one

    @cached_property
    def information(self):
        """Kᵀ Ω⁻¹ K (p, p) of all windows, Ω their full block-tridiagonal covariance."""
        same, next_one = self.covariances
        total = 0.0
        for K in self.blocks:
            count = len(K)
            omega = np.kron(np.eye(count), same)
            omega += np.kron(np.eye(count, k=1), next_one)
            omega += np.kron(np.eye(count, k=-1), next_one.T)
            stacked = K.reshape(-1, K.shape[2])
            total = total + stacked.T @ cho_solve(cho_factor(omega), stacked)
        return total

    def covariance(self, prior):
        """Return the bound (p, p) on any estimate's covariance under this prior."""
        unit = np.outer(prior.std, prior.std)
        return unit * np.linalg.inv(self.information * unit + np.eye(len(prior.std)))


@dataclass(frozen=True)
class Draw:
    """One prior and one draw of the noise, identified."""

    solved: SolvedProblem
    bound: np.ndarray

    @property
    def prior(self):
        return self.solved.problem.prior


@pytest.fixture(scope="module")
def bound():
    return Bound(ParameterSet(load_model(CONFIG / "symbitron.xml")), ideal_segment())


@pytest.fixture(scope="module")
def draws(bound):
    parameters, layout = bound.parameters, RowLayout.of(bound.parameters)
    found = []
    for noise in range(NOISE_DRAWS):
        segment = with_noise(bound.ideal, parameters.model, noise)
        observations = observe([segment], equation_rows(parameters), layout, (WINDOW,))
        for seed in range(PRIOR_DRAWS):
            prior = draw_prior(parameters, "percent", 25, 10 * noise + seed)
            solved = SolvedProblem.of(Problem(observations, parameters, prior))
            found.append(Draw(solved, bound.covariance(prior)))
    return found


def com_jacobian(parameters):
    """Return the derivative (3, p) of the centre of mass, all joints at zero, by differences."""
    model = parameters.model
    poses = link_poses(model, np.zeros((1, len(model.joints))))

    def com(values):
        links = parameters.link_phi(values)
        moment = sum(
            m * poses.position[0, link] + poses.rotation[0, link] @ mc
            for link, m, mc in zip(parameters.links, links[:, 0], links[:, 1:4], strict=True)
        )
        return moment / links[:, 0].sum()

    truth = parameters.values
    steps = 1e-6 * np.eye(len(truth))
    return np.array([(com(truth + step) - com(truth - step)) / 2e-6 for step in steps]).T


@pytest.mark.parametrize("method", ["map", "map_lmi"])
def test_errors_are_as_small_as_the_bound_allows(method, bound, draws):
    K = np.concatenate(bound.blocks)
    metrics = {
        "gen_force": K.reshape(-1, K.shape[2]) / np.sqrt(len(K)),
        "torque": K[:, 6:].reshape(-1, K.shape[2]) / np.sqrt(len(K)),
        "com": com_jacobian(bound.parameters),
    }
    for name, J in metrics.items():
        errors, least = [], []
        for draw in draws:
            value = getattr(draw.solved, method)().estimate.value
            errors.append(np.sum((J @ (value - bound.parameters.values)) ** 2))
            least.append(np.trace(J @ draw.bound @ J.T))
        ratio = np.sqrt(np.mean(errors) / np.mean(least))
        assert 0.7 < ratio < 1.2, name


def test_the_stated_covariance_is_near_the_bound(draws):
    for draw in draws:
        found = draw.solved.posterior
        ratio = found.std / np.sqrt(np.diag(draw.bound))
        assert ratio.min() > 0.95
        # Weights of so short a log are paid for: some fifty independent windows, 16 coordinates.
        assert ratio.max() < 1.6


def test_errors_are_as_large_as_stated_in_the_determined_directions(bound, draws):
    squares = []
    for draw in draws:
        found = draw.solved.posterior
        _, told, Vt = np.linalg.svd(found.factor * draw.prior.std)
        error = (found.mean - bound.parameters.values) / draw.prior.std
        squares.append((told * (Vt @ error))[told > 1 / DETERMINED] ** 2)
    assert all(len(each) > 15 for each in squares)
    assert 0.7 < np.mean(np.concatenate(squares)) < 1.3


def test_every_link_is_consistent_and_there_are_no_alarms(bound, draws):
    possible = 0
    for draw in draws:
        estimate = draw.solved.map_lmi().estimate
        links = bound.parameters.link_phi(estimate.value)
        assert all(estimate.consistent.values())
        assert all(map(is_consistent, links))
        assert estimate.verdict.alarms == ()
        possible += sum(map(is_consistent, bound.parameters.link_phi(draw.prior.mean)))
    # Priors drawn parameter by parameter are impossible themselves.
    assert possible < len(draws) * len(bound.parameters.links)


def test_map_lmi_equals_map_where_map_is_consistent(bound, draws):
    """With a consistent prior and a log that agrees with it, no constraint is active."""
    problem = draws[0].solved.problem
    parameters = bound.parameters
    prior = draw_prior(parameters, "consistent", 0.1, 0)
    solved = SolvedProblem.of(replace(problem, prior=prior))
    map_, lmi = solved.map().estimate, solved.map_lmi().estimate
    assert all(map_.consistent.values())
    np.testing.assert_allclose(lmi.value, map_.value, atol=1e-9 * np.abs(map_.value).max())
    np.testing.assert_array_equal(lmi.std, map_.std)


def test_map_lmi_is_better_than_the_truncated_methods(bound, draws):
    """All methods on the same rows and prior, z chosen without validation data."""
    J = com_jacobian(bound.parameters)
    errors = {method: [] for method in METHODS}
    for draw in draws[:2]:
        for method in METHODS:
            if method.startswith("map"):
                estimate = getattr(draw.solved, method)().estimate
            else:
                estimate = draw.solved.truncated(method, Truncation()).estimate
            errors[method].append(np.linalg.norm(J @ (estimate.value - bound.parameters.values)))
    means = {method: np.mean(values) for method, values in errors.items()}
    assert min(means, key=means.get) in ("map", "map_lmi")
