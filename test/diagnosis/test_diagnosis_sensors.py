"""What an IMU and the joint states say of themselves: units, gravity, signs."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.imu_checks import ImuCheck, RateComparison
from symbid_ros.diagnosis.joint_checks import JointCheck
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import ImuStream, JointStream

TIME = np.arange(0, 6, 0.005)
STAMP = np.round(TIME * 1e9).astype(np.int64)
NAMES = ("hip", "knee", "foot")


@pytest.fixture
def imu() -> dict[str, np.ndarray]:
    """A body that rocks about all axes under gravity, seen by noisy sensors."""
    rng = np.random.default_rng(1)
    angles = 0.3 * np.sin(np.outer(TIME, [2.1, 3.3, 4.0]) + np.arange(3))
    rotation = Rotation.from_rotvec(angles)
    middle = Rotation.from_rotvec(
        0.3 * np.sin(np.outer(TIME + 1e-6, [2.1, 3.3, 4.0]) + np.arange(3))
    )
    rate = (rotation.inv() * middle).as_rotvec() / 1e-6
    return {
        "orientation": rotation.as_quat(),
        "angular_velocity": rate + 0.01 * rng.standard_normal(rate.shape) + 0.02,
        "linear_acceleration": rotation.inv().apply([0, 0, 9.81])
        + 0.1 * rng.standard_normal(rate.shape),
    }


def told(columns):
    watch = ImuCheck("/imu")
    for part in (slice(0, 600), slice(600, None)):
        watch.add(ImuStream("/imu", "imu", STAMP[part], **{k: v[part] for k, v in columns.items()}))
    return watch.findings()


def test_an_honest_imu_is_clean(imu) -> None:
    assert told(imu) == []


def test_an_imu_at_rest_has_no_axes(imu) -> None:
    imu["orientation"][:] = imu["orientation"][0]
    imu["angular_velocity"] = 0.01 * np.random.default_rng(2).standard_normal((len(TIME), 3))
    assert told(imu) == []


@pytest.mark.parametrize(
    ("name", "factor", "kind"),
    [
        ("linear_acceleration", 1 / 9.81, Kind.UNIT),
        ("linear_acceleration", 100.0, Kind.UNIT),
        ("linear_acceleration", 0.01, Kind.GRAVITY),
        ("angular_velocity", 180 / np.pi, Kind.UNIT),
        ("angular_velocity", -1.0, Kind.IMU_MOUNTING),
    ],
)
def test_a_scaled_reading(imu, name, factor, kind) -> None:
    imu[name] *= factor
    (finding,) = told(imu)
    assert (finding.kind, finding.severity) == (kind, Severity.UNUSABLE)
    assert name in finding.message


def test_acceleration_without_gravity(imu) -> None:
    upright = Rotation.from_quat(imu["orientation"])
    imu["linear_acceleration"] -= upright.inv().apply([0, 0, 9.81])
    (finding,) = told(imu)
    assert finding.kind is Kind.GRAVITY


def test_a_quaternion_in_another_order(imu) -> None:
    imu["orientation"] = np.roll(imu["orientation"], 1, axis=1)
    (finding,) = told(imu)
    assert (finding.kind, finding.severity) == (Kind.ORIENTATION, Severity.WARNING)


def test_exchanged_axes_of_a_gyroscope(imu) -> None:
    imu["angular_velocity"] = imu["angular_velocity"][:, [1, 2, 0]]
    (finding,) = told(imu)
    assert finding.kind is Kind.IMU_MOUNTING
    assert finding.figures["angle_deg"] == pytest.approx(120, abs=1)


@pytest.fixture
def joints() -> JointStream:
    position = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0, 1.0]) + np.arange(3))
    velocity = np.gradient(position, TIME, axis=0)
    noise = np.random.default_rng(4).standard_normal((2, *position.shape))
    return JointStream(
        "/joints",
        NAMES,
        STAMP,
        position + 1e-5 * noise[0],
        velocity + 0.02 * noise[1],
        5 * position,
    )


def of(joints: JointStream, model=None):
    motion = JointCheck(joints.topic, joints.names)
    motion.add(joints)
    return motion.findings(model)


def test_honest_joints_are_clean(joints) -> None:
    assert of(joints) == []


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_velocities_that_are_not_filled_are_no_fault(joints, value) -> None:
    joints.velocity[:] = value
    assert of(joints) == []


def test_a_joint_that_counts_backwards(joints) -> None:
    joints.position[:, 1] *= -1
    (finding,) = of(joints)
    assert (finding.kind, finding.severity) == (Kind.VELOCITY, Severity.UNUSABLE)
    assert "knee" in finding.message
    assert "hip" not in finding.message


def test_positions_in_degrees(joints) -> None:
    joints.position[:] *= 180 / np.pi
    (finding,) = of(joints)
    assert (finding.kind, finding.severity) == (Kind.UNIT, Severity.UNUSABLE)
    assert "positions of all joints" in finding.message


def test_velocities_in_degrees(joints) -> None:
    joints.velocity[:, 2] *= 180 / np.pi
    (finding,) = of(joints)
    assert (finding.kind, finding.severity) == (Kind.UNIT, Severity.WARNING)
    assert "velocities of foot" in finding.message


@pytest.mark.parametrize(("value", "says"), [(0.0, "always zero"), (np.nan, "in no message")])
def test_no_effort_at_all(joints, value, says) -> None:
    joints.effort[:] = value
    (finding,) = of(joints)
    assert (finding.kind, finding.severity) == (Kind.MISSING_JOINT, Severity.UNUSABLE)
    assert f"effort of all joints is {says}" in finding.message


def robot(*, passive: tuple[str, ...] = (), floating: bool = False):
    model = random_robot(3, 4, floating=floating)
    named = [
        replace(joint, name=name, kind="revolute", effort=0.0 if name in passive else 20.0)
        for joint, name in zip(model.joints, NAMES, strict=True)
    ]
    return replace(model, joints=tuple(named))


@pytest.mark.parametrize(("value", "says"), [(0.0, "always zero"), (np.nan, "in no message")])
def test_one_joint_without_effort(joints, value, says) -> None:
    joints.effort[:, 1] = value
    (finding,) = of(joints, robot())
    assert (finding.kind, finding.severity) == (Kind.MISSING_JOINT, Severity.WARNING)
    assert f"effort of knee is {says}, its row" in finding.message
    # It may be passive, and nobody knows without a model.
    assert of(joints) == of(joints, robot(passive=("knee",))) == []


@pytest.mark.parametrize(
    ("floating", "severity"), [(False, Severity.UNUSABLE), (True, Severity.WARNING)]
)
def test_without_any_effort_a_floating_robot_has_its_base(joints, floating, severity) -> None:
    joints.effort[:] = np.nan
    (finding,) = of(joints, robot(floating=floating))
    assert (finding.kind, finding.severity) == (Kind.MISSING_JOINT, severity)


@pytest.mark.parametrize("name", ["position", "velocity", "effort"])
def test_joints_outside_the_model_may_leave_anything_out(joints, name) -> None:
    getattr(joints, name)[:, 2] = np.nan
    other = replace(joints, names=(*NAMES[:2], "gripper"))
    model = robot()
    smaller = replace(model, joints=(*model.joints[:2], replace(model.joints[2], name="arm")))
    assert of(other, smaller) == of(other) == []


def test_positions_in_degrees_are_seen_beside_a_joint_without_position(joints) -> None:
    joints.position[:] *= 180 / np.pi
    joints.velocity[:] = np.nan
    joints.position[:, 2] = np.nan
    model = robot()
    limited = tuple(replace(joint, lower=-1.0, upper=1.0) for joint in model.joints)
    gripper = replace(joints, names=(*NAMES[:2], "gripper"))
    other = (*limited[:2], replace(limited[2], name="arm"))
    (finding,) = of(gripper, replace(model, joints=other))
    assert (finding.kind, finding.severity) == (Kind.UNIT, Severity.UNUSABLE)


def test_half_of_the_positions_are_too_few(joints) -> None:
    joints.position[::2, 0] = np.nan
    (finding,) = of(joints, robot())
    assert (finding.kind, finding.severity) == (Kind.MISSING_JOINT, Severity.UNUSABLE)


def test_joints_that_some_messages_leave_out(joints) -> None:
    joints.effort[::4, 0] = np.nan
    joints.position[:30, 2] = np.nan
    position, effort = of(joints)
    assert "30 of 1200 messages have no position of foot" in position.message
    assert "300 of 1200 messages have no effort of hip" in effort.message
    assert {position.severity, effort.severity} == {Severity.WARNING}
    assert effort.figures["share"] == 0.25


def test_figures_do_not_depend_on_the_epoch(joints) -> None:
    joints.velocity[:] *= 3.0
    (early,) = of(joints)
    (late,) = of(replace(joints, stamp=joints.stamp + 1_700_000_000 * 10**9))
    assert late.figures == early.figures


def test_the_unexplained_rate_has_a_closed_form() -> None:
    rates = RateComparison(cross=np.diag([3.0, 2.0, 1.0]), orientation_square=6.0)
    assert rates.unexplained(6.0) == 0.0
    # With an axis reversed, the smallest singular value counts against: 3 + 2 - 1 of 6.
    assert rates.unexplained(6.0, mirrored=True) == pytest.approx(np.sqrt(1 - (4 / 6) ** 2))


def test_severities_are_the_exit_statuses_of_the_doctor() -> None:
    assert [severity.value for severity in Severity] == [0, 1, 2]


def test_the_doctor_reports_findings_and_logs_no_warnings(caplog) -> None:
    model = random_robot(3, 4, floating=False)
    time = np.arange(0, 4, 0.01)
    position = np.sin(np.outer(time, 1 + np.arange(len(model.measured_joint_names))))
    effort = position.copy()
    effort[:, 0] = 0.0
    log = Log.from_arrays(model, time=time, position=position, effort=effort)
    assert any(one.kind is Kind.MISSING_JOINT for one in diagnose(log, model).findings)
    assert caplog.messages == []
