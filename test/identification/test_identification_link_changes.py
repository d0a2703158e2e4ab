"""What an identification changed, and the deviations of centres of mass and principal moments."""

import json

import numpy as np
import pytest
from json_schemas import require_valid
from written_results import write_result

from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.identification import link_changes
from symbid_ros.identification.link_changes import principal_moments, robot_change
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.package_paths import config_file


@pytest.fixture
def result(tmp_path, monkeypatch):
    """Return a result whose parameters are uncertain by a hundredth, with correlations."""
    folder = tmp_path / "result"
    write_result(folder, config_file("symbitron.urdf"))
    estimate = load_estimate(folder / "estimate.json")
    rng = np.random.default_rng(3)
    count = len(estimate.names)
    mixing = np.eye(count) + 0.2 * rng.standard_normal((count, count)) / np.sqrt(count)
    factor = 1e-3 * np.abs(estimate.value)[:, None] * mixing
    monkeypatch.setattr(link_changes, "load_deviation_factor", lambda _: factor)
    return folder, estimate, factor


def test_deviations_are_those_of_drawn_parameters(result) -> None:
    folder, estimate, factor = result
    rng = np.random.default_rng(5)
    drawn = estimate.value + rng.standard_normal((20_000, factor.shape[1])) @ factor.T
    for change in robot_change(folder).links[:4]:
        first = estimate.names.index(f"{change.name}/m")
        phi = drawn[:, first : first + 10]
        com = np.array([com_from_phi(one)[1] for one in phi])
        moments = np.array([principal_moments(one) for one in phi])
        assert change.mass_kg.std == (estimate.std[first],)
        np.testing.assert_allclose(change.com_m.std, com.std(axis=0), rtol=0.05)
        spread = change.principal_inertia_kg_m2.std
        np.testing.assert_allclose(spread, moments.std(axis=0), rtol=0.05)


def test_values_are_those_of_both_robots(result) -> None:
    folder, estimate, _ = result
    found = robot_change(folder)
    assert [one.name for one in found.links] == list(estimate.consistent)
    change = found.links[1]
    columns = slice(10, 20)
    for phi, value in ((estimate.prior, "before"), (estimate.value, "after")):
        mass, com, inertia = com_from_phi(phi[columns])
        assert getattr(change.mass_kg, value) == (mass,)
        assert getattr(change.com_m, value) == pytest.approx(com)
        moments = np.sort(np.linalg.eigvals(inertia).real)
        assert getattr(change.principal_inertia_kg_m2, value) == pytest.approx(moments)
    assert change.determined == 1
    require_valid("difference", json.loads(json.dumps(found.document())))
