"""The verdict: its numbers against dense algebra, its alarms on either side of their thresholds."""

from dataclasses import replace

import numpy as np
import pytest
from gaussian_logs import gaussian_log, prior_of
from random_robots import random_samples
from scipy.linalg import eigh

from symbid_ros.choices import TERMS
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.alarms import (
    SUSPICIOUS_NOISE,
    SUSPICIOUS_SCALE,
    SUSPICIOUS_WHITENESS,
    Alarm,
    alarms,
)
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.truncated_svd import informative_rank
from symbid_ros.estimation.unexplained import SMALL, UnexplainedForce
from symbid_ros.estimation.verdict import assess


class Judged:
    """A posterior, its covariances in dense form, and the verdict on another value."""

    def __init__(self, seed, **options):
        self.log = gaussian_log(seed, count=120, **options)
        self.parameters = self.log.parameters
        self.prior = prior_of(self.log, seed, related=True)
        self.posterior = posterior(self.log.observations(), self.prior)
        L0, L = self.prior.covariance_factor(), self.posterior.deviation_factor
        self.before, self.after = L0 @ L0.T, L @ L.T
        self.value = self.posterior.mean + 0.1 * self.posterior.std
        self.verdict = assess(
            self.posterior, self.value, self.parameters, window=0.081, whiteness=1.0
        )

    @property
    def told(self):
        """Information of the data (p,) per direction, in the prior's."""
        unit = np.outer(self.prior.std, self.prior.std)
        return 1 / eigh(self.after / unit, self.before / unit, eigvals_only=True) - 1


@pytest.fixture(scope="module", params=[{}, {"floating": False, "terms": TERMS}])
def judged(request):
    return Judged(1, **request.param)


def test_base_parameters_carry_all_forces_with_their_covariance(judged):
    """Forces of any motion, from the base parameters alone and from all parameters."""
    parameters, verdict = judged.parameters, judged.verdict
    model = parameters.model
    samples = random_samples(model, 60, np.random.default_rng(0), ())
    # Joints reverse in too few of them for the friction about a reversal to show.
    reversing = np.random.default_rng(1).uniform(-1, 1, (2, *samples.velocity.shape))
    samples = replace(samples, leading=np.sign(reversing[0]), creeping=reversing[1])
    K = equation_of_motion(parameters, samples).K.reshape(-1, len(parameters))
    leads = [quantity.name.split(" ")[0] for quantity in verdict.base]
    columns = [parameters.names.index(name) for name in leads]
    effect = np.linalg.norm(K, axis=0)
    rank = np.linalg.matrix_rank(K[:, effect > 1e-8] / effect[effect > 1e-8], tol=1e-8)
    assert len(verdict.base) == rank
    force = K @ judged.value
    values = np.array([quantity.value for quantity in verdict.base])
    np.testing.assert_allclose(K[:, columns] @ values, force, atol=1e-8 * np.abs(force).max())
    # K = K_lead B, so B, with the dense covariance between, gives each deviation.
    B = np.linalg.lstsq(K[:, columns], K)[0]
    after = np.sqrt(np.einsum("ia,ab,ib->i", B, judged.after, B))
    before = np.sqrt(np.einsum("ia,ab,ib->i", B, judged.before, B))
    np.testing.assert_allclose([each.std for each in verdict.base], after, rtol=1e-6)
    np.testing.assert_array_equal(
        [each.determined for each in verdict.base], after < DETERMINED * before
    )
    units = dict(zip(parameters.names, parameters.units, strict=True))
    assert [each.unit for each in verdict.base] == [units[name] for name in leads]


def test_counts_and_gains_are_those_of_dense_covariances(judged):
    told, verdict = judged.told, judged.verdict
    assert len(verdict.directions) == np.sum(1 / (1 + told) < DETERMINED**2)
    assert 0 < len(verdict.directions) < len(told)
    assert verdict.effective == pytest.approx(np.sum(told / (1 + told)), rel=1e-6)
    assert verdict.gain == pytest.approx(np.sum(np.log2(1 + told)) / 2, rel=1e-6)
    assert list(verdict.link_gain) == list(judged.parameters.link_names)
    for index, gain in enumerate(verdict.link_gain.values()):
        own = slice(10 * index, 10 * index + 10)
        unit = np.outer(judged.prior.std[own], judged.prior.std[own])
        volumes = [np.linalg.slogdet(P[own, own] / unit)[1] for P in (judged.before, judged.after)]
        assert gain == pytest.approx((volumes[0] - volumes[1]) / 2 / np.log(2), abs=1e-6)


def test_the_rank_without_validation_is_the_number_of_determined_directions(judged):
    expected = int(np.sum(judged.told > 1))
    count = len(judged.parameters)
    assert informative_rank(judged.posterior, count) == expected
    assert informative_rank(judged.posterior, 3) == 3
    with pytest.raises(EstimateError, match="excites no parameter"):
        informative_rank(judged.posterior, 0)


def test_a_rank_is_never_less_than_one():
    log = gaussian_log(2, count=120)
    prior = prior_of(log, 2)
    faint = replace(log, K=1e-9 * log.K)
    assert informative_rank(posterior(faint.observations(), prior), 10) == 1


