"""What was identified is read in the order of the model it is judged by."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.archive import write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.result_files import load_estimated_model
from symbid_ros.model.parameters import ParameterSet

TERMS = ("viscous", "offset")


@pytest.fixture
def parameters():
    return ParameterSet(random_robot(4, links=3), TERMS)


@pytest.fixture
def estimate(parameters):
    p = len(parameters)
    return Estimate(
        method="map",
        model=parameters.model.name,
        names=parameters.names,
        units=parameters.units,
        value=np.arange(p) + 0.5,
        prior=np.arange(p) + 0.25,
        std=np.arange(p) + 1.0,
        determined=np.arange(p) % 3 == 0,
        rank=None,
        condition=1.0,
        samples=7,
        residual_rmse={},
        consistent=dict.fromkeys(parameters.link_names, True),
        inputs=(),
        software="test",
    )


def write(estimate, parameters, folder, factor):
    estimate.write(folder / "estimate.json")
    observations = Observations.empty(RowLayout.of(parameters), 0.1)
    write_archive(folder / "information.npz", [observations], factor)


def test_every_number_stays_with_its_parameter(parameters, estimate, tmp_path):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(parameters))
    factor = rng.normal(size=(len(order), 5))
    shuffled = replace(
        estimate,
        names=tuple(estimate.names[i] for i in order),
        units=tuple(estimate.units[i] for i in order),
        value=estimate.value[order],
        prior=estimate.prior[order],
        std=estimate.std[order],
        determined=estimate.determined[order],
    )
    write(shuffled, parameters, tmp_path, factor[order])
    found = load_estimated_model(tmp_path, parameters.model)
    assert found.parameters.names == parameters.names
    assert found.estimate.names == estimate.names
    assert found.estimate.units == estimate.units
    for name in ("value", "prior", "std", "determined"):
        np.testing.assert_array_equal(getattr(found.estimate, name), getattr(estimate, name))
    np.testing.assert_array_equal(found.values, estimate.value)
    np.testing.assert_array_equal(found.deviation_factor, factor)


def test_an_estimate_without_covariance_has_none(parameters, estimate, tmp_path):
    write(replace(estimate, std=None, determined=None), parameters, tmp_path, None)
    assert load_estimated_model(tmp_path, parameters.model).deviation_factor is None
    alone = load_estimated_model(tmp_path / "estimate.json", parameters.model)
    assert (alone.deviation_factor, alone.estimate.std) == (None, None)


def test_a_covariance_of_other_parameters_is_refused(parameters, estimate, tmp_path):
    write(estimate, parameters, tmp_path, np.ones((3, 3)))
    with pytest.raises(EstimateError, match=r"information\.npz: its covariance"):
        load_estimated_model(tmp_path, parameters.model)


def test_a_prior_has_values_alone(parameters, tmp_path):
    links = ParameterSet(parameters.model)
    prior = draw_prior(links, "percent", 10, 1)
    prior.write(tmp_path / "prior.json")
    found = load_estimated_model(tmp_path / "prior.json", parameters.model)
    np.testing.assert_array_equal(found.values, prior.mean)
    assert (found.estimate, found.deviation_factor) == (None, None)
    assert found.parameters.names == links.names


def test_another_robot_is_refused(parameters, estimate, tmp_path):
    estimate.write(tmp_path / "estimate.json")
    with pytest.raises(EstimateError, match="not those of random"):
        load_estimated_model(tmp_path, random_robot(4, links=4))
