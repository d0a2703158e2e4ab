"""An arm whose drives rub more than they carry: only true faults of its efforts are found."""

from dataclasses import replace

import numpy as np
import pytest
from arm_log import arm_streams, without_load
from documented_robots import packaged_urdf, ur5_urdf
from drive_logs import arm, stroke_and_rest
from expected_errors import raises_code

import symbid_ros as sy
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import (
    OF_SIGNED_EFFORTS,
    Diagnosis,
    Kind,
    Severity,
    has_unsigned_efforts,
)
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.conventions import position_units
from symbid_ros.identification.log_reading import first_segments
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import Streams

SECONDS = 20.0


@pytest.fixture(scope="module")
def ur5():
    return load_model(ur5_urdf(), "fixed")


def judged(ur5, streams: Streams, seed: int = 2) -> Diagnosis:
    """Return the diagnosis against a model whose inertias are off by up to a quarter."""
    parameters = ParameterSet(ur5)
    drawn = draw_prior(parameters, "consistent", 25, seed).mean
    return diagnose(Log.from_streams(streams), ur5.with_phi(parameters.link_phi(drawn)))


def with_effort(streams: Streams, joint, factor: float) -> Streams:
    effort = streams.joints.effort.copy()
    effort[:, joint] *= factor
    return replace(streams, joints=replace(streams.joints, effort=effort))


@pytest.mark.parametrize(("friction", "seed"), [(0.0, 1), (0.05, 2), (0.15, 3)])
def test_friction_is_no_gain(ur5, friction, seed) -> None:
    diagnosis = judged(ur5, arm_streams(ur5, SECONDS, seed, friction=friction), seed)
    assert [one.message for one in diagnosis.findings] == []
    for name in ur5.joint_names[1:3]:
        gain, std = (diagnosis.figures[f"{name}/effort_gain{end}"] for end in ("", "_std"))
        assert abs(gain - 1) < 3 * std
        assert std < 0.3


@pytest.mark.parametrize("factor", [0.1, 10.0])
@pytest.mark.parametrize("friction", [0.0, 0.05])
def test_currents_for_torques(ur5, friction, factor) -> None:
    streams = with_effort(arm_streams(ur5, SECONDS, 1, friction=friction), slice(None), factor)
    (finding,) = judged(ur5, streams).findings
    assert (finding.kind, finding.severity) == (Kind.TORQUE_GAIN, Severity.WARNING)
    assert finding.figures["reads"] == pytest.approx(factor, rel=0.3)


@pytest.mark.parametrize("resting", [(), ("wrist_2_joint", "wrist_3_joint")])
def test_newton_millimetres_are_named(ur5, resting) -> None:
    """Also those of joints that show no load."""
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05, resting=resting)
    (finding,) = diagnose(Log.from_streams(with_effort(streams, slice(None), 1e3)), ur5).findings
    assert finding.kind is Kind.TORQUE_GAIN
    assert "as if in mNm (Nmm)" in finding.message
    assert all(f'"{name}:=0.001"' in finding.message for name in ur5.joint_names)


@pytest.mark.parametrize("is_milli", [True, False])
def test_an_effort_beyond_its_limit_is_named_if_friction_hides_its_load(ur5, is_milli) -> None:
    """Drives give somewhat more than stated limits, but not many times as much."""
    name, last = ur5.joint_names[5], ur5.joints[5]
    streams = with_effort(arm_streams(ur5, SECONDS, 1, friction=0.2), 5, 1e3 if is_milli else 1.0)
    rms = np.sqrt(np.mean(streams.joints.effort[:, 5] ** 2))
    effort = last.effort if is_milli else rms / 1.11
    robot = replace(ur5, joints=(*ur5.joints[:5], replace(last, effort=effort)))
    (finding,) = judged(robot, streams).findings
    assert (finding.kind, finding.severity) == (Kind.TORQUE_GAIN, Severity.WARNING)
    assert list(finding.figures) == [f"{name}/times_limit"]
    line = f'for mNm write effort_scale: ["{name}:=0.001"]'
    assert (line in finding.message) == is_milli


@pytest.mark.parametrize("late", [False, True])
def test_placeholder_friction_in_the_model_hides_neither_motion_nor_delays(ur5, late) -> None:
    """Files of hands state friction far beyond their efforts."""
    streams = arm_streams(ur5, SECONDS, 1, friction=0.02)
    efforts = np.abs(streams.joints.effort).max(axis=0)
    placeholders = [
        replace(joint, damping=100 * effort, friction_loss=100 * effort)
        for joint, effort in zip(ur5.joints, efforts, strict=True)
    ]
    if late:
        effort = np.roll(streams.joints.effort, 3, axis=0)  # of 5 ms each
        streams = replace(streams, joints=replace(streams.joints, effort=effort))
    found = judged(replace(ur5, joints=tuple(placeholders)), streams).findings
    assert [one.kind for one in found] == [Kind.DELAY] * late
    if late:
        assert found[0].figures["delay_ms"] == pytest.approx(15, abs=2)


