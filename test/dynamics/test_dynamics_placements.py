"""Derivatives by displaced joints: against Pinocchio and differences of the equation of motion."""

from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from random_robots import random_robot, random_samples

from symbid_ros.dynamics.placements import displaced, displacement_columns
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet

STEP = 1e-5


def slopes(model, residual):
    """Return central differences (N, n, J, 6) of a residual of displaced robots."""
    size = len(model.joints)
    columns = []
    for place in range(6 * size):
        screws = np.zeros(6 * size)
        screws[place] = STEP
        screws = screws.reshape(size, 6)
        ahead, behind = (residual(displaced(model, sign * screws)) for sign in (1, -1))
        columns.append((ahead - behind) / (2 * STEP))
    stacked = np.stack(columns, axis=-1)
    return stacked.reshape(*stacked.shape[:2], size, 6)


@pytest.mark.parametrize("seed", [0, 1, 3])
@pytest.mark.parametrize("floating", [True, False])
def test_columns_are_slopes_of_the_equation_of_motion(seed, floating):
    model = random_robot(seed, links=6, floating=floating, wrench_frames=3)
    samples = random_samples(model, 4, np.random.default_rng(seed))
    # One wrench acts on another link than that of its frame, as those of force plates may.
    first, second, third = samples.wrench_frames
    samples = replace(samples, wrench_frames=(first, f"{second}@link_4", third))
    phi = ParameterSet(model).values

    def residual(robot):
        rows = equation_of_motion(ParameterSet(robot), samples)
        return rows.y - rows.K @ phi

    columns = displacement_columns(model, model.phi[None], samples)
    assert np.abs(columns).max() > 10
    atol = 1e-7 * np.abs(columns).max()
    np.testing.assert_allclose(columns, slopes(model, residual), atol=atol)


def test_columns_are_slopes_of_pinocchios_inverse_dynamics():
    model = random_robot(2, links=7, floating=False, wrench_frames=0)
    samples = random_samples(model, 3, np.random.default_rng(5))

    def residual(robot):
        pin = pinocchio.buildModelFromXML(urdf_text(robot))
        data, order = pin.createData(), [pin.getJointId(name) for name in model.joint_names]
        q, v = ([getattr(pin.joints[one], f"idx_{of}") for one in order] for of in "qv")
        torques = []
        for k in range(len(samples)):
            motion = np.zeros((3, pin.nv))
            motion[0, q] = samples.position[k]
            motion[1:, v] = samples.velocity[k], samples.acceleration[k]
            torques.append(-pinocchio.rnea(pin, data, *motion)[v])
        return np.array(torques)

    columns = displacement_columns(model, model.phi[None], samples)
    atol = 1e-7 * np.abs(columns).max()
    np.testing.assert_allclose(columns, slopes(model, residual), atol=atol)
