"""A model with replaced inertias agrees with a compiled model and with the regressor."""

import mujoco
import numpy as np
import pytest

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import (
    centroidal,
    com_position,
    equation_of_motion,
    momentum_regressor,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import SimulationError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller_model import ControllerModel, replace_inertias
from symbid_ros.simulation.plant import RobotFailureError, State
from symbid_ros.simulation.scenario import SOLES

ROBOT = config_file("symbitron.xml")
PARAMETERS = ParameterSet(load_model(ROBOT))


@pytest.fixture(scope="module")
def plant_model():
    return mujoco.MjModel.from_xml_path(str(ROBOT))


@pytest.fixture
def state(plant_model):
    random = np.random.default_rng(8)
    position = plant_model.key("standing").qpos.copy()
    mujoco.mj_integratePos(plant_model, position, 0.4 * random.standard_normal(plant_model.nv), 1.0)
    return State(0.25, position, random.standard_normal(plant_model.nv))


def by_link(values):
    return dict(zip(PARAMETERS.link_names, PARAMETERS.link_phi(values), strict=True))


@pytest.fixture
def impossible():
    """Parameters with a negative foot mass and an indefinite shank inertia."""
    values = PARAMETERS.values.copy()
    phi = by_link(values)  # views
    phi["R_foot"][:4] *= -0.2
    phi["L_shank"][[5, 8]] = 0.06
    assert not any(is_consistent(phi[name]) for name in ("R_foot", "L_shank"))
    return values


def smooth_dynamics(model, state):
    """Mass matrix, bias force, centre of mass, its velocity, angular momentum, frames."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.position, state.velocity
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_subtreeVel(model, data)
    mass_matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass_matrix)
    base = model.jnt_bodyid[0]
    return {
        "mass matrix": mass_matrix,
        "bias": data.qfrc_bias,
        "com": data.subtree_com[base],
        "com velocity": data.subtree_linvel[base],
        "momentum": data.subtree_angmom[base],
        "sites": data.site_xpos,
        "geoms": data.geom_xpos,
    }


@pytest.mark.parametrize("seed", range(3))
def test_replaced_inertias_move_like_compiled_ones(plant_model, state, seed):
    values = draw_prior(PARAMETERS, "consistent", 40, seed).mean
    text = mjcf_text(PARAMETERS.apply(values), ROBOT, ROBOT.parent)
    replaced = smooth_dynamics(replace_inertias(plant_model, by_link(values)), state)
    for name, expected in smooth_dynamics(mujoco.MjModel.from_xml_string(text), state).items():
        np.testing.assert_allclose(replaced[name], expected, rtol=1e-9, atol=1e-9, err_msg=name)


def regressor_samples(state, velocity, acceleration):
    """Samples at one posture; motion (N, nv) as in MuJoCo except for base axes."""
    count = len(acceleration)
    return Samples(
        stamp=np.arange(count),
        position=np.tile(state.position[7:], (count, 1)),
        velocity=velocity[:, 6:],
        acceleration=acceleration[:, 6:],
        effort=np.zeros((count, len(state.position) - 7)),
        base_angular_velocity=velocity[:, 3:6],
        base_angular_acceleration=acceleration[:, 3:6],
        base_specific_force=acceleration[:, :3],
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )


def base_rotation(state):
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, state.position[3:7])
    return rotation.reshape(3, 3)


def test_mass_matrix_of_impossible_inertias_matches_the_regressor(plant_model, state, impossible):
    units = np.eye(plant_model.nv)
    units[:3, :3] = base_rotation(state)  # unit accelerations in the world, in base axes
    K = equation_of_motion(PARAMETERS, regressor_samples(state, np.zeros_like(units), units)).K
    moment, force, joints = np.split(K @ impossible, [3, 6], axis=1)
    expected = np.hstack([force @ base_rotation(state).T, moment, joints])
    model = replace_inertias(plant_model, by_link(impossible))
    mass_matrix = smooth_dynamics(model, state)["mass matrix"]
    np.testing.assert_allclose(mass_matrix, expected, rtol=1e-9, atol=1e-11)


def test_momentum_of_impossible_inertias_matches_the_regressor(plant_model, state, impossible):
    dynamics = ControllerModel(replace_inertias(plant_model, by_link(impossible)), SOLES)
    dynamics.update(state)
    to_world = base_rotation(state)
    velocity = state.velocity[None]
    samples = regressor_samples(state, velocity, np.zeros_like(velocity))
    poses = link_poses(PARAMETERS.model, samples.position)
    com = com_position(PARAMETERS, impossible, poses)
    momentum = (
        momentum_regressor(PARAMETERS, samples, velocity[:, :3] @ to_world, poses) @ impossible
    )
    angular, linear = np.split(centroidal(momentum, com)[0], 2)
    np.testing.assert_allclose(dynamics.com, state.position[:3] + to_world @ com[0], atol=1e-12)
    np.testing.assert_allclose(dynamics.com_velocity, to_world @ linear / dynamics.mass, atol=1e-12)
    np.testing.assert_allclose(dynamics.angular_momentum, to_world @ angular, atol=1e-12)


def test_indefinite_mass_matrix_raises_an_error(plant_model, state, capfd):
    foot = -by_link(PARAMETERS.values)["R_foot"]
    dynamics = ControllerModel(replace_inertias(plant_model, {"R_foot": foot}), SOLES)
    with pytest.raises(RobotFailureError, match=r"mass matrix .* at 0\.250 s; give") as caught:
        dynamics.update(state)
    assert caught.value.time == state.time
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")  # MuJoCo does not warn either


def test_plant_and_other_bodies_keep_their_inertias(plant_model):
    before = plant_model.body_inertia.copy()
    phi = by_link(PARAMETERS.values)["R_foot"]
    model = replace_inertias(plant_model, {"R_foot": 2.0 * phi})
    np.testing.assert_array_equal(plant_model.body_inertia, before)
    foot = plant_model.body("R_foot").id
    ratio = model.body_mass[1:] / plant_model.body_mass[1:]
    np.testing.assert_allclose(ratio, np.where(np.arange(1, model.nbody) == foot, 2.0, 1.0))
    assert model.body_subtreemass[1] == pytest.approx(41.05 + phi[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tail": np.ones(10)}, "no body tail"),
        ({"R_foot": np.array([0.0, 0.1, *np.zeros(8)])}, "body R_foot has mass 0 kg"),
        ({"R_foot": np.full(10, np.nan)}, "body R_foot has mass nan kg"),
        ({name: np.zeros(10) for name in PARAMETERS.link_names}, "sum to 0 kg"),
    ],
)
def test_inertias_without_centre_of_mass_raise_an_error(plant_model, change, message):
    with pytest.raises(SimulationError, match=message) as caught:
        replace_inertias(plant_model, change)
    assert "\n" not in str(caught.value)
