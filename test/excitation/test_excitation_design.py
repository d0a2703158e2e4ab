"""The design of a trajectory: Fourier series, gradients, limits and expected deviations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from documented_robots import ur5_urdf
from scipy.sparse import csc_array

from symbid_ros.cli.flags import flag
from symbid_ros.errors import OptionError
from symbid_ros.estimation.prior import planning_prior
from symbid_ros.excitation.files import write_plan
from symbid_ros.excitation.fourier import FourierSeries
from symbid_ros.excitation.limits import joint_limits
from symbid_ros.excitation.optimizer import (
    LinearizedProblem,
    TrajectoryOptimizer,
    best_move,
    updated_curvature,
)
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
from symbid_ros.model.load import load_model
from symbid_ros.options import spelled
from symbid_ros.simulation.joint_sensors import JointSensorOptions

SENSORS = JointSensorOptions()


@pytest.fixture(scope="module")
def arm():
    return load_model(ur5_urdf(), "fixed")


@pytest.fixture(scope="module")
def problem(arm):
    return excitation_problem(arm, ExciteOptions(period=6.0, seconds=12.0, harmonics=3), SENSORS)


@pytest.fixture(scope="module")
def optimizer(problem):
    found = TrajectoryOptimizer(problem.design, seed=1)
    found.run(starts=1, iterations=15)
    return found


@pytest.fixture(scope="module")
def plan(problem, optimizer):
    return ExcitationPlan(problem, optimizer.best, optimizer.random)


def pinocchio_torques(path, names, motion):
    """Inverse dynamics of Pinocchio for position, velocity, acceleration (3, N, D)."""
    model = pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_v for name in names]
    torques = np.zeros(motion.shape[1:])
    for row in range(len(torques)):
        q, v, a = (np.zeros(model.nv) for _ in range(3))
        q[order], v[order], a[order] = motion[:, row]
        torques[row] = pinocchio.rnea(model, data, q, v, a)[order]
    return torques


def test_a_series_is_periodic_at_rest_at_its_start_and_its_derivatives_are_exact():
    series = FourierSeries(4.0, 3)
    coefficients = np.random.default_rng(0).normal(size=(series.size, 2))
    start, end = series.motion(coefficients, np.array([0.0, 4.0])).swapaxes(0, 1)
    np.testing.assert_allclose(start, end, atol=1e-12)
    np.testing.assert_allclose(start[1:], 0.0, atol=1e-12)
    time, step = np.linspace(0, 4, 50), 1e-5
    ahead, behind = (series.motion(coefficients, time + s) for s in (step, -step))
    here = series.motion(coefficients, time)
    np.testing.assert_allclose((ahead - behind)[:2] / (2 * step), here[1:], atol=1e-8)


def test_the_gradients_agree_with_finite_differences(arm, problem):
    guarded = excitation_problem(arm, replace(problem.options, floor=0.2), SENSORS)
    optimizer = TrajectoryOptimizer(guarded.design, seed=0)
    point = optimizer.draw().ravel()
    here = optimizer._linearized(point)
    direction = np.random.default_rng(1).normal(size=point.shape)
    step = 1e-6
    ahead, behind = (optimizer._linearized(point + s * direction) for s in (step, -step))
    slope = (ahead.gain - behind.gain) / (2 * step)
    assert slope == pytest.approx(here.slope @ direction, rel=1e-5)
    taken = -(ahead.room - behind.room) / (2 * step)
    motion_rows = 6 * len(guarded.design.time) * len(guarded.limits.names)
    assert len(taken) > motion_rows  # efforts and distances have rows too
    expected = here.rows @ direction
    # A few closest points may jump from one corner to another between both sides.
    wrong = np.abs(taken - expected) > 1e-3 * np.abs(expected).max()
    assert not wrong[:motion_rows].any()
    assert wrong.mean() < 1e-3


def test_a_program_respects_its_limits_and_the_trust_region():
    problem = LinearizedProblem(
        0.0, np.array([1.0, 1.0]), csc_array(np.array([[1.0, 0.0]])), np.array([0.1])
    )
    np.testing.assert_allclose(best_move(problem, np.eye(2), 0.5), [0.1, 0.5], atol=1e-6)
    np.testing.assert_allclose(best_move(problem, np.eye(2), 5.0), [0.1, 1.0], atol=1e-6)


def test_the_curvature_is_that_along_the_moves_and_stays_positive():
    true = np.diag([1.0, 4.0, 9.0])
    curvature = np.eye(3)
    for move in np.random.default_rng(0).normal(size=(60, 3)):
        curvature = updated_curvature(curvature, move, true @ move)
    np.testing.assert_allclose(curvature, true, rtol=1e-3, atol=1e-3)
    bent = updated_curvature(np.eye(3), np.array([1.0, 0.0, 0.0]), np.array([-5.0, 0.0, 0.0]))
    assert np.linalg.eigvalsh(bent)[0] > 0


def test_the_search_gains_more_than_random_starts_within_the_limits(problem, optimizer):
    draws = TrajectoryOptimizer(problem.design, seed=5)
    gains = [problem.design.gain(draws.draw()) for _ in range(5)]
    assert optimizer.best_gain > max(gains)


def test_a_trajectory_keeps_its_limits_between_the_samples_by_other_dynamics(problem, plan):
    time = np.linspace(0, problem.design.seconds, 5003)
    motion = plan.motion(time)
    torque = pinocchio_torques(ur5_urdf(), plan.joints.names, motion)
    options, limits = problem.options, problem.limits
    half = options.position_share * limits.half_width
    assert np.all(np.abs(motion[0] - limits.centre) <= half)
    assert np.all(np.abs(motion[1]) <= options.speed_share * limits.speed)
    assert np.all(np.abs(motion[2]) <= options.speed_share * limits.acceleration)
    assert np.all(np.abs(torque) <= options.effort_share * limits.effort)
    # The file gives these numbers; a wrong limit would be kept as well.
    np.testing.assert_allclose(limits.speed, [3.15, 3.15, 3.15, 3.2, 3.2, 3.2])
    np.testing.assert_allclose(limits.effort, [150, 150, 150, 28, 28, 28])
    np.testing.assert_allclose(plan.torque(time), torque, atol=1e-6)


def test_the_expected_covariance_is_that_of_rows_with_the_stated_noise(problem, plan):
    """Without noise of positions and friction, the posterior is that of least squares."""
    arm = plan.joints.model
    options = replace(problem.options, joint_terms=("none",))
    ideal = excitation_problem(arm, options, JointSensorOptions(position_noise=0.0))
    found = ExcitationPlan(ideal, plan.coefficients, plan.validation)
    time = np.arange(round(12.0 * SENSORS.rate)) / SENSORS.rate
    K = ideal.design.expected.rows(plan.motion(time))
    std = 1e-3 * ideal.limits.effort
    rows = (K / std[:, None]).reshape(-1, K.shape[2])
    prior = planning_prior(ideal.parameters)
    covariance = prior.factor @ prior.factor.T / np.outer(prior.std, prior.std)
    precision = np.linalg.inv(covariance) + (rows * prior.std).T @ (rows * prior.std)
    expected = np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(found.std, prior.std * expected, rtol=1e-5)


def test_more_seconds_and_earlier_information_leave_less_to_learn(arm, problem, plan):
    longer = excitation_problem(arm, replace(problem.options, seconds=48.0), SENSORS)
    std = ExcitationPlan(longer, plan.coefficients, plan.validation).std
    assert np.all(std <= plan.std * (1 + 1e-9))
    # Well determined parameters improve with the square root of time.
    assert np.min(std / plan.std) == pytest.approx(0.5, abs=0.02)


def test_a_limits_file_replaces_limits_of_the_model(arm, tmp_path):
    file = tmp_path / "joint_limits.yaml"
    file.write_text(
        "joint_limits:\n  elbow_joint: {has_velocity_limits: true, max_velocity: 0.5, "
        "min_position: -1.0, max_position: 9.0, max_acceleration: 2.0, max_effort: 40}\n"
    )
    named = {joint.name: joint for joint in arm.joints}
    limits = joint_limits(named, {}, file)
    place = limits.names.index("elbow_joint")
    found = [getattr(limits, name)[place] for name in ("lower", "speed", "acceleration", "effort")]
    assert found == [-1.0, 0.5, 2.0, 40.0]
    assert limits.upper[place] == pytest.approx(np.pi)  # the model's range is not exceeded
    assert not any("elbow" in each for each in limits.assumed)
    file.write_text("joint_limits:\n  elbow: {max_velocity: 1}\n")
    with pytest.raises(OptionError, match="'elbow' is not a joint") as error:
        joint_limits(named, {}, file)
    assert error.value.code == "E580"


@pytest.mark.parametrize(
    "limit", ["max_velocity: -1", "max_effort: 0", "min_position: 1, max_position: -1"]
)
def test_an_impossible_limit_is_refused(arm, tmp_path, limit):
    file = tmp_path / "joint_limits.yaml"
    file.write_text(f"joint_limits:\n  elbow_joint: {{{limit}}}\n")
    with pytest.raises(OptionError, match=r"of joint elbow_joint") as error:
        joint_limits({joint.name: joint for joint in arm.joints}, {}, file)
    assert error.value.code == "E580"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("joints: {elbow_joint: {}}\n", "has no mapping 'joint_limits'; write it as MoveIt's"),
        ("<robot/>: [", "correct it"),
        ("joint_limits: {}\njoint_limits: {}\n", "given twice; remove one of them"),
    ],
)
def test_the_error_of_another_file_gives_one_advice_in_the_words_of_the_file(
    arm, tmp_path, text, says
):
    """The key of the file is not spelled as a flag."""
    file = tmp_path / "joint_limits.yaml"
    file.write_text(text)
    with pytest.raises(OptionError) as error:
        joint_limits({joint.name: joint for joint in arm.joints}, {}, file)
    message = spelled(str(error.value), flag)
    assert says in message
    assert message.count(";") == 1


def test_a_limits_file_states_ranges_and_efforts_that_the_model_lacks(arm, tmp_path):
    names = arm.joint_names
    still = tuple(replace(joint, lower=0.0, upper=0.0, effort=0.0) for joint in arm.joints)
    robot = replace(arm, joints=still)
    file = tmp_path / "joint_limits.yaml"
    file.write_text(
        f"joint_limits:\n  {names[0]}: {{min_position: -1.0, max_position: 0.5, max_effort: 40}}\n"
    )
    options = ExciteOptions(seconds=8.0, period=8.0, no_collision=True)
    with pytest.raises(OptionError, match="`limits`") as error:
        excitation_problem(robot, options, SENSORS)
    assert error.value.code == "E583"
    limits = excitation_problem(robot, replace(options, limits=file), SENSORS).limits
    assert limits.names == names[:1]
    assert (limits.lower[0], limits.upper[0], limits.effort[0]) == (-1.0, 0.5, 40.0)


def test_lengths_have_upper_limits():
    for given in ({"seconds": 1e9}, {"seconds": float("inf")}, {"period": 1e9}):
        with pytest.raises(OptionError, match="at most"):
            ExciteOptions(**given)


def test_a_joint_without_limits_gets_stated_defaults(arm):
    joint = replace(arm.joints[2], lower=-np.inf, upper=np.inf, speed=np.inf, effort=np.inf)
    limits = joint_limits({"elbow_joint": joint}, {})
    assert (limits.lower[0], limits.upper[0]) == (-np.pi / 2, np.pi / 2)
    assert (limits.speed[0], limits.acceleration[0]) == (1.0, 2.0)
    assert limits.assumed == (
        "elbow_joint: position from -1.57 to 1.57 rad",
        "elbow_joint: velocity 1 rad/s",
        "elbow_joint: acceleration 2 rad/s²",
        "elbow_joint: effort unlimited",
    )


def test_named_joints_move_alone(arm):
    options = ExciteOptions(joints=("elbow_joint,wrist_1_joint",), period=4.0)
    problem = excitation_problem(arm, options, SENSORS)
    motion = TrajectoryOptimizer(problem.design, 0).draw()
    samples = problem.design.expected.joints.samples(
        problem.design.series.motion(motion, problem.design.time)
    )
    moved = np.ptp(samples.position, axis=0) > 0
    assert [name for name, one in zip(arm.joint_names, moved, strict=True) if one] == [
        "elbow_joint",
        "wrist_1_joint",
    ]


def test_efforts_are_those_of_an_arm_on_its_wall(arm):
    options = ExciteOptions(period=4.0, gravity=(3.0, 0.0, 0.0))
    problem = excitation_problem(arm, options, SENSORS)
    motion = TrajectoryOptimizer(problem.design, 0).draw()
    samples = problem.design.expected.joints.samples(
        problem.design.series.motion(motion, problem.design.time)
    )
    np.testing.assert_allclose(samples.base_specific_force, [[-9.81, 0, 0]] * len(samples))


def test_an_impossible_plan_names_the_joint_that_is_too_weak(arm):
    weak = tuple(
        replace(joint, effort=1e-3) if joint.name == "elbow_joint" else joint
        for joint in arm.joints
    )
    options = ExciteOptions(no_collision=True)
    problem = excitation_problem(replace(arm, joints=weak), options, SENSORS)
    with pytest.raises(OptionError, match="the effort of elbow_joint uses") as error:
        TrajectoryOptimizer(problem.design, 0).run(1, 1)
    assert error.value.code == "E584"


@pytest.mark.parametrize(
    ("base", "options", "code"),
    [
        ("floating", {}, "E581"),
        ("floating", {"gravity": (1.0, 0.0, 0.0)}, "E503"),
        ("fixed", {"joints": ("elbow",)}, "E583"),
        ("fixed", {"posture": ("elbow_joint=1",)}, "E503"),
        ("fixed", {"ground_friction": 0.3}, "E503"),
        ("fixed", {"information": Path("nosuch")}, "E401"),
        ("fixed", {"joint_terms": ("stribeck",)}, "E501"),
    ],
)
def test_what_cannot_be_planned_is_refused(base, options, code):
    with pytest.raises(OptionError) as error:
        excitation_problem(load_model(ur5_urdf(), base), ExciteOptions(**options), SENSORS)
    assert error.value.code == code


def test_a_plan_after_a_result_does_not_keep_the_prior_of_an_earlier_plan(problem, plan, tmp_path):
    write_plan(plan, tmp_path / "plan")
    assert (tmp_path / "plan" / "prior.json").is_file()
    informed = replace(plan, problem=replace(problem, prior=None))
    write_plan(informed, tmp_path / "plan")
    assert not (tmp_path / "plan" / "prior.json").exists()
    assert (tmp_path / "plan" / "plan.json").is_file()