def in_degrees(streams: Streams) -> Log:
    joints = streams.joints
    moved = {"position": np.degrees(joints.position), "velocity": np.degrees(joints.velocity)}
    return Log.from_streams(replace(streams, joints=replace(joints, **moved)))


@pytest.mark.parametrize("has_limits", [True, False])
def test_degrees_are_found_and_refused_with_and_without_limits(ur5, has_limits) -> None:
    limits = {} if has_limits else {"lower": -np.inf, "upper": np.inf}
    robot = replace(ur5, joints=tuple(replace(joint, **limits) for joint in ur5.joints))
    log = in_degrees(arm_streams(ur5, SECONDS, 1, friction=0.05))
    (finding,) = sy.diagnose(robot, log).findings
    assert (finding.kind, finding.severity) == (Kind.UNIT, Severity.UNUSABLE)
    assert '"shoulder_pan_joint:=0.0174532925", "shoulder_lift_joint:=' in finding.message
    with raises_code("E517", "degrees.*position_scale"):
        sy.identify(robot, log)


@pytest.mark.parametrize("friction", [0.0, 0.05, 0.2])
def test_radians_are_not_taken_for_degrees(ur5, friction, monkeypatch) -> None:
    """Not even if joints turn so often that it is asked."""
    monkeypatch.setattr(position_units, "TURN", 0.0)
    log = Log.from_streams(arm_streams(ur5, SECONDS, 1, friction=friction))
    assert position_units.find_degrees(first_segments(log, ur5), ur5) is None


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_short_logs_tell_the_sign_of_all_efforts_together(ur5, seed) -> None:
    """No single joint of this log is known well enough."""
    read = arm_streams(ur5, 8.0, seed, friction=0.05)
    assert judged(ur5, read, seed).findings == ()
    (finding,) = judged(ur5, with_effort(read, slice(None), -1.0), seed).findings
    assert (finding.kind, finding.severity) == (Kind.TORQUE_SIGN, Severity.UNUSABLE)
    assert set(finding.figures) == {f"{name}/gain" for name in ur5.joint_names}


@pytest.mark.parametrize(
    ("position", "effort", "kind", "option"),
    [
        (-1.0, 1.0, Kind.JOINT_READINGS, r'flip_joint: \["joint2"\] in'),
        (1.0, -1.0, Kind.TORQUE_SIGN, r'effort_scale: \["joint2:=-1"\] in'),
    ],
)
def test_a_reversed_position_does_not_accuse_the_efforts_of_other_joints(
    position, effort, kind, option
) -> None:
    """The gains of the efforts alone say that those of all joints are reversed."""
    robot = load_model(packaged_urdf("xarm7.urdf"), "fixed")
    read = with_effort(arm_streams(robot, 12.0, 1, friction=0.02), 1, effort)
    signs = np.where(np.arange(read.joints.position.shape[1]) == 1, position, 1.0)
    motion = {name: getattr(read.joints, name) * signs for name in ("position", "velocity")}
    log = Log.from_streams(replace(read, joints=replace(read.joints, **motion)))
    (finding,) = sy.diagnose(robot, log).findings
    assert finding.kind is kind
    with raises_code("E517", option):
        sy.identify(robot, log)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_magnitudes_are_not_taken_for_wrong_signs(ur5, sign) -> None:
    """Efforts without signs explain neither signs nor factors; the alarm says what to correct."""
    streams = arm_streams(ur5, SECONDS, 1, friction=0.3)
    sizes = sign * np.abs(streams.joints.effort)
    log = Log.from_streams(replace(streams, joints=replace(streams.joints, effort=sizes)))
    found = sy.diagnose(ur5, log).findings
    assert has_unsigned_efforts(found)
    assert not {one.kind for one in found} & {*OF_SIGNED_EFFORTS}
    (alarm,) = sy.identify(ur5, log).alarms  # others would only repeat it
    assert "as if it were a magnitude" in alarm


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("joint", [1, 2])
def test_an_effort_without_its_load_has_no_factor(ur5, joint, seed) -> None:
    """The load that the model implies is many times the effort, which shows friction alone."""
    streams = arm_streams(ur5, SECONDS, seed, friction=0.05)
    read = replace(streams.joints, effort=without_load(streams.joints, joint))
    (finding,) = judged(ur5, replace(streams, joints=read), seed).findings
    name = ur5.joint_names[joint]
    assert (finding.kind, finding.severity) == (Kind.TORQUE_GAIN, Severity.WARNING)
    assert list(finding.figures) == [f"{name}/load_share"]
    assert finding.figures[f"{name}/load_share"] < 0.05
    assert name in finding.message
    assert "effort_scale" not in finding.message


