"""Columns of gains and delays against finite differences; factors against dense rows."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_samples, readings_of
from random_robots import random_robot
from scipy.signal import savgol_filter
from scipy.sparse import csr_array

from symbid_ros.diagnosis.gain_rows import (
    CoordinateRows,
    GainLayout,
    GainRows,
    specific_force_jacobian,
)
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_samples import at_base
from symbid_ros.signals.window_averages import average

COUNT = 40
IMUS = ("imu_link", "link_2")


def robot(floating):
    """Return a robot one of whose joints is passive."""
    model = random_robot(3, links=5, floating=floating, wrench_frames=2)
    efforts = (5.0, 0.0, 0.5, 7.0)
    joints = [replace(j, effort=e) for j, e in zip(model.joints, efforts, strict=True)]
    return replace(model, joints=tuple(joints))


@pytest.fixture(scope="module", params=[True, False])
def case(request):
    model = robot(request.param)
    parameters = ParameterSet(model)
    stamp = 5_000_000 * np.arange(COUNT, dtype=np.int64)
    samples = analytic_samples(parameters, stamp, 1)
    readings = readings_of(model, samples, IMUS if model.floating else ())
    layout = GainLayout.of(model, samples.wrench_frames, IMUS)
    return parameters, readings, layout


@pytest.mark.parametrize("floating", [True, False])
def test_unknowns_have_places_of_their_own(floating):
    layout = GainLayout.of(robot(floating), ("wrench_0", "wrench_1"), IMUS)
    imus = 2 * floating
    assert layout.joint_names == tuple(robot(floating).joint_names[i] for i in (0, 2, 3))
    places = [layout.wrench(0), layout.wrench(1), *(layout.imu(i) for i in range(imus))]
    covered = []
    for place in places:
        covered += range(place.start, place.stop)
        assert place.stop - place.start == 9
        assert layout.is_delay[place.stop]
        covered.append(place.stop)
    covered += range(layout.efforts.start, layout.efforts.stop)
    assert layout.efforts.stop - layout.efforts.start == 3
    covered.append(layout.effort_delay)
    covered += np.flatnonzero(layout.is_encoder).tolist()
    assert covered == list(range(len(layout)))
    revolute = [i for i, joint in enumerate(robot(floating).joints) if joint.kind == "revolute"]
    assert layout.measured == tuple(revolute)
    assert layout.encoders == slice(layout.effort_delay + 1, len(layout))
    assert layout.is_delay.sum() == 2 + imus + 1
    assert layout.is_delay[layout.effort_delay]
    expected = np.zeros(len(layout), dtype=bool)
    for place in places[2:]:
        expected[place] = True
    np.testing.assert_array_equal(layout.is_imu, expected)


def residual(parameters, readings):
    rows = equation_of_motion(parameters, at_base(readings, parameters.model))
    return rows.y - rows.K @ parameters.values


def changed(readings, what, index, matrix):
    """Return the readings of one sensor times a matrix."""
    values = getattr(readings, what).copy()
    shape = values[:, index].shape
    values[:, index] = (values[:, index].reshape(-1, 3) @ matrix.T).reshape(shape)
    return replace(readings, **{what: values})


def test_columns_are_the_slopes_of_the_residual(case):
    """Gains are linear, so differences are exact; delays are the derivatives of the readings."""
    parameters, readings, layout = case
    C = layout.columns(parameters, readings)
    here = residual(parameters, readings)
    scale = np.abs(here).max() + np.abs(C).max()
    sensors = [("wrenches", i, layout.wrench(i)) for i in range(2)]
    sensors += [("specific_force", i, layout.imu(i)) for i in range(len(layout.imu_frames))]
    for what, index, place in sensors:
        for row in range(3):
            for column in range(3):
                matrix = np.eye(3)
                matrix[row, column] += 1.0
                slope = residual(parameters, changed(readings, what, index, matrix)) - here
                found = C[:, :, place.start + 3 * row + column]
                np.testing.assert_allclose(found, slope, atol=1e-10 * scale)
    for place, joint in enumerate((0, 2, 3)):
        effort = readings.effort.copy()
        effort[:, joint] *= 2
        slope = residual(parameters, replace(readings, effort=effort)) - here
        found = C[:, :, layout.efforts.start + place]
        np.testing.assert_allclose(found, slope, atol=1e-10 * scale)


def late(readings, names, index=None):
    """Return the derivative of some channels by time, of one sensor, and zero for the others."""
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    arrays = {}
    for name in names:
        values = getattr(readings, name)
        slope = np.gradient(values, time, axis=0)
        slope[2:-2] = savgol_filter(values, 5, 4, deriv=1, delta=time[1], axis=0)[2:-2]
        arrays[name] = values.copy()
        if index is None:
            arrays[name] += 1e-3 * slope
        else:
            arrays[name][:, index] += 1e-3 * slope[:, index]
    return replace(readings, **arrays)


def test_delays_are_the_readings_slopes(case):
    parameters, readings, layout = case
    C = layout.columns(parameters, readings)
    # At rest, products of rates with the derivative vanish, as the columns assume.
    rest = {
        name: np.zeros_like(getattr(readings, name))
        for name in ("velocity", "acceleration", "angular_velocity")
    }
    still = replace(readings, **rest)
    passive = np.array([1.0, 0.0, 1.0, 1.0])
    still = replace(still, effort=still.effort * passive)
    here = residual(parameters, still)
    shifted = [(layout.wrench(i).stop, late(still, ["wrenches"], i)) for i in range(2)]
    shifted += [
        (layout.imu(i).stop, late(still, ["angular_acceleration", "specific_force"], i))
        for i in range(len(layout.imu_frames))
    ]
    shifted.append((layout.effort_delay, late(still, ["effort"])))
    for place, moved in shifted:
        slope = (residual(parameters, moved) - here) / 1e-3
        np.testing.assert_allclose(C[:, :, place], slope, atol=1e-6 * np.abs(slope).max())
    one = layout.columns(parameters, readings[:1])
    np.testing.assert_array_equal(one[:, :, layout.is_delay], 0)
    others = ~layout.is_delay & ~layout.is_encoder
    np.testing.assert_allclose(one[..., others], C[:1][..., others])


def test_an_encoders_column_is_the_slope_of_the_residual(case):
    parameters, readings, layout = case
    instant = readings[20:21]
    C = layout.columns(parameters, instant)
    for index, joint in enumerate(layout.measured):
        sides = []
        for offset in (1e-6, -1e-6):
            position = instant.position.copy()
            position[:, joint] -= offset
            sides.append(residual(parameters, replace(instant, position=position)))
        slope = (sides[0] - sides[1]) / 2e-6
        found = C[:, :, layout.encoders.start + index]
        np.testing.assert_allclose(found, slope, atol=5e-3 * max(np.abs(slope).max(), 1e-3))
    # The columns of other instants are interpolated between means over 0.2 s.
    every = layout.columns(parameters, readings)[:, :, layout.encoders]
    assert every.shape == (COUNT, parameters.model.dof, len(layout.measured))


def test_the_structure_covers_what_sensors_reach(case):
    parameters, readings, layout = case
    reached = np.any(layout.columns(parameters, readings) != 0, axis=0)
    structure = layout.structure(parameters.model)
    assert not np.any(reached & ~structure)
    # Nothing else is in the rows of efforts and wrenches; an IMU's columns may be zero.
    others = ~layout.is_imu & ~layout.is_encoder
    for index in range(len(layout.imu_frames)):
        others[layout.imu(index).stop] = False
    np.testing.assert_array_equal(reached[:, others], structure[:, others])


@pytest.mark.parametrize("floating", [True, False])
def test_the_specific_force_acts_on_all_masses(floating):
    model = random_robot(5, links=6, floating=floating)
    parameters = ParameterSet(model)
    stamp = 5_000_000 * np.arange(5, dtype=np.int64)
    samples = analytic_samples(parameters, stamp, 2)
    poses = link_poses(model, samples.position)
    found = specific_force_jacobian(parameters, poses)
    here = equation_of_motion(parameters, samples).K @ parameters.values
    for axis in range(3):
        force = samples.base_specific_force + np.eye(3)[axis]
        moved = equation_of_motion(parameters, replace(samples, base_specific_force=force))
        slope = moved.K @ parameters.values - here
        np.testing.assert_allclose(found[:, :, axis], slope, atol=1e-9)


def test_rows_are_built_in_chunks_and_close_with_gains_of_one(case, monkeypatch):
    parameters, readings, layout = case
    monkeypatch.setattr("symbid_ros.diagnosis.gain_rows.CHUNK", 17)
    readings.effort[3, 2] = np.nan
    parts = list(GainRows(parameters, layout)(readings))
    readings.effort[3, 2] = 0.0
    assert [len(part.stamp) for part in parts] == [17, 17, 6]
    valid = np.concatenate([part.valid for part in parts])
    lost = np.zeros_like(valid)
    lost[3, 6 * parameters.model.floating + 2] = True
    np.testing.assert_array_equal(valid, ~lost)
    K = np.concatenate([part.rows.K for part in parts])
    assert K.shape[2] == len(parameters) + len(layout)
    np.testing.assert_allclose(
        K[20, :, len(parameters) :],
        -layout.columns(parameters, readings[17:34])[3],
        atol=1e-9,
    )


def test_factors_hold_the_moments_of_all_rows():
    rng = np.random.default_rng(0)
    structure = rng.random((3, 6)) < 0.6
    structure[0], structure[1, 2] = True, False
    rows = CoordinateRows(("base/force_x", "a", "b"), ("N", "Nm", "Nm"), structure)
    K = rng.normal(size=(50, 3, 6)) * structure
    y = rng.normal(size=(50, 3))
    for part in (slice(0, 20), slice(20, 21), slice(21, 50)):
        rows.fold(Rows(K[part], y[part]))
    assert rows.samples == 50
    x = rng.normal(size=6)
    expected = np.mean((y - K @ x) ** 2, axis=0)
    np.testing.assert_allclose(rows.residual_squares(x), expected)
    np.testing.assert_allclose(rows.target_squares, np.mean(y**2, axis=0))
    for coordinate in range(3):
        for unknown in np.flatnonzero(structure[coordinate]):
            square = rows.column_squares(coordinate, unknown)
            assert square == pytest.approx(np.mean(K[:, coordinate, unknown] ** 2))
    deviation = np.array([0.5, 2.0, 3.0])
    dense = np.concatenate([K, y[..., None]], axis=2) / deviation[:, None]
    dense = dense.reshape(-1, 7)
    factor = rows.whitened(deviation)
    np.testing.assert_allclose(factor.T @ factor, dense.T @ dense, atol=1e-10)
    assert factor.shape == (7, 7)
    empty = CoordinateRows(("a",), ("Nm",), structure[:1])
    np.testing.assert_array_equal(empty.target_squares, [0])


def test_averages_over_windows_need_no_rows_of_single_samples(case):
    parameters, readings, layout = case
    build = GainRows(parameters, layout)
    weights = [csr_array(np.random.default_rng(1).random((3, len(readings))))]
    weights += [weights[0][:2], weights[0][:0]]  # the last part is too short for a window
    for found, expected in zip(
        build.averages(readings, weights), average(build(readings), weights), strict=True
    ):
        assert found.K.shape == expected.K.shape
        scale = np.abs(expected.K).max(initial=0.0)
        np.testing.assert_allclose(found.K, expected.K, atol=1e-12 * scale)
        np.testing.assert_allclose(found.y, expected.y)
        np.testing.assert_allclose(found.valid, expected.valid)
