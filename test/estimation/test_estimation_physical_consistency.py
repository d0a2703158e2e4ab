"""Physically consistent minimum: against another method, its optimality, and invalid input."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import CONFIG, random_phi, random_robot
from scipy.optimize import least_squares

from symbid_ros.errors import EstimateError
from symbid_ros.estimation import physical_consistency as physical
from symbid_ros.estimation.constraints import Bounds, total_mass_row
from symbid_ros.estimation.physical_consistency import (
    ACCURACY,
    MARGIN,
    ConicConstraints,
    consistent_minimum,
)
from symbid_ros.estimation.prior import draw_prior, model_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.inertia import is_consistent, phi_from_pseudo_inertia, pseudo_inertia
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

FRICTION = ("viscous", "coulomb", "armature", "offset")


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"))


def problem(parameters, seed, *, decades=3.0, percent=25.0):
    """Stack rows of data, from weak to strong, of the true robot on an impossible prior's."""
    rng = np.random.default_rng(seed)
    prior = draw_prior(parameters, "percent", percent, seed)
    count = len(parameters)
    directions = np.linalg.qr(rng.normal(size=(count, count)))[0]
    strength = np.logspace(decades, -3, count)[:, None]
    rows = strength * directions / prior.std
    data = rows @ parameters.values + rng.normal(size=count)
    factor = np.concatenate([rows, np.diag(1 / prior.std)])
    return factor, np.concatenate([data, prior.mean / prior.std]), prior.std


def links_of(parameters, value):
    return parameters.link_phi(value)


def deviations(factor, one, other):
    """Distance in posterior standard deviations."""
    return np.linalg.norm(factor @ (one - other))


def assert_optimal(parameters, factor, target, solution):
    """Assert the conditions of Karush, Kuhn and Tucker, link by link, without the solver.

    Any point mass may join a link, and the link itself may grow or shrink: along none of
    these ways d may the cost fall, gᵀd ≥ 0. An answer that is u posterior deviations from the
    optimum can miss that by u ‖factor d‖.
    """
    gradient = factor.T @ (factor @ solution.value - target)
    rng = np.random.default_rng(0)
    slack = 2 * solution.accuracy + 1e-5
    for index, link in enumerate(links_of(parameters, solution.value)):
        own = slice(10 * index, 10 * index + 10)
        J = pseudo_inertia(link)
        # <G, J> = gᵀφ; the eigenvectors of G are the points most likely to lower the cost.
        G = np.linalg.lstsq(pseudo_inertia(np.eye(10)).reshape(10, 16), gradient[own])[0]
        size = np.sqrt(np.diag(J))
        points = np.linalg.eigh(G.reshape(4, 4) * np.outer(size, size))[1].T
        points = np.concatenate([points, rng.normal(size=(20, 4))]) * size
        ways = phi_from_pseudo_inertia(points[:, :, None] * points[:, None, :])
        for way in (*ways, link, -link):
            assert gradient[own] @ way >= -slack * np.linalg.norm(factor[:, own] @ way)


def reference(parameters, factor, target, start):
    """Minimise over Cholesky factors, J = L Lᵀ, by a trust region: possible by construction."""
    lower = np.tril_indices(4)

    def phi(entries):
        L = np.zeros((len(parameters.links), 4, 4))
        L[:, *lower] = entries.reshape(-1, 10) * size
        return phi_from_pseudo_inertia(L @ L.swapaxes(1, 2)).ravel()

    J = pseudo_inertia(links_of(parameters, start))
    L = np.linalg.cholesky(J)
    diagonal = np.sqrt(np.diagonal(J, axis1=1, axis2=2))
    size = diagonal[:, lower[0]]
    found = least_squares(
        lambda x: factor @ phi(x) - target,
        (L[:, *lower] / size).ravel(),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=3000,
        method="trf",
    )
    return phi(found.x)


@pytest.mark.parametrize("seed", range(1, 6))
def test_agrees_with_a_search_over_cholesky_factors(seed):
    parameters = ParameterSet(random_robot(seed, 2))
    factor, target, std = problem(parameters, seed, decades=2)
    solution = consistent_minimum(factor, target, std, 2)
    assert solution.active.any()
    other = reference(parameters, factor, target, parameters.values)
    cost = [np.sum((factor @ value - target) ** 2) for value in (solution.value, other)]
    # What the margin costs is all that parts them.
    assert cost[0] == pytest.approx(cost[1], rel=1e-6)
    assert deviations(factor, solution.value, other) < 1e-4