def test_sensor_errors_are_separate_from_the_robots_parameters():
    log = gaussian_log(3, count=120)
    count, (n, p) = 2, log.K.shape[1:]
    rng = np.random.default_rng(3)
    names, units = ("plate/offset", "plate/unseen"), ("N", "1")
    seen = np.zeros((n, count), dtype=bool)
    seen[:, 0] = True
    columns = np.zeros((len(log), n, count))
    columns[:, :, 0] = rng.normal(size=(len(log), n))
    extended = replace(
        log,
        layout=log.layout.extended(names, np.ones_like(seen)),
        K=np.concatenate([log.K, columns], axis=2),
        noise_rows=np.zeros((len(log), n, p + count)),
        y=log.y + 2.0 * columns[:, :, 0],
    )
    prior = prior_of(log, 3).extended(names, np.zeros(2), np.array([5.0, 3.0]))
    found = posterior(extended.observations(), prior, count=p)
    verdict = assess(
        found, found.mean, log.parameters, window=0.321, whiteness=1.0, sensors=(names, units)
    )
    offset, unseen = verdict.sensors
    assert [each.name for each in verdict.sensors] == list(names)
    assert [each.unit for each in verdict.sensors] == list(units)
    assert offset.determined
    assert abs(offset.value - 2) < 4 * offset.std
    assert offset.std == pytest.approx(found.std[p])
    assert not unseen.determined
    assert (unseen.value, unseen.std) == pytest.approx((0, 3))
    assert list(verdict.link_gain) == list(log.parameters.link_names)
    # The robot's covariance is the marginal one: not knowing the sensor costs information.
    alone = posterior(log.observations(), prior_of(log, 3))
    told = assess(alone, alone.mean, log.parameters, window=0.321, whiteness=1.0)
    assert verdict.gain < told.gain


def alarms_of(judged, *, whiteness=1.0, unexplained=(), **changes):
    doubtful = replace(judged.posterior, **changes)
    return alarms(
        doubtful,
        judged.value,
        len(judged.parameters),
        whiteness=whiteness,
        unexplained=unexplained,
    )


def test_alarms_are_raised_only_beyond_their_thresholds(judged):
    below, above = 1 - 1e-6, 1 + 1e-6
    calm = {"prior_scale": 1.0, "noise_share": 0.0}
    assert alarms_of(judged, **calm) == ()
    assert alarms_of(judged, **calm | {"prior_scale": below * SUSPICIOUS_SCALE}) == ()
    (scale,) = alarms_of(judged, **calm | {"prior_scale": above * SUSPICIOUS_SCALE})
    assert "2.0 times wider" in scale
    assert alarms_of(judged, whiteness=below * SUSPICIOUS_WHITENESS, **calm) == ()
    (white,) = alarms_of(judged, whiteness=above * SUSPICIOUS_WHITENESS, **calm)
    assert f"whiteness {SUSPICIOUS_WHITENESS:.1f}" in white
    assert "record a bag" in white
    small, large = (UnexplainedForce("knee", "Nm", 4.0, 80.0, share * SMALL) for share in (0.9, 5))
    assert alarms_of(judged, whiteness=2.0, unexplained=(small,), **calm) == ()
    (sized,) = alarms_of(judged, whiteness=2.0, unexplained=(large, small), **calm)
    assert sized.startswith("4 Nm of 80 Nm unexplained on knee: ")
    assert alarms_of(judged, **calm | {"noise_share": below * SUSPICIOUS_NOISE}) == ()
    (noise,) = alarms_of(judged, **calm | {"noise_share": above * SUSPICIOUS_NOISE})
    assert "50 %" in noise
    assert alarms_of(judged, **calm | {"prior_scale": 1e-2}) == ()
    everything = alarms_of(judged, whiteness=9.0, prior_scale=9.0, noise_share=0.9)
    assert len(everything) == 3
    assert not any("\n" in alarm for alarm in everything)


def test_one_window_alone_raises_no_alarm_of_whiteness(judged):
    assert alarms_of(judged, whiteness=0.0, prior_scale=1.0, noise_share=0.0) == ()


def test_only_a_robot_that_contradicts_its_prior_raises_an_alarm():
    for seed in range(3):
        log = gaussian_log(seed, count=400)
        prior = prior_of(log, seed)
        other = 6.0 * prior.std * np.random.default_rng(seed).normal(size=len(prior.std))
        found = [
            posterior(replace(log, y=log.y + log.K @ change).observations(), prior)
            for change in (0.0 * other, other)
        ]
        like, unlike = (
            alarms(each, each.mean, len(log.parameters), whiteness=1.0) for each in found
        )
        assert like == ()
        assert len(unlike) == 1


def test_an_estimate_that_the_data_did_not_change_raises_an_alarm(judged):
    """As of a log in which hardly a row is usable."""
    assert alarms_of(judged, prior_scale=1.0, noise_share=0.0) == ()
    alone = np.linalg.inv(judged.prior.covariance_factor())
    unmoved = replace(
        judged.posterior, mean=judged.prior.mean, factor=alone, excess_score=None, other_models=None
    )
    verdict = assess(unmoved, judged.prior.mean, judged.parameters, window=0.081, whiteness=1.0)
    assert verdict.directions == ()
    found = alarms(unmoved, judged.prior.mean, len(judged.parameters), whiteness=1.0)
    assert Alarm.NOTHING in found[0]
