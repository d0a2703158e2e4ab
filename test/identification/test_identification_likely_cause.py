"""The likely cause of correlated residuals, against the fault that was put into the log."""

import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from drive_logs import SECONDS, arm, drives, log_of
from quadruped_log import FEET, quadruped_urdf, standing_log
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Finding, Kind
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.alarms import SUSPICIOUS_WHITENESS, Alarm
from symbid_ros.identification.causes.candidate_causes import GROUPS, Candidate
from symbid_ros.identification.causes.likely_cause import LeftOutBlocks
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.log_checks import LogChecks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.pipeline import identify_problem

GAIN, DELAY, OFFSET = 1.1, 0.02, 4.0  # s, degrees
JOINT = 2


@dataclass
class Fault:
    """A fault of a log, and what the alarm says about it."""

    said: str
    size: float | None = None
    change: object = None
    extra: object = None
    options: object = None
    seconds: float = SECONDS


def late(time, position, effort):
    return position, np.stack([np.interp(time - DELAY, time, one) for one in effort.T], axis=1)


def one_late(time, position, effort):
    effort = effort.copy()
    effort[:, JOINT] = np.interp(time - DELAY, time, effort[:, JOINT])
    return position, effort


def with_gain(_, position, effort):
    effort = effort.copy()
    effort[:, JOINT] *= GAIN
    return position, effort


def with_offset(_, position, effort):
    position = position.copy()
    # An offset of the last joint would only turn its link.
    position[:, 0] += np.radians(OFFSET)
    return position, effort


def with_both(time, position, effort):
    return with_gain(time, *with_offset(time, position, effort))


def strange(velocity, acceleration):
    """Return torques that no candidate contains: they depend on the angles of two joints."""
    angle = np.cumsum(velocity, axis=0) / 200.0
    return 2.0 * np.sin(7 * (angle + np.roll(angle, 1, axis=1)))


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


def cold(velocity, acceleration):
    """Return the viscous friction that drives lose while they warm up."""
    return 3.0 * np.exp(-np.linspace(0, 3, len(velocity)))[:, None] * velocity


def identify(robot, fault):
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    log = log_of(robot, truth, extra=fault.extra, seconds=fault.seconds)
    if fault.change is not None:
        joints = log.streams().joints
        time = (joints.stamp - joints.stamp[0]) * 1e-9
        position, effort = fault.change(time, joints.position, joints.effort)
        log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    options = {"no_holdout": True, "unchecked": True, **(fault.options or {})}
    return sy.identify(robot, log, **options)


FAULTS = {
    "delay": Fault(r"a delay of the efforts by (\S+) ms", 1e3 * DELAY, late),
    "single delay": Fault(
        r"delays of single efforts, (\S+) ms late at joint_2", 1e3 * DELAY, one_late
    ),
    "gain": Fault(
        r"gains of the efforts, (\S+) % at joint_2",
        100 * (GAIN - 1),
        with_gain,
        options={"prior_percent": 5.0},
    ),
    "offset": Fault(
        r"encoder offsets, (\S+)° at joint_0", OFFSET, with_offset, options={"prior_percent": 5.0}
    ),
    "several": Fault(
        "several sensor errors together", change=with_both, options={"prior_percent": 5.0}
    ),
    "friction": Fault("Coulomb friction", options={"joint_terms": ("viscous",)}),
    "warming": Fault(
        r"viscous friction that changes during the log, .* leave `joint_terms` .* later `start`",
        extra=cold,
        seconds=75.0,
        options={"joint_terms": ("viscous", "coulomb", "armature")},
    ),
    "strange": Fault("none of these explains it", extra=strange),
}


@pytest.mark.parametrize("name", FAULTS)
def test_an_alarm_names_the_cause_and_what_would_remain(robot, name):
    fault = FAULTS[name]
    found = identify(robot, fault)
    (alarm,) = [one for one in found.alarms if "white noise" in one]
    worst = found.estimate.verdict.unexplained[0]
    assert alarm.startswith(str(worst))
    said = re.search(fault.said, alarm)
    assert said, alarm
    if fault.size is not None:
        assert float(said[1]) == pytest.approx(fault.size, rel=0.1)
    assert ("remain unexplained" in alarm) == (name != "strange")
    assert "\n" not in alarm


def test_a_small_unexplained_force_is_a_detail(robot):
    def weak(velocity, acceleration):
        return 0.005 * strange(velocity, acceleration)

    found = identify(robot, Fault("", extra=weak))
    verdict = found.estimate.verdict
    assert verdict.whiteness > SUSPICIOUS_WHITENESS
    assert not found.alarms


