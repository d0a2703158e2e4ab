"""Priors: drawn, written, read, refused."""

import json

import numpy as np
import pytest
from random_robots import CONFIG, random_robot

from symbid_ros.errors import PriorError
from symbid_ros.estimation.prior import draw_prior, load_prior, model_prior
from symbid_ros.model.inertia import is_consistent, pseudo_inertia
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


def test_a_consistent_prior_keeps_every_link_possible(symbitron):
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


def test_same_seed_same_prior_and_it_survives_the_file(symbitron, tmp_path):
    for kind, amount in (("percent", 25.0), ("absolute", 0.125), ("consistent", 25.0)):
        one, two = (draw_prior(symbitron, kind, amount, 3) for _ in range(2))
        np.testing.assert_array_equal(one.mean, two.mean)
        path = tmp_path / f"{kind}.json"
        one.write(path)
        read = load_prior(path, symbitron)
        np.testing.assert_array_equal(read.mean, one.mean)
        np.testing.assert_array_equal(read.std, one.std)
        document = json.loads(path.read_text())
        assert set(document) == {"model", "kind", "seed", "parameters"}
        assert set(document["parameters"]) == set(symbitron.names)


def test_the_models_own_prior_never_takes_a_zero_for_certain():
    parameters = ParameterSet(random_robot(0))
    parameters.model.links[2].phi[5] = 0.0
    prior = model_prior(parameters)
    np.testing.assert_array_equal(prior.mean, parameters.values)
    assert np.all(prior.std > 0)


def test_a_prior_without_friction_serves_a_model_with_it(symbitron, tmp_path):
    path = tmp_path / "prior.json"
    draw_prior(symbitron, "percent", 25, 3).write(path)
    prior = load_prior(path, ParameterSet(symbitron.model, friction=True))
    assert len(prior.mean) == 130
    np.testing.assert_array_equal(prior.mean[110:], 0)


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
        "tail/m is unknown",
    ),
    "zero std": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(std=0)),
        "R_foot/m has value .* std 0",
    ),
    "NaN": (
        lambda d: edited(d, lambda x: x["parameters"]["R_foot/m"].update(value=float("nan"))),
        "R_foot/m has value nan",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_prior_says_what_is_wrong(case, symbitron, tmp_path):
    path = tmp_path / "prior.json"
    draw_prior(symbitron, "percent", 25, 3).write(path)
    change, message = BAD[case]
    path.write_text(change(json.loads(path.read_text())))
    with pytest.raises(PriorError, match=message) as caught:
        load_prior(path, symbitron)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_prior_and_a_senseless_amount_are_refused(symbitron, tmp_path):
    with pytest.raises(PriorError, match="cannot read"):
        load_prior(tmp_path / "none.json", symbitron)
    for kind, amount in (("percent", 0), ("absolute", -1), ("consistent", 100)):
        with pytest.raises(PriorError):
            draw_prior(symbitron, kind, amount, 0)
