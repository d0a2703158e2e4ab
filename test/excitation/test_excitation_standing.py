"""Excitation of standing robots: closed chains, ground forces, and the simulated stance."""

import csv
from dataclasses import replace
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.stance_forces import smallest_forces
from symbid_ros.errors import ModelError, OptionError, SimulationError
from symbid_ros.excitation.files import write_plan
from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
from symbid_ros.excitation.rehearsal import standing_simulator
from symbid_ros.excitation.stance_options import find_stance
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.options import TruthOptions

SENSORS = JointSensorOptions(rate=100.0)
POINTS = tuple(f"{name}_FOOT:point" for name in ("FL", "FR", "HL", "HR"))
SOLES = ("left_sole", "right_sole")
SHORT = {"period": 4.0, "seconds": 4.0, "harmonics": 2}


@pytest.fixture(scope="module")
def solo():
    (found,) = (each for each in files("example-robot-data") or () if each.name == "solo12.urdf")
    robot = load_model(Path(str(found.locate())), "floating")
    drives = (replace(joint, effort=2.7, speed=10.0) for joint in robot.joints)
    return replace(robot, joints=tuple(drives))


@pytest.fixture(scope="module")
def symbitron():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def plans(solo, symbitron, tmp_path_factory):
    """Folders and plans: a few steps of the search for one robot, random motion of the other."""
    found = {}
    for name, robot, feet in (("solo", solo, POINTS), ("symbitron", symbitron, SOLES)):
        options = ExciteOptions(feet=feet, no_collision=True, **SHORT)
        problem = excitation_problem(robot, options, SENSORS)
        optimizer = TrajectoryOptimizer(problem.design, seed=0)
        random = optimizer.draw()
        best = random
        if name == "solo":
            optimizer._climb(random, number=1, starts=1, iterations=6)
            best = optimizer.best
        plan = ExcitationPlan(problem, best, random)
        folder = tmp_path_factory.mktemp("standing") / name
        write_plan(plan, folder)
        found[name] = folder, plan
    return found