def test_efforts_in_another_unit_are_the_one_cause_of_correlated_residuals(robot):
    """The checks of the log name them; no other line may say that no gain explains the log."""
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    log = log_of(robot, truth, gain=np.array([1e-3, 1.0, 1.0]))
    alarms = sy.identify(robot, log, no_holdout=True).alarms
    (units,) = [one for one in alarms if "times what the motion implies" in one]
    assert "effort of joint_0 reads" in units
    (coloured,) = [one for one in alarms if "white noise" in one]
    assert "the wrong efforts in another alarm" in coloured
    assert "none of these" not in coloured


@pytest.mark.parametrize("is_moving", [True, False])
def test_an_alarm_names_joints_that_the_log_lacks(robot, is_moving):
    """A joint that is taken to be at rest may have moved."""
    truth = drives(robot, viscous=0.4)
    joints = log_of(robot, truth, seconds=SECONDS).streams().joints
    time = (joints.stamp - joints.stamp[0]) * 1e-9
    position, effort = joints.position.copy(), joints.effort.copy()
    if is_moving:
        position[:, JOINT], effort[:, JOINT] = position[0, JOINT], np.nan
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    found = sy.identify(robot, log, no_holdout=True, unchecked=True)
    named = [one for one in found.alarms if one.startswith(f"the log lacks joint_{JOINT}")]
    assert len(named) == is_moving
    assert bool(found.alarms) == is_moving


def opposed(time, position, effort):
    """Return an effort of the last joint that is friction with the wrong sign."""
    effort = effort.copy()
    effort[:, -1] = -np.tanh(20 * np.gradient(position[:, -1], time))
    return position, effort


def only_noise(time, position, effort):
    effort = effort.copy()
    effort[:, -1] = np.random.default_rng(1).normal(size=len(time))
    return position, effort


def test_friction_that_would_drive_a_joint_shows_the_sign_of_its_effort(robot):
    found = identify(robot, Fault("", change=opposed))
    assert any("; give `effort_scale` joint_2:=-1.0" in one for one in found.alarms)
    assert not any("likely cause" in one for one in found.alarms)


@pytest.mark.parametrize("change", [opposed, only_noise])
def test_an_effort_that_is_not_predicted_at_all_raises_an_alarm(robot, change):
    """With factors of other joints, signs are not looked for."""
    found = identify(robot, Fault("", change=change, options={"drive_gain": ("joint_0",)}))
    alarms = [
        one
        for one in found.alarms
        if one.startswith("the model does not predict the effort of joint_2")
    ]
    assert len(alarms) == (change is opposed)
    assert all("`flip_joint` joint_2, or `effort_scale` joint_2:=-1" in one for one in alarms)


def test_friction_that_a_short_log_cannot_judge_raises_an_alarm(robot):
    """Unmodelled friction is most of an effort, but shows neither signs nor exchanged joints."""
    truth = drives(robot, viscous=0.4, coulomb=8.0)
    for seconds, is_short in ((1.2, True), (SECONDS, False)):
        log = log_of(robot, truth, seconds=seconds)
        found = sy.identify(robot, log, no_holdout=True, unchecked=True)
        alarms = [one for one in found.alarms if "friction of" in one]
        assert len(alarms) == is_short
        assert all("unexplained" in one and "record longer" in one for one in alarms)
        assert not any(Alarm.UNPREDICTED_EFFORT in one for one in found.alarms)


def backwards(_, position, effort):
    position = position.copy()
    position[:, JOINT] *= -1
    return position, effort


def test_an_alarm_names_a_reversed_joint(robot):
    found = identify(robot, Fault("", change=backwards))
    first, *others = found.alarms
    assert "give `flip_joint` joint_2" in first
    assert ("the other alarms may follow" in first) == bool(others)


def test_a_reversed_joint_is_not_reported_as_a_wrong_zero(robot):
    """Its readings look like a large error of the zero as well; the rate is another matter."""
    readings = log_of(robot, drives(robot, viscous=0.4), seconds=SECONDS).streams().joints
    time = (readings.stamp - readings.stamp[0]) * 1e-9
    position, effort = backwards(time, readings.position, readings.effort)
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    options = IdentifyOptions(no_holdout=True, unchecked=True)
    zero = Finding.of("joints", Kind.ENCODER_OFFSET, "reads 43 degrees too little", {})
    stamps = Finding.of("joints", Kind.JITTER, "the stamps jitter", {})
    problem = replace(load_problem(robot, log, options), checks=LogChecks((zero, stamps)))
    _, found = identify_problem(problem)
    alarms = found.estimate.verdict.alarms
    assert f"give `flip_joint` joint_{JOINT}" in alarms[0]
    assert stamps.message in alarms
    assert zero.message not in alarms


