"""A payload behind a wrist sensor is identified together with the arm and the sensor's offset."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from documented_robots import ur5_urdf
from payload_arm import COM, INERTIA, MASS, OFFSET, payload_arm_log

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.api import diagnose, identify
from symbid_ros.identification.installation import install
from symbid_ros.identification.predictions.comparison import compare
from symbid_ros.identification.predictions.validation import validate
from symbid_ros.identification.report_data import load_report_data
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.urdf import UrdfReader
from symbid_ros.model.xml_file import read_xml
from symbid_ros.signals.log import Log

FRAME = "tool0"
FAST = {"joint_terms": ("none",), "no_holdout": True, "window": 0.161}


@pytest.fixture(scope="module")
def true_arm():
    return load_model(ur5_urdf())


@pytest.fixture(scope="module")
def arm(true_arm):
    """Links of the arm are wrong by up to 25 %, and the payload is not in the model."""
    parameters = ParameterSet(true_arm)
    return parameters.apply(draw_prior(parameters, "consistent", 25, 1).mean)


@pytest.fixture(scope="module")
def measured(true_arm):
    """Efforts and wrenches of good sensors."""
    return payload_arm_log(true_arm, FRAME, seconds=15.0)


def log_of(arm, measured, wrench, frame=FRAME):
    return Log.from_arrays(
        arm,
        time=measured.time,
        position=measured.position,
        effort=measured.effort,
        wrenches={frame: wrench},
    )


def assert_payload(found, link, offset=OFFSET):
    payload = found.links[link]
    assert payload.mass == pytest.approx(MASS, rel=5e-3)
    np.testing.assert_allclose(payload.com, COM, atol=1e-3)
    np.testing.assert_allclose(payload.inertia, INERTIA, atol=1e-3)
    names = [f"{FRAME}/offset_{kind}_{axis}" for kind in ("force", "moment") for axis in "xyz"]
    errors = np.array([found.parameters[name].value for name in names]) - offset
    stds = np.array([found.parameters[name].std for name in names])
    assert np.all(np.abs(errors) < 4 * stds)
    assert all(found.parameters[name].is_determined for name in names)


def test_payload_arm_and_offset_are_found_together(arm, true_arm, measured):
    log = log_of(arm, measured, measured.wrench)
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST | {"no_holdout": False})
    assert_payload(found, FRAME)
    assert not found.alarms
    # The returned robot is the user's own, which carries the payload.
    assert found.robot.joint_names == arm.joint_names
    carried = found.robot.phi[-1, 0] - true_arm.phi[-1, 0]
    assert carried == pytest.approx(MASS, rel=0.02)
    assert found.estimate.holdout.percent_after < 2
    first, inertia, _ = found.estimate.describe_payloads()
    assert first.startswith("beyond tool0: 1.7")
    numbers = inertia.partition("zz: ")[2].removesuffix(" kg m²").split(", ")
    assert {len(one.partition(".")[2]) for one in numbers} == {6}


def test_a_gain_that_all_sensors_share_moves_no_centre_of_mass(arm, measured):
    """A gain of 1 % changes the mass by 1 %, not the centre of mass by 1 % of its distance."""
    log = log_of(arm, measured, measured.wrench)
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST)
    own = slice(*(found.estimate.names.index(f"{FRAME}/{name}") for name in ("m", "Ixx")))
    phi, covariance = found.estimate.value[own], found.covariance[own, own]
    slope = np.column_stack([-phi[1:] / phi[0], np.eye(3)]) / phi[0]
    std = np.sqrt(np.diag(slope @ covariance @ slope.T))
    error = phi[1:] / phi[0] - COM
    assert np.all(np.abs(error) < 4 * std)
    assert np.all(std < 0.1 * 0.01 * np.linalg.norm(COM))
    assert found.parameters[f"{FRAME}/m"].std == pytest.approx(0.01 * MASS, rel=0.1)


def test_terms_chosen_by_the_data_are_those_of_joints_only(arm, measured):
    log = log_of(arm, measured, measured.wrench)
    options = FAST | {"joint_terms": ("auto",)}
    found = identify(arm, log, wrist_sensor=(FRAME,), **options)
    assert_payload(found, FRAME)
    assert set(found.estimate.joint_terms) == set(arm.joint_names)


def test_a_sensor_of_the_opposite_sign_is_recognised(arm, measured, caplog):
    log = log_of(arm, measured, -measured.wrench)
    with caplog.at_level(logging.WARNING):
        found = identify(arm, log, wrist_sensor=(FRAME,), **FAST)
    assert "give `wrist_sensor` -tool0" in caplog.text
    assert_payload(found, FRAME, -OFFSET)
    assert found.estimate.wrist_sensors == ("-tool0:tool0",)


def test_a_sensor_that_is_not_named_is_recognised(arm, measured, caplog):
    log = log_of(arm, measured, measured.wrench)
    with caplog.at_level(logging.WARNING):
        identify(arm, log, **FAST, unchecked=True)
    assert "a body of 1.7 kg fixed to it" in caplog.text
    assert "give `wrist_sensor` tool0" in caplog.text


def test_efforts_are_right_although_a_sensor_is_not_named(arm, measured):
    """Taken for a contact's, the wrench of a payload seems to load the joints too."""
    log = log_of(arm, measured, measured.wrench)
    (finding,) = diagnose(arm, log).findings
    assert finding.kind is Kind.WRIST_SENSOR
    found = identify(arm, log, **FAST | {"no_holdout": False})
    assert not found.estimate.verdict.sensors
    assert any(finding.message.partition(";")[0] in alarm for alarm in found.alarms)


