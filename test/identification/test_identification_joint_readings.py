"""Signs that a log gets wrong at all joints together, although single joints do not show them."""

import re

import numpy as np
import pytest
from drive_logs import SECONDS, arm, drives, log_of, stroke_and_rest
from expected_errors import raises_code

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.identification.causes.joint_alarms import with_explained_alarms
from symbid_ros.identification.conventions.joint_readings import JointReadings, find_readings
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.log_reading import first_segments
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.progress import reported_to

SEEDS = 1, 2, 5


def arm_and_log(seed, position=1.0, effort=1.0, seconds=SECONDS):
    """Return an arm and its log, whose readings are multiplied by these factors."""
    robot = arm(seed=seed, links=5)
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    joints = log_of(robot, truth, seed=seed, seconds=seconds).streams().joints
    time, position, effort = 1e-9 * joints.stamp, position * joints.position, effort * joints.effort
    return robot, sy.Log.from_arrays(robot, time=time, position=position, effort=effort)


def found_in(robot, log) -> JointReadings | None:
    return find_readings(first_segments(log, robot), robot)


@pytest.mark.parametrize("seed", SEEDS)
def test_friction_shows_the_sign_of_all_efforts(seed) -> None:
    assert found_in(*arm_and_log(seed)) is None
    robot, log = arm_and_log(seed, effort=-1.0)
    readings = found_in(robot, log)
    assert set(readings.reversed_efforts) == set(robot.joint_names)
    assert readings.are_all_efforts_reversed
    assert "efforts of all joints have" in readings.alarm


@pytest.mark.parametrize("seed", SEEDS)
def test_gravity_tells_reversed_positions_from_reversed_efforts(seed) -> None:
    robot, log = arm_and_log(seed, position=-1.0)
    readings = found_in(robot, log)
    assert readings.reversed_joints == dict.fromkeys(robot.joint_names, False)
    assert not readings.reversed_efforts


@pytest.mark.parametrize("seed", SEEDS)
def test_one_finding_names_all_joints(seed) -> None:
    robot, log = arm_and_log(seed, effort=-1.0)
    signs = Kind.TORQUE_SIGN, Kind.JOINT_READINGS
    (finding,) = [one for one in sy.diagnose(robot, log).findings if one.kind in signs]
    assert all(f'"{name}:=-1' in finding.message for name in robot.joint_names)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("seconds", [8.0, SECONDS])
def test_a_log_that_reverses_all_efforts_is_refused(seed, seconds) -> None:
    """Also one that is too short for the gain of any single joint."""
    robot, log = arm_and_log(seed, effort=-1.0, seconds=seconds)
    every = ", ".join(f'"{name}:=-1(.0)?"' for name in robot.joint_names)
    with raises_code("E517", rf"effort_scale: \[{every}\]"):
        sy.identify(robot, log, no_holdout=True)
    right = arm_and_log(seed, seconds=seconds)
    assert not any("opposite sign" in one for one in sy.identify(*right, no_holdout=True).alarms)


def test_factors_that_are_found_do_not_hide_a_reversed_effort() -> None:
    """Not even those that the program tries, for which the user did not ask."""
    robot, log = arm_and_log(1, effort=-1.0, seconds=8.0)
    problem = load_problem(robot, log, sy.IdentifyOptions(unchecked=True))
    with_gains = problem.with_drive_gains(("all",), 20.0)
    found = with_gains.solve()
    alarms = with_explained_alarms(with_gains, found, has_known_units=True).alarms
    assert "efforts of all joints have the opposite sign" in alarms[0]
    alarms = with_explained_alarms(with_gains, found, has_known_units=False).alarms
    assert not any("opposite sign" in one for one in alarms)