@pytest.mark.parametrize("decades", [0, 3, 6])
@pytest.mark.parametrize("seed", range(3))
def test_the_solution_is_consistent_and_optimal(symbitron, seed, decades):
    factor, target, std = problem(symbitron, seed, decades=decades)
    free = np.linalg.lstsq(factor, target)[0]
    assert not all(map(is_consistent, links_of(symbitron, free)))
    solution = consistent_minimum(factor, target, std, 11)
    assert all(map(is_consistent, links_of(symbitron, solution.value)))
    assert solution.smallest.min() > 0
    assert np.all(np.linalg.eigvalsh(pseudo_inertia(links_of(symbitron, solution.value))) > 0)
    assert solution.accuracy <= ACCURACY * max(1, solution.moved)
    assert solution.moved == pytest.approx(deviations(factor, solution.value, free), rel=1e-3)
    assert_optimal(symbitron, factor, target, solution)
    # A link inside what is possible feels no force, in units of posterior deviations.
    gradient = links_of(symbitron, factor.T @ (factor @ solution.value - target))
    for link in np.flatnonzero(~solution.active):
        triangle = np.linalg.qr(factor[:, 10 * link : 10 * link + 10], mode="r")
        force = np.linalg.norm(np.linalg.solve(triangle.T, gradient[link]))
        assert force <= solution.accuracy + 1e-5


def test_constraints_bring_the_estimate_nearer_to_the_truth(symbitron):
    closer = []
    for seed in range(3):
        factor, target, std = problem(symbitron, seed)
        free = np.linalg.lstsq(factor, target)[0]
        value = consistent_minimum(factor, target, std, 11).value
        errors = [deviations(factor, each, symbitron.values) for each in (value, free)]
        closer.append(errors[0] < errors[1])
    # Projection onto a convex set that holds the truth: nearer in this very metric.
    assert all(closer)


def test_a_consistent_free_minimum_is_returned_unchanged(symbitron):
    prior = model_prior(symbitron)
    factor = np.diag(1 / prior.std)
    solution = consistent_minimum(factor, prior.mean / prior.std, prior.std, 11)
    np.testing.assert_allclose(solution.value, symbitron.values, rtol=1e-12, atol=1e-15)
    assert (solution.status, solution.iterations, solution.moved) == ("Free", 0, 0)
    assert not solution.active.any()


def test_projection_is_idempotent(symbitron):
    factor, target, std = problem(symbitron, 3)
    once = consistent_minimum(factor, target, std, 11)
    twice = consistent_minimum(factor, factor @ once.value, std, 11)
    assert deviations(factor, once.value, twice.value) < 1e-3


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    links=st.integers(1, 5),
    decades=st.floats(-2, 5),
    percent=st.floats(1, 90),
    kilograms=st.sampled_from([1e-3, 1.0, 1e4]),
    metres=st.sampled_from([1e-2, 1.0, 1e2]),
)
def test_any_problem_has_a_consistent_solution_in_any_units(
    seed, links, decades, percent, kilograms, metres
):
    parameters = ParameterSet(random_robot(seed, links))
    factor, target, std = problem(parameters, seed, decades=decades, percent=percent)
    unit = kilograms * np.tile(np.repeat([1.0, metres, metres**2], [1, 3, 6]), links)
    here = consistent_minimum(factor, target, std, links)
    there = consistent_minimum(factor / unit, target, std * unit, links)
    for solution in (here, there):
        assert all(map(is_consistent, links_of(parameters, solution.value)))
        assert np.all(links_of(parameters, solution.value)[:, 0] > 0)
    bound = here.accuracy + there.accuracy + 1e-6
    assert deviations(factor, here.value, there.value / unit) <= 1.01 * bound


