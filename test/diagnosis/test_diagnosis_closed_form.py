"""Parts of the doctor that have a closed form: the nearest rotation, and what a log determines."""

import numpy as np
import pytest
from analytic_log import analytic_segment
from random_robots import random_robot, random_rotation
from scipy.spatial.transform import Rotation

from symbid_ros.choices import JOINT_TERMS
from symbid_ros.diagnosis.delay_checks import _attribute_to_joints, delay_finding
from symbid_ros.diagnosis.findings import ModelChecks
from symbid_ros.diagnosis.forces import _reference_gain
from symbid_ros.diagnosis.gain_problem import loads
from symbid_ros.diagnosis.model_checks import RESOLUTION, excitation
from symbid_ros.diagnosis.model_statistics import WINDOWS, ModelStatistics
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import equation_rows, windowed_rows

OVERLAP = 4 / 3  # of half-overlapped Hann windows


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_the_nearest_rotation_is_found(seed, sign) -> None:
    rng = np.random.default_rng(seed)
    rotation, scale, deviation = random_rotation(rng), rng.uniform(0.5, 2.0), 1e-3
    matrix = sign * scale * rotation + deviation * rng.normal(size=(3, 3))
    found = fit_rotation(matrix, deviation**2 * np.eye(9))
    # White noise: the polar factor is the nearest rotation (Kabsch), its scale the mean stretch.
    U, singular, Vt = np.linalg.svd(sign * matrix)
    assert found.sign == sign
    np.testing.assert_allclose(found.rotation, U @ Vt, atol=1e-6)
    assert found.scale == pytest.approx(singular.mean(), rel=1e-6)
    assert found.angle == pytest.approx(Rotation.from_matrix(U @ Vt).magnitude(), abs=1e-6)
    assert found.cost == pytest.approx(np.sum((singular - singular.mean()) ** 2) / deviation**2)
    straight = np.trace(matrix) / 3
    plain = np.sum((max(straight, 1e-3) * np.eye(3) - matrix) ** 2) / deviation**2
    assert found.plain == pytest.approx(plain)


@pytest.mark.parametrize("floating", [True, False])
def test_what_is_determined_has_lost_half_of_its_variance(floating) -> None:
    model = random_robot(4, links=4, floating=floating, wrench_frames=1)
    segment = analytic_segment(ParameterSet(model), 4.0, 4, rate=100.0)
    watch = ModelStatistics(model, segment.wrench_frames, segment.imu_frames)
    watch.add(segment)
    # Joints of an arm count while they slip, like those with dry friction.
    build = equation_rows(ParameterSet(model, () if floating else ("coulomb",)))
    rows = [part.mean.K for (part,) in windowed_rows(segment, build, WINDOWS[:1], ())]
    K = np.concatenate(rows)[:, :, : len(watch.prior.std)]
    scale = loads(watch.rows, watch.problem.expected)
    std = watch.prior.std
    counts = []
    for share in np.geomspace(1e-3, 1.0, 12):
        left = (share * scale) ** 2
        variance = OVERLAP * (left + (RESOLUTION * scale) ** 2)
        told = np.einsum("Nip,Niq,i->pq", K, K, 1 / variance) * np.outer(std, std)
        rest = len(K) * np.einsum("ip,iq,i->pq", K.mean(0), K.mean(0), 1 / variance)
        found = excitation(watch, left)
        for count, information in (
            (found.determined, told),
            (found.at_rest, rest * np.outer(std, std)),
        ):
            # The variances that data of this information leave of a prior's.
            assert count == np.sum(1 / (1 + np.linalg.eigvalsh(information)) < 0.5)
        gain = np.linalg.slogdet(np.eye(len(std)) + told)[1] / 2 / np.log(2)
        assert found.gain == pytest.approx(gain, rel=1e-6)
        counts.append(found.determined)
    assert counts == sorted(counts, reverse=True)
    assert len(set(counts)) > 5


def fits(*scales: float) -> dict[int, RotationFit]:
    return {i: RotationFit(1, np.eye(3), 0.0, scale, 0.0, 0.0) for i, scale in enumerate(scales)}


def test_the_reference_gain_depends_on_the_ratio_of_wrenches_to_efforts() -> None:
    efforts = dict.fromkeys("abc", (1.2, 0.01))
    # Alike: the median of all. In another unit: whichever is closer to the model.
    assert _reference_gain(fits(1.5, 1.5, 1.5, 1.5), efforts) == 1.5
    assert _reference_gain(fits(1000.0, 1000.0), efforts) == 1.2


@pytest.mark.parametrize(
    ("late", "blamed"),
    [
        ({"/imu": -20.0, "/wrench": -21.0}, {"/joints"}),
        ({"/joints": 20.0, "/wrench": -21.0}, {"/joints"}),
        ({"/imu": -20.0, "/wrench": -50.0}, {"/imu", "/wrench"}),
        ({"/imu": -20.0}, {"/imu"}),
    ],
)
def test_streams_that_are_all_early_alike_mean_late_joint_states(late, blamed) -> None:
    checks = ModelChecks()
    for topic, delay in late.items():
        checks.findings += delay_finding(topic, 1e-3 * delay, 1e-4, "the others")
    _attribute_to_joints(checks, "/joints", {"/imu", "/wrench"})
    assert {finding.stream for finding in checks.findings} == blamed


def test_drives_have_a_prior_that_is_a_share_of_their_joints_load() -> None:
    """Whatever the size of a column: a regressor of tiny velocities gives a wide prior."""
    model = random_robot(4, links=4, wrench_frames=1)
    segment = analytic_segment(ParameterSet(model), 4.0, 4, rate=100.0)
    statistics = ModelStatistics(model, segment.wrench_frames, segment.imu_frames)
    statistics.add(segment)
    problem, parameters = statistics.problem, statistics.parameters
    load = loads(problem.rows, problem.expected)[6:]
    for term, columns in parameters.term_columns.items():
        for joint, column in enumerate(range(columns.start, columns.stop)):
            size = np.sqrt(problem.rows.column_squares(6 + joint, column))
            if size > 0:
                share = problem.std[column] * size / load[joint]
                assert share == pytest.approx(JOINT_TERMS[term].load_share, rel=1e-3)
