"""Relative poses of resting soles: slopes, noise that is honest, and geometry that they tell."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_segment
from random_robots import CONFIG, random_robot
from scipy.spatial.transform import Rotation

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.identification.calibration.stance_closure import (
    MOUNTING,
    RestingSoles,
    Stance,
    TrackedStance,
    closure_rows,
    contradicted_geometry,
    find_stances,
)
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import LinearizationPoint
from symbid_ros.signals.sensor_errors import SensorErrors

KINDS = ("encoder_offset", "link_length", "joint_axis")
SOLES = "left_sole", "right_sole"


@pytest.fixture(scope="module")
def parameters():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"))


def errors_of(parameters):
    return SensorErrors.of(KINDS, parameters.model, SOLES, ())


def relative_pose(model, position):
    """Return rotations and positions of the right sole in the left one."""
    poses, placed = link_poses(model, position), []
    for name in SOLES:
        frame = model.frame(name)
        turn = poses.rotation[:, frame.link]
        origin = poses.position[:, frame.link] + turn @ frame.translation
        placed.append((turn @ frame.rotation, origin))
    (first, start), (second, end) = placed
    inverse = first.swapaxes(1, 2)
    return inverse @ second, (inverse @ (end - start)[..., None])[..., 0]


def stance_of(position):
    """Return a stance of soles that carry no load, so that they do not yield."""
    return Stance(SOLES, position, np.zeros((len(position), 2, 6)))


def readings(parameters, errors, theta, count, rng, yielding=None):
    """Return what encoders read in random postures in which the soles do not move.

    ``yielding`` are displacements (count, 2, 6) of both soles in their axes, rad and m.
    """
    true = errors.placed(parameters, theta).model
    offset = errors.of_kind("encoder_offset", theta)[:, 0]
    turn, place = relative_pose(true, np.zeros((1, len(true.joints))))
    if yielding is not None:
        one, other = (Rotation.from_rotvec(yielding[:, k, :3]) for k in (0, 1))
        place = one.inv().apply(
            place - yielding[:, 0, 3:] + Rotation.from_matrix(turn).apply(yielding[:, 1, 3:])
        )
        turn = (one.inv() * Rotation.from_matrix(turn) * other).as_matrix()
    posture = 0.2 * rng.standard_normal((count, len(true.joints)))

    def misfit(posture):
        one, other = relative_pose(true, posture)
        left = Rotation.from_matrix(one @ turn.swapaxes(1, 2)).as_rotvec()
        return np.concatenate([left, other - place], axis=1)

    for _ in range(12):  # Newton's method of least change
        error = misfit(posture)
        steps = 1e-6 * np.eye(posture.shape[1])
        jacobian = np.stack([(misfit(posture + step) - error) / 1e-6 for step in steps], axis=2)
        posture = posture - (np.linalg.pinv(jacobian) @ error[..., None])[..., 0]
    assert np.abs(misfit(posture)).max() < 1e-7
    return posture + offset


def test_resting_soles_tell_the_geometry(parameters):
    errors, rng = errors_of(parameters), np.random.default_rng(0)
    truth = errors.std * rng.standard_normal(len(errors))
    stance = stance_of(readings(parameters, errors, truth, 60, rng))
    p, theta = len(parameters), np.zeros(len(errors))
    for _ in range(2):
        point = LinearizationPoint(parameters.values, theta)
        rows = closure_rows(RestingSoles((stance,)), parameters, errors, point)
        assert rows.rows.shape == (len(errors), p + len(errors))
        assert not rows.rows[:, :p].any()
        A, information = rows.rows[:, p:], np.diag(errors.std**-2)
        covariance = np.linalg.inv(A.T @ A + information)
        theta = covariance @ A.T @ rows.targets
    # They determine many combinations, not all: a common scale changes no relative pose's change.
    ratios = np.linalg.eigvalsh(A.T @ A * np.outer(errors.std, errors.std))
    assert np.sum(ratios > 100) > 5
    assert np.sum(ratios < 1e-9) > 5
    left = theta - truth
    assert left @ np.linalg.solve(covariance, left) / len(errors) < 1.5
    # Rows are exact at the true errors.
    at_truth = closure_rows(
        RestingSoles((stance,)), parameters, errors, LinearizationPoint(None, truth)
    )
    assert np.linalg.norm(at_truth.rows[:, p:] @ truth - at_truth.targets) < 0.3


def test_soles_that_yield_to_their_load_tell_the_geometry_as_well(parameters):
    errors, rng = errors_of(parameters), np.random.default_rng(2)
    truth = 0.3 * errors.std * rng.standard_normal(len(errors))
    wrenches = rng.standard_normal((60, 2, 6)) * np.repeat([4.0, 50.0], 3)
    yielding = wrenches * np.repeat([2e-4, 3e-6], 3)
    position = readings(parameters, errors, truth, 60, rng, yielding)
    point = LinearizationPoint(parameters.values, truth)

    def misses(stance):
        """Return by how many deviations the true geometry misses the rows."""
        rows = closure_rows(RestingSoles((stance,)), parameters, errors, point)
        return np.linalg.norm(rows.rows[:, len(parameters) :] @ truth - rows.targets)

    assert misses(Stance(SOLES, position, wrenches)) < 0.3
    assert misses(stance_of(position)) > 3.0
    alarm = contradicted_geometry(
        RestingSoles((Stance(SOLES, position, wrenches),)), errors.placed(parameters, truth).model
    )
    assert alarm == ""


def test_resting_soles_contradict_wrong_lengths_but_no_encoder_offsets(parameters):
    """Offsets of encoders, which are estimated, explain what their errors do to the poses."""
    errors, model = errors_of(parameters), parameters.model
    for kinds, expected in (({"encoder_offset"}, False), (set(KINDS), True)):
        rng = np.random.default_rng(6)
        truth = np.zeros(len(errors))
        for kind in kinds:
            place = errors.places[kind]
            truth[place] = errors.std[place] * rng.standard_normal(place.stop - place.start)
        stance = stance_of(readings(parameters, errors, truth, 200, rng))
        alarm = contradicted_geometry(RestingSoles((stance,)), model)
        assert ("link lengths" in alarm) == expected
    assert contradicted_geometry(RestingSoles(), model) == ""


@pytest.mark.parametrize(("scale", "expected"), [(0.06, False), (1.0, True)])
def test_postures_that_repeat_are_no_further_evidence(parameters, scale, expected):
    """Soles that yield by 0.05 mm look like displaced joints, in long logs as in short ones."""
    errors, rng = errors_of(parameters), np.random.default_rng(1)
    truth = scale * errors.std * rng.standard_normal(len(errors))
    position = readings(parameters, errors, truth, 60, rng)
    for times in (17, 170):
        stance = stance_of(np.tile(position, (times, 1)))
        alarm = contradicted_geometry(RestingSoles((stance,)), parameters.model)
        assert ("link lengths" in alarm) == expected


def tracked(parameters, errors, theta, rng, *, late=0.0, noise=0.0):
    """Return poses of a frame of the base that is neither where nor turned as the model says."""
    time = 0.05 * np.arange(500)
    count = len(parameters.model.joints)
    rates, phases = rng.uniform(0.3, 1.5, count), rng.uniform(0, 6, count)

    def poses(at):
        true = errors.placed(parameters, theta).model
        posture = 0.3 * np.sin(rates * at[:, None] + phases)
        base, sole = true.frame("imu_link"), true.frame(SOLES[0])
        links = link_poses(true, posture)
        turn = Rotation.from_matrix(links.rotation[:, sole.link] @ sole.rotation).inv()
        place = -turn.apply(
            links.position[:, sole.link]
            + (links.rotation[:, sole.link] @ sole.translation[:, None])[..., 0]
        )
        # The base seen from the sole, and the tracked frame on it.
        mounted = Rotation.from_matrix(base.rotation) * Rotation.from_rotvec([0.004, -0.006, 0.01])
        markers = base.translation + base.rotation @ [0.004, -0.003, 0.005]
        return posture, place + turn.apply(markers), turn * mounted

    posture, _, _ = poses(time)
    _, place, turn = poses(time - late)
    place = place + noise * rng.standard_normal(place.shape)
    turn = turn * Rotation.from_rotvec(0.3 * noise * rng.standard_normal(place.shape))
    offset = errors.of_kind("encoder_offset", theta)[:, 0]
    return TrackedStance("imu_link", SOLES[0], time, posture + offset, place, turn.as_quat())


def test_poses_of_the_base_tell_the_scale_of_the_legs(parameters):
    errors, rng = errors_of(parameters), np.random.default_rng(3)
    truth = errors.std * rng.standard_normal(len(errors))
    stance = tracked(parameters, errors, truth, rng, late=0.004, noise=5e-4)
    p, theta = len(parameters), np.zeros(len(errors))
    for _ in range(3):
        point = LinearizationPoint(parameters.values, theta)
        rows = closure_rows(RestingSoles(tracked=(stance,)), parameters, errors, point)
        A = rows.rows[:, p:]
        assert A.shape == (len(errors), len(errors))
        covariance = np.linalg.inv(A.T @ A + np.diag(errors.std**-2))
        theta = covariance @ A.T @ rows.targets
    left = theta - truth
    assert left @ np.linalg.solve(covariance, left) / len(errors) < 1.5
    # Thigh and shank, whose common scale no pair of soles could tell.
    legs = np.array(
        [name in {"L_kfe/link_length_x", "L_adp/link_length_x"} for name in errors.names]
    )
    assert legs.sum() == 2
    common = legs / 2.0
    assert np.sqrt(common @ covariance @ common) < 0.3 * errors.std[legs][0] / np.sqrt(2)


def test_poses_without_noise_close_at_the_true_geometry(parameters):
    errors, rng = errors_of(parameters), np.random.default_rng(4)
    truth = 0.3 * errors.std * rng.standard_normal(len(errors))
    stance = tracked(parameters, errors, truth, rng, late=0.002)
    p = len(parameters)
    point = LinearizationPoint(parameters.values, truth)
    rows = closure_rows(RestingSoles(tracked=(stance,)), parameters, errors, point)
    # What remains is how unlikely mounting and delay are, and no error of the linearisation.
    unlikely = np.array([0.004, -0.006, 0.01, 0.004, -0.003, 0.005, 0.002]) / MOUNTING
    left = np.linalg.norm(rows.rows[:, p:] @ truth - rows.targets)
    assert left == pytest.approx(np.linalg.norm(unlikely), rel=0.05)


def test_points_that_roll_give_no_rows(parameters, caplog):
    errors = errors_of(parameters)
    position = 0.2 * np.random.default_rng(1).standard_normal((50, len(parameters.model.joints)))
    point = LinearizationPoint(parameters.values, np.zeros(len(errors)))
    stances = RestingSoles((stance_of(position),))
    assert closure_rows(stances, parameters, errors, point) is None
    assert "soles moved" in caplog.text
    assert closure_rows(RestingSoles(), parameters, errors, point) is None


def test_stances_are_where_two_feet_are_loaded():
    robot = random_robot(1, links=6)  # with both wrench sensors on moving links
    parameters = ParameterSet(robot)
    segment = analytic_segment(parameters, 8.0, 3, rate=200.0)
    weight = 9.81 * robot.phi[:, 0].sum()
    wrenches = np.zeros_like(segment.wrenches)
    wrenches[:, :, 5] = 0.5 * weight
    time = 1e-9 * segment.stamp
    wrenches[(time > 3) & (time < 4), 0, 5] = 0.01 * weight
    stances = find_stances([replace(segment, wrenches=wrenches)], robot)
    assert [len(one.position) for one in stances.pairs] == [60, 80]
    assert stances.tracked == ()
    for one in stances.pairs:
        assert one.soles == segment.wrench_frames
        assert one.wrenches.shape == (len(one.position), 2, 6)
        np.testing.assert_allclose(one.wrenches[..., 5], 0.5 * weight)
