"""Rows of robots with fewer sensors, compared with dense algebra and simulated truth."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from random_robots import CONFIG, random_robot, random_samples, with_drives

from symbid_ros.bags import bag_log
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import StudyError
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Processing, read_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.frames import Frame
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.weak_form import equation_rows, windowed_rows
from symbid_ros.study.sensor_subsets import Annihilator, SensorSubset, SubsetRows, observe_subset

PARTS = {"base_rows": slice(0, 6), "joint_rows": slice(6, 16)}


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"))


@pytest.fixture(scope="module")
def motion(simulated, symbitron):
    """True motion and forces of an ideal bag."""
    bag = simulated("smooth", moves=1, motion_seed=22, ideal=True)
    return read_true_motion([bag], symbitron.model).samples[::5]


@pytest.fixture(scope="module")
def record(simulated, symbitron):
    return read_dataset(
        bag_log([simulated("smooth", moves=3, motion_seed=21, noise_seed=5)]), symbitron
    )


def jacobian(model, samples):
    return contact_jacobian(model, samples.wrench_frames, link_poses(model, samples.position))


def driven_by(parameters, samples, values, rng):
    """Return the samples with random contact wrenches and efforts that cause their motion."""
    model = parameters.model
    needed = equation_of_motion(parameters, samples).K @ values
    contacts = jacobian(model, samples).transpose(0, 2, 1)
    wrenches = 30 * rng.normal(size=(len(samples), contacts.shape[2]))
    if model.floating:
        missing = needed[:, :6] - np.einsum("nij,nj->ni", contacts[:, :6], wrenches)
        wrenches += np.einsum("nij,nj->ni", np.linalg.pinv(contacts[:, :6]), missing)
    effort = (needed - np.einsum("nij,nj->ni", contacts, wrenches))[:, 6 * model.floating :]
    return replace(samples, wrenches=wrenches.reshape(len(samples), -1, 6), effort=effort)


def robot_on_contacts(kind, rng):
    """Return robots whose contact effects are independent, dependent, or partly zero."""
    if kind == "two feet":
        model = random_robot(3, links=12, wrench_frames=2)
    elif kind == "two frames on one link":
        model = random_robot(4, links=8, wrench_frames=2)
        first = next(frame for frame in model.frames if frame.name == "wrench_0")
        second = Frame("wrench_1", first.link, np.eye(3), rng.normal(size=3))
        others = tuple(frame for frame in model.frames if frame.name != "wrench_1")
        model = replace(model, frames=(*others, second))
    else:
        model = random_robot(5, links=8, floating=False, wrench_frames=1)
        second = Frame("wrench_1", 0, np.eye(3), np.zeros(3))
        model = replace(model, frames=(*model.frames, second))
    return ParameterSet(model)


@pytest.mark.parametrize("kind", ["two feet", "two frames on one link", "fixed base"])
def test_rows_without_plates_hold_for_any_contact_wrenches(kind):
    rng = np.random.default_rng(1)
    parameters = robot_on_contacts(kind, rng)
    model = parameters.model
    samples = driven_by(parameters, random_samples(model, 60, rng), parameters.values, rng)
    subset = SubsetRows.of(parameters, "no_plates", samples)
    rows = subset.at(samples).rows
    left = model.dof - np.linalg.matrix_rank(jacobian(model, samples)).max()
    assert rows.y.shape == (len(samples), left)
    assert 0 < left < model.dof
    scale = np.abs(rows.K * parameters.values).sum(axis=2).max()
    np.testing.assert_allclose(rows.K @ parameters.values, rows.y, atol=1e-11 * scale)
    assert np.abs(rows.K @ (1.1 * parameters.values) - rows.y).max() > 1e-3 * scale
    # The readings of the wrench sensors are ignored.
    other = replace(samples, wrenches=rng.normal(size=samples.wrenches.shape))
    np.testing.assert_array_equal(subset.at(other).rows.y, rows.y)
    through = subset.selection.at(samples.position) @ jacobian(model, samples).transpose(0, 2, 1)
    assert np.abs(through).max() < 1e-12 * np.abs(jacobian(model, samples)).max()


@pytest.mark.parametrize("sensors", get_args(SensorSubset))
def test_rows_hold_at_the_truth_of_an_ideal_bag(sensors, motion, symbitron):
    rows = SubsetRows.of(symbitron, sensors, motion).at(motion).rows
    expected = {"all": 16, "base_rows": 6, "joint_rows": 10, "no_plates": 4}
    assert rows.K.shape[1] == expected[sensors]
    assert np.abs(rows.K @ symbitron.values - rows.y).max() < 1e-6
    assert np.abs(rows.y).max() > 1


def test_all_rows_without_contact_wrenches_are_kept(motion, symbitron):
    model = symbitron.model
    annihilator = Annihilator.of(model, motion)
    # With legs in different planes, every wrench on the feet has an effect.
    apart = motion[:20].position + np.random.default_rng(2).normal(size=(20, len(model.joints)))
    contacts = jacobian(model, replace(motion[:20], position=apart))
    N = annihilator.at(apart)
    together = np.concatenate([N, contacts], axis=1)
    assert np.all(np.linalg.matrix_rank(N, rtol=1e-6) == 4)
    assert np.all(np.linalg.matrix_rank(together, rtol=1e-9) == model.dof)


def test_rows_are_smooth_where_the_contact_jacobian_loses_rank(motion, symbitron):
    model = symbitron.model
    annihilator = Annihilator.of(model, motion)
    # If both legs have equal angles in parallel planes, opposite moments on the feet load no joint.
    # Joints are ordered leg by leg.
    names = [joint.name for joint in model.joints]
    legs = motion.position.mean(axis=0).reshape(2, -1).mean(axis=0)
    upright = np.tile(legs, 2)
    upright[[index for index, name in enumerate(names) if name.endswith(("haa", "aie"))]] = 0.0
    contacts = jacobian(model, replace(motion[:1], position=upright[None]))
    assert np.linalg.matrix_rank(contacts[0], rtol=1e-9) == 11
    along, aside = np.random.default_rng(3).normal(size=(2, len(names)))

    def largest_step(count):
        time = np.linspace(-1, 1, count)[:, None]
        N = annihilator.at(upright + 1e-2 * (time * along + 1e-3 * aside))
        return np.abs(np.diff(N, axis=0)).max()

    assert largest_step(4001) < 0.6 * largest_step(2001) < 0.36 * largest_step(1001)


@pytest.mark.parametrize("sensors", PARTS)
def test_selected_rows_equal_the_equation_of_motion(sensors, motion, symbitron):
    part = PARTS[sensors]
    rows = SubsetRows.of(symbitron, sensors, motion)
    information = Observations.unwindowed(rows.layout, [rows.at(motion)], 1.0).rows
    every = equation_of_motion(symbitron, motion)
    names = symbitron.model.coordinates[part]
    assert information.layout.coordinates == names
    rng = np.random.default_rng(4)
    G = rng.normal(size=(len(names), len(names)))
    stacked = np.concatenate([every.K, every.y[:, :, None]], axis=2)[:, part]
    dense = (G @ stacked).reshape(-1, len(symbitron) + 1)
    factor = information.whitened(G)
    moment = dense.T @ dense
    np.testing.assert_allclose(factor.T @ factor, moment, atol=1e-10 * np.abs(moment).max())


@pytest.mark.parametrize("sensors", PARTS)
def test_selected_windows_equal_the_equation_of_motion(sensors, record, symbitron):
    segment, part = next(iter(record.segments)).cut(0, 4000), PARTS[sensors]
    build = SubsetRows.of(symbitron, sensors, record.samples).build
    every = windowed_rows(segment, equation_rows(symbitron), [0.161])
    some = windowed_rows(segment, build, [0.161])
    for (whole,), (chosen,) in zip(every, some, strict=True):
        np.testing.assert_array_equal(chosen.valid, whole.valid[:, part])
        for a, b in ((chosen.mean, whole.mean), (chosen.noise, whole.noise)):
            np.testing.assert_allclose(a.K, b.K[:, part], atol=1e-12)
            np.testing.assert_allclose(a.y, b.y[:, part], atol=1e-12)


def test_base_rows_ignore_efforts(motion, symbitron):
    rows = SubsetRows.of(symbitron, "base_rows", motion)
    other = replace(motion, effort=motion.effort + 1.0)
    np.testing.assert_array_equal(rows.at(other).rows.y, rows.at(motion).rows.y)


def test_every_subset_gains_information(record, simulated, symbitron):
    prior = draw_prior(symbitron, "percent", 25.0, 3)
    filtered = read_dataset(
        bag_log([simulated("smooth", moves=3, motion_seed=21, noise_seed=5)]),
        symbitron,
        Processing(LowPass(30.0)),
    )
    for log in (record, filtered):
        gains = {}
        for sensors in get_args(SensorSubset):
            observations = observe_subset(log, symbitron, sensors)
            assert [one.window for one in observations] == [one.window for one in log.observations]
            solved = SolvedProblem.of(Problem(observations, symbitron, prior))
            gains[sensors] = solved.posterior.gain(len(symbitron))
        assert min(gains.values()) > 20
        assert gains["all"] == max(gains.values())
    assert observe_subset(record, symbitron, "all") is record.observations


def test_estimates_without_plates_cover_the_truth(record, symbitron):
    observations = observe_subset(record, symbitron, "no_plates")
    distances = []
    for seed in range(4):
        prior = draw_prior(symbitron, "percent", 25.0, seed)
        found = SolvedProblem.of(Problem(observations, symbitron, prior)).posterior
        distances.append(found.factor @ (symbitron.values - found.mean))
    # Root mean square of 440 deviations; all draws share the noise of one log.
    assert 0.7 < np.sqrt(np.mean(np.square(distances))) < 1.3


def test_combinations_with_sticking_joints_are_invalid():
    rng = np.random.default_rng(6)
    model = with_drives(random_robot(3, links=12, wrench_frames=1), rng)
    parameters = ParameterSet(model, ("viscous", "coulomb", "armature"))
    samples = driven_by(parameters, random_samples(model, 40, rng), parameters.values, rng)
    samples.velocity[::2, 4] = 0.0
    for sensors, where in (("no_plates", slice(None)), ("joint_rows", 4)):
        valid = SubsetRows.of(parameters, sensors, samples).at(samples).valid
        assert not valid[::2, where].any()
    base = SubsetRows.of(parameters, "base_rows", samples).at(samples)
    assert base.valid.all()


def test_robot_without_remaining_rows_is_rejected(symbitron):
    fixed = ParameterSet(random_robot(1, floating=False))
    rng = np.random.default_rng(7)
    with pytest.raises(StudyError, match="base_rows: random has a fixed base; choose other"):
        SubsetRows.of(fixed, "base_rows", random_samples(fixed.model, 5, rng))
    frames = ("left_sole", "right_sole", "suspension")
    hung = random_samples(symbitron.model, 5, rng, frames)
    with pytest.raises(StudyError, match="left_sole, right_sole, suspension explain any motion"):
        SubsetRows.of(symbitron, "no_plates", hung)
    with pytest.raises(StudyError, match="no wrench topic"):
        SubsetRows.of(symbitron, "no_plates", random_samples(symbitron.model, 5, rng, ()))
    rigid = ParameterSet(random_robot(1, links=1))
    with pytest.raises(StudyError, match="joint_rows: random has no joint"):
        SubsetRows.of(rigid, "joint_rows", random_samples(rigid.model, 5, rng))
