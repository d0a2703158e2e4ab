"""Sensor errors as unknowns: exact correction, correct linearisation, consistent names."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from analytic_log import analytic_samples, noisy, readings_of, segment_of, spoilt
from random_robots import CONFIG, random_robot

from symbid_ros.choices import TYPICAL_ERRORS, UNSEEN_WITH_CONTACTS
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint, error_columns
from symbid_ros.signals.sensor_errors import DEVIATIONS, KINDS, UNITS, SensorErrors
from symbid_ros.signals.sensor_noise import FORCES, MOTION
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import BLOCK, equation_rows, windowed_rows
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator

PERIOD_NS = 1_000_000


def parameters_of(robot):
    if robot == "symbitron":
        return ParameterSet(load_model(CONFIG / "symbitron.xml"))
    if robot == "on its soles":
        model = load_model(CONFIG / "symbitron.xml")
        return ParameterSet(with_contacts(model, ("left_sole", "right_sole:point")))
    seed, floating = robot
    return ParameterSet(random_robot(seed, links=6, floating=floating))


ROBOTS = [(1, True), (4, True), (2, False), "symbitron"]


def exact_readings(parameters, count, seed, step=PERIOD_NS):
    stamp = step * np.arange(1, count + 1, dtype=np.int64)
    model = parameters.model
    bare = replace(parameters, model=replace(model, contacts=None))
    samples = analytic_samples(bare, stamp, seed)
    readings = readings_of(model, samples, ("imu_link",) if model.floating else ())
    if model.contacts is None:
        return readings
    return replace(readings, wrenches=readings.wrenches[:, :0], wrench_frames=())


def all_errors(parameters, readings, kinds=TYPICAL_ERRORS):
    return SensorErrors.of(kinds, parameters.model, readings.wrench_frames, readings.imu_frames)


def residual(parameters, errors, phi, readings, theta):
    parameters = errors.placed(parameters, theta)
    samples = at_base(errors.corrected(readings, theta), parameters.model)
    rows = equation_of_motion(parameters, samples)
    return rows.y - rows.K @ phi


SEEN = tuple(kind for kind in KINDS if kind not in UNSEEN_WITH_CONTACTS)


@pytest.mark.parametrize(
    ("robot", "kinds"),
    [
        *product(ROBOTS, [KINDS, KINDS[1:2], KINDS[2:5], KINDS[4:]]),
        *product(["on its soles"], [SEEN, SEEN[3:4], SEEN[4:]]),
    ],
    ids=str,
)
def test_columns_are_the_slopes_of_the_residual(robot, kinds):
    parameters = parameters_of(robot)
    readings = exact_readings(parameters, 5, 3, step=170_000_000)
    errors = all_errors(parameters, readings, kinds)
    rng = np.random.default_rng(0)
    theta = errors.std * rng.standard_normal(len(errors))
    phi = parameters.values * rng.uniform(0.8, 1.2, len(parameters))
    C = error_columns(parameters, errors, LinearizationPoint(phi, theta), readings)
    assert C.shape == (5, parameters.model.dof, len(errors))
    for column, name in enumerate(errors.names):
        step = np.zeros(len(errors))
        step[column] = 1e-5
        ahead, behind = (
            residual(parameters, errors, phi, readings, theta + sign * step) for sign in (1, -1)
        )
        slope = (ahead - behind) / 2e-5
        # One-sided differences of 1e-4 are taken inside.
        scale = np.abs(slope).max()
        np.testing.assert_allclose(C[:, :, column], slope, atol=5e-4 * scale + 1e-6, err_msg=name)


def test_columns_are_not_interpolated_from_one_set_of_contacts_to_another():
    parameters = parameters_of("on its soles")
    readings = exact_readings(parameters, 120, 3)
    errors = all_errors(parameters, readings, ("imu_bias", "torque_gain"))
    lifted = np.ones((120, 2), dtype=bool)
    lifted[57:, 0] = False
    readings = replace(readings, touching=lifted)
    point = LinearizationPoint(parameters.values, np.zeros(len(errors)))
    (found,) = CalibratingRows(parameters, errors, point)(readings)
    exact = error_columns(parameters, errors, point, readings)
    scale = np.abs(exact).max(axis=(0, 1)) + 1e-9
    np.testing.assert_allclose(found.rows.K[..., -len(errors) :] / scale, -exact / scale, atol=0.1)
    # A leg in the air gives rows of its own.
    swings = found.combined.touching[:, 0] < 1
    np.testing.assert_array_equal(swings, ~lifted[:, 0])
    assert found.valid[swings].sum(axis=1).min() > found.valid[~swings].sum(axis=1).max()


def test_an_effort_that_was_not_measured_leaves_the_columns_of_other_joints_as_they_are():
    parameters = parameters_of(ROBOTS[-1])
    readings = exact_readings(parameters, 5, 3, step=170_000_000)
    errors = all_errors(parameters, readings, ("compliance",))
    point = LinearizationPoint(parameters.values, np.zeros(len(errors)))
    silent = readings.effort.copy()
    silent[:, 0] = np.nan
    first = parameters.model.dof - silent.shape[1]
    full, found = (
        error_columns(parameters, errors, point, each)
        for each in (readings, replace(readings, effort=silent))
    )
    np.testing.assert_allclose(found[:, first + 1 :, 1:], full[:, first + 1 :, 1:], atol=1e-9)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("robot", ROBOTS, ids=str)
def test_the_structure_covers_every_affected_coordinate(robot):
    parameters = parameters_of(robot)
    readings = exact_readings(parameters, 6, 5, step=150_000_000)
    errors = all_errors(parameters, readings)
    theta = errors.std * np.random.default_rng(1).standard_normal(len(errors))
    C = np.abs(
        error_columns(parameters, errors, LinearizationPoint(parameters.values, theta), readings)
    ).max(axis=0)
    reach = errors.structure(parameters.model)
    assert reach.shape == C.shape
    assert not np.any(C[~reach] > 1e-9 * C.max())
    gains = errors.places["torque_gain"]
    np.testing.assert_array_equal(reach[:, gains].sum(axis=0), 1)
    # Plates load only the joints between them and the base.
    model = parameters.model
    for frame in errors.wrench_frames:
        columns = [i for i, name in enumerate(errors.names) if name.startswith(f"{frame}/wrench")]
        carried = model.ancestors[:, model.frame(frame).link]
        first = 6 * model.floating
        np.testing.assert_array_equal(reach[first:, columns].any(axis=1), carried)


@pytest.mark.parametrize("robot", ROBOTS, ids=str)
def test_names_units_deviations_and_places_agree(robot):
    parameters = parameters_of(robot)
    readings = exact_readings(parameters, 1, 0)
    model = parameters.model
    errors = all_errors(parameters, readings, KINDS)
    assert len(errors) == len(errors.names) == len(errors.units) == len(errors.std)
    assert len(set(errors.names)) == len(errors)
    driven = [joint.name for joint in model.joints if joint.effort > 0]
    joints = list(model.joint_names)
    owners = {"torque_gain": driven, "encoder_offset": joints, "compliance": joints}
    owners |= {"link_length": joints, "joint_axis": joints}
    end = 0
    for kind in KINDS:
        place = errors.places[kind]
        assert place.start == end
        end = place.stop
        sensors = readings.wrench_frames if kind.startswith("wrench") else readings.imu_frames
        if kind == "sensor_delay":
            sensors = (*readings.imu_frames, *readings.wrench_frames, "efforts")
        if kind == "frame_pose":
            sensors = (*readings.wrench_frames, *readings.imu_frames)
        owned = owners.get(kind, list(sensors))
        names = errors.names[place]
        size = len(DEVIATIONS[kind])
        assert [name.partition("/")[0] for name in names] == list(np.repeat(owned, size))
        assert all(name.partition("/")[2].startswith(kind) for name in names)
        # Wrench sensors turn and IMUs move.
        meant = [
            "wrench_position" if kind == "frame_pose" and owner in readings.imu_frames else kind
            for owner in owned
        ]
        assert errors.units[place] == sum((UNITS[one] for one in meant), ())
        expected = sum((DEVIATIONS[one] for one in meant), ())
        np.testing.assert_array_equal(errors.std[place], expected)
        theta = np.arange(len(errors)) + 1.0
        np.testing.assert_array_equal(errors.of_kind(kind, theta).ravel(), theta[place])
        assert errors.of_kind(kind, theta).shape == (len(owned), size)
    assert end == len(errors)


def test_moments_come_before_forces_and_gyroscopes_before_accelerometers():
    parameters = parameters_of((1, True))
    errors = all_errors(parameters, exact_readings(parameters, 1, 0))
    frame = errors.wrench_frames[0]
    assert errors.names[:6] == tuple(
        f"{frame}/wrench_offset_{part}_{axis}" for part in ("moment", "force") for axis in "xyz"
    )
    start = errors.places["imu_bias"].start
    assert errors.names[start] == "imu_link/imu_bias_gyroscope_x"
    assert errors.names[start + 3] == "imu_link/imu_bias_accelerometer_x"
    assert errors.units[start : start + 6] == ("rad/s",) * 3 + ("m/s^2",) * 3


def simulated_readings(errors):
    """Return the drawn errors, and readings of one motion that have these errors alone."""
    simulator = Simulator(
        SimulateOptions("vibrating", moves=1, ideal=True, errors=errors, error_seed=4)
    )
    instants = [simulator.step() for _ in range(60)]

    def column(name):
        return np.array([getattr(instant, name) for instant in instants])

    wrenches, gyroscope = column("wrenches"), column("imu_angular_velocity")
    alpha = np.gradient(gyroscope, 1e-3, axis=0)
    return simulator.errors, SensorSamples(
        stamp=column("stamp"),
        position=column("joint_position"),
        velocity=column("joint_velocity"),
        acceleration=column("true_acceleration"),
        effort=column("joint_effort"),
        angular_velocity=gyroscope[:, None],
        angular_acceleration=alpha[:, None],
        specific_force=column("imu_linear_acceleration")[:, None],
        wrenches=np.concatenate([wrenches[..., 3:], wrenches[..., :3]], axis=2),
        imu_frames=(simulator.imu_frame,),
        wrench_frames=tuple(sensor.frame_id for sensor in simulator.wrench_sensors),
    )


@pytest.fixture(scope="module")
def perfect():
    return simulated_readings("")[1]


@pytest.mark.parametrize("kind", ["typical", *(k for k in TYPICAL_ERRORS if k != "imu_bias")])
def test_the_simulators_errors_are_undone_to_the_last_digit(kind, perfect):
    drawn, wrong = simulated_readings(kind)
    parameters = parameters_of("symbitron")
    errors = all_errors(parameters, perfect)
    # The simulator writes wrenches as messages do, force first.
    moment_first = [3, 4, 5, 0, 1, 2]
    theta = np.zeros(len(errors))
    theta[errors.places["wrench_offset"]] = drawn.wrench_offset[:, moment_first].ravel()
    theta[errors.places["wrench_gain"]] = drawn.wrench_gain[:, moment_first].ravel()
    theta[errors.places["wrench_position"]] = drawn.wrench_position.ravel()
    theta[errors.places["torque_gain"]] = drawn.torque_gain[errors.driven]
    theta[errors.places["imu_mounting"]] = drawn.imu_mounting
    theta[errors.places["encoder_offset"]] = drawn.encoder_offset
    assert np.any(theta)
    mended = errors.corrected(wrong, theta)
    assert_same(mended, perfect)
    assert np.any(np.abs(mended.wrenches - wrong.wrenches) > 1e-3) == (
        kind == "typical" or kind.startswith("wrench")
    )
    assert_same(errors.corrected(perfect, np.zeros(len(errors))), perfect)


def assert_same(one, other):
    motion = ("angular_velocity", "angular_acceleration", "specific_force")
    for name in ("position", "effort", "wrenches", *motion):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS, ids=str)
def test_rows_close_at_the_true_parameters_and_errors(robot):
    parameters = parameters_of(robot)
    readings = exact_readings(parameters, 1300, 7)
    segment = segment_of(readings, 1e9 / PERIOD_NS)
    errors = all_errors(parameters, readings)
    phi = parameters.values
    draw = errors.std * np.random.default_rng(2).standard_normal(len(errors))

    def closure(theta, pilot):
        build = CalibratingRows(parameters, errors, pilot)
        ((rows,),) = windowed_rows(spoilt(segment, errors, theta), build, [0.321])
        left = rows.mean.K @ np.concatenate([phi, theta]) - rows.mean.y
        return np.linalg.norm(left) / np.linalg.norm(rows.mean.y)

    none = np.zeros(len(errors))
    exact = closure(none, LinearizationPoint(phi, none))
    assert exact < 1e-4
    # Exact about the true errors; about zero errors, up to second order.
    assert closure(draw, LinearizationPoint(phi, draw)) < exact + 1e-5
    ignored = np.linalg.norm(uncorrected(spoilt(segment, errors, draw), parameters))
    linearised = closure(draw, LinearizationPoint(phi, none))
    assert linearised < 0.1 * ignored
    assert closure(draw / 4, LinearizationPoint(phi, none)) < linearised / 10 + exact


@pytest.mark.parametrize("robot", [(1, True), (2, False)], ids=str)
def test_rows_close_when_late_sensors_are_realigned(robot):
    parameters, seed = parameters_of(robot), 7
    readings = exact_readings(parameters, 1300, seed)
    errors = all_errors(parameters, readings, ["sensor_delay"])
    late = np.random.default_rng(3).uniform(-0.005, 0.005, len(errors))

    def delayed(delay):
        stamp = readings.stamp - round(1e9 * delay)
        samples = analytic_samples(parameters, stamp, seed)
        return readings_of(parameters.model, samples, readings.imu_frames)

    segment, phi = segment_of(readings, 1e9 / PERIOD_NS), parameters.values
    for name, delay in zip(errors.names, late, strict=True):
        owner, past = name.partition("/")[0], delayed(delay)
        for channel, own, frames in (
            ("angular_velocity", past.angular_velocity, readings.imu_frames),
            ("linear_acceleration", past.specific_force, readings.imu_frames),
            ("wrenches", past.wrenches, readings.wrench_frames),
        ):
            if owner in frames:
                values = getattr(segment, channel).copy()
                values[:, frames.index(owner)] = own[:, frames.index(owner)]
                segment = replace(segment, **{channel: values})
        if owner == "efforts":
            segment = replace(segment, effort=past.effort)

    def closure(point):
        build = CalibratingRows(parameters, errors, LinearizationPoint(phi, point))
        ((rows,),) = windowed_rows(segment, build, [0.321])
        left = rows.mean.K @ np.concatenate([phi, late]) - rows.mean.y
        return np.linalg.norm(left) / np.linalg.norm(rows.mean.y)

    ignored = np.linalg.norm(uncorrected(segment, parameters))
    assert ignored > 1e-3
    assert closure(late) < 1e-4
    assert closure(np.zeros(len(errors))) < 0.1 * ignored


def test_noise_in_the_columns_of_gains_is_known():
    """A gain's column and y share the noise of one reading, which is not information."""
    parameters = ParameterSet(random_robot(2, links=3))
    readings = exact_readings(parameters, 1300, 7)
    segment = segment_of(readings, 1e9 / PERIOD_NS)
    kinds = ("wrench_gain", "torque_gain")
    errors = SensorErrors.of(kinds, parameters.model, segment.wrench_frames, segment.imu_frames)
    p, truth = len(parameters), np.append(parameters.values, np.zeros(len(errors)))
    build = CalibratingRows(
        parameters, errors, LinearizationPoint(parameters.values, np.zeros(len(errors)))
    )

    def gradient(rows):
        """How a least-squares fit would leave the truth, per gain (r,)."""
        return np.einsum("tij,ti->j", rows.K, rows.y - rows.K @ truth)[p:]

    def pulls(seed, sign):
        drawn = noisy(segment, np.random.default_rng(seed), effort=2.0, wrench=20.0)
        # Another time brings another draw of the noise that is replayed.
        change = {"stamp": segment.stamp + seed * BLOCK}
        for name in FORCES:
            exact = getattr(segment, name)
            change[name] = exact + sign * (getattr(drawn, name) - exact)
        ((rows,),) = windowed_rows(replace(segment, **change), build, [0.161], MOTION + FORCES)
        return gradient(rows.mean), gradient(rows.noise)

    # Noise and its negative: terms of first order cancel.
    found = np.array([[pulls(seed, sign) for sign in (1, -1)] for seed in range(10)]).mean(axis=1)
    left = found[:, 0] - found[:, 1]
    seen, known = found.mean(axis=0)
    chance = left.std(axis=0) / np.sqrt(len(found))
    assert np.sqrt(np.mean((seen / chance) ** 2)) > 3
    assert np.sqrt(np.mean(((seen - known) / chance) ** 2)) < 1.6


def uncorrected(segment, parameters):
    """Return the residual of rows without sensor errors, relative to their forces."""
    ((rows,),) = windowed_rows(segment, equation_rows(parameters), [0.321])
    left = rows.mean.K @ parameters.values - rows.mean.y
    return left / np.linalg.norm(rows.mean.y)