def test_without_any_effort_the_payload_is_still_found(arm, measured):
    silent = replace(measured, effort=np.full_like(measured.effort, np.nan))
    log = log_of(arm, silent, measured.wrench)
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST)
    assert_payload(found, FRAME)
    assert not any(one.is_determined for name, one in found.parameters.items() if "arm" in name)
    # What a payload tells about its own prior is nothing about the links of the model file.
    assert found.estimate.verdict.prior_scale == pytest.approx(1, abs=0.01)
    mass = found.parameters["forearm_link/m"]
    assert mass.std > 0.14 * mass.value
    assert validate(found, log).percent_after < 2


def test_a_sensor_whose_gain_contradicts_the_efforts_raises_an_alarm(arm, measured):
    for gain in (0.85, 1.15):
        log = log_of(arm, measured, gain * measured.wrench)
        found = identify(arm, log, wrist_sensor=(FRAME,), **FAST)
        (alarm,) = (one for one in found.alarms if one.startswith("the wrench at tool0 reads"))
        said = re.search(r"reads ([0-9.]+) ± ([0-9.]+) times", alarm)
        value, std = map(float, said.groups())
        assert abs(value - gain) < 3 * std < 0.15


def test_a_reversed_sensor_that_is_not_named_does_not_accuse_the_efforts(arm, measured):
    found = diagnose(arm, log_of(arm, measured, -measured.wrench))
    (finding,) = found.findings
    assert finding.kind is Kind.WRIST_SENSOR
    assert "give `wrist_sensor` -tool0" in finding.message
    assert any("the wrench at tool0" in one and "torque_gain" in one for one in found.left_out)


def test_the_scale_of_unknown_drive_gains_contains_the_payload(true_arm, measured):
    """The drives carry a payload that the model file lacks, and the sensor weighs it."""
    factors = np.array([2.0, 0.5, 4.0, 1.0, 0.25, 3.0])
    log = log_of(true_arm, replace(measured, effort=measured.effort / factors), measured.wrench)
    found = identify(true_arm, log, wrist_sensor=(FRAME,), drive_gain="all", **FAST)
    gains = [one.value for one in found.estimate.verdict.sensors]
    np.testing.assert_allclose(gains, factors, rtol=0.03)
    assert_payload(found, FRAME)


def late_log(arm, measured, late):
    """Return the log of a sensor whose wrenches come ``late`` samples after the motion."""
    return log_of(arm, measured, np.roll(measured.wrench, late, axis=0))


def test_a_late_sensor_is_found_and_named(arm, measured):
    period = measured.time[1] - measured.time[0]
    late = max(1, round(0.008 / period))
    log = late_log(arm, measured, late)
    (finding,) = diagnose(arm, log, wrist_sensor=(FRAME,)).findings
    assert finding.kind is Kind.DELAY
    assert finding.figures["delay_ms"] == pytest.approx(1e3 * late * period, abs=0.3)
    assert not diagnose(arm, late_log(arm, measured, 0), wrist_sensor=(FRAME,)).findings
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST | {"window": None})
    assert any("likely cause: delays of sensors, mostly of tool0" in one for one in found.alarms)


