"""Priors are drawn, written, read and checked."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log
from hypothesis import given, settings
from hypothesis import strategies as st
from json_schemas import require_valid
from random_robots import CONFIG, random_robot, with_drives
from scipy.linalg import block_diag

from symbid_ros.choices import JOINT_TERMS, TERMS
from symbid_ros.errors import PriorError, SymbidError
from symbid_ros.estimation.prior import (
    Prior,
    absolute_model_prior,
    consistent_prior,
    default_prior,
    draw_prior,
    model_prior,
)
from symbid_ros.estimation.prior_file import load_prior, write_prior
from symbid_ros.estimation.prior_std import percent_floor, sized_std, stated_covariance
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.inertia import (
    is_consistent,
    phi_from_pseudo_inertia,
    pseudo_inertia,
)
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"))


def test_percent_is_uniform_about_the_value(symbitron):
    draws = np.array([draw_prior(symbitron, "percent", 25, s).mean for s in range(200)])
    relative = draws / symbitron.values - 1
    assert np.abs(relative).max() <= 0.25
    assert np.abs(relative).mean() == pytest.approx(0.125, rel=0.03)
    prior = draw_prior(symbitron, "percent", 25, 1)
    assert np.all(prior.std >= 0.25 * np.abs(prior.mean) / np.sqrt(3))
    mass = 0
    assert prior.std[mass] == pytest.approx(0.25 * prior.mean[mass] / np.sqrt(3))


def test_absolute_is_the_same_for_every_parameter(symbitron):
    draws = np.array([draw_prior(symbitron, "absolute", 0.125, s).mean for s in range(200)])
    error = draws - symbitron.values
    assert np.abs(error).max() <= 0.125
    prior = draw_prior(symbitron, "absolute", 0.125, 1)
    np.testing.assert_allclose(prior.std, 0.125 / np.sqrt(3))
    assert error.std() == pytest.approx(prior.std[0], rel=0.02)


def test_a_consistent_prior_keeps_every_link_consistent(symbitron):
    truth = pseudo_inertia(symbitron.link_phi(symbitron.values))
    for seed in range(50):
        prior = draw_prior(symbitron, "consistent", 25, seed)
        links = symbitron.link_phi(prior.mean)
        assert all(map(is_consistent, links))
        for drawn, true in zip(pseudo_inertia(links), truth, strict=True):
            change = np.linalg.eigvals(np.linalg.solve(true, drawn)).real
            assert change.min() > 0.75 - 1e-9
            assert change.max() < 1.25 + 1e-9


def test_a_consistent_priors_deviation_is_that_of_its_draws(symbitron):
    draws = [draw_prior(symbitron, "consistent", 25, s) for s in range(300)]
    spread = np.std([prior.mean for prior in draws], axis=0)
    stated = np.sqrt(np.mean([prior.std**2 for prior in draws], axis=0))
    ratio = spread / stated
    assert np.median(ratio) == pytest.approx(1, abs=0.05)
    # Below one where a nearly vanishing product meets the floor.
    assert ratio.min() > 0.7
    assert ratio.max() < 1.2


def test_the_covariance_of_a_consistent_prior_is_that_of_its_draws(symbitron):
    found = consistent_prior(symbitron, 25)
    draws = np.array([draw_prior(symbitron, "consistent", 25, s).mean for s in range(600)])
    scaled = (draws - draws.mean(axis=0)) / found.std
    root = found.factor / found.std[:, None]
    expected = root @ root.T
    floor = percent_floor(symbitron, 25)
    for link in range(len(symbitron.links)):
        own = [i for i in range(10 * link, 10 * link + 10) if found.std[i] > 1.01 * floor[i]]
        assert len(own) >= 7
        sample = scaled[:, own].T @ scaled[:, own] / len(draws)
        # The standard error of a covariance of 600 draws is at most .06.
        np.testing.assert_allclose(sample, expected[np.ix_(own, own)], atol=0.3)
    np.testing.assert_allclose(found.mean, symbitron.values)


@pytest.mark.parametrize("kind", ["percent", "consistent", "separate"])
def test_the_default_prior_expects_all_kinds_of_wrong_files(symbitron, kind):
    prior = default_prior(symbitron, 25)
    links = np.arange(symbitron.inertial)

    # In units of the prior's deviations, no direction of an error is more than expected.
    errors = [
        draw_prior(symbitron, kind, 25, seed).mean[links] - symbitron.values[links]
        for seed in range(300)
    ]
    units = np.linalg.solve(prior.covariance_factor()[np.ix_(links, links)], np.transpose(errors))
    largest = np.linalg.svd(units / np.sqrt(len(errors)), compute_uv=False)[0]
    assert largest**2 < 2.5


def test_the_covariance_is_a_sum_over_kinds_of_errors(symbitron):
    extended = default_prior(symbitron, 25).extended(("x/gain",), np.ones(1), np.full(1, 0.1))
    count = symbitron.inertial
    kinds = extended.kinds_of_errors(extended.judged(count))
    stated = [stated_covariance(phi, 0.25) for phi in symbitron.link_phi(symbitron.values)]
    bodies = consistent_prior(symbitron, 25).factor[:count, :count]
    links = slice(count)
    alone = model_prior(symbitron, 25).std[links], 0.1 * sized_std(symbitron, 25)[links]
    covariances = [
        bodies @ bodies.T + block_diag(*stated),
        *(np.diag(each**2) for each in alone),
    ]
    L = extended.factor[:count, :count]
    scale = np.linalg.norm(L, axis=1)
    for kind, covariance in zip(kinds, covariances, strict=True):
        found = L @ kind / scale[:, None]
        expected = covariance / np.outer(scale, scale)
        np.testing.assert_allclose(found @ found.T, expected, atol=1e-12)


@pytest.mark.parametrize("points", [1, 2, 3])
def test_a_consistent_prior_of_links_without_volume_is_drawn(points):
    """Points, rods and plates are possible; rounding may make their eigenvalues negative."""
    rng, robot = np.random.default_rng(points), random_robot(3, links=5)
    for link in robot.links:
        places = np.c_[rng.normal(size=(points, 3)), np.ones(points)]
        link.phi[:] = phi_from_pseudo_inertia(places.T @ places)
    eigenvalues = np.linalg.eigvalsh(pseudo_inertia(robot.phi))
    assert np.abs(eigenvalues[:, : 4 - points]).max() < 1e-14 < eigenvalues[:, -1].min()
    assert (eigenvalues < 0).any()
    parameters = ParameterSet(robot)
    for phi in parameters.link_phi(draw_prior(parameters, "consistent", 25, 0).mean):
        assert np.linalg.matrix_rank(pseudo_inertia(phi), tol=1e-12) == points


def test_no_consistent_prior_is_drawn_around_an_inconsistent_link():
    robot = random_robot(3, links=5)
    robot.links[2].phi[0] *= -1.0
    with pytest.raises(PriorError, match="physically inconsistent link"):
        draw_prior(ParameterSet(robot), "consistent", 25, 0)


def test_same_seed_same_prior_and_it_survives_the_file(symbitron, tmp_path):
    for kind, amount in (("percent", 25.0), ("absolute", 0.125), ("consistent", 25.0)):
        one, two = (draw_prior(symbitron, kind, amount, 3) for _ in range(2))
        np.testing.assert_array_equal(one.mean, two.mean)
        path = tmp_path / f"{kind}.json"
        write_prior(path, one)
        read = load_prior(path, symbitron)
        np.testing.assert_array_equal(read.mean, one.mean)
        np.testing.assert_array_equal(read.std, one.std)
        document = json.loads(path.read_text())
        require_valid("prior", document)
        assert document["seed"] == 3
        assert set(document["parameters"]) == set(symbitron.names)


def test_the_models_prior_gives_zeros_an_uncertainty():
    parameters = ParameterSet(random_robot(0))
    parameters.model.links[2].phi[5] = 0.0
    prior = model_prior(parameters)
    np.testing.assert_array_equal(prior.mean, parameters.values)
    assert np.all(prior.std > 0)


def test_the_models_prior_has_the_requested_width(symbitron):
    percent, absolute = model_prior(symbitron, 10.0), absolute_model_prior(symbitron, 0.125)
    for prior in (percent, absolute):
        np.testing.assert_array_equal(prior.mean, symbitron.values)
    assert percent.std[0] == pytest.approx(0.1 * symbitron.values[0] / np.sqrt(3))
    np.testing.assert_allclose(percent.std, 0.4 * model_prior(symbitron).std)
    np.testing.assert_allclose(absolute.std, 0.125 / np.sqrt(3))
    assert (percent.kind, absolute.kind) == ("model, percent 10", "model, absolute 0.125")
    for amount in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(PriorError, match="positive half-width"):
            model_prior(symbitron, amount)
        with pytest.raises(PriorError, match="positive half-width"):
            absolute_model_prior(symbitron, amount)


@pytest.fixture
def driven():
    """A tree with a slide, whose file states the terms of its joints, but for one."""
    # Large, so that no floor is met.
    sizes = {"damping": 100.0, "friction_loss": 100.0, "armature": 100.0}
    robot = with_drives(random_robot(10, links=6), np.random.default_rng(4), **sizes)
    assert {joint.kind for joint in robot.joints} == {"revolute", "prismatic"}
    silent = replace(robot.joints[0], damping=0.0)
    return ParameterSet(replace(robot, joints=(silent, *robot.joints[1:])), TERMS)


def terms_of(parameters, values):
    return {term: values[columns] for term, columns in parameters.term_columns.items()}


def test_missing_joint_terms_are_zero_with_the_terms_deviation(driven):
    parameters = ParameterSet(random_robot(10, links=6), TERMS)
    kinds = np.array([joint.kind for joint in parameters.model.joints])
    stds = []
    for prior in (
        model_prior(parameters, 10),
        absolute_model_prior(parameters, 0.1),
        *(draw_prior(parameters, kind, 10, 0) for kind in ("percent", "absolute", "consistent")),
    ):
        np.testing.assert_array_equal(prior.mean[parameters.inertial :], 0)
        stds.append(prior.std[parameters.inertial :])
        for term, std in terms_of(parameters, prior.std).items():
            np.testing.assert_array_equal(std[kinds == "revolute"], JOINT_TERMS[term].std)
        # Seen at the lever of the same drive, a slide's motion and effort each count once.
        levers = {
            "viscous": 100,
            "coulomb": 10,
            "armature": 100,
            "offset": 10,
            "stribeck": 10,
            "load": 1,
            "presliding": 10,
            "lead": 10,
            "creep": 10,
            "stiffness": 100,
        }
        for term, std in terms_of(parameters, prior.std).items():
            np.testing.assert_allclose(
                std[kinds == "prismatic"], levers[term] * JOINT_TERMS[term].std
            )
    assert model_prior(driven).std[driven.inertial] == stds[0][0]


@pytest.mark.parametrize(("kind", "amount"), [("percent", 25), ("consistent", 25)])
def test_stated_joint_terms_are_drawn_as_links_are(driven, kind, amount):
    stated = np.flatnonzero(driven.values[driven.inertial :]) + driven.inertial
    assert len(stated) == 3 * len(driven.model.joints) - 1
    draws = [draw_prior(driven, kind, amount, seed) for seed in range(200)]
    relative = np.array([prior.mean[stated] for prior in draws]) / driven.values[stated] - 1
    assert np.abs(relative).max() <= 0.25
    assert relative.std() == pytest.approx(0.25 / np.sqrt(3), rel=0.03)
    for prior in draws[:3]:
        np.testing.assert_allclose(prior.std[stated], 0.25 * prior.mean[stated] / np.sqrt(3))


def test_stated_joint_terms_move_by_an_absolute_amount(driven):
    stated = np.flatnonzero(driven.values[driven.inertial :]) + driven.inertial
    draws = [draw_prior(driven, "absolute", 0.125, seed) for seed in range(200)]
    error = np.array([prior.mean[stated] for prior in draws]) - driven.values[stated]
    assert np.abs(error).max() <= 0.125
    assert error.std() == pytest.approx(0.125 / np.sqrt(3), rel=0.03)
    np.testing.assert_allclose(draws[0].std[stated], 0.125 / np.sqrt(3))


@pytest.mark.parametrize("kind", ["percent", "absolute", "consistent"])
def test_joint_terms_do_not_change_the_draw_of_the_links(driven, kind):
    links = draw_prior(ParameterSet(driven.model), kind, 10, 3)
    both = draw_prior(driven, kind, 10, 3)
    np.testing.assert_array_equal(both.mean[: driven.inertial], links.mean)
    np.testing.assert_array_equal(both.std[: driven.inertial], links.std)


def test_a_tiny_given_term_keeps_an_uncertainty(driven):
    joint = replace(driven.model.joints[1], damping=1e-9)
    joints = (driven.model.joints[0], joint, *driven.model.joints[2:])
    parameters = ParameterSet(replace(driven.model, joints=joints), TERMS)
    index = parameters.names.index(f"{joint.name}/viscous")
    assert model_prior(parameters).std[index] > 1e-4


def random_factor(std, rng):
    """Return the Cholesky factor of a random covariance with these deviations."""
    covariance = np.cov(rng.normal(size=(len(std), 3 * len(std))))
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    return np.linalg.cholesky(correlation * np.outer(std, std))


def with_factor(prior, seed=0):
    return replace(prior, factor=random_factor(prior.std, np.random.default_rng(seed)))


def test_a_covariance_survives_the_file(symbitron, tmp_path):
    prior = with_factor(draw_prior(symbitron, "percent", 25, 3))
    write_prior(tmp_path / "prior.json", prior)
    read = load_prior(tmp_path / "prior.json", symbitron)
    np.testing.assert_array_equal(read.factor, prior.factor)
    np.testing.assert_array_equal(read.covariance_factor(), prior.factor)
    independent = draw_prior(symbitron, "percent", 25, 3)
    np.testing.assert_array_equal(independent.covariance_factor(), np.diag(independent.std))


@pytest.mark.parametrize("terms", [(), ("armature",), ("viscous", "offset"), TERMS])
def test_a_covariance_is_marginalised_to_the_columns_in_use(driven, terms, tmp_path):
    held = ParameterSet(driven.model, ("viscous", "armature"))
    prior = with_factor(draw_prior(held, "consistent", 25, 3))
    covariance = prior.factor @ prior.factor.T
    order = np.random.default_rng(1).permutation(len(prior.names))
    shuffled = Prior(
        prior.model,
        prior.kind,
        prior.seed,
        tuple(prior.names[i] for i in order),
        prior.mean[order],
        prior.std[order],
        np.linalg.cholesky(covariance[np.ix_(order, order)]),
    )
    write_prior(tmp_path / "prior.json", shuffled)
    parameters = ParameterSet(driven.model, terms)
    read = load_prior(tmp_path / "prior.json", parameters)
    assert read.names == parameters.names
    known = [name for name in parameters.names if name in held.names]
    here = [parameters.names.index(name) for name in known]
    there = [held.names.index(name) for name in known]
    found = read.factor @ read.factor.T
    scale = np.outer(read.std, read.std)
    assert not np.any(np.triu(read.factor, 1))
    np.testing.assert_allclose(
        (found / scale)[np.ix_(here, here)],
        (covariance / np.outer(prior.std, prior.std))[np.ix_(there, there)],
        atol=1e-12,
    )
    np.testing.assert_array_equal(read.mean[here], prior.mean[there])
    # What the file lacks is as the model has it, and has nothing to do with the rest.
    rest = np.setdiff1d(np.arange(len(parameters)), here)
    own = model_prior(parameters)
    np.testing.assert_array_equal(read.mean[rest], own.mean[rest])
    np.testing.assert_allclose(found[np.ix_(rest, rest)], np.diag(own.std[rest] ** 2), atol=1e-12)
    assert np.abs((found / scale)[np.ix_(rest, here)]).max(initial=0) < 1e-12


BAD_FACTORS = {
    "wrong size": (lambda L: L[:-1], r"shape \(109, 110\); 110 parameters need 110 rows"),
    "no matrix": (lambda L: L[0], r"shape \(110,\)"),
    "NaN": (lambda L: np.where(np.eye(110) * np.arange(110) == 7, np.nan, L), "not finite"),
    "upper": (lambda L: L.T, "not lower triangular"),
    "singular": (lambda L: L * (np.arange(110) < 109), "not positive definite: its diagonal at"),
    "negative": (lambda L: -L, "not positive definite"),
    "other deviations": (lambda L: 1.00001 * L, "base_link/m a std of .* make them agree"),
    "ragged": (lambda L: [row[:i].tolist() for i, row in enumerate(L)], "not a prior.json"),
    "words": (lambda L: [["much"]], "not a prior.json"),
}


@pytest.mark.parametrize("case", BAD_FACTORS)
def test_errors_of_an_invalid_covariance_name_the_cause(case, symbitron, tmp_path):
    change, message = BAD_FACTORS[case]
    path = tmp_path / "prior.json"
    prior = with_factor(draw_prior(symbitron, "percent", 25, 3))
    write_prior(path, prior)
    document = json.loads(path.read_text())
    document["covariance_factor"] = np.asarray(change(prior.factor), dtype=object).tolist()
    path.write_text(json.dumps(document))
    with pytest.raises(PriorError, match=message) as caught:
        load_prior(path, symbitron)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.code in ("E402", "E403", "E404", "E405")


def test_a_prior_without_friction_serves_a_model_with_it(symbitron, tmp_path):
    path = tmp_path / "prior.json"
    write_prior(path, draw_prior(symbitron, "percent", 25, 3))
    prior = load_prior(path, ParameterSet(symbitron.model, ("viscous", "coulomb")))
    assert len(prior.mean) == 130
    np.testing.assert_array_equal(prior.mean[110:], 0)
    np.testing.assert_array_equal(prior.std[110:120], JOINT_TERMS["viscous"].std)


def test_a_prior_with_joint_terms_serves_a_model_without(driven, tmp_path):
    prior = draw_prior(driven, "percent", 25, 3)
    write_prior(tmp_path / "prior.json", prior)
    links = load_prior(tmp_path / "prior.json", ParameterSet(driven.model))
    np.testing.assert_array_equal(links.mean, prior.mean[: driven.inertial])
    both = load_prior(tmp_path / "prior.json", driven)
    np.testing.assert_array_equal(both.mean, prior.mean)


def edited(document, change):
    change(document)
    return json.dumps(document)


BAD = {
    "no JSON": (lambda d: "{", "not a prior.json"),
    "no parameters": (lambda d: edited(d, lambda x: x.pop("parameters")), "not a prior.json"),
    "no std": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].pop("std")),
        "not a prior.json",
    ),
    "other robot": (lambda d: edited(d, lambda x: x.update(model="talos")), "for model 'talos'"),
    "missing link": (
        lambda d: edited(d, lambda x: x["parameters"].pop("R_foot/m")),
        "lacks R_foot/m",
    ),
    "unknown link": (
        lambda d: edited(d, lambda x: x["parameters"].update({"tail/m": {"value": 1, "std": 1}})),
        "has no tail/m",
    ),
    "zero std": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(std=0)),
        "R_foot/m has value .* std 0",
    ),
    "zero in place of a tiny std": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(std=1e-300)),
        "R_foot/m has std 1e-300; give one from 1e-18 to 1e",
    ),
    "a std whose square overflows": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(std=1e200)),
        "R_foot/m has std 1e.200; give one from 1e-18 to 1e",
    ),
    "a value of no robot": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/Ixy"].update(value=-1e308)),
        "R_foot/Ixy has value -1e.308, outside a robot's range; give at most 1e.09",
    ),
    "a negative mass": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(value=-0.1)),
        "R_foot/m has value -0.1; give a mass of 0 kg or more",
    ),
    "a key given twice": (
        lambda d: json.dumps(d).replace('"R_foot/m"', '"R_foot/mc_x"'),
        "key 'R_foot/mc_x' is given twice",
    ),
    "an integer beyond floats": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(value=10**400)),
        "not a prior.json .*too large",
    ),
    "NaN": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(value=float("nan"))),
        "R_foot/m has value nan",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_of_an_invalid_prior_name_the_cause(case, symbitron, tmp_path):
    path = tmp_path / "prior.json"
    write_prior(path, draw_prior(symbitron, "percent", 25, 3))
    change, message = BAD[case]
    path.write_text(change(json.loads(path.read_text())))
    with pytest.raises(PriorError, match=message) as caught:
        load_prior(path, symbitron)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_prior_and_an_invalid_amount_are_rejected(symbitron, tmp_path):
    with pytest.raises(PriorError, match="cannot read"):
        load_prior(tmp_path / "none.json", symbitron)
    for kind, amount in (("percent", 0), ("absolute", -1), ("consistent", 100)):
        with pytest.raises(PriorError):
            draw_prior(symbitron, kind, amount, 0)


def test_a_draw_with_a_negative_mass_is_not_written(symbitron, tmp_path):
    drawn = next(
        prior
        for seed in range(100)
        if (prior := draw_prior(symbitron, "absolute", 0.3, seed)).mean[::10].min() < 0
    )
    with pytest.raises(PriorError, match=r"/m came out as -.* kg; choose another seed or a sm"):
        write_prior(tmp_path / "prior.json", drawn)
    assert list(tmp_path.iterdir()) == []


SIZES = [0.0, 5e-324, 1e-300, 1e-18, 1e-9, 1e-3, 1e5, 1e9, 1e200, 1e308]


@settings(max_examples=25)
@given(data=st.data())
def test_a_prior_with_any_numbers_is_used_or_rejected_in_one_line(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "prior.json"
    log = gaussian_log(0, links=2)
    write_prior(path, draw_prior(log.parameters, "percent", 25, 0))
    document = json.loads(path.read_text())
    names = st.sampled_from(sorted(document["parameters"]))
    for name in data.draw(st.lists(names, min_size=1, max_size=3)):
        entry = document["parameters"][name]
        key = data.draw(st.sampled_from(["value", "std"]))
        entry[key] = data.draw(st.sampled_from(SIZES)) * data.draw(st.sampled_from([1, -1]))
    path.write_text(json.dumps(document))
    said = ""
    try:
        prior = load_prior(path, log.parameters)
        solved = SolvedProblem.of(Problem((log.observations(),), log.parameters, prior))
        for found in (solved.map(), solved.map_lmi()):
            assert np.all(np.isfinite(found.estimate.value))
    except SymbidError as error:
        said = str(error)
    assert "\n" not in said
