"""Efforts in unknown units: signs, factors, and what fixes their scale."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, heavy_arm, log_of

import symbid_ros as sy
from symbid_ros.errors import OptionError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.causes.gain_check import wrong_factors
from symbid_ros.identification.end_check import CheckedTrial
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.holdout import hold_out
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.online.initial_state import InitialState

FACTORS = np.array([3.0, -0.2, 15.0])
FRICTION = {"viscous": 0.4, "coulomb": 0.8}


def driven(robot):
    return replace(robot, joints=tuple(replace(one, effort=np.inf) for one in robot.joints))


@pytest.fixture(scope="module")
def robot():
    return driven(arm(seed=2))


@pytest.fixture(scope="module")
def model(robot, tmp_path_factory):
    """What is known of the robot: wrong masses."""
    wrong = robot.with_phi(robot.phi * np.array([0.75, 0.9, 1.2, 0.8])[:, None])
    path = tmp_path_factory.mktemp("arm") / "robot.urdf"
    path.write_text(urdf_text(wrong))
    return sy.load_model(path, base="fixed")


@pytest.fixture(scope="module")
def currents(robot):
    return log_of(robot, drives(robot, **FRICTION), gain=FACTORS)


def factors(result):
    return np.array([one.value for one in result.estimate.verdict.sensors])


def test_signs_and_ratios_of_factors_need_no_calibrated_joint(model, currents):
    result = sy.identify(model, currents, drive_gain="all")
    relative = factors(result) / FACTORS
    np.testing.assert_allclose(relative / relative[0], 1.0, rtol=2e-3)
    assert 0.75 < relative[0] < 1.25
    assert any("does not show the common scale" in one for one in result.estimate.remarks)
    assert result.estimate.holdout.percent_after < 0.5


def test_a_calibrated_joint_fixes_the_scale(tmp_path, robot, model):
    log = log_of(robot, drives(robot, **FRICTION), gain=np.append(FACTORS[:2], 1.0))
    named = ",".join(robot.joint_names[:2])
    result = sy.identify(model, log, drive_gain=named, no_holdout=True)
    np.testing.assert_allclose(factors(result), FACTORS[:2], rtol=3e-3)
    assert not any("common scale" in one for one in result.estimate.remarks)
    result.save(tmp_path)
    predicted = ForcePredictor.load(tmp_path)
    assert predicted.sensor_names == tuple(f"{one}/drive_gain" for one in robot.joint_names[:2])
    assert sy.validate(tmp_path, log).percent_after < 0.5


def test_a_known_payload_fixes_the_scale(robot, model, currents):
    mass, place = 1.5, (0.02, -0.1, 0.2)
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(mass, np.array(place), np.zeros((3, 3)))
    truth = drives(robot.with_phi(phi), **FRICTION)
    loaded = log_of(robot.with_phi(phi), truth, gain=FACTORS, seed=1, start=100.0)
    payload = ",".join([robot.link_names[-1], str(mass), *map(str, place)])
    fields = {"drive_gain": "all", "no_holdout": True, "unchecked": True}
    result = sy.identify(model, currents, payload=[(loaded, payload)], **fields)
    np.testing.assert_allclose(factors(result), FACTORS, rtol=3e-3)
    gains = result.estimate.verdict.describe_drive_gains()
    for joint, factor in zip(model.joint_names, factors(result), strict=True):
        assert f"{joint} {factor:.4g} ± " in gains
    assert not any("common scale" in one for one in result.estimate.remarks)


def test_a_payload_that_is_carried_all_the_time_needs_a_log_without_it(robot, model, currents):
    payload = f"{robot.link_names[-1]},1.5,0.02,-0.1,0.2"
    fields = {"drive_gain": "all", "no_holdout": True, "unchecked": True, "payload": [payload]}
    (remark,) = (
        one
        for one in sy.identify(model, currents, **fields).estimate.remarks
        if "common scale" in one
    )
    assert "carried all the time" in remark
    assert "give a log without it" in remark


def test_a_payload_of_unknown_place_fixes_the_scale(tmp_path, robot, model, currents):
    mass, place = 1.5, np.array([0.02, -0.1, 0.06])
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(mass, place, np.zeros((3, 3)))
    truth = drives(robot.with_phi(phi), **FRICTION)
    loaded = log_of(robot.with_phi(phi), truth, gain=FACTORS, seed=1, start=100.0)
    link = robot.link_names[-1]
    fields = {"drive_gain": "all", "unchecked": True}
    result = sy.identify(model, currents, payload=[(loaded, f"{link},{mass}")], **fields)
    np.testing.assert_allclose(factors(result)[:3], FACTORS, rtol=5e-3)
    np.testing.assert_allclose(factors(result)[3:], place, atol=2e-3)
    (line,) = result.estimate.verdict.describe_payload_places()
    assert line.startswith(f"payload of 1.5 kg on {link}: centre of mass at (")
    assert result.estimate.holdout.percent_after < 1.0
    result.save(tmp_path)
    assert sy.validate(tmp_path, currents).percent_after < 1.0


def brisk(robot, seed=0, seconds=6.0, gain=1.0):
    """Return a log of few slow windows, in which drives rub and turn rotors."""
    truth = drives(robot, **FRICTION, armature=0.3)
    return log_of(robot, truth, seed=seed, seconds=seconds, slowdown=1.0, gain=gain)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_short_log_of_brisk_motion_is_enough(robot, model, seed):
    log = brisk(robot, seed, gain=FACTORS)
    result = sy.identify(model, log, drive_gain="all", no_holdout=True)
    relative = factors(result) / FACTORS
    np.testing.assert_allclose(relative / relative[0], 1.0, rtol=5e-3)
    assert sy.validate(result, brisk(robot, seed + 10, gain=FACTORS)).percent_after < 0.5
    terms = ("viscous", "coulomb", "armature")
    assert all(set(one) >= set(terms) for one in result.estimate.joint_terms.values())


@pytest.mark.parametrize("kind", ["encoder_offset", "sensor_delay"])
def test_sensor_errors_need_no_longer_log_than_links(robot, model, kind):
    result = sy.identify(model, brisk(robot), sensor_errors=kind, no_holdout=True)
    assert sy.validate(result, brisk(robot, seed=10)).percent_after < 0.5


@pytest.mark.parametrize(("error", "is_large"), [(0.002, False), (0.05, True)])
def test_a_zero_that_errs_far_beyond_its_prior_raises_an_alarm(robot, error, is_large):
    """The prior of .11 degrees holds it back, and the links take the rest."""
    joints = log_of(robot, drives(robot, **FRICTION)).streams().joints
    log = sy.Log.from_arrays(
        robot,
        time=(joints.stamp - joints.stamp[0]) * 1e-9,
        position=joints.position + error * np.eye(len(robot.joints))[1],
        effort=joints.effort,
    )
    found = sy.identify(robot, log, sensor_errors="encoder_offset", no_holdout=True, unchecked=True)
    named = [one for one in found.alarms if one.startswith("encoder offsets are too large")]
    assert len(named) == is_large
    assert all(f"{robot.joint_names[1]} (" in one for one in named)


@pytest.mark.parametrize("seed", [0, 1])
def test_gains_of_coupled_drives(robot, model, seed):
    drive = np.array([0.0, 1.0, -1.0])

    def coupled(velocity, acceleration):
        speed = velocity @ drive
        torque = 0.6 * speed + 1.5 * np.sign(speed) + 0.05 * (acceleration @ drive)
        return torque[:, None] * drive

    gains = np.array([3.0, 0.5, 15.0])
    log = log_of(robot, drives(robot, **FRICTION), seed=seed, extra=coupled, gain=gains)
    label = f"{robot.joint_names[1]}-{robot.joint_names[2]}"
    result = sy.identify(model, log, drive_gain="all", coupling=label, unchecked=True)
    relative = factors(result) / gains
    np.testing.assert_allclose(relative / relative[0], 1.0, rtol=2e-3)
    assert set(result.estimate.joint_terms[label]) >= {"viscous", "coulomb", "armature"}
    assert result.estimate.holdout.percent_after < 0.5


def test_unknown_joints_are_refused(model, currents):
    with pytest.raises(OptionError, match="drive_gain"):
        sy.identify(model, currents, drive_gain="elbow")


def test_gains_need_a_complete_log(model, caplog):
    initial = InitialState.of(model, sy.IdentifyOptions(drive_gain="all"))
    assert not initial.options.drive_gain
    assert "no effect live" in caplog.text
    with pytest.raises(OptionError, match="drive_gain"):
        sy.IdentifyOptions(drive_gain="all", method="ols")
    with pytest.raises(OptionError, match="information"):
        sy.IdentifyOptions(drive_gain="all", information="earlier/information.npz")
    with pytest.raises(OptionError, match="has no effect without `drive_gain`"):
        sy.IdentifyOptions(drive_gain_percent=20.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_torque_constants_are_identified_with_an_alarm(robot, model, seed):
    def identified(gain, **options):
        log = log_of(robot, drives(robot, **FRICTION), seed=seed, gain=gain)
        result = sy.identify(model, log, **options)
        return result, [one for one in result.alarms if "wrong factors" in one]

    right, alarms = identified(1.0)
    assert not alarms
    assert not right.estimate.verdict.sensors
    gain = np.array([1.0, 1 / 0.85, 1.0])
    wrong, (alarm,) = identified(gain)
    (name,) = (one for one in robot.joint_names if f"{one} reads" in alarm)
    assert name == robot.joint_names[1]
    assert f"{name} reads 0.85 times the torque" in alarm
    assert [one.name for one in wrong.estimate.verdict.sensors] == [f"{name}/drive_gain"]
    np.testing.assert_allclose(factors(wrong), 1 / 0.85, rtol=3e-3)
    assert wrong.estimate.holdout.percent_after < 1.5 * right.estimate.holdout.percent_after
    kept, alarms = identified(gain, drive_gain="none")
    assert not alarms
    assert not kept.estimate.verdict.sensors
    assert kept.estimate.holdout.percent_after > 3 * wrong.estimate.holdout.percent_after


def test_rounded_angles_of_the_model_do_not_disturb_factors() -> None:
    """The least entries of rows are near the limit below which they count as zero."""
    robot = heavy_arm()
    joint = robot.joint_names[1]
    gain = np.array([1.0, 1 / 0.85, 1.0])
    log = log_of(robot, drives(robot, viscous=400.0, coulomb=800.0), gain=gain)
    model = robot.with_phi(robot.phi * np.array([0.75, 0.9, 1.2, 0.8])[:, None])
    found = sy.identify(model, log)
    assert any(f"{joint} reads 0.85 times the torque" in one for one in found.alarms)
    np.testing.assert_allclose(factors(found), 1 / 0.85, rtol=3e-3)


@pytest.mark.parametrize("gain", [(0.85, 1.1, 1.25), (1.2, 0.85, 1.0)])
def test_factors_of_all_joints_are_uncertain_if_several_err(robot, gain):
    """If those of joints that do not stand out counted as exact, wrong masses would as well."""
    links = ParameterSet(robot)
    model = links.apply(draw_prior(links, "consistent", 25.0, seed=3).mean)
    log = log_of(robot, drives(robot, **FRICTION), gain=np.array(gain))
    found = sy.identify(model, log)
    (alarm,) = (one for one in found.alarms if Alarm.UNCERTAIN_FACTORS in one)
    assert "drive_gain" in alarm
    relative = factors(found) / gain
    deviations = np.array([one.std for one in found.estimate.verdict.sensors]) / gain
    assert np.all(np.abs(relative - 1) < 3 * deviations)
    assert np.all(deviations > 0.02)
    np.testing.assert_allclose(relative / relative[0], 1.0, rtol=5e-3)
    kept = sy.identify(model, log, drive_gain="none")
    assert not kept.estimate.verdict.sensors
    assert found.estimate.holdout.percent_after < 0.1 * kept.estimate.holdout.percent_after
    stated = sy.identify(model, log, drive_gain="all", drive_gain_percent=20.0)
    np.testing.assert_allclose(factors(stated), factors(found), rtol=1e-6)


@pytest.fixture(scope="module")
def carrying():
    """The model of an arm, a log with a tool that it lacks, and the mass of the last link then."""
    robot = driven(arm(seed=0, links=6))
    links = ParameterSet(robot.with_phi(robot.phi * np.array([1.0] * 5 + [0.02])[:, None]))
    model = links.apply(draw_prior(links, "consistent", 60.0, seed=3).mean)
    phi = links.model.phi.copy()
    phi[-1] += phi_from_com(4.0, 0.12 * np.array([0.6, 0.8, 0.0]), np.zeros((3, 3)))
    return model, log_of(robot, drives(robot.with_phi(phi), **FRICTION)), phi[-1, 0]


def with_error(check, percent):
    return replace(check, holdout=replace(check.holdout, percent_after=percent))


def test_a_missing_tool_is_no_factor_of_all_efforts(carrying):
    """Masses, factors and noise that shrink together explain the log as well."""
    model, log, _ = carrying
    problem = load_problem(model, log, IdentifyOptions())
    check = hold_out(problem, problem.solve().window, 0)
    assert check.holdout.percent_after < 0.1
    tried = []

    def by_chance(other):
        found = other.solve()
        tried.append([one.value for one in found.estimate.verdict.sensors])
        return CheckedTrial(other, found, with_error(check, 0.5))

    assert wrong_factors(problem, check, by_chance) is None
    assert not tried  # there is nothing to explain
    assert wrong_factors(problem, with_error(check, 1.0), by_chance) is None
    assert np.all(np.abs(tried) < 0.4)


def test_a_missing_tool_is_named_and_leaves_the_mass_uncertain(carrying):
    """Its first moment needs a mass, of which the motion tells nothing else."""
    model, log, truth = carrying
    found = sy.identify(model, log, no_holdout=True)
    (alarm,) = (one for one in found.alarms if Alarm.HEAVY_LINK in one)
    mass = found.parameters["link_5/m"]
    assert alarm.startswith(f"link_5 is {mass.value / model.phi[-1, 0]:.2g} times")
    assert abs(mass.value - truth) < 2 * mass.std


@pytest.mark.parametrize(
    ("gain", "named"),
    [((5.0, 5.0, 0.45), [0, 1, 2]), ((6.0, 0.5, 0.5), [0, 1, 2]), ((1.0, 10.0, 1.0), [1])],
)
def test_factors_that_differ_as_those_of_currents_are_identified(robot, model, gain, named):
    """Equal factors of equal drives are no torques: only those that fit the model's masses are."""
    log = log_of(robot, drives(robot, **FRICTION), gain=np.array(gain))
    found = sy.identify(model, log)
    (alarm,) = (one for one in found.alarms if Alarm.WRONG_FACTORS in one)
    is_open = len(named) == len(gain)
    assert ("only their ratios" in alarm) == is_open
    assert any("does not show the common scale" in one for one in found.estimate.remarks) == is_open
    sensors = [one.name for one in found.estimate.verdict.sensors]
    assert sensors == [f"{robot.joint_names[index]}/drive_gain" for index in named]
    relative = factors(found) / np.array(gain)[named]
    np.testing.assert_allclose(relative / relative[0], 1.0, rtol=5e-3)
    assert 0.75 < relative[0] < 1.25 if is_open else abs(relative[0] - 1) < 5e-3
    assert found.estimate.holdout.percent_after < 0.5


