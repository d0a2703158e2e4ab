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


def test_an_arm_is_identified_with_default_options() -> None:
    trial = foreign_robots.trial("z1", "present", 3, 12.0)
    assert trial.default < 0.01 * trial.prior
    assert trial.default < 1.5 * trial.by_hand
