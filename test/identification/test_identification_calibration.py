"""Sensor errors: the tare, their identification, and the alarms without it."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import yaml
from analytic_log import analytic_segment, dataset_of, noisy, spoilt
from foreign_bags import imu, joint_state, wrench, write_rosbags
from random_robots import CONFIG, random_robot

from symbid_ros.bags import bag_log
from symbid_ros.choices import KINEMATIC_ERRORS, TYPICAL_ERRORS
from symbid_ros.errors import DataError, OptionError, SymbidError
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.calibration.extended_problem import SensorErrorRequest, calibrate
from symbid_ros.identification.calibration.tares import Tare, read_tare
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.problem import Problem
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest
from symbid_ros.signals.sensor_errors import DEVIATIONS, SensorErrors
from symbid_ros.signals.weak_form import WINDOWS
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.scenario import SOLES
from symbid_ros.simulation.simulator import Simulator

MODEL = CONFIG / "symbitron.xml"
# Without Coulomb friction no joint sticks, so even a short log has rows for every joint.
DRIVES = {"damping": 0.3, "frictionloss": 0.0, "armature": 0.01}


def written(folder, name, seconds=None, **options):
    """Record a simulation, or only its first ``seconds``."""
    simulator = Simulator(SimulateOptions(**options))
    if seconds is not None:
        simulator.steps = round(1e9 * seconds / simulator.period_ns)
    record(simulator, folder / name)
    return simulator


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def wrong(folder):
    """Record a tare and a log of one robot with errors in all sensors; return these errors."""
    parameters = ParameterSet(load_model(MODEL))
    write_prior(folder / "prior.json", draw_prior(parameters, "percent", 25, 3))
    drives = folder / "friction.yaml"
    drives.write_text(yaml.safe_dump(dict.fromkeys(parameters.model.joint_names, DRIVES)))
    robot = {"errors": "typical", "error_seed": 11, "friction_file": drives}
    written(folder, "tare", 1.0, scenario="tare", noise_seed=8, **robot)
    simulator = written(folder, "log", moves=2, motion_seed=33, noise_seed=7, **robot)
    return simulator.errors


def identified(folder, **known):
    options = IdentifyOptions(
        prior=folder / "prior.json", friction=True, armature=True, offset=True, **known
    )
    # Without Coulomb friction, with which a joint's rows count only while it slips.
    vars(options)["terms"] = ("viscous", "armature", "offset")
    return BagRequest((folder / "log",), MODEL, options).load()


class TestTare:
    def test_an_unloaded_plate_reads_its_offset(self, folder, wrong, caplog):
        with caplog.at_level(logging.WARNING):
            tares = read_tare(bag_log([folder / "tare"]))
        assert set(tares) == set(SOLES)
        for index, sole in enumerate(SOLES):
            tare = tares[sole]
            offset = wrong.wrench_offset[index, [3, 4, 5, 0, 1, 2]]
            # A second of white noise: 0.1 Nm and 1 N over a thousand readings.
            np.testing.assert_allclose(tare.std, np.repeat([0.1, 1.0], 3) / 1000**0.5, rtol=0.1)
            assert np.all(np.abs(tare.mean - offset) < 5 * tare.std)
        # The load cell of the overhead support carries the robot.
        (warning,) = caplog.messages
        assert "/suspension/wrench reads 403 N, so it is loaded" in warning

    def test_a_tare_needs_an_unloaded_sensor(self, folder, wrong):
        assert wrong.wrench_offset.any()
        with pytest.raises(DataError, match="no unloaded wrench sensor"):
            read_tare(bag_log([folder / "log"]))

    def test_a_nan_reading_is_refused(self, tmp_path):
        messages = [
            ("/joint_states", JOINT_STATE, joint_state(1, ["a"], [0.0])),
            ("/imu/data", IMU, imu(1)),
            ("/left_foot/wrench", WRENCH, wrench(1, (0.0, np.nan, 0.0))),
        ]
        bag = write_rosbags(tmp_path / "bag", messages)
        with pytest.raises(SymbidError, match=r"/left_foot/wrench: wrench\.force\.y is nan"):
            read_tare(bag_log([bag]))


def normalised(quantities, truth):
    values = np.array([(quantity.value, quantity.std) for quantity in quantities])
    return (values[:, 0] - truth) / values[:, 1]


def drawn(errors, wrong):
    """Return θ (r,) of the simulator's errors."""
    moment_first = [3, 4, 5, 0, 1, 2]
    content = {
        "wrench_offset": wrong.wrench_offset[:, moment_first],
        "wrench_gain": wrong.wrench_gain[:, moment_first],
        "wrench_position": wrong.wrench_position,
        "torque_gain": wrong.torque_gain[errors.driven],
        "imu_mounting": wrong.imu_mounting,
        "imu_bias": np.zeros(6),
        "encoder_offset": wrong.encoder_offset,
    }
    return np.concatenate([content[kind].ravel() for kind in errors.kinds])


