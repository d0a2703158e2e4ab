"""Parts of the doctor that have a closed form: the nearest rotation, and what a log determines."""

import numpy as np
import pytest
from analytic_log import analytic_segment
from random_robots import random_robot, random_rotation
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.gains import loads
from symbid_ros.diagnosis.model_checks import RESOLUTION, excitation
from symbid_ros.diagnosis.model_statistics import WINDOWS, ModelStatistics
from symbid_ros.diagnosis.rotation_fit import fit_rotation
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
    rows = [
        part.mean.K
        for (part,) in windowed_rows(segment, equation_rows(ParameterSet(model)), WINDOWS[:1], ())
    ]
    K = np.concatenate(rows)
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
