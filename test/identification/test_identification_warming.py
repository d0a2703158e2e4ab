"""Friction that changes while drives warm up, found and left behind at the end of a log."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, log_of

import symbid_ros as sy
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import RowSettings
from symbid_ros.estimation.group_moments import GROUPS, SECOND, Grouping
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.force_errors import ForceRows
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.identification.stored_information import with_constant_friction
from symbid_ros.identification.terms import further_terms
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.warming import NODES, is_change
from symbid_ros.online.initial_state import InitialState
from symbid_ros.report.data_summary import verdict_entries

SECONDS = 64.0
START = 0.0  # s, of a simulated clock
VISCOUS, COULOMB = 0.4, 0.8
MILLI = SECOND // 1000
WARM = np.exp(-2.0)  # what is left of the change at the end


def change(share):
    """Return what friction exceeds its final value by, from 1 - WARM to 0."""
    return np.exp(-2.0 * share) - WARM


def cold(velocity, acceleration):
    """Return more viscous friction of the first joint, and more Coulomb friction of the second."""
    left = change(np.linspace(0, 1, len(velocity)))
    torque = np.zeros_like(velocity)
    torque[:, 0] = 0.5 * left * velocity[:, 0]
    torque[:, 1] = 0.6 * left * np.sign(velocity[:, 1])
    return torque


EXCESS = {("joint_0", "viscous"): 0.5, ("joint_1", "coulomb"): 0.6}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("warming") / "robot.urdf"
    path.write_text(urdf_text(arm(seed=2, links=3)))
    return sy.load_model(path, base="fixed")


@pytest.fixture(scope="module")
def log(robot):
    truth = drives(robot, viscous=VISCOUS, coulomb=COULOMB)
    return log_of(robot, truth, extra=cold, seconds=SECONDS, start=START)


@pytest.fixture(scope="module")
def found(robot, log):
    return sy.identify(robot, log, unchecked=True, jobs=2)


def test_the_joints_whose_friction_changes_are_found(robot, found) -> None:
    parameters = ParameterSet.of_names(robot, found.estimate.names)
    names = robot.joint_names
    assert {(names[one.joint], one.term) for one in parameters.warming} == set(EXCESS)
    for (joint, term), size in EXCESS.items():
        for node in NODES[:-1]:
            one = found.parameters[f"{joint}/{term}_excess_{node}"]
            true = size * change(node / 100)
            assert one.is_determined
            assert abs(one.value - true) < max(4 * one.std, 0.01 * size)
            assert one.unit == found.parameters[f"{joint}/{term}"].unit
    assert not found.alarms
    assert not any("excess" in one for one in found.estimate.remarks)
    grouped = found.estimate.verdict.base
    assert {"joint_0/viscous", "joint_0/viscous_excess_60"} <= {one.name for one in grouped}


def test_the_model_has_the_friction_at_the_end(robot, found) -> None:
    for joint in robot.joint_names:
        for term, true in (("viscous", VISCOUS), ("coulomb", COULOMB)):
            one = found.parameters[f"{joint}/{term}"]
            assert abs(one.value - true) < max(4 * one.std, 0.005 * true)
    damping = [joint.damping for joint in found.robot.joints]
    np.testing.assert_allclose(damping, VISCOUS, rtol=0.01)


def test_the_end_of_the_log_is_predicted_with_the_friction_before_it(robot, log, found) -> None:
    constant = sy.identify(
        robot, log, unchecked=True, joint_terms=("viscous", "coulomb", "armature")
    )
    assert found.estimate.holdout.percent_after < 0.7 * constant.estimate.holdout.percent_after
    assert "changes during the log" in constant.alarms[0]
    assert "leave `joint_terms` and `sensor_errors` out" in constant.alarms[0]


@pytest.fixture(scope="module")
def warm(robot):
    """Return a log of the warm robot whose clock starts as that of the identified log."""
    return log_of(robot, drives(robot, viscous=VISCOUS, coulomb=COULOMB), seed=5, start=START)


def test_another_log_is_predicted_with_the_friction_at_the_end(found, warm) -> None:
    checked = sy.validate(found, warm)
    assert checked.verdict.startswith("use it: ")
    assert checked.percent_after < 0.3


def test_filtered_rows_have_the_friction_at_the_end_as_well(robot, found, warm) -> None:
    predictor = replace(found.predictor, settings=RowSettings("butterworth", cutoff=10.0))
    rows = ForceRows.of(predictor, AlignedLog(warm, robot), "warm")
    error = (rows.after - rows.y)[rows.valid]
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.sqrt(np.mean(rows.y**2))


def test_the_identified_log_is_predicted_with_its_own_friction(robot, log, found) -> None:
    end = 20.0
    joints = log.streams().joints
    is_early = joints.stamp < 1e9 * (START + end)
    early = sy.Log.from_arrays(
        robot,
        time=1e-9 * joints.stamp[is_early],
        position=joints.position[is_early],
        effort=joints.effort[is_early],
    )
    for one in (log, early):
        assert sy.validate(found, one).percent_after < 0.3


def test_the_summary_tells_the_change(found) -> None:
    number = r"(-?[.0-9]+)"
    lines = found.estimate.describe_warming()
    assert len(lines) == len(EXCESS)
    for line, ((joint, term), size), last in zip(
        lines, EXCESS.items(), (VISCOUS, COULOMB), strict=True
    ):
        said = re.fullmatch(
            rf"{term} friction of {joint} changes by {number} ± {number} Nm(?: s/rad)? during the "
            rf"log, from {number} to {number}",
            line,
        )
        assert said, line
        true = -size * change(0.0), last + size * change(0.0), last
        values = [float(said[place]) for place in (1, 3, 4)]
        np.testing.assert_allclose(values, true, rtol=0.02)
    assert "change of viscous during the log (joint_0)" in found.estimate.describe_terms()
    (entry,) = [one for one in verdict_entries(found.estimate) if one.name == "Changing friction"]
    assert entry.value == "; ".join(lines)


def test_constant_friction_stays_constant(robot) -> None:
    truth = drives(robot, viscous=VISCOUS, coulomb=COULOMB)

    def strange(velocity, acceleration):
        """Leave residuals that no term explains."""
        angle = np.cumsum(velocity, axis=0) / 200.0
        return 0.5 * np.sin(7 * (angle + np.roll(angle, 1, axis=1)))

    log = log_of(robot, truth, extra=strange, seconds=SECONDS)
    plain = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert plain.estimate.verdict.is_coloured
    assert not ParameterSet.of_names(robot, plain.estimate.names).warming


@pytest.fixture(scope="module")
def with_pause(robot):
    """A log whose first joint is cold twice, and colder the first time."""

    def twice(velocity, acceleration):
        left = np.array([[1.0], [0.6]]) * change(np.linspace(0, 1, len(velocity) // 2))
        left[0] += 0.2
        torque = np.zeros_like(velocity)
        torque[:, 0] = left.ravel() * velocity[:, 0]
        return torque

    truth = drives(robot, viscous=VISCOUS, coulomb=COULOMB)
    joints = log_of(robot, truth, extra=twice, seconds=SECONDS).streams().joints
    time = 1e-9 * joints.stamp
    time[len(time) // 2 :] += 100.0
    return sy.Log.from_arrays(robot, time=time, position=joints.position, effort=joints.effort)


def test_drives_that_cooled_in_a_pause_warm_up_again(robot, with_pause) -> None:
    """The result has the friction at the end of the second part."""
    found = sy.identify(robot, with_pause, unchecked=True, no_holdout=True)
    assert len(found.estimate.courses) == 2
    assert not found.alarms
    expected = {"viscous": VISCOUS, "viscous_excess_0": 0.6 * change(0.0)}
    expected |= {f"viscous_excess_part1_{node}": 0.2 + change(node / 100) for node in NODES}
    for term, true in expected.items():
        one = found.parameters[f"joint_0/{term}"]
        assert abs(one.value - true) < max(4 * one.std, 0.01)


def test_a_log_with_many_pauses_is_not_searched(robot, with_pause, monkeypatch, caplog) -> None:
    monkeypatch.setattr(further_terms, "MOST_PARTS", 1)
    caplog.set_level(logging.INFO)
    found = sy.identify(robot, with_pause, unchecked=True, no_holdout=True)
    assert not found.estimate.courses
    assert "divide it into 2 parts" in caplog.text


def hour_apart(robot, seconds):
    """Return two recordings with an hour between them and the residuals of fast and slow motion."""
    truth = drives(robot, viscous=VISCOUS, coulomb=COULOMB)
    parts = [
        log_of(
            robot,
            truth,
            seed=seed,
            seconds=seconds,
            start=start,
            slowdown=slowdown,
            extra=lambda velocity, acceleration: 0.6 * velocity * np.abs(velocity),
        )
        .streams()
        .joints
        for seed, start, slowdown in ((3, START, 0.6), (4, START + 3600.0, 0.3))
    ]
    time = np.concatenate([1e-9 * one.stamp for one in parts])
    position = np.concatenate([one.position for one in parts])
    effort = np.concatenate([one.effort for one in parts])
    return sy.Log.from_arrays(robot, time=time, position=position, effort=effort)


@pytest.mark.parametrize("least", [further_terms.LEAST_WARMING, 0])
def test_a_pause_is_not_taken_for_time_to_warm_up(robot, monkeypatch, least) -> None:
    """Two short recordings show no change, however long the pause between them is."""
    monkeypatch.setattr(further_terms, "LEAST_WARMING", least)
    log = hour_apart(robot, seconds=20.0)
    found = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert found.estimate.verdict.is_coloured
    assert not found.estimate.courses


def test_groups_have_equal_recorded_time() -> None:
    hour = 3600 * SECOND
    stamp = np.concatenate([np.arange(0, 3 * SECOND, MILLI), hour + np.arange(0, SECOND, MILLI)])
    spans = [(0, 3 * SECOND), (hour, hour + SECOND)]
    counts = np.bincount(Grouping.contiguous(spans).of(stamp), minlength=GROUPS)
    np.testing.assert_allclose(counts, len(stamp) / GROUPS, atol=2)


def test_a_saved_result_predicts_the_same_and_its_information_too(tmp_path, robot, found) -> None:
    found.save(tmp_path / "result")
    loaded = ForcePredictor.load(tmp_path / "result")
    assert loaded.parameters.warming == found.predictor.parameters.warming
    information = sy.LogInformation.load(tmp_path / "result/information.npz")
    again = sy.identify(robot, information)
    np.testing.assert_allclose(again.estimate.value, found.estimate.value, rtol=1e-9, atol=1e-12)
    assert len(again.estimate.describe_warming()) == len(EXCESS)
    assert not again.estimate.courses
    with pytest.raises(EstimateError, match="friction changed during one of the logs"):
        information.merged(information)
    constant = with_constant_friction(information.observations)
    assert not any(is_change(name) for name in constant[0].layout.parameters)
    assert constant[0].slipping.layout.parameters == constant[0].layout.parameters


def test_a_further_log_is_one_of_the_warm_robot(tmp_path, robot, found) -> None:
    found.information.save(tmp_path / "information.npz")
    truth = drives(robot, viscous=VISCOUS, coulomb=COULOMB)
    warm = log_of(robot, truth, seed=5, start=START + 100.0)
    earlier = tmp_path / "information.npz"
    assert InitialState.of(robot, IdentifyOptions(information=earlier)).layout.parameters
    both = sy.identify(robot, warm, unchecked=True, no_holdout=True, information=earlier)
    one, other = found.parameters["joint_0/viscous"], both.parameters["joint_0/viscous"]
    assert other.std < one.std
    assert abs(other.value - VISCOUS) < 4 * other.std