def true_parameters(parameters):
    """Return the parameters of the simulated robot; its drives have no torque offset."""
    truth = parameters.values.copy()
    truth[parameters.term_columns["viscous"]] = DRIVES["damping"]
    truth[parameters.term_columns["armature"]] = DRIVES["armature"]
    return truth


class TestCure:
    @pytest.fixture(scope="class")
    @classmethod
    def calibrated(cls, folder, wrong):
        assert wrong.encoder_offset.any()
        return identified(folder, tare=(folder / "tare",), total_mass=41.05, total_mass_std=0.02)

    @pytest.fixture(scope="class")
    @classmethod
    def uncalibrated(cls, folder, wrong):
        assert wrong.encoder_offset.any()
        return identified(folder)

    def test_sensor_errors_are_estimated_within_their_standard_deviations(self, calibrated, wrong):
        verdict = calibrated.solve("map_lmi").estimate.verdict
        segment = next(iter(calibrated.dataset.segments))
        errors = SensorErrors.of(
            TYPICAL_ERRORS, calibrated.parameters.model, segment.wrench_frames, segment.imu_frames
        )
        assert tuple(quantity.name for quantity in verdict.sensors) == errors.names
        assert tuple(quantity.unit for quantity in verdict.sensors) == errors.units
        z = normalised(verdict.sensors, drawn(errors, wrong))
        assert np.sqrt(np.mean(z**2)) < 1.5
        assert np.abs(z).max() < 4.5
        # A log determines drives and the tilt of the robot better than a data sheet.
        for kind in ("torque_gain", "encoder_offset", "imu_mounting"):
            known = [one.determined for one in verdict.sensors[errors.places[kind]]]
            assert np.mean(known) > 0.5

    @pytest.mark.parametrize("method", ["map", "map_lmi"])
    def test_links_and_drives_are_estimated_within_their_standard_deviations(
        self, calibrated, method
    ):
        estimate = calibrated.solve(method).estimate
        parameters = calibrated.parameters
        z = (estimate.value - true_parameters(parameters)) / estimate.std
        assert np.sqrt(np.mean(z[estimate.determined] ** 2)) < 1.5
        for term, columns in parameters.term_columns.items():
            assert np.sqrt(np.mean(z[columns] ** 2)) < 1.8, term
            assert np.abs(z[columns]).max() < 4, term
        if method == "map_lmi":
            assert all(estimate.consistent.values())

    def test_sensor_errors_that_are_not_identified_raise_an_alarm(self, calibrated, uncalibrated):
        assert calibrated.solve("map").estimate.verdict.alarms == ()
        assert uncalibrated.solve("map").estimate.verdict.alarms != ()

    def test_identifying_sensor_errors_reduces_the_bias(self, calibrated, uncalibrated):
        truth = true_parameters(calibrated.parameters)
        with_calibration, without = (
            np.abs((p.solve("map").estimate.value - truth) / p.solve("map").estimate.std)
            for p in (calibrated, uncalibrated)
        )
        assert without.max() > 4 * with_calibration.max()


def test_filtered_rows_do_not_support_sensor_errors(folder, wrong):
    assert wrong.wrench_gain.any()
    with pytest.raises(OptionError, match="sensor errors need rows averaged over windows"):
        IdentifyOptions(sensor_errors=("torque_gain",), filter="butterworth")