def random_motion(seed: int, count: int, size: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return size * rng.uniform(-1, 1, (3, count, 6))


def test_the_feet_stay_and_the_base_goes_where_it_should(solo):
    stance = find_stance(solo, ExciteOptions(feet=POINTS))
    motion = random_motion(0, 20, 0.15)
    samples, poses = stance.samples(motion)
    feet, _ = stance.feet_poses(poses.base_position, poses.base_rotation, poses.position)
    np.testing.assert_allclose(feet, np.broadcast_to(stance.places[0], feet.shape), atol=1e-7)
    height = stance.base_position[2]
    moved = (poses.base_position - stance.base_position) / height
    np.testing.assert_allclose(moved, motion[0, :, :3], atol=1e-6)
    turned = stance.base_rotation.T @ poses.base_rotation
    np.testing.assert_allclose(
        Rotation.from_matrix(turned).as_rotvec(), motion[0, :, 3:], atol=1e-6
    )
    # The feet are at rest: the Jacobian maps base twist and joint rates to zero.
    J = contact_jacobian(solo, stance.frames, link_poses(solo, samples.position))
    linear = np.einsum("nji,nj->ni", poses.base_rotation, height * motion[1, :, :3])
    rates = np.hstack([samples.base_angular_velocity, linear, samples.velocity])
    slip = np.einsum("nij,nj->ni", J, rates).reshape(20, 4, 6)[:, :, 3:]
    np.testing.assert_allclose(slip, 0.0, atol=1e-4)


def test_a_sole_stays_flat_on_a_leg_with_a_joint_without_drive(symbitron):
    stance = find_stance(symbitron, ExciteOptions(feet=SOLES))
    low = random_motion(1, 30, 0.04)[0] - [0, 0, 0.04, 0, 0, 0]  # the knees are nearly straight
    poses = stance.poses(low)
    assert poses.slip.max() < 1e-4
    _, rotation = stance.feet_poses(poses.base_position, poses.base_rotation, poses.position)
    np.testing.assert_allclose(rotation[..., 2, 2], 1.0, atol=1e-5)


def test_ground_forces_are_the_rates_of_momentum_that_pinocchio_computes(plans):
    _, plan = plans["solo"]
    stance, robot = plan.joints.stance, plan.joints.model
    course = plan.course(np.linspace(0.0, 4.0, 7))
    samples, poses = stance.samples(course)
    links = ParameterSet(robot)
    force = equation_of_motion(links, samples).K @ links.values
    found = smallest_forces(stance, poses, force, plan.joints.driven)
    model = pinocchio.buildModelFromUrdf(robot.source, pinocchio.JointModelFreeFlyer())
    data, mass = model.createData(), pinocchio.computeTotalMass(model)
    order = [model.joints[model.getJointId(joint)].idx_v for joint in robot.joint_names]
    for row in range(len(course[0])):
        q, v, a = pinocchio.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        rotation = poses.base_rotation[row]
        q[:3], q[3:7] = poses.base_position[row], Rotation.from_matrix(rotation).as_quat()
        q[np.add(order, 1)] = samples.position[row]
        v[:3] = rotation.T @ (course[1, row, :3] * stance.base_position[2])
        v[3:6] = samples.base_angular_velocity[row]
        v[order], a[order] = samples.velocity[row], samples.acceleration[row]
        a[3:6] = samples.base_angular_acceleration[row]
        # Pinocchio's acceleration is the spatial one, and the sensor's contains minus gravity.
        coordinate = samples.base_specific_force[row] + rotation.T @ robot.gravity
        a[:3] = coordinate - np.cross(v[3:6], v[:3])
        rate = pinocchio.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        forces = found.wrench[row, :, 3:]
        total = forces.sum(axis=0) + mass * robot.gravity
        np.testing.assert_allclose(total, rate.linear, atol=1e-3)
        about = np.cross(stance.places[0] - data.com[0], forces).sum(axis=0)
        np.testing.assert_allclose(about, rate.angular, atol=1e-3)


def test_no_torque_acts_on_a_joint_without_drive(plans):
    _, plan = plans["symbitron"]
    space = plan.joints
    stance, robot = space.stance, space.model
    samples, poses = stance.samples(plan.course(np.linspace(0.0, 4.0, 9)))
    links = ParameterSet(robot)
    force = equation_of_motion(links, samples).K @ links.values
    found = smallest_forces(stance, poses, force, space.driven)
    assert np.all(found.torque[:, ~space.driven] == 0.0)
    J = contact_jacobian(robot, stance.frames, link_poses(robot, samples.position))
    # From the middle of the soles back to the frames' origins.
    wrench = found.wrench.copy()
    for index, foot in enumerate(stance.feet):
        wrench[:, index, :3] += np.cross(foot.middle, wrench[:, index, 3:])
    given = np.einsum("nij,ni->nj", J, wrench.reshape(len(wrench), -1))
    given[:, 6:] += found.torque
    np.testing.assert_allclose(given, force, atol=1e-8)


def test_a_plan_keeps_all_limits_and_gains_information(plans):
    _, plan = plans["solo"]
    assert max(plan.contact_usage.values()) <= 1.001
    random = replace(plan, coefficients=plan.validation)
    assert plan.gain > random.gain + 1


def test_a_brief_peak_of_an_acceleration_keeps_its_limit(symbitron):
    """A knee that is nearly straight accelerates briefly, between the instants of the search."""
    options = ExciteOptions(feet=SOLES, no_collision=True, **SHORT)
    design = excitation_problem(symbitron, options, SENSORS).design
    drawn = TrajectoryOptimizer(design, seed=4).draw()
    assert 0.99 < design.excess(drawn, 997) <= 1.0


@pytest.mark.parametrize("name", ["solo", "symbitron"])
@pytest.mark.parametrize("file", ["trajectory.csv", "validation.csv"])
def test_every_line_of_a_written_trajectory_keeps_the_shares_of_the_limits(plans, name, file):
    folder, plan = plans[name]
    limits, names = plan.problem.limits, plan.joints.names
    with (folder / file).open() as stream:
        rows = list(csv.DictReader(stream))
    position, velocity, acceleration, effort = (
        np.array([[float(row[f"{joint}/{kind}"]) for joint in names] for row in rows])
        for kind in ("position", "velocity", "acceleration", "effort")
    )
    assert np.all(np.abs(position - limits.centre) <= 0.95 * limits.half_width)
    assert np.all(np.abs(velocity) <= 0.8 * limits.speed)
    assert np.all(np.abs(acceleration) <= 0.8 * limits.acceleration)
    assert np.all(np.abs(effort) <= 0.7 * limits.effort)
    used = replace(plan, coefficients=plan.validation) if file == "validation.csv" else plan
    shares = {kind: each.max() for kind, each in used.usage().items()}
    assert shares["position"] <= 0.95
    assert max(shares["velocity"], shares["acceleration"]) <= 0.8


@pytest.mark.parametrize("name", ["solo", "symbitron"])
def test_the_true_robot_stands_while_it_follows_the_plan(plans, name):
    """The true links differ by up to 25 %; all feet remain loaded, soles flat on the ground."""
    folder, plan = plans[name]
    robot = plan.joints.model
    simulator = standing_simulator(
        robot,
        folder,
        truth=TruthOptions(truth_seed=3),
        has_friction=True,
        sensors=SENSORS,
        base_sensors=BaseSensorOptions(),
        seed=None,
    )
    instants = [simulator.step() for _ in range(simulator.steps)]
    force = np.array([each.wrenches for each in instants])
    weight = 9.81 * simulator.truth.phi[:, 0].sum()
    rotation = np.array(
        [Rotation.from_quat(each.base_orientation).as_matrix() for each in instants]
    )
    position = np.array([each.true_position for each in instants])
    order = [simulator.joint_names.index(joint) for joint in robot.joint_names]
    place = np.array([each.base_position for each in instants])
    feet, turned = plan.joints.stance.feet_poses(place, rotation, position[:, order])
    vertical = np.einsum("nfij,nfj->nfi", turned, force[:, :, :3])[..., 2]
    assert vertical.min() > 0.02 * weight
    assert vertical.sum(axis=1).mean() == pytest.approx(weight, rel=0.01)
    assert np.abs(feet - plan.joints.stance.places[0]).max() < 0.005
    # Slower joints would tell less than the plan promises.
    wanted = plan.motion(np.arange(len(instants)) / SENSORS.rate)[1]
    velocity = np.array([each.true_velocity for each in instants])
    followed = velocity[:, [simulator.joint_names.index(joint) for joint in plan.joints.names]]
    error = np.sqrt(np.mean((followed - wanted) ** 2, axis=0))
    assert np.all(error < 0.25 * np.sqrt(np.mean(wanted**2, axis=0)))


def test_a_robot_that_crouches_as_planned_has_not_fallen(plans, tmp_path):
    """Nor does a robot that is lower than at first, as long as the plan is."""
    _, plan = plans["solo"]
    crouch = np.zeros_like(plan.coefficients)
    at_start = plan.problem.design.series.basis(np.zeros(1))[0, 0]
    cosine = int(np.flatnonzero(at_start)[1])
    crouch[[0, cosine], 2] = -0.19, -0.19  # from standing to 0.62 times that height, and back
    write_plan(ExcitationPlan(plan.problem, crouch, crouch), tmp_path / "crouch")
    simulator = standing_simulator(
        plan.joints.model,
        tmp_path / "crouch",
        truth=TruthOptions(truth_percent=0.0),
        has_friction=False,
        sensors=SENSORS,
        base_sensors=BaseSensorOptions(),
        seed=None,
    )
    height = np.array([simulator.step().base_position[2] for _ in range(simulator.steps)])
    assert height.min() < 0.65 * height[0]
    _, _, planned = np.array(
        [
            [float(row[f"base/{axis}"]) for axis in "xyz"]
            for row in csv.DictReader((tmp_path / "crouch" / "trajectory.csv").open())
        ]
    ).T
    assert height.min() == pytest.approx(planned.min(), rel=0.03)


def test_the_true_robot_does_not_depend_on_the_trajectory_that_it_follows(plans):
    folder, plan = plans["solo"]

    def drives(path):
        truth = standing_simulator(
            plan.joints.model,
            path,
            truth=TruthOptions(truth_seed=3),
            has_friction=True,
            sensors=SENSORS,
            base_sensors=BaseSensorOptions(),
            seed=None,
        ).truth
        return [(one.damping, one.friction_loss, one.armature) for one in truth.joints]

    assert drives(folder) == drives(folder / "validation.csv")


def test_only_rows_that_are_never_left_out_are_weighted_together(solo):
    """A joint with friction sticks at times; its residual is then unknown."""
    for terms, are_joined in (((), False), (("none",), True)):
        options = ExciteOptions(feet=POINTS, joint_terms=terms, no_collision=True, **SHORT)
        precision = excitation_problem(solo, options, SENSORS).design.expected.precision
        assert np.any(precision[6:, :6]) == are_joined
        assert np.linalg.matrix_rank(precision) == solo.dof


def test_feet_without_sensors_leave_rows_without_their_forces(solo):
    options = ExciteOptions(feet=POINTS, contact=POINTS, no_collision=True, **SHORT)
    problem = excitation_problem(solo, options, SENSORS)
    expected = problem.design.expected
    motion = random_motion(2, 6, 0.05)
    K = expected.measured_rows(motion)
    used = problem.parameters.model.contacts.coordinates
    assert np.flatnonzero(np.diag(expected.precision)).tolist() == used.tolist()
    # Forces at the feet change the generalised force, but none of these rows.
    complete = expected.rows(motion)
    assert len(used) < complete.shape[1]
    measured = excitation_problem(solo, replace(options, contact=()), SENSORS)
    shape = (problem.design.series.size, 6)
    coefficients = 0.03 * np.random.default_rng(3).normal(size=shape)
    assert problem.design.gain(coefficients) < measured.design.gain(coefficients)
    assert np.all(np.isfinite(K))


@pytest.mark.parametrize(
    ("robot", "options", "code"),
    [
        ("solo", {"feet": ("FL_FOOT:sphere",)}, "E920"),
        ("solo", {"feet": POINTS, "joints": ("FL_HAA",)}, "E920"),
        ("solo", {"feet": POINTS[:2]}, "E921"),
        ("solo", {"feet": POINTS, "posture": ("FL_KFE=-1",)}, "E921"),
        ("symbitron", {"feet": SOLES, "posture": ("R_knee=1",)}, "E922"),
        ("symbitron", {"feet": SOLES, "posture": ("R_kfe=nan",)}, "E922"),
        ("symbitron", {"feet": ("imu_link",)}, "E923"),
        ("symbitron", {"feet": ("nosuch",)}, "E116"),
    ],
)
def test_a_stance_that_is_none_is_refused(request, robot, options, code):
    with pytest.raises((ModelError, OptionError)) as error:
        excitation_problem(request.getfixturevalue(robot), ExciteOptions(**options), SENSORS)
    assert error.value.code == code


def test_a_foot_that_is_taken_for_a_sole_is_named_with_the_remedy(solo):
    uneven = ("FL_UPPER_LEG", "FR_FOOT:point", "HL_FOOT:point", "HR_FOOT:point")
    with pytest.raises(ModelError, match="give FL_UPPER_LEG:point in `feet`"):
        excitation_problem(solo, ExciteOptions(feet=uneven), SENSORS)


def test_a_plan_of_another_robot_is_refused(plans, symbitron, tmp_path):
    folder, _ = plans["solo"]
    for path, code in ((folder, "E925"), (tmp_path, "E925")):
        with pytest.raises(SimulationError) as error:
            standing_simulator(
                symbitron,
                path,
                truth=TruthOptions(),
                has_friction=False,
                sensors=SENSORS,
                base_sensors=BaseSensorOptions(),
                seed=None,
            )
        assert error.value.code == code


@pytest.fixture(scope="module")
def balls():
    """A robot whose feet are balls of 2 cm."""
    (found,) = (each for each in files("example-robot-data") or () if each.name == "a1.urdf")
    return load_model(Path(str(found.locate())), "floating")


BALLS = tuple(f"{name}_foot:point" for name in ("FL", "FR", "RL", "RR"))
RADIUS = 0.02


def test_feet_that_are_balls_roll(balls):
    """The lowest points are at rest, the balls' centres move."""
    stance = find_stance(balls, ExciteOptions(feet=BALLS))
    assert [foot.radius for foot in stance.feet] == [RADIUS] * 4
    motion = random_motion(0, 20, 0.03)
    samples, poses = stance.samples(motion)
    assert poses.slip.max() < 1e-6
    centres, turned = stance.feet_poses(poses.base_position, poses.base_rotation, poses.position)
    np.testing.assert_allclose(centres[..., 2], RADIUS, atol=1e-6)
    J = contact_jacobian(balls, stance.frames, link_poses(balls, samples.position))
    height = stance.base_position[2]
    linear = np.einsum("nji,nj->ni", poses.base_rotation, height * motion[1, :, :3])
    rates = np.hstack([samples.base_angular_velocity, linear, samples.velocity])
    twist = np.einsum("nij,nj->ni", J, rates).reshape(20, 4, 2, 3)
    down = -RADIUS * turned[..., 2, :]
    lowest = twist[:, :, 1] + np.cross(twist[:, :, 0], down)
    assert np.abs(lowest).max() < 0.05 * np.abs(twist[:, :, 1]).max()


@pytest.mark.parametrize(
    ("kind", "radius"),
    [("", RADIUS), (":point", RADIUS), (":0.0", 0.0), (":0.03", 0.03)],
    ids=str,
)
def test_feet_and_contacts_mean_the_same(balls, kind, radius):
    feet = tuple(f"{name.partition(':')[0]}{kind}" for name in BALLS)
    options = ExciteOptions(feet=feet, contact=feet, no_collision=True, **SHORT)
    problem = excitation_problem(balls, options, SENSORS)
    assert [foot.radius for foot in problem.design.expected.joints.stance.feet] == [radius] * 4
    assert problem.parameters.model.contacts.radii.tolist() == [radius] * 4


def test_the_floor_touches_a_simulated_ball_at_its_lowest_point(balls, tmp_path):
    options = ExciteOptions(feet=BALLS, no_collision=True, **SHORT)
    problem = excitation_problem(balls, options, SENSORS)
    random = TrajectoryOptimizer(problem.design, seed=0).draw()
    write_plan(ExcitationPlan(problem, random, random), tmp_path / "plan")
    simulator = standing_simulator(
        balls,
        tmp_path / "plan",
        truth=TruthOptions(truth_seed=3),
        has_friction=True,
        sensors=SENSORS,
        base_sensors=BaseSensorOptions(),
        seed=None,
    )
    instants = [simulator.step() for _ in range(100)]
    rotation = Rotation.from_quat([each.base_orientation for each in instants]).as_matrix()
    place = np.array([each.base_position for each in instants])
    order = [simulator.joint_names.index(joint) for joint in balls.joint_names]
    position = np.array([each.true_position for each in instants])[:, order]
    stance = problem.design.expected.joints.stance
    centres, turned = stance.feet_poses(place, rotation, position)
    np.testing.assert_allclose(centres[..., 2], RADIUS, atol=2e-3)
    force, moment = np.split(np.array([each.wrenches for each in instants]), 2, axis=2)
    lever = -RADIUS * turned[..., 2, :]
    assert np.abs(moment).max() > 0.01
    np.testing.assert_allclose(moment, np.cross(lever, force), atol=0.02 * np.abs(moment).max())
