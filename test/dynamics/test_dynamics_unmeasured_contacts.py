"""Combined rows of the equation of motion that no unmeasured contact wrench enters."""

from dataclasses import replace

import numpy as np
import pytest
from quadruped_log import FEET, quadruped_urdf

from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion, equation_residual
from symbid_ros.dynamics.unmeasured_contacts import (
    variance_of_all_rows,
    with_all_rows,
    with_contacts,
    without_contacts,
)
from symbid_ros.errors import ModelError
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sampled_rows import CombinedCoordinates, sampled_rows
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.weak_form import equation_rows, windowed_rows

POINTS = tuple(f"{foot}:point" for foot in FEET)


@pytest.fixture(scope="module")
def quadruped(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return load_model(path)


@pytest.mark.parametrize("contacts", [POINTS, POINTS[:2], FEET[:2], (FEET[0], "LF_HAA_link:point")])
def test_no_wrench_at_a_contact_enters_the_rows(quadruped, contacts):
    model = with_contacts(quadruped, contacts)
    frames = tuple(name.partition(":")[0] for name in contacts)
    rng = np.random.default_rng(1)
    motion = random_motions(quadruped, 30)
    wrenches = 100 * rng.normal(size=(30, len(frames), 6))
    wrenches[:, [name.endswith(":point") for name in contacts], :3] = 0.0
    touched = replace(motion, wrenches=wrenches, wrench_frames=frames)
    parameters = ParameterSet(model)
    with_load, without = (equation_of_motion(parameters, one) for one in (touched, motion))
    size = np.abs(equation_of_motion(ParameterSet(quadruped), touched).y).max()
    np.testing.assert_allclose(with_load.y, without.y, atol=1e-9 * size)
    np.testing.assert_array_equal(with_load.K, without.K)
    # As many rows are left as there are directions without contact.
    components = sum(3 if name.endswith(":point") else 6 for name in contacts)
    left = model.contacts.coordinates
    assert len(left) >= model.dof - components
    assert np.linalg.matrix_rank(without.K[:, left].reshape(len(left) * 30, -1)) > len(left)


@pytest.mark.parametrize("flagged", [False, True])
def test_all_rows_are_the_parts_that_no_wrench_balances(quadruped, flagged):
    """They are projections: nothing changes if they are projected again, but by the damping."""
    model = with_contacts(quadruped, POINTS)
    every = with_all_rows(model)
    motion = random_motions(quadruped, 20)
    touching = np.ones((20, 4), dtype=bool)
    if flagged:
        touching[10:, 2:] = False
        motion = replace(motion, touching=touching)
    few, all_ = (equation_of_motion(ParameterSet(one), motion).K for one in (model, every))
    # The few are orthonormal combinations of these, so that squares of errors are the same.
    squares, of_few = (np.einsum("tij,tik->tjk", one, one) for one in (all_, few))
    np.testing.assert_allclose(of_few, squares, atol=1e-9 * squares.max())
    whole = equation_of_motion(ParameterSet(quadruped), replace(motion, touching=None)).K
    J = contact_jacobian(quadruped, FEET, link_poses(quadruped, motion.position))
    for index in range(20):
        forces = [6 * foot + axis for foot in np.flatnonzero(touching[index]) for axis in (3, 4, 5)]
        P = np.eye(quadruped.dof) - np.linalg.pinv(J[index, forces]) @ J[index, forces]
        np.testing.assert_allclose(all_[index], P @ whole[index], atol=1e-3 * np.abs(whole).max())


@pytest.mark.parametrize("lifted", [(), (1,), (0, 3)])
def test_the_variance_of_all_rows_is_that_of_projected_efforts(quadruped, lifted):
    """Efforts with covariance Σ have projections with covariance P Σ P."""
    model = with_contacts(quadruped, POINTS)
    touching = np.ones((5, 4), dtype=bool)
    touching[:, lifted] = False
    motion = replace(random_motions(quadruped, 5), touching=touching)
    factor = np.random.default_rng(2).normal(size=(quadruped.dof, quadruped.dof))
    rows = without_contacts(model, motion, np.tile(factor, (5, 1, 1)))
    J = contact_jacobian(quadruped, FEET, link_poses(quadruped, motion.position))
    active = [6 * foot + axis for foot in range(4) if foot not in lifted for axis in (3, 4, 5)]
    for index in range(5):
        covariance = rows[index] @ rows[index].T
        std = np.sqrt(covariance.diagonal())
        size = np.outer(std, std)
        correlation = np.divide(covariance, size, out=np.eye(model.dof), where=size > 0)
        found = variance_of_all_rows(with_all_rows(model), motion, std**2, correlation)[index]
        P = np.eye(quadruped.dof) - np.linalg.pinv(J[index, active]) @ J[index, active]
        expected = np.sum((P @ factor) ** 2, axis=1)
        np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-3 * expected.max())


