"""Simulated robots of the bench: exact rows, gains of one, and parameters that are found."""

from dataclasses import replace

import foreign_robots
import numpy as np
import pytest

from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.parameters import ParameterSet


@pytest.fixture(scope="module")
def standing():
    """A small quadruped that stands, its size of efforts, and a generator."""
    robot, feet = foreign_robots.load_robot("solo12")
    rng = np.random.default_rng(5)
    return robot, foreign_robots.move(robot, feet, rng, 12.0), rng


def test_forces_obey_the_equation_of_motion(standing) -> None:
    robot, motion, _ = standing
    robot = foreign_robots.plain(robot)
    motion = replace(motion, effort=foreign_robots.torque(robot, motion))
    parameters = ParameterSet(robot)
    rows = equation_of_motion(parameters, motion)
    np.testing.assert_allclose(rows.K @ parameters.values, rows.y, atol=1e-9)


def test_the_doctor_finds_a_correct_log_of_a_calm_robot_clean(standing) -> None:
    """Gains and inertias of a third would leave a third of the noise."""
    robot, motion, rng = standing
    robot = foreign_robots.plain(robot)
    size = np.sqrt(np.mean(foreign_robots.torque(robot, motion) ** 2, axis=0))
    diagnosis = diagnose(foreign_robots.record(robot, motion, size, rng), robot)
    assert {one.kind for one in diagnosis.findings} <= {Kind.EXCITATION}
    for foot in motion.wrench_frames:
        assert diagnosis.figures[f"{foot}/gain"] == pytest.approx(1.0, abs=0.05)


def test_the_doctor_claims_no_gain_of_a_joint_that_rubs_far_more_than_it_carries() -> None:
    """The wrist of this UR10 carries 6 mNm, 34 mNm by the model file, and rubs with 0.8 Nm."""
    seed = 102
    robot, _ = foreign_robots.load_robot("ur10")
    rng = np.random.default_rng(seed)
    motion = foreign_robots.move(robot, (), rng, 60.0)
    load = foreign_robots.torque(foreign_robots.plain(robot), motion)
    size = np.sqrt(np.mean(load**2, axis=0))
    size = np.maximum(size, 0.05 * size.max())
    truth = foreign_robots.with_friction(robot, True, size, rng)
    log = foreign_robots.record(truth, motion, size, rng)
    model = foreign_robots.inaccurate(truth, False, size, seed, rng)
    assert diagnose(log, model).findings == ()


def test_the_doctor_claims_no_gain_of_wheels_that_are_balanced() -> None:
    """The file's wheels have masses off the axis, which would need 50 times the torque."""
    robot, _ = foreign_robots.load_robot("tiago_no_hand")
    rng = np.random.default_rng(101)
    motion = foreign_robots.move(robot, (), rng, 15.0)
    robot = foreign_robots.plain(robot)
    size = np.sqrt(np.mean(foreign_robots.torque(robot, motion) ** 2, axis=0))
    size = np.maximum(size, 0.05 * size.max())
    model = foreign_robots.inaccurate(robot, False, size, 101, rng)
    diagnosis = diagnose(foreign_robots.record(robot, motion, size, rng), model)
    assert {one.kind for one in diagnosis.findings} <= {Kind.EXCITATION, Kind.EFFORT_NOISE}


@pytest.mark.parametrize(
    ("name", "feet"),
    [
        ("ur5", ()),
        ("panda", ()),
        ("anymal_c_simple_description/anymal", ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")),
        ("talos_reduced", ("left_sole_link", "right_sole_link")),
        ("bolt", ("FL_FOOT", "FR_FOOT")),
    ],
)
def test_feet_are_the_lowest_ends_of_legs(name, feet) -> None:
    robot, found = foreign_robots.load_robot(name)
    assert (robot.floating, set(found)) == (bool(feet), set(feet))


def test_an_arm_is_identified_with_default_options() -> None:
    trial = foreign_robots.trial("z1", "present", 3, foreign_robots.Setup(12.0))
    assert trial.default < 0.01 * trial.prior
    assert trial.default < 1.5 * trial.by_hand


def test_noise_of_an_accelerometer_is_no_error_of_the_model_file() -> None:
    """Where no sensor feels the feet, accelerations tell the masses, and their noise counts."""
    setup = foreign_robots.Setup(has_foot_sensors=False)
    found = foreign_robots.trial("a1", "absent", 6200, setup)
    assert found.default < min(found.prior, 1.2 * found.expected)
    assert found.expected < 1.2 * found.bound
    assert found.alarms == ()


def test_placements_are_found_where_the_first_axis_looks_like_another_gravity() -> None:
    setup = foreign_robots.Setup(seconds=30.0, geometry=foreign_robots.KINEMATIC_ERRORS)
    found = foreign_robots.trial("ur5", "absent", 5202, setup)
    assert found.prior > 50 * found.default
    assert found.geometry < 2.0


def test_the_bound_of_a_gripper_whose_fingers_rub() -> None:
    """The second finger follows the first: it has no friction that a log could tell."""
    robot, _ = foreign_robots.load_robot("panda")
    rng = np.random.default_rng(4)
    motion, other = (foreign_robots.move(robot, (), rng, seconds) for seconds in (4.0, 2.0))
    size = np.ones(len(robot.joints))
    truth = foreign_robots.with_friction(robot, True, size, rng)
    least = foreign_robots.least_variance(truth, motion, other, 1e-3 * size)
    assert np.all(np.isfinite(least))
    assert np.all(least[:, robot.joint_names.index("panda_joint4")] > 0)