def test_a_sign_that_the_log_does_not_show_is_reported_once_if_factors_are_asked_for(robot, caplog):
    joints = log_of(robot, drives(robot)).streams().joints
    effort = joints.effort.copy()
    effort[:, 1] = np.random.default_rng(0).normal(size=len(effort))
    time = (joints.stamp - joints.stamp[0]) * 1e-9
    log = sy.Log.from_arrays(robot, time=time, position=joints.position, effort=effort)
    options = IdentifyOptions(no_holdout=True)
    problem = load_problem(robot, log, options)
    problem.with_drive_gains(("all",))  # as `wrong_factors` tries
    assert "the sign of the effort" not in caplog.text
    load_problem(robot, log, replace(options, drive_gain=("all",)))
    said = [one for one in caplog.messages if "the sign of the effort" in one]
    assert len(said) == 1
    assert "the effort of joint_1, which" in said[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_factor_that_friction_hides_is_uncertain(robot, seed):
    """A light wrist's effort is friction and armature, which grow and shrink with the factor."""
    light = robot.with_phi(robot.phi * np.array([1.0, 1.0, 1.0, 1e-3])[:, None])
    truth = drives(light, viscous=0.4, coulomb=0.8, armature=0.1)
    log = log_of(light, truth, seed=seed)
    rng = np.random.default_rng(seed)
    wrong = light.with_phi(light.phi * rng.uniform(0.8, 1.2, 4)[:, None])
    found = sy.identify(wrong, log, drive_gain="joint_2")
    (last,) = found.estimate.verdict.sensors
    assert last.std > 0.03
    assert abs(last.value - 1) < 3 * last.std
    for term, value in (("viscous", 0.4), ("coulomb", 0.8), ("armature", 0.1)):
        one = found.parameters[f"joint_2/{term}"]
        assert abs(one.value - value) < 3 * one.std
    assert not found.alarms
    # Efforts of unknown unit are columns: their size must not be that of the noise.
    sizes = {one.coordinate: one.measured for one in found.estimate.verdict.unexplained}
    assert sizes["joint_2"] > 0.5
