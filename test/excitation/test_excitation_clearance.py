"""Distances between links against hand calculations and against Coal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from documented_robots import ur5_urdf

from symbid_ros.errors import OptionError
from symbid_ros.excitation.clearance import SCALE, Clearance
from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
from symbid_ros.model.load import load_model
from symbid_ros.simulation.joint_sensors import JointSensorOptions

# How far a mesh sticks out of the hull with few vertices that the search uses, m.
WITHIN_HULL = 1.5e-3
BALL = """<link name="{name}"><inertial><origin xyz="0.5 0 0"/><mass value="1"/><inertia ixx="0.1"
 iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="{at}"/><geometry>
 <sphere radius="{radius}"/></geometry></collision></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
 <origin xyz="{at}"/><axis xyz="0 {axis} {up}"/>
 <limit lower="-3" upper="3" effort="10" velocity="2"/></joint>"""


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Return three links in a plane, a metre long, with balls at the first and the last."""
    path = tmp_path_factory.mktemp("chain") / "chain.urdf"
    links = [
        BALL.format(name="base", at="0 0 0", radius=0.2),
        BALL.format(name="upper", at="0.5 0 0", radius=0.05),
        BALL.format(name="lower", at="1 0 0", radius=0.1),
    ]
    joints = [
        JOINT.format(name="one", parent="base", child="upper", at="0 0 0", axis=0, up=1),
        JOINT.format(name="two", parent="upper", child="lower", at="1 0 0", axis=0, up=1),
    ]
    path.write_text(f"<robot name='chain'>{''.join(links + joints)}</robot>")
    return load_model(path, "fixed")


def place_of_hand(position):
    """Position of the last ball in the base's frame (N, 3)."""
    first, both = position[:, 0], position.sum(axis=1)
    zero = np.zeros(len(position))
    return np.stack([np.cos(first) + np.cos(both), np.sin(first) + np.sin(both), zero], axis=1)


def test_distances_and_slopes_of_balls_are_those_of_geometry(chain):
    rng = np.random.default_rng(0)
    clearance = Clearance(chain, 0.5, rng.uniform(-3, 3, (50, 2)))
    # Near the base, so that the distance counts.
    position = np.column_stack([rng.uniform(-3, 3, 40), rng.uniform(2.3, 3.0, 40)])
    expected = np.linalg.norm(place_of_hand(position), axis=1) - 0.3
    for row, distance in zip(position, expected, strict=True):
        assert clearance.smallest(row[None])[0] == pytest.approx(distance, abs=1e-5)
    ((share, slopes),) = clearance.shares(position)
    np.testing.assert_allclose(share, 1 + (0.5 - expected) / SCALE, atol=1e-4)
    step = 1e-6
    ends = np.linalg.norm(
        place_of_hand(
            np.concatenate([position + np.array([0, step]), position - np.array([0, step])])
        ),
        axis=1,
    )
    found = -(ends[:40] - ends[40:]) / (2 * step) / SCALE
    np.testing.assert_allclose(slopes[:, 1], found, atol=1e-3)
    np.testing.assert_allclose(slopes[:, 0], 0.0, atol=1e-3)  # the base's axis changes nothing


def test_a_floor_is_against_gravity_and_neighbours_are_not_compared(chain):
    postures = np.zeros((5, 2))
    clearance = Clearance(chain, 0.05, postures, floor=-0.25)
    assert clearance.smallest(postures[:1])[0] == pytest.approx(0.15, abs=1e-6)
    assert clearance.smallest(postures[:1])[1] == "floor and lower"
    # On a floor that all postures touch nothing is left to compare but the base and the hand.
    assert "always close" in Clearance(chain, 0.05, postures, floor=0.0).remarks[-1]


def cramped(path, radius, at):
    """Write a robot like the chain, whose last ball surrounds a point at (at, 0, 0) of its link."""
    links = [
        BALL.format(name="base", at="0 0 0", radius=0.2),
        BALL.format(name="upper", at="0.5 0 0", radius=0.05),
        BALL.format(name="lower", at=f"{at} 0 0", radius=radius),
    ]
    joints = [
        JOINT.format(name="one", parent="base", child="upper", at="0 0 0", axis=0, up=1),
        JOINT.format(name="two", parent="upper", child="lower", at="1 0 0", axis=0, up=1),
    ]
    path.write_text(f"<robot name='cramped'>{''.join(links + joints)}</robot>")
    return load_model(path, "fixed")


def test_links_that_touch_about_the_middle_of_the_ranges_do_not_prevent_a_plan(tmp_path):
    """They move apart only when the elbow is bent by more than 1.5 of 3 rad."""
    robot = cramped(tmp_path / "robot.urdf", 0.85, -0.4)
    problem = excitation_problem(robot, ExciteOptions(), JointSensorOptions())
    assert "base and lower" in " ".join(problem.unchecked)
    assert TrajectoryOptimizer(problem.design, 0).draw() is not None


def test_an_impossible_plan_names_the_closest_links(chain):
    options = ExciteOptions(clearance=0.02)
    problem = excitation_problem(chain, options, JointSensorOptions())
    everywhere = Clearance(chain, 3.0, np.zeros((0, 2)))
    with pytest.raises(OptionError, match=r"base and lower are .* mm apart") as error:
        TrajectoryOptimizer(replace(problem.design, clearance=everywhere), 0).run(1, 1)
    assert error.value.code == "E584"


def test_a_designed_trajectory_keeps_coals_distances_and_the_floor():
    path = ur5_urdf()
    arm = load_model(path, "fixed")
    options = ExciteOptions(period=6.0, seconds=12.0, harmonics=3, floor=0.0)
    problem = excitation_problem(arm, options, JointSensorOptions())
    optimizer = TrajectoryOptimizer(problem.design, seed=0)
    optimizer.run(starts=1, iterations=8)
    plan = ExcitationPlan(problem, optimizer.best, optimizer.random)
    assert options.clearance * 0.999 <= plan.closest[0] < options.clearance + SCALE
    model = pinocchio.buildModelFromUrdf(str(path))
    folders = [str(Path(path).parents[4])]
    geometry = pinocchio.buildGeomFromUrdf(
        model, str(path), pinocchio.COLLISION, package_dirs=folders
    )
    geometry.addAllCollisionPairs()
    data, distances = model.createData(), pinocchio.GeometryData(geometry)
    time = np.linspace(0, 6.0, 60)
    position = plan.joints.samples(plan.motion(time)).position
    names = [one.name for one in geometry.geometryObjects]
    far = {"upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"}
    checked = 0
    for posture in position:
        pinocchio.computeDistances(model, data, geometry, distances, posture)
        for pair, found in zip(geometry.collisionPairs, distances.distanceResults, strict=True):
            links = {names[index].rpartition("_")[0] for index in (pair.first, pair.second)}
            if links in ({"base_link", "wrist_3_link"}, {"upper_arm_link", "wrist_3_link"}):
                assert found.min_distance >= options.clearance - WITHIN_HULL
                checked += 1
        for placement, shape in zip(distances.oMg, geometry.geometryObjects, strict=True):
            if shape.name.rpartition("_")[0] in far:
                vertices = shape.geometry.vertices() @ placement.rotation.T
                lowest = (vertices + placement.translation)[:, 2].min()
                assert lowest >= options.clearance - WITHIN_HULL
    assert checked == 2 * len(time)