def test_one_drive_in_another_unit(ur5) -> None:
    streams = with_effort(arm_streams(ur5, SECONDS, 1, friction=0.05), 1, 0.1)
    (finding,) = judged(ur5, streams).findings
    assert finding.kind is Kind.TORQUE_GAIN
    assert set(finding.figures) == {"reads", f"{ur5.joint_names[1]}/reads"}


@pytest.mark.parametrize("friction", [0.0, 0.08])
@pytest.mark.parametrize(("joint", "degrees"), [(1, 10), (2, -10), (0, 10)])
def test_an_encoder_with_a_wrong_zero_where_gravity_shows_it(ur5, friction, joint, degrees) -> None:
    streams = arm_streams(ur5, SECONDS, 1, friction=friction)
    position = streams.joints.position.copy()
    position[:, joint] += np.radians(degrees)
    diagnosis = judged(ur5, replace(streams, joints=replace(streams.joints, position=position)))
    if joint == 0:  # turns about the vertical: no effort changes
        assert diagnosis.findings == ()
        assert diagnosis.figures[f"{ur5.joint_names[0]}/offset_std_deg"] > 10
        return
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.severity) == (Kind.ENCODER_OFFSET, Severity.WARNING)
    assert ur5.joint_names[joint] in finding.message
    assert finding.figures["offset_deg"] == pytest.approx(degrees, rel=0.5)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrist_with_hardly_any_load_of_its_own_has_no_gain(ur5, seed) -> None:
    """The true centre of mass is on its axis, the model's is not."""
    resting = ur5.joint_names[0], ur5.joint_names[3]
    streams = arm_streams(ur5, SECONDS, seed, friction=0.08, resting=resting)
    assert [one.message for one in judged(ur5, streams, seed).findings] == []


@pytest.mark.parametrize("factor", [0.0, 1e-17])
def test_an_effort_that_is_always_zero(ur5, factor) -> None:
    """Computed efforts of a joint without a load are rounding errors."""
    streams = with_effort(arm_streams(ur5, SECONDS, 1, friction=0.05), 1, factor)
    (finding,) = judged(ur5, streams).findings
    assert finding.kind is Kind.MISSING_JOINT
    assert ur5.joint_names[1] in finding.message
    assert "always zero" in finding.message


@pytest.mark.parametrize("brakes", [False, True])
def test_resting_joints_are_not_frozen(ur5, brakes) -> None:
    """Their coarse encoders repeat, and so does the effort of a joint that its brake holds."""
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05, resting=ur5.joint_names[3:5])
    position, effort = streams.joints.position.copy(), streams.joints.effort.copy()
    # An encoder of 16 bits a turn that changes with nearly each message while the arm moves.
    step = 2 * np.pi / 2**16
    still = np.abs(streams.joints.velocity[:, 0]) < 5e-3
    smooth = np.cumsum(streams.joints.velocity, axis=0) / 200 + position[0]
    position = np.round(smooth / step) * step
    position[:, 3:5] = np.round(streams.joints.position[:, 3:5] / 1e-3) * 1e-3
    first = int(np.flatnonzero(~still)[0])
    position[: max(first - 20, 0)] = position[max(first - 20, 0)]
    if brakes:
        effort[: max(first - 20, 0)] = effort[0]
    joints = replace(streams.joints, position=position, effort=effort)
    found = diagnose(Log.from_streams(replace(streams, joints=joints))).findings
    assert Kind.FROZEN not in {one.kind for one in found}


def test_an_encoder_that_flickers_at_rest_is_not_frozen(ur5) -> None:
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05, resting=ur5.joint_names[3:5])
    position = streams.joints.position.copy()
    position[:, 3] = np.where(np.arange(len(position)) % 100 == 50, 1.0001, 1.0)
    joints = replace(streams.joints, position=position)
    found = diagnose(Log.from_streams(replace(streams, joints=joints))).findings
    assert Kind.FROZEN not in {one.kind for one in found}


