"""The content of a report follows from estimates and ground truth."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot, random_samples

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.predictions.evaluation import TrueMotion
from symbid_ros.identification.predictions.realistic_prediction import RealisticMotion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.compose import GroundTruth, compose
from symbid_ros.report.content import METRICS, PRIOR, REALISTIC_METRICS, TRUTH
from symbid_ros.report.saved_results import ReportedResult

COUNT = 6
METADATA = {"Bag": "log"}


@pytest.fixture(scope="module")
def parameters() -> ParameterSet:
    return ParameterSet(random_robot(1, links=3))


@pytest.fixture(scope="module")
def ground_truth(parameters: ParameterSet) -> GroundTruth:
    """Random states whose efforts and base forces are exactly those of the true parameters."""
    rng = np.random.default_rng(0)
    samples = random_samples(parameters.model, COUNT, rng)
    rows = equation_of_motion(parameters, samples)
    owed = (rows.K @ parameters.values - rows.y)[:, 6:]
    samples = replace(samples, effort=samples.effort + owed)
    rotation = np.tile(np.eye(3), (COUNT, 1, 1))
    motion = TrueMotion(samples, rng.normal(size=(COUNT, 3)), rotation)
    return GroundTruth(motion, parameters.model, RealisticMotion(samples, motion))


def estimated(parameters: ParameterSet, factor: float, rank: int | None = None) -> Estimate:
    truth = parameters.values
    return Estimate(
        method="map",
        model=parameters.model.name,
        names=parameters.names,
        units=parameters.units,
        value=factor * truth,
        prior=1.5 * truth,
        std=None,
        determined=None,
        rank=rank,
        condition=1.0,
        samples=COUNT,
        residual_rmse={},
        consistent=dict.fromkeys(parameters.link_names, True),
        inputs=(),
        software="test",
    )


def test_errors_are_relative_to_the_ground_truth(
    parameters: ParameterSet, ground_truth: GroundTruth
) -> None:
    deviation = 0.1 * np.diag(parameters.values)
    content = compose(
        {
            "A": ReportedResult(estimated(parameters, 1.2), parameters),
            "B": ReportedResult(estimated(parameters, 0.9), parameters, deviation),
        },
        chosen="B",
        metadata=METADATA,
        ground_truth=ground_truth,
        truncations={("A", "itself"): estimated(parameters, 1.2, rank=3)},
    )
    assert [method.label for method in content.methods] == [PRIOR, "A", "B", TRUTH]
    errors = {}
    for method in content.methods:
        assert method.metrics is not None
        assert set(method.metrics) == {metric.key for metric in METRICS}
        errors[method.label] = method.metrics
    percent = {label: row["parameter_error_pct"] for label, row in errors.items()}
    assert percent == pytest.approx({PRIOR: 50, "A": 20, "B": 10, TRUTH: 0})
    # All parameters scaled alike: torques err in proportion, the centre of mass does not err.
    K = equation_of_motion(parameters, ground_truth.motion.samples).K[:, 6:]
    load = np.sqrt(np.mean(np.sum((K @ parameters.values) ** 2, axis=1)))
    assert errors["A"]["torque_rmse"] == pytest.approx(0.2 * load)
    assert errors["A"]["com_position_rmse_mm"] == pytest.approx(0, abs=1e-9)

    assert content.link_errors is not None
    np.testing.assert_allclose(content.link_errors.percent["B"], 10)
    assert [series.label for series in content.predictions or ()] == [TRUTH, PRIOR, "B"]
    # The drives give what the motion needs less what the environment's wrenches give.
    effort, needed = ground_truth.motion.samples.effort, K @ parameters.values
    assert np.max(np.abs(needed - effort)) > 1.0
    drawn = {series.label: series.torque for series in content.predictions or ()}
    np.testing.assert_allclose(drawn[TRUTH], effort, atol=1e-9)
    np.testing.assert_allclose(drawn["B"], effort - 0.1 * needed, atol=1e-9)

    assert content.intervals is not None
    std = np.linalg.norm(K @ deviation, axis=2)
    expected = np.sqrt(np.mean(np.sum(std**2, axis=1)))
    assert content.intervals.torque_std == pytest.approx(expected)

    assert list(content.realistic) == [PRIOR, "B", TRUTH]
    assert set(content.realistic["B"]) == {metric.key for metric in REALISTIC_METRICS}
    assert content.realistic["B"]["torque_from_wrenches_rmse"] == pytest.approx(0.1 * load)

    (choice,) = content.truncations
    assert (choice.label, choice.chosen_by, choice.rank) == ("A", "itself", 3)
    assert choice.metrics == errors["A"]


def test_without_ground_truth_there_are_no_errors(parameters: ParameterSet) -> None:
    shown = ReportedResult(estimated(parameters, 1.1), parameters, np.eye(len(parameters)))
    content = compose({"A": shown}, chosen="A", metadata=METADATA)
    assert [(m.label, m.metrics) for m in content.methods] == [(PRIOR, None), ("A", None)]
    judged = (content.predictions, content.link_errors, content.intervals)
    assert judged == (None, None, None)
    assert (content.realistic, content.truncations) == ({}, ())


def test_results_may_differ_in_joint_terms(
    parameters: ParameterSet, ground_truth: GroundTruth
) -> None:
    rubbing = ParameterSet(parameters.model, ("viscous",))
    viscous = estimated(rubbing, 1.0)
    coefficient = 0.7
    values = viscous.value.copy()
    values[rubbing.inertial :] = coefficient
    content = compose(
        {
            "A": ReportedResult(estimated(parameters, 1.2), parameters),
            "B": ReportedResult(replace(viscous, value=values), rubbing),
        },
        chosen="A",
        metadata=METADATA,
        ground_truth=ground_truth,
    )
    errors = {method.label: method.metrics or {} for method in content.methods}
    assert errors["A"]["parameter_error_pct"] == pytest.approx(20)
    assert errors["B"]["parameter_error_pct"] == pytest.approx(0, abs=1e-9)
    velocity = ground_truth.motion.samples.velocity
    friction = coefficient * np.sqrt(np.mean(np.sum(velocity**2, axis=1)))
    assert errors["B"]["torque_rmse"] == pytest.approx(friction)


def test_results_of_other_robots_are_refused(parameters: ParameterSet) -> None:
    other = ParameterSet(random_robot(2, links=4))
    results = {
        "A": ReportedResult(estimated(other, 1.1), other),
        "B": ReportedResult(estimated(parameters, 1.1), parameters),
    }
    with pytest.raises(EstimateError, match=r"^A: its joints are not those of B") as caught:
        compose(results, chosen="B", metadata=METADATA)
    assert caught.value.code == "E512"


def test_the_truth_must_be_the_same_robot(
    parameters: ParameterSet, ground_truth: GroundTruth
) -> None:
    other = replace(ground_truth, model=random_robot(2, links=5))
    shown = ReportedResult(estimated(parameters, 1.0), parameters)
    with pytest.raises(EstimateError, match="true model of this robot"):
        compose({"A": shown}, chosen="A", metadata=METADATA, ground_truth=other)
