"""Designed trajectories beat random ones by what the documentation promises, and more."""

import re

import pytest
from excitation import compare
from foreign_robots import load_robot

from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
from symbid_ros.simulation.joint_sensors import JointSensorOptions


@pytest.fixture(scope="module")
def plan():
    robot = load_robot("ur5", base="fixed")[0]
    problem = excitation_problem(robot, ExciteOptions(no_collision=True), JointSensorOptions())
    optimizer = TrajectoryOptimizer(problem.design, seed=0)
    optimizer.run(starts=1, iterations=40)
    return ExcitationPlan(problem, optimizer.best, optimizer.random)


def test_a_designed_trajectory_beats_random_ones(plan, capsys):
    compare(plan, draws=6)
    shown = capsys.readouterr().out
    ratios = dict(re.findall(r"\| (best|median) of 6 random \| ([\d.]+) \|", shown))
    assert float(ratios["best"]) > 1.2
    assert float(ratios["median"]) > 2.0
