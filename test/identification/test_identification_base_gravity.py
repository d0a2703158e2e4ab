"""Arms on walls and under ceilings, of which the model file says that they stand on a table."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm_log import arm_streams
from documented_robots import ur5_urdf
from foreign_bags import joint_state, joints_only
from random_robots import random_robot
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import OptionError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.base_gravity import find_gravity
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.robot_setup import inspect_robot
from symbid_ros.signals.log import Log

DOWN = np.array([0.0, 0.0, -9.81])
WALL = np.array([9.81, 0.0, 0.0])
FRICTION = 0.05  # of the effort limits; wrists rub more than they carry


@pytest.fixture(scope="module")
def ur5(tmp_path_factory):
    """Return the model file of a UR5 whose links are off by up to a quarter."""
    robot = sy.load_model(ur5_urdf(), base="fixed")
    parameters = ParameterSet(robot)
    drawn = draw_prior(parameters, "consistent", 25, 3).mean
    path = tmp_path_factory.mktemp("model") / "ur5.urdf"
    path.write_text(urdf_text(parameters.apply(drawn), ur5_urdf()))
    return sy.load_model(path, base="fixed")


def streams_under(gravity, seed=1, friction=FRICTION, seconds=20.0):
    """Return what an arm reads on which gravity acts in some direction."""
    true = replace(sy.load_model(ur5_urdf(), base="fixed"), gravity=np.asarray(gravity))
    return arm_streams(true, seconds, seed, friction=friction)


def found_in(streams, robot):
    return find_gravity(AlignedLog(Log.from_streams(streams), robot), robot)


def angle(direction, gravity) -> float:
    """Return the angle in degrees between a unit vector and gravity."""
    cosine = np.dot(direction, gravity) / np.linalg.norm(gravity)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@pytest.mark.parametrize(
    "gravity",
    [WALL, -DOWN, [0.0, 1.7, -9.66], [3.0, -8.0, 4.8]],
    ids=["wall", "ceiling", "tilted by 10 degrees", "askew"],
)
@pytest.mark.parametrize("friction", [0.0, 0.15])
def test_the_direction_is_found(ur5, gravity, friction) -> None:
    found = found_in(streams_under(gravity, friction=friction), ur5)
    assert angle(found.direction, gravity) < 0.2
    assert found.after < 0.1 * found.before


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("friction", [0.0, 0.05, 0.15])
def test_the_direction_of_a_right_model_is_kept(ur5, friction, seed) -> None:
    assert found_in(streams_under(DOWN, seed, friction), ur5) is None


@pytest.mark.parametrize(
    "factor", [-1.0, np.array([0.1, -1.2, 0.7, 1.0, -0.3, 2.0])], ids=["sign", "units"]
)
def test_wrong_efforts_are_no_other_direction(ur5, factor) -> None:
    """Efforts of the wrong sign look like those of an arm under the ceiling."""
    read = streams_under(DOWN)
    read = replace(read, joints=replace(read.joints, effort=factor * read.joints.effort))
    assert found_in(read, ur5) is None


@pytest.mark.parametrize(("degrees", "is_found"), [(6.0, False), (40.0, True)])
def test_a_wrong_zero_of_the_first_joint_is_no_other_direction(ur5, degrees, is_found) -> None:
    """On a wall, both turn the arm about the axis of its first joint."""
    read = streams_under(WALL)
    position = read.joints.position + np.radians(degrees) * (np.arange(6) == 0)
    read = replace(read, joints=replace(read.joints, position=position))
    assert (found_in(read, ur5.with_gravity(WALL)) is not None) == is_found


@pytest.fixture(scope="module")
def result(ur5):
    return sy.identify(ur5, Log.from_streams(streams_under(WALL, seconds=40.0)))


def test_an_arm_on_a_wall_is_identified_by_default(ur5, result) -> None:
    estimate = result.estimate
    assert angle(estimate.gravity, WALL) < 0.2
    assert np.linalg.norm(estimate.gravity) == pytest.approx(9.81)
    assert result.options.gravity == pytest.approx(np.array(estimate.gravity) / 9.81)
    assert estimate.holdout.percent_after < 0.1 * estimate.holdout.percent_before
    assert estimate.verdict.alarms == ()
    true = sy.load_model(ur5_urdf(), base="fixed").phi
    errors = [
        (one.value - true[ur5.link_names.index(link), 0]) / one.std
        for link in ur5.link_names[1:]
        if (one := result.parameters[f"{link}/m"]).is_determined
    ]
    assert np.sqrt(np.mean(np.square(errors))) < 2.0


def test_a_direction_that_is_given_is_used(ur5, result) -> None:
    log = Log.from_streams(streams_under(WALL, seconds=40.0))
    given = sy.identify(ur5, log, gravity=2.0 * WALL, no_holdout=True)
    assert given.options.gravity == tuple(2.0 * WALL)
    np.testing.assert_allclose(given.estimate.gravity, WALL)
    std = np.maximum(result.estimate.std, given.estimate.std)
    assert np.all(np.abs(given.estimate.value - result.estimate.value) < 3 * std + 1e-9)


@pytest.mark.parametrize(("degrees", "is_mounting"), [(0.25, False), (8.0, True)])
def test_a_small_tilt_is_an_unknown_axis_of_the_first_joint(ur5, degrees, is_mounting) -> None:
    """Both tilt all that the base carries."""
    tilted = Rotation.from_euler("x", degrees, degrees=True).apply(DOWN)
    log = Log.from_streams(streams_under(tilted, friction=0.0))
    found = sy.identify(ur5, log, sensor_errors=("joint_axis",), no_holdout=True)
    assert angle(found.estimate.gravity, tilted if is_mounting else DOWN) < 0.2
    if not is_mounting:
        (error,) = [
            one.value
            for one in found.estimate.verdict.sensors
            if one.name == "shoulder_pan_joint/joint_axis_x"
        ]
        assert error == pytest.approx(-np.radians(degrees), rel=0.05)


def test_a_saved_result_predicts_the_arm_on_its_wall(result, tmp_path) -> None:
    result.save(tmp_path / "result")
    model = ForcePredictor.load(tmp_path / "result").parameters.model
    assert angle(model.gravity / 9.81, WALL) < 0.2
    validation = sy.validate(tmp_path / "result", Log.from_streams(streams_under(WALL)))
    assert validation.is_better
    assert validation.percent_after < 1.0
    option = ET.parse(tmp_path / "result/model.xml").getroot().find("option")
    assert angle([float(one) / 9.81 for one in option.get("gravity").split()], WALL) < 0.2


def test_the_doctor_blames_the_mounting_and_no_sensor(ur5) -> None:
    diagnosis = sy.diagnose(ur5, Log.from_streams(streams_under(WALL)))
    (finding,) = diagnosis.findings
    assert finding.kind is Kind.BASE_MOUNTING
    assert finding.figures["gravity_x"] == pytest.approx(1.0, abs=1e-3)
    given = sy.diagnose(ur5, Log.from_streams(streams_under(WALL)), gravity=WALL)
    assert given.findings == ()


def bag_of(streams, path):
    read = streams.joints
    columns = zip(read.stamp, read.position, read.velocity, read.effort, strict=True)
    messages = [joint_state(int(stamp), read.names, *one) for stamp, *one in columns]
    return joints_only(path / "bag", *messages)


def test_init_writes_the_direction(ur5, tmp_path) -> None:
    bag = bag_of(streams_under(WALL), tmp_path)
    setup = inspect_robot(Path(ur5.source), [bag], "fixed")
    written = [float(one) for one in setup.options["gravity"]]
    assert angle(written, WALL) < 0.2
    found = found_in(streams_under(WALL), ur5).direction
    np.testing.assert_allclose(written, found, atol=1e-5)
    assert "effort_scale" not in setup.options
    assert setup.diagnosis.findings == ()


ROD_JOINTS = (  # name, axis, origin, length of its rod, mass
    ("pan", "0 0 1", "0 0 0.1", 0.1, 4.0),
    ("lift", "0 1 0", "0 0 0.12", 0.4, 6.0),
    ("elbow", "0 1 0", "0.4 0 0", 0.35, 3.0),
    ("wrist_1", "0 1 0", "0.35 0 0", 0.1, 1.2),
    ("wrist_2", "0 0 1", "0 0 0.1", 0.08, 1.0),
    ("wrist_3", "1 0 0", "0.08 0 0", 0.05, 0.4),
)


def rods_urdf():
    """Return a URDF of an arm of six rods."""
    parent, text = "base", '<link name="base"/>'
    for name, axis, origin, length, mass in ROD_JOINTS:
        turning = mass * length**2 / 12
        centre = f"{length / 2} 0.01 0.01" if length > 0.1 else f"0.01 0.01 {length / 2}"
        text += (
            f'<link name="{name}_link"><inertial><origin xyz="{centre}"/>'
            f'<mass value="{mass}"/><inertia ixx="{turning / 5}" ixy="0" ixz="0" iyy="{turning}" '
            f'iyz="0" izz="{turning}"/></inertial></link><joint name="{name}" type="continuous">'
            f'<parent link="{parent}"/><child link="{name}_link"/><origin xyz="{origin}"/>'
            f'<axis xyz="{axis}"/></joint>'
        )
        parent = f"{name}_link"
    return f'<robot name="rods">{text}</robot>'


def test_init_reverses_no_joint_in_place_of_gravity(tmp_path) -> None:
    """Under the wrong gravity, a reversed first joint explains the efforts of the wrists better."""
    path = tmp_path / "rods.urdf"
    path.write_text(rods_urdf())
    robot = sy.load_model(path, base="fixed")
    parameters = ParameterSet(robot)
    true = parameters.apply(draw_prior(parameters, "consistent", 25, 0).mean)
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 20.0, 0.005)
    frequency = rng.uniform(0.05, 0.6, (5, 6))
    rate = 2 * np.pi * frequency
    size = 0.15 * rng.uniform(0.5, 1.0, (5, 6)) / frequency**0.7
    phase = time[:, None, None] * rate + rng.uniform(0, 2 * np.pi, (5, 6))
    position = np.sum(size * np.sin(phase), axis=1)
    velocity = np.sum(size * rate * np.cos(phase), axis=1)
    acceleration = -np.sum(size * rate**2 * np.sin(phase), axis=1)
    rows = sy.regressor(true.with_gravity(-DOWN), position, velocity, acceleration)
    effort = rows @ true.phi.ravel()
    scale = effort.std(axis=0)
    effort += 0.05 * scale * (2 * velocity + np.tanh(velocity / 1e-3) + acceleration)
    effort += 0.01 * scale * rng.standard_normal(effort.shape)
    position += 2e-5 * rng.standard_normal(position.shape)
    columns = zip((1e9 * time).astype(int) + 10**18, position, velocity, effort, strict=True)
    messages = [joint_state(int(stamp), robot.joint_names, *one) for stamp, *one in columns]
    setup = inspect_robot(path, [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert angle([float(one) for one in setup.options["gravity"]], -DOWN) < 0.2
    assert not {"flip_joint", "effort_scale"} & set(setup.options)


def test_a_direction_needs_a_fixed_base_and_a_length() -> None:
    with pytest.raises(OptionError, match="no direction"):
        RobotOptions(gravity=(0.0, 0.0, 0.0))
    floating = random_robot(1, links=3, floating=True)
    with pytest.raises(OptionError, match="fixed base"):
        with_robot_options(floating, RobotOptions(gravity=(1.0, 0.0, 0.0)))