def test_a_long_search_reports_its_progress() -> None:
    heard = []
    robot, log = arm_and_log(1, effort=[-1.0, 1.0, 1.0, 1.0])
    segments = first_segments(log, robot)
    with reported_to(lambda step, share: heard.append((step, share))):
        find_readings(segments, robot)
    assert {step for step, _ in heard} == {"looking for exchanged and reversed joints"}
    shares = [share for _, share in heard]
    first = shares[: shares.index(0.0, 1) if 0.0 in shares[1:] else None]
    assert first[0] == 0.0
    assert 0.9 < first[-1] < 1.0
    assert first == sorted(first)


def test_an_alarm_gives_options_that_can_be_given() -> None:
    names = "a", "b", "c", "d"
    readings = JointReadings.unchanged(names).with_exchanged(0, 1)
    for joint, signs in ((1, (-1.0, -1.0)), (2, (-1.0, 1.0)), (3, (1.0, -1.0))):
        readings = readings.with_reversed(joint, *signs)
    given: dict[str, list[str]] = {}
    for option, value in re.findall(r"`(\w+)` ([^\s;]+)", readings.alarm):
        given.setdefault(option, []).append(value)
    assert given == readings.options
    mapping = SensorMapping.of(LogOptions(**given))
    assert mapping.effort_scale == {"b": -1.0, "d": -1.0}


@pytest.mark.parametrize(("seed", "joint"), [(4, 0), (6, 0), (6, 1), (6, 2)])
def test_a_joint_that_sticks_after_one_stroke_does_not_show_its_sign(seed, joint) -> None:
    """A spring that the model lacks pushes it while its drive resists, and then it sticks."""
    robot = arm(seed=seed, links=5)
    time, position, effort = stroke_and_rest(robot, joint, seed, stop=10.0)

    def readings(signs):
        read = {"time": time, "position": position, "effort": signs * effort}
        return found_in(robot, sy.Log.from_arrays(robot, **read))

    assert readings(np.ones(4)) is None
    for other in {0, 1, 2, 3} - {joint}:
        found = readings(1 - 2 * np.eye(4)[other])
        assert found.reversed_efforts == (robot.joint_names[other],)


@pytest.mark.parametrize("what", ["positions", "efforts"])
@pytest.mark.parametrize("seed", SEEDS)
def test_positions_or_efforts_alone_may_be_exchanged(seed, what) -> None:
    """The friction of a joint follows its own speed, and its load the angles before it."""
    robot, log = arm_and_log(seed)
    joints = log.streams().joints
    read = {"time": 1e-9 * joints.stamp, "position": joints.position, "effort": joints.effort}
    array = what.removesuffix("s")
    read[array] = read[array][:, [0, 2, 1, 3]]
    readings = found_in(robot, sy.Log.from_arrays(robot, **read))
    names = set(robot.joint_names[1:3])
    assert not readings.exchanged
    assert set(readings.exchanged_positions) == (names if what == "positions" else set())
    assert set(readings.exchanged_efforts) == (names if what == "efforts" else set())
    assert f"the log exchanges {what} alone of" in readings.alarm
    assert readings.alarm.endswith(
        "; publish each position and effort under the name of its own joint"
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_efforts_of_joints_at_rest_are_not_exchanged_with_those_of_others(seed) -> None:
    """Small efforts at rest leave small residuals, but explain nothing that moves."""
    robot, log = arm_and_log(seed)
    joints = log.streams().joints
    position, effort = joints.position.copy(), joints.effort.copy()
    rng = np.random.default_rng(seed)
    scale = np.sqrt(np.mean(effort**2, axis=0))
    position[:, 2:] = position[0, 2:]
    effort[:, 2:] = 1e-2 * scale[2:]
    effort += 1e-2 * scale * rng.normal(size=effort.shape)
    effort[:, :2] += scale[:2] * np.sin(5e-9 * joints.stamp)[:, None]  # of a load on the arm
    time = 1e-9 * joints.stamp
    found = found_in(robot, sy.Log.from_arrays(robot, time=time, position=position, effort=effort))
    assert found is None or not found.exchanged_efforts