def test_a_drifting_sensor_is_named(arm, measured):
    """A random walk, as of a sensor that warms up: 2 N and 0.1 Nm at the end of the log."""
    steps = np.random.default_rng(1).normal(size=measured.wrench.shape) / np.sqrt(
        len(measured.time)
    )
    drift = np.cumsum(steps, axis=0) * np.repeat([2.0, 0.1], 3)
    log = log_of(arm, measured, measured.wrench + drift)
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST | {"window": None})
    cause = "cause: offsets of wrist sensors that change during the log, mostly of tool0"
    assert any(cause in one for one in found.alarms), found.alarms


def test_the_delay_of_a_sensor_is_estimated(arm, measured):
    period = measured.time[1] - measured.time[0]
    late = max(1, round(0.008 / period))
    log = late_log(arm, measured, late)
    options = FAST | {"sensor_errors": ("sensor_delay",)}
    found = identify(arm, log, wrist_sensor=(FRAME,), **options)
    assert_payload(found, FRAME)
    errors = {one.name: one.value for one in found.estimate.verdict.sensors}
    assert errors[f"{FRAME}/sensor_delay"] == pytest.approx(late * period, abs=3e-4)
    assert errors["efforts/sensor_delay"] == pytest.approx(0, abs=3e-4)


def check_changed_sensors(found, arm, measured):
    """Another tare spares the links and the payload; a turned sign or another load do not."""
    carried = measured.wrench - OFFSET
    tare = np.array([-3.0, 2.5, -6.0, -0.1, 0.2, 0.05])
    other = validate(found, log_of(arm, measured, measured.wrench + tare))
    assert other.verdict.startswith(f"use it, but not its offset of {FRAME}: ")
    (change,) = other.offsets
    np.testing.assert_allclose(np.r_[change.force, change.moment], tare, atol=0.02)
    assert other.is_recommended
    assert other.coverage > 0.8
    reversed_sign = validate(found, log_of(arm, measured, -measured.wrench))
    assert reversed_sign.worse == (f"moment at {FRAME}", f"force at {FRAME}")
    assert not reversed_sign.is_recommended
    assert f" of the measured force at {FRAME}" in reversed_sign.verdict
    heavier = validate(found, log_of(arm, measured, measured.wrench + 0.3 * carried))
    assert not heavier.offsets


def test_a_saved_result_predicts_the_sensor_and_merges(arm, measured, tmp_path):
    log = log_of(arm, measured, measured.wrench)
    found = identify(arm, log, wrist_sensor=(FRAME,), **FAST | {"no_holdout": False})
    found.save(tmp_path)
    again = validate(tmp_path, log)
    assert {one.name for one in again.coordinates} >= {f"{FRAME}/force_z", "elbow_joint"}
    check_changed_sensors(found, arm, measured)
    with pytest.raises(EstimateError, match=r"wrist sensors are none instead of tool0:tool0"):
        compare([found, identify(arm, log, unchecked=True, **FAST)], log)
    series = load_report_data(tmp_path).forces
    of_sensor = [name.startswith(FRAME) for name in series.coordinates]
    np.testing.assert_array_equal(np.isnan(series.speed).all(axis=0), of_sensor)
    written = load_model(tmp_path / "model.urdf", "fixed")
    np.testing.assert_allclose(written.phi, found.robot.phi, atol=1e-9)
    other = identify(arm, found.information, wrist_sensor=(FRAME,), joint_terms=("none",))
    np.testing.assert_allclose(other.estimate.value, found.estimate.value, rtol=1e-6, atol=1e-9)


def test_the_users_file_gets_the_payload_in_the_link_of_the_sensor(arm, measured, tmp_path):
    """The result's own file is the same; the wrist does not become heavier by the payload."""
    file = tmp_path / "arm.urdf"
    file.write_text(urdf_text(arm, ur5_urdf()))
    robot = load_model(file)
    log = log_of(robot, measured, measured.wrench)
    identify(robot, log, wrist_sensor=(FRAME,), **FAST).save(tmp_path / "found")
    install(tmp_path / "found", file)
    written, expected = (
        UrdfReader(str(path), read_xml(path)) for path in (file, tmp_path / "found" / "model.urdf")
    )
    assert written.phi(FRAME)[0] == pytest.approx(MASS, rel=5e-3)
    for link in ("wrist_3_link", FRAME):
        np.testing.assert_allclose(written.phi(link), expected.phi(link), rtol=1e-9, atol=1e-12)


def test_a_log_without_the_sensor_is_refused(arm, measured):
    log = log_of(arm, measured, measured.wrench, frame="ee_link")
    with pytest.raises(DataError, match=r"no array of wrenches has the frame tool0 .*ee_link"):
        identify(arm, log, wrist_sensor=(FRAME,), **FAST)