@pytest.mark.parametrize("samples", [3, 8, -12])
@pytest.mark.parametrize("moving", [range(1, 2), range(6)])
def test_efforts_are_late_if_those_of_several_joints_are(ur5, moving, samples) -> None:
    """Friction of one drive that lags behind its motion looks like a late effort of that joint."""
    resting = [name for index, name in enumerate(ur5.joint_names) if index not in moving]
    streams = arm_streams(ur5, SECONDS, 1, friction=0.15, resting=resting)
    effort = np.roll(streams.joints.effort, samples, axis=0)  # the arm rests at both ends
    diagnosis = judged(ur5, replace(streams, joints=replace(streams.joints, effort=effort)))
    found = [one for one in diagnosis.findings if one.kind is Kind.DELAY]
    assert len(found) == (len(moving) > 1)
    for finding in found:
        period = np.diff(streams.joints.stamp)[0] * 1e-6
        assert finding.figures["delay_ms"] == pytest.approx(samples * period, rel=0.03)


@pytest.mark.parametrize("friction", [0.0, 0.05])
@pytest.mark.parametrize(("joint", "samples"), [(1, 2), (2, 6), (1, -4)])
def test_a_single_late_effort_is_named(ur5, friction, joint, samples) -> None:
    streams = arm_streams(ur5, SECONDS, 1, friction=friction)
    effort = streams.joints.effort.copy()
    effort[:, joint] = np.roll(effort[:, joint], samples)  # the arm rests at both ends
    diagnosis = judged(ur5, replace(streams, joints=replace(streams.joints, effort=effort)))
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.severity) == (Kind.EFFORT_DELAY, Severity.WARNING)
    name, period = ur5.joint_names[joint], np.diff(streams.joints.stamp)[0] * 1e-6
    assert set(finding.figures) == {f"{name}/delay_ms", f"{name}/delay_std_ms"}
    assert finding.figures[f"{name}/delay_ms"] == pytest.approx(samples * period, abs=1)


@pytest.mark.parametrize("samples", [-20, 16, 40])
def test_a_delay_beyond_the_search_is_not_given_as_its_bound(ur5, samples) -> None:
    """It is at least the bound, or not found."""
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05)
    effort = streams.joints.effort.copy()
    effort[:, 1] = np.roll(effort[:, 1], samples)  # the arm rests at both ends
    diagnosis = judged(ur5, replace(streams, joints=replace(streams.joints, effort=effort)))
    found = [one.message for one in diagnosis.findings if one.kind is Kind.EFFORT_DELAY]
    assert len(found) == (abs(samples) < 40)
    for message in found:
        side = "late" if samples > 0 else "early"
        assert f"{ur5.joint_names[1]} at least 70 ms {side};" in message


@pytest.mark.parametrize("seed", [5, 6])
def test_static_friction_of_a_light_wrist_is_no_delay(seed) -> None:
    robot = arm(seed=seed, links=5)
    robot = robot.with_phi(robot.phi * np.array([1.0, 1.0, 1.0, 1.0, 1e-3])[:, None])
    robot = replace(robot, joints=tuple(replace(one, effort=np.inf) for one in robot.joints))
    time, position, effort = stroke_and_rest(robot, 3, seed, 10.0, lasts=0.8)
    log = Log.from_arrays(robot, time=time, position=position, effort=effort)
    assert not diagnose(log, robot).findings


@pytest.mark.parametrize("moving", [0, 2])
def test_drives_at_rest_have_no_gain(ur5, moving) -> None:
    """Dry friction carries a part of their load, and what remains of it depends on chance."""
    resting = [name for index, name in enumerate(ur5.joint_names) if index != moving]
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05, resting=resting)
    effort = streams.joints.effort.copy()
    still = np.arange(6) != moving
    effort[:, still] *= np.where(np.arange(5) % 2, 0.2, 3.0)
    diagnosis = judged(ur5, replace(streams, joints=replace(streams.joints, effort=effort)))
    assert Kind.TORQUE_GAIN not in {one.kind for one in diagnosis.findings}


def test_an_encoder_that_stops_while_its_joint_moves_is_frozen(ur5) -> None:
    streams = arm_streams(ur5, SECONDS, 1, friction=0.05)
    position = streams.joints.position.copy()
    position[2000:2100, 2] = position[2000, 2]
    joints = replace(streams.joints, position=position)
    found = diagnose(Log.from_streams(replace(streams, joints=joints))).findings
    (frozen,) = (one for one in found if one.kind is Kind.FROZEN)
    assert frozen.figures["frozen_s"] == pytest.approx(0.5, abs=0.02)