@pytest.mark.parametrize(("seed", "floating"), [(1, True), (6, True), (2, False)])
def test_sensors_of_any_tree_are_calibrated(seed, floating):
    rng = np.random.default_rng(seed)
    parameters = ParameterSet(random_robot(seed, links=4, floating=floating))
    perfect = analytic_segment(parameters, 3.9, seed, start=0.05)
    errors = SensorErrors.of(
        TYPICAL_ERRORS, parameters.model, perfect.wrench_frames, perfect.imu_frames
    )
    theta = errors.std * rng.standard_normal(len(errors))
    levels = {"position": 1e-5, "rate": 2e-3, "acceleration": 0.02, "effort": 0.05, "wrench": 0.3}
    segment = noisy(spoilt(perfect, errors, theta), rng, **levels)
    log = dataset_of(parameters, [segment])
    offset = errors.of_kind("wrench_offset", theta)[0]
    tare = {errors.wrench_frames[0]: Tare(offset, np.repeat([1e-3, 1e-2], 3))}
    prior = draw_prior(parameters, "percent", 25, seed)
    found = calibrate(Problem((), parameters, prior), log, SensorErrorRequest(TYPICAL_ERRORS, tare))

    p = len(parameters)
    assert found.sensor_names == errors.names
    # Prior of a tared sensor: the tare's standard deviation; of others: that of a data sheet.
    place = errors.places["wrench_offset"]
    np.testing.assert_array_equal(found.prior.std[p:][place][:6], tare[errors.wrench_frames[0]].std)
    np.testing.assert_array_equal(found.prior.mean[p:][place][:6], offset)
    np.testing.assert_array_equal(found.prior.std[p:][place][6:12], DEVIATIONS["wrench_offset"])
    assert [one.window for one in found.observations][-1] == max(WINDOWS)
    after = posterior(found.observations[-1], found.prior, count=p)
    z = (after.mean - np.concatenate([parameters.values, theta])) / after.std
    assert np.sqrt(np.mean(z**2)) < 1.6
    told = after.std < 0.7 * found.prior.std
    assert told.sum() > 10
    assert np.sqrt(np.mean(z[told] ** 2)) < 1.8


def test_placements_of_joints_that_the_model_file_holds_exactly_vertical():
    """Gravity loads a turntable that is not quite level, which none of its parameters could do."""
    rng = np.random.default_rng(5)
    robot = random_robot(5, links=4, floating=False, wrench_frames=0)
    axes = np.eye(3)[[2, 1, 1]]
    joints = tuple(
        replace(joint, rotation=np.eye(3), axis=axis, kind="revolute", parent=index)
        for index, (joint, axis) in enumerate(zip(robot.joints, axes, strict=True))
    )
    stated = ParameterSet(replace(robot, joints=joints, gravity=np.array([0.0, 0.0, -9.81])))
    errors = SensorErrors.of(KINEMATIC_ERRORS, stated.model, (), ())
    theta = errors.std * rng.standard_normal(len(errors))
    perfect = analytic_segment(errors.placed(stated, theta), 11.9, 5, start=0.05)
    levels = {"position": 1e-5, "rate": 0.0, "acceleration": 0.0, "effort": 0.02, "wrench": 0.0}
    log = dataset_of(stated, [noisy(perfect, rng, **levels)])
    prior = draw_prior(stated, "percent", 25, 5)
    problem = Problem((), stated, prior)
    found = calibrate(problem, log, SensorErrorRequest(KINEMATIC_ERRORS, {}))
    after = posterior(found.observations[-1], found.prior, count=len(stated))
    error = after.mean - np.concatenate([stated.values, theta])
    assert np.mean((error / after.std) ** 2) < 2.0
    tilts = [errors.names.index(f"joint_0/joint_axis_{axis}") for axis in "xy"]
    std = after.std[len(stated) :]
    assert np.all(std[tilts] < 0.2 * errors.std[tilts])


def test_sensors_without_noise_are_calibrated():
    parameters = ParameterSet(random_robot(1, links=4))
    segment = analytic_segment(parameters, 3.9, 1, start=0.05)
    log = dataset_of(parameters, [segment])
    prior = draw_prior(parameters, "percent", 25, 1)
    found = calibrate(Problem((), parameters, prior), log, SensorErrorRequest(TYPICAL_ERRORS, {}))
    after = posterior(found.observations[-1], found.prior, count=len(parameters))
    assert np.all(np.isfinite(after.mean))
    assert np.all(after.std <= found.prior.std * (1 + 1e-9))
