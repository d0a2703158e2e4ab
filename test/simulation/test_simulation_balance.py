"""Closed-loop balance of the true robot with errors in the controller's model."""

import mujoco
import numpy as np
import pytest
import scipy.linalg

from symbid_ros.errors import SimulationError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.balance import balance
from symbid_ros.simulation.controller import BalanceGains
from symbid_ros.simulation.scenario import SOLES

ROBOT = config_file("symbitron.xml")
PARAMETERS = ParameterSet(load_model(ROBOT))
LINKS = PARAMETERS.link_names


def by_link(values):
    return dict(zip(LINKS, PARAMETERS.link_phi(values).copy(), strict=True))


def run(inertias):
    return balance(inertias, moves=1, motion_seed=0)


@pytest.fixture(scope="module")
def truth():
    return run(None)


def test_true_model_tracks_its_reference(truth):
    assert truth.failed_at is None
    assert truth.failure == ""
    assert truth.com_rmse_mm < 4.0
    assert 0.8 < truth.feed_forward_share < 1.0
    assert np.linalg.norm(truth.com_bias_mm) < truth.com_rmse_mm


def test_true_model_tracks_better_than_priors_with_less_feedback(truth):
    drawn = [
        draw_prior(PARAMETERS, "percent", 25, seed).mean for seed in (7, 8, 9)
    ]  # the robot stands with these
    priors = [run(by_link(values)) for values in drawn]
    assert [prior.failure for prior in priors] == ["", "", ""]
    assert truth.com_rmse_mm < 0.5 * min(prior.com_rmse_mm for prior in priors)
    # On average: errors that make the robot stand lower need more torque from any model.
    shares = [prior.feed_forward_share for prior in priors]
    assert truth.feed_forward_share > np.mean(shares) + 0.01


class Statics:
    """The standing robot with some heavier links, compiled by MuJoCo."""

    def __init__(self, heavier):
        spec = mujoco.MjSpec.from_file(str(ROBOT))
        for body in spec.bodies:
            factor = heavier.get(body.name, 1.0)
            body.mass *= factor
            body.fullinertia = factor * np.array(body.fullinertia)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("standing").id)
        mujoco.mj_forward(model, data)
        self.inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, self.inertia)
        self.gravity = data.qfrc_bias.copy()
        self.com = data.subtree_com[1].copy()
        self.com_jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSubtreeCom(model, data, self.com_jacobian, 1)
        soles = np.zeros((len(SOLES), 6, model.nv))
        for sole, jacobian in zip(SOLES, soles, strict=True):
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site(sole).id)
        self.free = scipy.linalg.null_space(soles.reshape(-1, model.nv))


def static_bias(heavier):
    """Offset of the true robot at rest from the reference, m.

    Along the motions N that leave the soles in place the drives hold the true robot up,
    Nᵀτ = Nᵀg, while the controller believes to accelerate its own: NᵀM̂N z̈ = Nᵀ(τ - ĝ). It
    commands such an acceleration of the centre of mass, J N z̈ = -k e, where what it believes to
    be the centre of mass is off by e; the true one is off by the difference of the two besides.
    """
    true, believed = Statics({}), Statics(heavier)
    N = true.free
    acceleration = N @ np.linalg.solve(
        N.T @ believed.inertia @ N, N.T @ (true.gravity - believed.gravity)
    )
    error = -believed.com_jacobian @ acceleration / BalanceGains().com_stiffness
    return error - (believed.com - true.com)


@pytest.mark.parametrize("links", [LINKS, ("R_thigh",), ("base_link",)], ids=len)
def test_overestimated_mass_shifts_the_robot_as_statics_predict(truth, links):
    heavier = dict.fromkeys(links, 1.1)
    phi = {name: heavier.get(name, 1.0) * phi for name, phi in by_link(PARAMETERS.values).items()}
    bias = np.array(run(phi).com_bias_mm) - truth.com_bias_mm
    expected = 1e3 * static_bias(heavier)
    assert np.linalg.norm(expected) > 4.0
    assert np.linalg.norm(bias - expected) < 0.2 * np.linalg.norm(expected)


def test_robot_can_stand_with_an_impossible_link_in_the_model(truth):
    foot = by_link(PARAMETERS.values)["R_foot"]
    foot[:4] *= -0.1
    result = run({"R_foot": foot})
    assert result.failure == ""
    assert truth.com_rmse_mm < result.com_rmse_mm < 20.0


@pytest.mark.parametrize("links", [("R_foot",), ("base_link", "R_thigh", "L_thigh")])
def test_indefinite_mass_matrix_is_reported(truth, links):
    result = run({name: -phi for name, phi in by_link(PARAMETERS.values).items() if name in links})
    assert result.failure == "the mass matrix of the controller's model is not positive definite"
    assert result.failed_at == -1.0
    assert np.isnan([result.com_rmse_mm, *result.com_bias_mm, result.feed_forward_share]).all()
    assert result.duration == truth.duration


def test_end_stop_is_reported_each_time_alike(truth):
    inertias = by_link(draw_prior(PARAMETERS, "percent", 25, 0).mean)
    result, again = run(inertias), run(inertias)
    assert (again.failure, again.failed_at) == (result.failure, result.failed_at)
    assert result.failure == "joint R_kfe ran into its end stop"
    assert -1.0 < result.failed_at < 0.0  # the legs extend while the robot settles
    assert np.isnan(result.com_rmse_mm)
    assert result.duration == truth.duration


@pytest.mark.parametrize(
    ("options", "message"),
    [({"motion_seed": -1}, "motion seed -1"), ({"moves": 0}, "0 moves")],
)
def test_invalid_options_raise_an_error(options, message):
    with pytest.raises(SimulationError, match=message):
        balance(None, **{"moves": 1, "motion_seed": 0} | options)