@pytest.mark.parametrize("stride", [1, 5])
def test_a_low_rate_is_named_if_nothing_else_explains_the_residuals(robot, stride):
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    joints = log_of(robot, truth, extra=strange, seconds=60.0).streams().joints
    log = sy.Log.from_arrays(
        robot,
        time=joints.stamp[::stride] * 1e-9,
        position=joints.position[::stride],
        effort=joints.effort[::stride],
    )
    alarms = sy.identify(robot, log, no_holdout=True, unchecked=True).alarms
    (alarm,) = (one for one in alarms if "none of these explains it" in one)
    assert ("the rate of 40 Hz may be too low for the motion" in alarm) == (stride == 5)


@pytest.fixture(scope="module")
def quadruped(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return sy.load_model(path)


@pytest.fixture(scope="module")
def standing(quadruped):
    return standing_log(quadruped, 12.0, 3, friction=0.0)


def identify_standing(quadruped, standing, **changed):
    """Return the alarms of a log to whose efforts and wrenches something is added."""
    return identified_standing(quadruped, standing, **changed).alarms


def identified_standing(quadruped, standing, *, effort=0.0, wrenches=None, **options):
    joints, imu = standing["/joint_states"], standing["/imu"]
    log = sy.Log.from_arrays(
        quadruped,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"] + effort,
        imus={"imu_link": np.hstack([imu["angular_velocity"] - 0.01, imu["linear_acceleration"]])},
        wrenches={
            foot: standing[f"/{foot}/wrench"]["wrench"] + added
            for foot, added in zip(FEET, wrenches or np.zeros(len(FEET)), strict=True)
        },
    )
    fixed = {"no_holdout": True, "unchecked": True, "joint_terms": ("none",)}
    return sy.identify(quadruped, log, **fixed | options)


def test_a_weighing_that_contradicts_the_data_is_the_cause_of_the_other_alarms(quadruped, standing):
    mass = float(quadruped.phi[:, 0].sum())
    weighed = {"total_mass_std": 0.01, "prior_percent": 10.0}
    assert identify_standing(quadruped, standing, total_mass=mass, **weighed) == ()
    first, second = identify_standing(quadruped, standing, total_mass=1.05 * mass, **weighed)
    assert "the weighing of" in first
    assert "the residuals are not white noise" in second
    assert "what contradicts the weighing in another alarm" in second


def relieved(quadruped, standing, lift):
    """Return what a support changes in efforts and wrenches.

    Its force, N, is constant in the world, at the middle of the feet, which it relieves equally.
    """
    position = standing["/joint_states"]["position"]
    poses = link_poses(quadruped, position)
    jacobian = contact_jacobian(quadruped, FEET, poses).reshape(len(position), len(FEET), 6, -1)
    above = Rotation.from_quat(standing["/imu"]["orientation"]).inv().apply([0.0, 0.0, 1.0])
    above = above @ quadruped.frame("imu_link").rotation.T
    effort, wrenches = np.zeros_like(position), []
    for index, foot in enumerate(FEET):
        frame = quadruped.frame(foot)
        rotation = poses.rotation[:, frame.link] @ frame.rotation
        relief = lift / len(FEET) * np.einsum("nji,nj->ni", rotation, above)
        effort += np.einsum("nij,ni->nj", jacobian[:, index, 3:, 6:], relief)
        wrenches.append(np.hstack([-relief, np.zeros_like(relief)]))
    return {"effort": effort, "wrenches": wrenches}


def test_a_support_without_a_sensor_is_a_likely_cause(quadruped, standing):
    lift = 60.0
    (alarm,) = identify_standing(quadruped, standing, **relieved(quadruped, standing, lift))
    found = re.search(r"a support without a sensor, such as a cable, of some (\S+) N", alarm)
    assert found is not None, alarm
    assert float(found[1]) == pytest.approx(lift, rel=0.2)


@pytest.mark.parametrize(
    ("share", "cause"),
    [(0.4, "a support without a sensor, such as a crane"), (-0.4, "it carried a payload, which")],
)
def test_feet_that_carry_another_mass_than_the_file_s_raise_an_alarm(
    quadruped, standing, share, cause
):
    """Each link may be off by a quarter, so that the links adapt to the missing weight."""
    mass = float(quadruped.phi[:, 0].sum())
    changed = relieved(quadruped, standing, share * mass * 9.81)
    alarm, *others = identify_standing(quadruped, standing, **changed)
    found = re.search(r"the total mass went from (\S+) kg in the model file to (\S+) kg", alarm)
    assert found is not None, alarm
    assert float(found[1]) == pytest.approx(mass, rel=5e-3)
    assert float(found[2]) == pytest.approx((1 - share) * mass, rel=0.03)
    assert cause in alarm
    assert all("the residuals are not white noise" in one for one in others)
    # With a weighing it is that which contradicts the data.
    weighed = {"total_mass": mass, "total_mass_std": 0.01}
    alarms = identify_standing(quadruped, standing, **changed, **weighed)
    assert any("the weighing of" in one for one in alarms)
    assert not any("the total mass went from" in one for one in alarms)


def hanging(quadruped, standing, lift, frame):
    """Return what a vertical force, N, at a frame of the base changes in efforts and wrenches.

    The forces of the feet change so that the base is in balance, and the efforts so that the legs
    are.
    """
    position = standing["/joint_states"]["position"]
    count, poses = len(position), link_poses(quadruped, position)
    jacobian = contact_jacobian(quadruped, FEET, poses).reshape(count, len(FEET), 6, -1)[:, :, 3:]
    above = Rotation.from_quat(standing["/imu"]["orientation"]).inv().apply([0.0, 0.0, 1.0])
    mount = quadruped.frame("imu_link").rotation.T @ quadruped.frame(frame).rotation
    rope = contact_jacobian(quadruped, (frame,), poses).reshape(count, 6, -1)[:, 3:]
    rope = lift * np.einsum("nij,ni->nj", rope, above @ mount)
    on_base = jacobian[..., :6].reshape(count, -1, 6).transpose(0, 2, 1)
    relief = (np.linalg.pinv(on_base) @ rope[:, :6, None]).reshape(count, len(FEET), 3)
    effort = np.einsum("nfij,nfi->nj", jacobian[..., 6:], relief) - rope[:, 6:]
    wrenches = [np.hstack([-one, np.zeros_like(one)]) for one in relief.transpose(1, 0, 2)]
    return {"effort": effort, "wrenches": wrenches}


def test_a_crane_that_is_named_as_a_contact_leaves_the_mass_right(quadruped, standing):
    mass = float(quadruped.phi[:, 0].sum())
    changed = hanging(quadruped, standing, 0.4 * mass * 9.81, "imu_link")
    (alarm,) = identify_standing(quadruped, standing, **changed)
    assert "name the frame that it holds in `contact` (FRAME:point for a rope)" in alarm
    found = identified_standing(quadruped, standing, **changed, contact=("imu_link:point",))
    assert not found.alarms
    assert sum(one.mass for one in found.links.values()) == pytest.approx(mass, rel=0.01)


@pytest.mark.parametrize("seconds", [40.0, 80.0])
def test_drives_that_warm_up_are_no_cause_in_short_recordings_far_apart(robot, seconds):
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    joints = log_of(robot, truth, extra=strange, seconds=seconds).streams().joints
    time = joints.stamp * 1e-9
    time[len(time) // 2 :] += 3600.0
    log = sy.Log.from_arrays(robot, time=time, position=joints.position, effort=joints.effort)
    alarms = sy.identify(robot, log, no_holdout=True, unchecked=True).alarms
    (alarm,) = (one for one in alarms if "none of these explains it" in one)
    assert ("viscous friction that changes during the log" in alarm) == (seconds > 50)


def test_errors_of_left_out_blocks_are_those_of_as_many_regressions():
    rng = np.random.default_rng(0)
    count, n, p, m = 10 * GROUPS, 3, 4, 2
    K, columns = rng.normal(size=(count, n, p)), rng.normal(size=(count, n, m))
    residual = K.sum(axis=2) + 2 * columns.sum(axis=2) + rng.normal(size=(count, n))
    covariance = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 0.5]])
    cause = Candidate("delay", ("a", "b"), columns, np.full(m, 1e3))
    group = np.arange(count) % GROUPS
    rows = SimpleNamespace(
        K=K, residual=residual, candidates=(cause,), group=group, covariance=covariance
    )
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    known = np.eye(p, p + m)  # a row of the prior for each identified unknown
    each, total = np.zeros(n), 0.0
    for one in range(GROUPS):
        A = np.concatenate([K, columns], axis=2)
        others = (white @ A[group != one]).reshape(-1, p + m)
        target = (residual[group != one] @ white.T).ravel()
        x = np.linalg.lstsq(np.vstack([others, known]), np.append(target, np.zeros(p)))[0]
        left = (residual - A @ x)[group == one]
        each += np.sum(left**2, axis=0)
        total += np.sum((left @ white.T) ** 2)
    found = LeftOutBlocks(rows).errors(cause)
    np.testing.assert_allclose(found[0], each, rtol=1e-4)
    assert found[1] == pytest.approx(total, rel=1e-4)