@pytest.mark.parametrize("amount", [1e-3, 1e-1, 1e2, 1e6])
def test_tight_and_loose_priors(symbitron, amount):
    """Constraints override a tight prior with an inconsistent mean; a loose prior has no bias."""
    factor, target, std = problem(symbitron, 1)
    prior = slice(len(factor) // 2, None)
    factor, target = factor.copy(), target.copy()
    factor[prior] /= amount
    target[prior] /= amount
    solution = consistent_minimum(factor, target, std * amount, 11)
    assert all(map(is_consistent, links_of(symbitron, solution.value)))
    assert solution.accuracy <= ACCURACY * max(1, solution.moved)


def test_the_margin_does_not_exclude_the_truth_under_a_loose_prior(symbitron):
    """With a thousand times the robot as the prior's deviation, the data decide."""
    std = np.full(110, 1e3)
    strong = np.diag(np.full(110, 1e9))
    factor = np.concatenate([strong, np.diag(1 / std)])
    target = np.concatenate([strong @ symbitron.values, np.zeros(110)])
    solution = consistent_minimum(factor, target, std, 11)
    np.testing.assert_allclose(solution.value, symbitron.values, rtol=1e-6, atol=1e-9)


def test_one_link_with_a_tight_prior_does_not_affect_the_others(symbitron):
    factor, target, std = problem(symbitron, 2)
    known = slice(20, 30)
    std = std.copy()
    std[known] = 1e-9 * np.abs(symbitron.values[known])
    rows = np.zeros((10, 110))
    rows[:, known] = np.diag(1 / std[known])
    factor = np.concatenate([factor, rows])
    target = np.concatenate([target, rows @ symbitron.values])
    solution = consistent_minimum(factor, target, std, 11)
    np.testing.assert_allclose(solution.value[known], symbitron.values[known], rtol=1e-6)
    assert solution.accuracy <= ACCURACY * max(1, solution.moved)
    assert all(map(is_consistent, links_of(symbitron, solution.value)))


def test_a_massless_link_becomes_a_small_consistent_one():
    model = random_robot(5, 4)
    phi = model.phi.copy()
    phi[2] = 0.0
    parameters = ParameterSet(model.with_phi(phi))
    prior = model_prior(parameters)
    rng = np.random.default_rng(0)
    factor = np.diag(1 / prior.std)
    target = prior.mean / prior.std + rng.normal(size=len(prior.std))
    solution = consistent_minimum(factor, target, prior.std, 4)
    link = links_of(parameters, solution.value)[2]
    assert np.any(link)
    assert is_consistent(link)
    at_rest = consistent_minimum(factor, prior.mean / prior.std, prior.std, 4)
    link = links_of(parameters, at_rest.value)[2]
    assert 0 < link[0] < 1e-5
    # A simulator takes it: MuJoCo refuses a moving body of less than 1e-15.
    assert mujoco.MjModel.from_xml_string(mjcf_text(parameters.apply(at_rest.value))).nbody


@pytest.mark.parametrize("seed", range(3))
def test_mujoco_accepts_every_solution(symbitron, seed):
    for percent in (10, 60):
        factor, target, std = problem(symbitron, seed, percent=percent)
        solution = consistent_minimum(factor, target, std, 11)
        assert solution.active.any()
        text = mjcf_text(symbitron.apply(solution.value))
        body = mujoco.MjModel.from_xml_string(text)
        assert body.body_mass[1:].min() > 0
        inertia = body.body_inertia[1:]
        assert np.all(inertia > 0)
        assert np.all(inertia.sum(axis=1) - 2 * inertia.max(axis=1) >= 0)


def joint_problem(seed):
    """Data on a robot whose friction is zero: the free estimates are negative half the time."""
    parameters = ParameterSet(random_robot(seed, 4), terms=FRICTION)
    rng = np.random.default_rng(seed)
    std = np.concatenate(
        [np.maximum(np.abs(parameters.values[:40]) * 0.1, 1e-4), np.full(len(parameters) - 40, 0.1)]
    )
    factor = np.concatenate([rng.normal(size=(60, len(std))) / std, np.diag(1 / std)])
    target = factor @ parameters.values + rng.normal(size=len(factor))
    return parameters, factor, target, std


@pytest.mark.parametrize("seed", range(3))
def test_friction_and_armature_are_never_negative_and_offsets_may_be(seed):
    parameters, factor, target, std = joint_problem(seed)
    free = np.linalg.lstsq(factor, target)[0]
    bounds = Bounds.nonnegative(parameters)
    signed = np.array([not name.endswith("/offset") for name in parameters.names])
    signed[:40] = False
    assert bounds.names == tuple(np.array(parameters.names)[signed])
    assert free[signed].min() < 0
    solution = consistent_minimum(factor, target, std, 4, bounds)
    # Not even by a rounding error: parsers refuse -1e-17.
    assert solution.value[signed].min() >= 0
    assert np.sum(solution.value[signed] == 0) > 0 or solution.value[signed].min() < 1e-6
    gradient = factor.T @ (factor @ solution.value - target) * std
    clamped = signed & (solution.value < 1e-6 * std)
    assert gradient[clamped].min() > -1e-2
    assert np.abs(gradient[40:][~clamped[40:]]).max() < 1e-2
    assert_optimal(parameters, factor, target, solution)


def test_columns_beyond_the_bounds_are_free():
    parameters, factor, target, std = joint_problem(1)
    rng = np.random.default_rng(1)
    wider = np.column_stack([factor, 1e-3 * rng.normal(size=(len(factor), 2))])
    wider = np.concatenate([wider, np.eye(2, len(std) + 2, len(std))])
    goal = np.concatenate([target, [-3.0, 2.0]])
    std = np.concatenate([std, [1.0, 1.0]])
    solution = consistent_minimum(wider, goal, std, 4, Bounds.nonnegative(parameters))
    np.testing.assert_allclose(solution.value[-2:], [-3, 2], atol=0.1)


def test_a_known_total_mass_hard_and_soft(symbitron):
    factor, target, std = problem(symbitron, 4, decades=0)
    hard = consistent_minimum(factor, target, std, 11, Bounds.total_mass(symbitron, 41.05, 41.05))
    assert links_of(symbitron, hard.value)[:, 0].sum() == pytest.approx(41.05, abs=1e-5)
    row, goal = total_mass_row(symbitron, 41.05, 1e-4)
    weighed = np.concatenate([factor, row[None]]), np.append(target, goal)
    soft = consistent_minimum(*weighed, std, 11)
    assert links_of(symbitron, soft.value)[:, 0].sum() == pytest.approx(41.05, abs=1e-3)
    assert deviations(factor, hard.value, soft.value) < 0.01
    within = consistent_minimum(factor, target, std, 11, Bounds.total_mass(symbitron, 30, 38))
    assert links_of(symbitron, within.value)[:, 0].sum() == pytest.approx(38, abs=1e-4)


IMPOSSIBLE = {
    "negative mass": lambda p: Bounds.total_mass(p, -np.inf, -1.0),
    "total below the sum of the links' least": lambda p: (
        Bounds.total_mass(p, -np.inf, 10.0)
        + Bounds(("left leg",), np.eye(1, len(p), 10), np.array([11.0]), np.array([np.inf]))
    ),
    "two totals": lambda p: Bounds.total_mass(p, 40.0, 40.0) + Bounds.total_mass(p, 41.0, np.inf),
    "no mass at all": lambda p: Bounds.total_mass(p, 0.0, 0.0),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_infeasible_bounds_are_named(symbitron, case):
    factor, target, std = problem(symbitron, 0)
    with pytest.raises(EstimateError, match="total mass") as caught:
        consistent_minimum(factor, target, std, 11, IMPOSSIBLE[case](symbitron))
    assert "\n" not in str(caught.value)


def test_invalid_problems_are_rejected(symbitron):
    factor, target, std = problem(symbitron, 0)
    with pytest.raises(EstimateError, match="do not determine"):
        consistent_minimum(factor * (np.arange(110) != 7), target, std, 11)
    with pytest.raises(EstimateError, match="do not determine"):
        consistent_minimum(factor[:60], target[:60], std, 11)
    with pytest.raises(EstimateError, match="standard deviation"):
        consistent_minimum(factor, target, np.where(np.arange(110) == 7, 0.0, std), 11)
    with pytest.raises(EstimateError, match="not finite"):
        consistent_minimum(factor, np.where(np.arange(220) == 7, np.nan, target), std, 11)


@pytest.fixture
def stopping_early(monkeypatch):
    """Let the solver stop after some iterations."""

    def stop(limit):
        attempts = tuple({**options, "max_iter": limit} for options in physical._ATTEMPTS)
        monkeypatch.setattr(physical, "_ATTEMPTS", attempts)

    return stop


@pytest.mark.parametrize("limit", [1, 3])
def test_a_solver_that_stops_too_early_is_detected(symbitron, stopping_early, limit):
    factor, target, std = problem(symbitron, 6)
    stopping_early(limit)
    with pytest.raises(EstimateError, match=r"not found .* MaxIterations") as caught:
        consistent_minimum(factor, target, std, 11)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("limit", [1, 4, 8, 12])
def test_an_unfinished_solution_is_consistent_with_a_valid_error_bound(
    symbitron, monkeypatch, stopping_early, limit
):
    factor, target, std = problem(symbitron, 6)
    exact = consistent_minimum(factor, target, std, 11)
    stopping_early(limit)
    monkeypatch.setattr(physical, "ACCURACY", np.inf)
    solution = consistent_minimum(factor, target, std, 11)
    assert solution.status == "MaxIterations" or limit >= 12
    assert all(map(is_consistent, links_of(symbitron, solution.value)))
    error = deviations(factor, solution.value, exact.value)
    assert error <= solution.accuracy + exact.accuracy


def test_a_failed_attempt_is_followed_by_another(symbitron, monkeypatch):
    factor, target, std = problem(symbitron, 6)
    exact = consistent_minimum(factor, target, std, 11)
    monkeypatch.setattr(physical, "_ATTEMPTS", ({"max_iter": 2}, *physical._ATTEMPTS))
    solution = consistent_minimum(factor, target, std, 11)
    assert solution.iterations == exact.iterations + 2
    np.testing.assert_array_equal(solution.value, exact.value)


def test_the_stated_accuracy_bounds_the_true_error(symbitron, monkeypatch):
    """Solutions with loose tolerances are within their certified distance of an accurate one."""
    factor, target, std = problem(symbitron, 7)
    exact = consistent_minimum(factor, target, std, 11)
    monkeypatch.setattr(physical, "ACCURACY", np.inf)
    stated = []
    for tolerance in (1e-1, 1e-2, 1e-4, 1e-6):
        monkeypatch.setattr(physical, "_TOLERANCE", tolerance)
        loose = consistent_minimum(factor, target, std, 11)
        assert all(map(is_consistent, links_of(symbitron, loose.value)))
        error = deviations(factor, loose.value, exact.value)
        assert error <= loose.accuracy + exact.accuracy
        stated.append(loose.accuracy)
    assert stated[0] > 10 * stated[-1]


def test_thirty_links():
    parameters = ParameterSet(random_robot(8, 30))
    factor, target, std = problem(parameters, 8)
    solution = consistent_minimum(factor, target, std, 30)
    assert all(map(is_consistent, links_of(parameters, solution.value)))
    assert_optimal(parameters, factor, target, solution)


def test_margin_is_far_below_a_real_link(symbitron):
    """Real links, even a thin plate, are orders of magnitude away from the boundary."""
    plate = pseudo_inertia(random_phi(np.random.default_rng(0)))
    plate[2, :3] = plate[:3, 2] = 0.0
    plate[2, 2], plate[2, 3], plate[3, 2] = 1e-4 * plate[0, 0], 0.0, 0.0
    phi = phi_from_pseudo_inertia(plate)
    std = 0.1 * np.abs(phi) + 1e-3 * np.abs(phi).max()
    solution = consistent_minimum(np.diag(1 / std), phi / std, std, 1)
    assert solution.status == "Free"
    assert solution.smallest[0] > 50 * MARGIN


def test_a_parameter_outside_its_bound_is_restored_to_the_bound():
    """Bounds come scaled, so neither their rows nor their offsets are one or zero."""
    link = random_phi(np.random.default_rng(0))
    value, scale = np.append(link, 0.3), np.append(np.abs(link) + 1.0, 0.5)
    quadratic = physical.Quadratic.of(np.diag(4 / scale), 4 * value / scale, scale)
    bounds = Bounds(("friction",), np.eye(11)[-1:], np.array([0.7]), np.array([np.inf]))
    constraints = physical.ConicConstraints.about(quadratic, 1, bounds)
    restored = constraints.restored(quadratic.minimum)
    np.testing.assert_allclose(restored[-1] * scale[-1], 0.7)
    np.testing.assert_array_equal(restored[:-1], quadratic.minimum[:-1])


def test_multipliers_are_projected_onto_the_dual_cone():
    """Equations are free, bounds non-negative, and matrices semi-definite (Moreau)."""
    rng = np.random.default_rng(0)
    constraints = ConicConstraints(np.zeros((25, 20)), np.zeros(25), 2, 5, 2)
    z = rng.normal(size=25)
    z[:5] = -3.0, 2.0, -0.5, -3.0, 0.7
    found = constraints.multipliers(z)
    np.testing.assert_array_equal(found[:5], [-3.0, 2.0, 0.0, 0.0, 0.7])
    column, row = np.tril_indices(4)
    for link in range(2):
        before, after = np.zeros((2, 4, 4))
        for matrix, values in ((before, z), (after, found)):
            own = values[5 + 10 * link : 15 + 10 * link]
            own = own / np.where(column == row, 1.0, np.sqrt(2.0))
            matrix[column, row] = matrix[row, column] = own
        assert np.linalg.eigvalsh(after)[0] > -1e-12
        assert np.linalg.eigvalsh(after - before)[0] > -1e-12
        assert np.sum(after * (after - before)) == pytest.approx(0, abs=1e-12)
