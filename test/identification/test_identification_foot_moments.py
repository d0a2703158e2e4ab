"""Foot sensors that read forces without moments, on feet that are balls."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from live_feed import feed_of
from quadruped_log import FEET, inaccurate, quadruped_urdf, record_log, standing_log

import symbid_ros as sy
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.errors import ModelError, OptionError
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.assumed_contacts import assumed_contacts
from symbid_ros.identification.conventions.foot_moments import find_foot_moments
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.validation import validate
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog, joined_segments
from symbid_ros.offline.bags import load_bag
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.signals.alignment import align_checked
from symbid_ros.signals.log import Log

RADIUS = 0.03
DEPTH = 0.024  # of the points at which soft ground pushes, below the centres of the balls
BALL = f'<collision><geometry><sphere radius="{RADIUS}"/></geometry></collision>'
FORCES = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
EXACT = {"joint_terms": ("none",), "window": 0.321, "sensor_errors": ("none",)}
SETTINGS = {"joint_terms": ("none",), "window": 0.161}


@pytest.fixture(scope="module")
def true_robot(tmp_path_factory):
    text = quadruped_urdf()
    for foot in FEET:
        text = text.replace(f'<link name="{foot}"/>', f'<link name="{foot}">{BALL}</link>')
    path = tmp_path_factory.mktemp("model") / "quadruped.urdf"
    path.write_text(text)
    return sy.load_model(path)


@pytest.fixture(scope="module")
def robot(true_robot):
    return inaccurate(true_robot)


@pytest.fixture(scope="module")
def readings(true_robot):
    return {
        depth: standing_log(true_robot, 16.0, 3, friction=0.0, radius=depth)
        for depth in (0.0, DEPTH)
    }


def log_of(robot, readings, *, moments=0.0, feet=FEET, touches=None):
    joints, imu = readings["/joint_states"], readings["/imu"]
    factors = FORCES + moments * (1.0 - FORCES)
    return Log.from_arrays(
        robot,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"],
        imus={"imu_link": np.hstack([imu["angular_velocity"] - 0.01, imu["linear_acceleration"]])},
        wrenches={foot: readings[f"/{foot}/wrench"]["wrench"] * factors for foot in feet},
        touches=touches,
    )


def segments_of(log, robot):
    return joined_segments(AlignedLog(log, robot))


def test_forces_below_the_frames_have_moments(true_robot, readings):
    measured = log_of(true_robot, readings[DEPTH], moments=1.0)
    sensors = tuple(f"{foot}:{DEPTH}" for foot in FEET)
    robot = with_robot_options(true_robot, RobotOptions(force_only=sensors))
    for moments in (0.0, 5.0):  # those of the log are not used
        log = log_of(true_robot, readings[DEPTH], moments=moments)
        (found,) = segments_of(log, robot)
        (expected,) = segments_of(measured, true_robot)
        np.testing.assert_array_equal(found.wrenches[..., 3:], expected.wrenches[..., 3:])
        left = np.sqrt(np.mean((found.wrenches - expected.wrenches)[..., :3] ** 2))
        # The moments that were measured have noise, and those from forces the noise of these.
        assert left < 1.1 * np.hypot(0.01, 0.3 * DEPTH)


def test_a_log_shows_where_forces_without_moments_act(
    robot, true_robot, readings, tmp_path, caplog
):
    log = log_of(robot, readings[DEPTH])
    with caplog.at_level(logging.WARNING):
        found = sy.identify(robot, log, **SETTINGS)
    names, radii = zip(*(one.split(":") for one in found.options.force_only), strict=True)
    assert sorted(names) == sorted(FEET)
    np.testing.assert_allclose(np.array(radii, dtype=float), DEPTH, atol=5e-4)
    assert f"{1e3 * float(radii[0]):.1f} mm below" in caplog.text
    assert not found.alarms
    asis = sy.identify(robot, log, force_only=("none",), no_holdout=True, **SETTINGS)
    errors = [np.abs(one.robot.phi - true_robot.phi)[:, :4].sum() for one in (found, asis)]
    assert errors[0] < 0.4 * errors[1]
    # A saved result predicts with these moments.
    found.save(tmp_path)
    assert load_estimate(tmp_path / "estimate.json").force_only == found.estimate.force_only
    again = validate(tmp_path, log)
    assert again.torque.percent_after < 0.5 * again.torque.percent_before
    assert 0.7 < again.torque.normalized_square < 1.4


def test_live_messages_give_the_same(robot, readings, tmp_path):
    forces = {topic: dict(columns) for topic, columns in readings[DEPTH].items()}
    for foot in FEET:
        forces[f"/{foot}/wrench"]["wrench"] = forces[f"/{foot}/wrench"]["wrench"] * FORCES
    bag = record_log(forces, robot, tmp_path / "bag")
    named = ",".join(f"{foot}:{DEPTH}" for foot in FEET)
    options = IdentifyOptions(force_only=(named,), no_holdout=True, **EXACT)
    offline = load_problem(robot, load_bag(bag, robot), options).solve().estimate
    feed = feed_of(bag)
    live = OnlineIdentification(InitialState.of(robot, options), feed.selected, Pace(share=1.0))
    try:
        feed.into(live, solving=6.0)
        found = live.solve(exactly=True).found.estimate
    finally:
        live.close()
    assert found.force_only == offline.force_only
    np.testing.assert_allclose(found.value, offline.value, atol=1e-3 * offline.std.max())


def test_moments_that_are_right_stay(robot, readings):
    for depth, moments in ((0.0, 0.0), (DEPTH, 1.0), (0.0, 1.0)):
        segments = segments_of(log_of(robot, readings[depth], moments=moments), robot)
        assert find_foot_moments(segments, robot) is None
    # Without a ball nothing tells where the forces act.
    bare = replace(robot, frames=tuple(replace(one, radius=0.0) for one in robot.frames))
    assert find_foot_moments(segments_of(log_of(robot, readings[DEPTH]), robot), bare) is None


def test_feet_without_sensors_show_where_the_ground_pushes(robot, readings):
    log = log_of(robot, readings[DEPTH], feet=())
    found = dict(one.split(":") for one in assumed_contacts(robot, log))
    assert sorted(found) == sorted(FEET)
    np.testing.assert_allclose([float(one) for one in found.values()], DEPTH, atol=1e-3)
    # A radius of the file that explains the log stays.
    frames = tuple(replace(one, radius=DEPTH * (one.radius > 0)) for one in robot.frames)
    right = replace(robot, frames=frames)
    assert set(assumed_contacts(right, log)) == {f"{foot}:{DEPTH}" for foot in FEET}
    # Without a ball in the file, the ground pushes below the frames if the log shows it.
    bare = replace(robot, frames=tuple(replace(one, radius=0.0) for one in robot.frames))
    found = dict(one.split(":") for one in assumed_contacts(bare, log))
    np.testing.assert_allclose([float(one) for one in found.values()], DEPTH, atol=2e-3)
    at_frames = assumed_contacts(bare, log_of(robot, readings[0.0], feet=()))
    assert set(at_frames) == {f"{foot}:point" for foot in FEET}


def test_flags_of_frames_in_balls_tell_of_these(readings, tmp_path):
    shin = '<link name="{leg}_KFE_link"><collision><origin xyz="0 0 -{at}"/>'
    shin += f'<geometry><sphere radius="{RADIUS}"/></geometry></collision>'
    text = quadruped_urdf()
    for leg in ("LF", "RF", "LH", "RH"):
        text = text.replace(f'<link name="{leg}_KFE_link">', shin.format(leg=leg, at=0.26))
    path = tmp_path / "balls.urdf"
    path.write_text(text)
    robot = sy.load_model(path)
    touches = np.ones((len(FEET), len(readings[DEPTH]["/imu"]["time"])), bool)
    touches[0, 100:200] = False
    log = log_of(robot, readings[DEPTH], feet=(), touches=dict(zip(FEET, touches, strict=True)))
    named = [f"{foot}:point" for foot in FEET]
    balls = tuple(f"{foot.partition('_')[0]}_KFE_link_end:{RADIUS}" for foot in FEET)
    on_balls = with_contacts(robot, named)
    assert on_balls.contacts.names == with_contacts(robot, balls).contacts.names == balls
    assert [one.partition(":")[0] for one in assumed_contacts(robot, log)] == [
        one.partition(":")[0] for one in balls
    ]
    (segment,) = align_checked(log.streams(), on_balls)
    assert segment.touching is not None
    lifted = ~segment.touching
    assert 0 < lifted[:, 0].sum() < 150
    assert not lifted[:, 1:].any()


def test_sensors_are_checked(robot):
    with pytest.raises(OptionError, match="FRAME:RADIUS"):
        IdentifyOptions(force_only=("LF_foot:ball",))
    with pytest.raises(ModelError, match=r"no ball .* imu_link"):
        with_robot_options(robot, RobotOptions(force_only=("imu_link",)))
    with pytest.raises(ModelError, match="LF_KFE_link is a moving link"):
        with_robot_options(robot, RobotOptions(force_only=("LF_KFE_link:0.02",)))
    with pytest.raises(ModelError, match="no frame or link 'hand'"):
        with_robot_options(robot, RobotOptions(force_only=("hand",)))
    named = with_robot_options(robot, RobotOptions(force_only=("LF_foot,imu_link:0.01",)))
    assert {one.name: one.below for one in named.frames if one.below} == {
        "LF_foot": RADIUS,
        "imu_link": 0.01,
    }