def test_the_variance_is_unknown_where_an_unknown_row_enters(quadruped):
    """Of a leg that swings, the rows are its own."""
    model = with_contacts(quadruped, POINTS)
    touching = np.tile([False, True, True, True], (5, 1))
    motion = replace(random_motions(quadruped, 5), touching=touching)
    leg = [quadruped.coordinates.index(f"LF_{name}") for name in ("HAA", "HFE", "KFE")]
    others = np.setdiff1d(np.arange(quadruped.dof), leg)
    every = with_all_rows(model)
    for unknown, known in ((leg, others), (others, leg)):
        variance = np.ones(quadruped.dof)
        variance[unknown] = np.nan
        found = variance_of_all_rows(every, motion, variance, np.eye(quadruped.dof))
        assert np.isinf(found[:, unknown]).all()
        assert np.isfinite(found[:, known]).all()
    np.testing.assert_allclose(found[:, leg], 1.0)


@pytest.mark.parametrize("terms", [("viscous", "coulomb"), ("load", "offset")])
def test_residuals_without_the_regressor_are_those_of_the_rows(quadruped, terms):
    motion = random_motions(quadruped, 12)
    motion.effort[4:8, 2] = np.nan
    touching = np.ones((12, 4), dtype=bool)
    touching[6:, 1] = False
    motion = replace(motion, touching=touching)
    parameters = ParameterSet(with_contacts(quadruped, POINTS), terms)
    phi = np.random.default_rng(3).normal(size=len(parameters))
    rows = equation_of_motion(parameters, motion)
    expected = rows.y - rows.K @ phi
    assert np.isnan(expected).any()
    size = np.nanmax(np.abs(expected))
    found = equation_residual(parameters, motion, phi)
    np.testing.assert_allclose(found, expected, atol=1e-9 * size)


def test_a_missing_effort_or_a_sticking_joint_spoils_only_combinations_that_contain_it(quadruped):
    two = with_contacts(quadruped, POINTS[:2])
    parameters = ParameterSet(two)
    motion = random_motions(quadruped, 10)
    effort = np.zeros((10, 12))
    effort[:3, 0] = np.nan  # a joint of a leg that touches
    effort[5:, 8] = np.nan  # a joint of a leg in the air
    rows = sampled_rows(parameters, replace(motion, effort=effort))
    first = 6 + 6  # the legs in the air
    kept = two.contacts.coordinates
    touching = kept[kept < first]
    assert set(range(first, 18)) <= set(kept.tolist())
    assert not rows.valid[:3, touching].any()
    assert rows.valid[3:, touching].all()
    assert rows.valid[:5, first:].all()
    assert not rows.valid[5:, 6 + 8].any()
    assert rows.valid[5:, 6 + 9].all()
    assert not rows.valid[:, np.setdiff1d(np.arange(18), kept)].any()


