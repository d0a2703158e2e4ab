"""Files of commit 17d344f stay readable and give the estimate that they gave then.

That commit's own code wrote ``information.npz``, both priors and ``posterior.json``, the mean of
the posterior of each window with its prior.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from symbid_ros.estimation.archive import load_archive, load_deviation_factor
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.prior_file import load_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

FILES = Path(__file__).with_name("data") / "earlier_files"


@pytest.fixture(scope="module")
def parameters():
    return ParameterSet(load_model(FILES / "arm.urdf"), ("viscous", "coulomb"))


def test_information_has_its_layout_windows_and_counts(parameters):
    short, long = load_archive(FILES / "information.npz")
    layout = RowLayout.of(parameters)
    for each, window, samples in ((short, 0.081, 400), (long, 0.321, 100)):
        assert each.layout.parameters == layout.parameters
        assert each.layout.coordinates == layout.coordinates
        np.testing.assert_array_equal(each.layout.structure, layout.structure)
        assert (each.window, each.kept, each.rows.samples) == (window, 1.0, samples)
        # The elbow is masked in every seventh row.
        assert each.counts.diagonal().tolist() == [samples, samples - len(range(0, samples, 7))]
        # Files of that commit do not say which seconds they cover.
        assert each.seconds == frozenset()


@pytest.mark.parametrize(("name", "window"), [("prior.json", 0), ("prior_correlated.json", 1)])
def test_information_and_prior_give_the_same_estimate(parameters, name, window):
    prior = load_prior(FILES / name, parameters)
    assert (prior.model, prior.kind, prior.seed) == ("arm", "percent 25", 4)
    assert (prior.factor is not None) == (name == "prior_correlated.json")
    found = posterior(load_archive(FILES / "information.npz")[window], prior)
    then = json.loads((FILES / "posterior.json").read_text())[name]
    # Since then a little is added to the variances of residuals.
    assert np.abs((found.mean - then) / found.std).max() < 1e-7


def test_the_covariance_factor_in_information_is_that_of_the_estimate(parameters):
    prior = load_prior(FILES / "prior.json", parameters)
    found = posterior(load_archive(FILES / "information.npz")[0], prior)
    factor = load_deviation_factor(FILES / "information.npz")
    assert factor is not None
    covariance = factor @ factor.T / np.outer(found.std, found.std)
    expected = found.deviation_factor @ found.deviation_factor.T / np.outer(found.std, found.std)
    np.testing.assert_allclose(covariance, expected, atol=1e-7)