def test_a_leg_that_swings_keeps_its_rows(quadruped):
    model = with_contacts(quadruped, POINTS)
    parameters = ParameterSet(model)
    rng = np.random.default_rng(2)
    motion = random_motions(quadruped, 40)
    touching = rng.random((40, len(FEET))) < 0.5
    touching[:2] = [[True] * 4, [False] * 4]
    wrenches = 100 * rng.normal(size=(40, len(FEET), 6)) * touching[:, :, None]
    wrenches[:, :, :3] = 0.0
    touched = replace(motion, wrenches=wrenches, wrench_frames=FEET, touching=touching)
    plain = equation_of_motion(ParameterSet(quadruped), touched)
    rows = sampled_rows(parameters, touched)
    # The true wrenches leave no trace, whichever feet touch.
    without = equation_of_motion(parameters, replace(touched, wrenches=0 * wrenches))
    np.testing.assert_allclose(rows.rows.y, without.y, atol=1e-9 * np.abs(plain.y).max())
    for leg in range(4):
        own = slice(6 + 3 * leg, 9 + 3 * leg)
        swings = ~touching[:, leg]
        assert rows.valid[swings, own].all()
        np.testing.assert_allclose(rows.rows.K[swings, own], plain.K[swings, own])
    # There are as many rows as directions that no contact takes, and all in flight.
    np.testing.assert_array_equal(rows.valid.sum(axis=1), 18 - 3 * touching.sum(axis=1))
    np.testing.assert_allclose(rows.rows.K[1], plain.K[1])


def test_windows_in_which_a_contact_opens_are_left_out(quadruped):
    model = with_contacts(quadruped, POINTS[:1])
    count, rate = 200, 200.0
    still = np.zeros((count, 12))
    closed = np.arange(count) < count // 2
    segment = Segment(
        stamp=(np.arange(count) * 1e9 / rate).astype(np.int64),
        rate=rate,
        position=still + 0.3,
        effort=still,
        angular_velocity=np.zeros((count, 1, 3)),
        linear_acceleration=np.tile([0, 0, 9.81], (count, 1, 1)),
        wrenches=np.zeros((count, 0, 6)),
        imu_frames=("imu_link",),
        wrench_frames=(),
        touching=closed[:, None],
    )
    length = 0.1
    ((rows,),) = windowed_rows(segment, equation_rows(ParameterSet(model)), [length], ())
    centre = rows.stamp * 1e-9
    is_apart = np.abs(centre - 0.5) > length / 2
    is_near = np.abs(centre - 0.5) < length / 5
    kept = model.contacts.coordinates
    before, after = centre < 0.5, centre > 0.5
    assert rows.valid[is_apart & before][:, kept].all()
    assert rows.valid[is_apart & after].all()
    assert not rows.valid[is_near][:, :9].any()
    # Other legs do not feel the contact.
    assert rows.valid[:, 9:].all()


def test_contacts_that_explain_everything_are_refused(quadruped):
    with pytest.raises(ModelError, match="mark points as FRAME:point"):
        with_contacts(quadruped, FEET)


def test_half_of_the_joints_must_slip_for_most_of_a_window_but_not_at_the_same_time(quadruped):
    model = with_contacts(quadruped, POINTS)
    touching = np.ones((1, len(FEET)))
    obeys = np.ones((1, 18))
    slips = obeys.copy()
    slips[0, 6:] = 0.85  # if not at the same time, no two of the joints slip for all of the window
    rows = CombinedCoordinates(model, obeys, obeys, slips, touching)
    kept = model.contacts.coordinates
    valid, free = rows.valid()
    assert set(np.flatnonzero(valid)) == set(np.flatnonzero(free)) == set(kept)
    slips[0, 6:12] = 0.75
    assert set(np.flatnonzero(replace(rows, slips=slips).valid()[1])) == set(kept)
    slips[0, 12] = 0.75
    valid, free = replace(rows, slips=slips).valid()
    assert set(np.flatnonzero(valid)) == set(kept)
    assert not free.any()
