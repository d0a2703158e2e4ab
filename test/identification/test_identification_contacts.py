"""A quadruped without force sensors in its feet, and robots whose drives measure nothing."""

from dataclasses import replace

import numpy as np
import pytest
from live_feed import feed_of
from quadruped_log import (
    FEET,
    RATE,
    inaccurate,
    load_quadruped,
    quadruped_urdf,
    record_log,
    standing_log,
)
from scipy.spatial.transform import Rotation

from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.errors import DataError, EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.identification.api import diagnose, identify
from symbid_ros.identification.conventions.assumed_contacts import assumed_contacts, chain_ends
from symbid_ros.identification.loaded_problem import load_information, load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.validation import validate
from symbid_ros.identification.rows.aligned_log import AlignedLog, joined_segments
from symbid_ros.identification.rows.dataset import Processing, fold_dataset
from symbid_ros.identification.terms.choice import _any_slips
from symbid_ros.identification.terms.remarks import resting_joints
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import load_bag
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.package_paths import config_file
from symbid_ros.signals.log import Log

POINTS = tuple(f"{foot}:point" for foot in FEET)


@pytest.fixture(scope="module")
def true_robot(tmp_path_factory):
    return load_quadruped(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def robot(true_robot):
    return inaccurate(true_robot)


@pytest.fixture(scope="module")
def readings(true_robot):
    return standing_log(true_robot, 10.0, 3, friction=0.0)


def log_of(robot, readings, *, feet=(), effort=None, touches=None):
    joints, imu = readings["/joint_states"], readings["/imu"]
    return Log.from_arrays(
        robot,
        time=joints["time"],
        position=joints["position"],
        effort=joints["effort"] if effort is None else effort,
        imus={"imu_link": np.hstack([imu["angular_velocity"] - 0.01, imu["linear_acceleration"]])},
        wrenches={foot: readings[f"/{foot}/wrench"]["wrench"] for foot in feet},
        touches=touches,
    )


def test_efforts_alone_weigh_a_robot_on_its_feet(robot, true_robot, readings, tmp_path):
    log = log_of(robot, readings)
    found = identify(robot, log, contact=POINTS, window=0.321)
    before, after, true = (one.phi[:, 0].sum() for one in (robot, found.robot, true_robot))
    assert abs(after - true) < 0.1 * abs(before - true)
    assert after == pytest.approx(true, rel=0.01)
    assert not found.alarms
    assert found.estimate.contacts == POINTS
    assert found.estimate.holdout.percent_after < 0.2 * found.estimate.holdout.percent_before
    # A saved result says which contacts were eliminated.
    found.save(tmp_path)
    combined = load_archive(tmp_path / "information.npz")[0].layout.combined
    assert combined == tuple(with_contacts(robot, POINTS).contacts.coordinates.tolist())
    # Earlier versions combined coordinates otherwise, and their archives do not say so.
    content = dict(np.load(tmp_path / "information.npz"))
    del content["combined"]
    np.savez(tmp_path / "earlier.npz", **content)
    with pytest.raises(EstimateError, match="other combinations"):
        load_problem(robot, log, IdentifyOptions(information=tmp_path / "earlier.npz"))
    again = validate(tmp_path, log)
    assert again.is_better
    assert again.mass is None
    # Dependent rows are judged too: what each joint's effort has that no contact can balance.
    assert [one.name for one in again.coordinates] == list(robot.coordinates)
    assert again.torque.percent_after < 0.2 * again.torque.percent_before


def test_a_robot_without_wrench_sensors_is_assumed_to_stand_on_its_legs(
    robot, readings, caplog, simulated, tmp_path
):
    log = log_of(robot, readings)
    assert assumed_contacts(robot, log) == POINTS
    problem = load_problem(robot, log, IdentifyOptions(window=0.321, joint_terms=("none",)))
    assert problem.options.contacts == problem.solve().estimate.contacts == POINTS
    assert f"give `contact` {','.join(POINTS)}" in caplog.text
    checked = diagnose(robot, log)
    assert not checked.severity
    assert "LF_foot, RF_foot, LH_foot, RH_foot are unknown" in " ".join(checked.left_out)
    # The feet may be balls.
    text = quadruped_urdf()
    for foot in FEET:
        ball = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
        text = text.replace(f'<link name="{foot}"/>', f'<link name="{foot}">{ball}</link>')
    path = tmp_path / "balls.urdf"
    path.write_text(text)
    on_balls = [one.split(":") for one in assumed_contacts(load_model(path), log)]
    assert [foot for foot, _ in on_balls] == list(FEET)
    # The log is that of feet without any size.
    assert max(float(radius) for _, radius in on_balls) < 1e-3
    # A frame named like a foot does not hide the ball that it is on, but one far from it does.
    for depth, ends in ((0.26, {"LF_KFE_link_end": 0.02}), (0.2, {"LF_foot": 0.0})):
        shape = f'<collision><origin xyz="0 0 -{depth}"/><geometry><sphere radius="0.02"/>'
        shape = f'<link name="LF_KFE_link">{shape}</geometry></collision>'
        path.write_text(quadruped_urdf().replace('<link name="LF_KFE_link">', shape))
        found = {one.name: one.radius for one in chain_ends(load_model(path))}
        assert found.items() >= ends.items()
    # Nothing is assumed of wrenches that are measured, and of efforts that are not.
    assert assumed_contacts(robot, log_of(robot, readings, feet=FEET[:1])) == ()
    silent = np.full_like(readings["/joint_states"]["effort"], np.nan)
    assert assumed_contacts(robot, log_of(robot, readings, effort=silent)) == ()
    # Flags name contacts, and a biped stands on surfaces.
    touches = {foot: np.ones(len(silent), bool) for foot in FEET[:0:-1]}
    assert assumed_contacts(robot, log_of(robot, readings, touches=touches)) == POINTS[:0:-1]
    biped = load_model(config_file("symbitron.xml"))
    log = load_bag(simulated("smooth", moves=1, motion_seed=21, noise_seed=5), biped)

    def without_wrenches(span, warn):
        for piece in log.slices(span, warn=warn):
            yield replace(piece, streams=replace(piece.streams, wrenches=()))

    alone = Log("biped", _read=without_wrenches)
    assert set(assumed_contacts(biped, alone)) == {"left_sole", "right_sole"}


# The identifier node leaves biases of the IMU out unless they are named.
EXACT = {"sensor_errors": ("none",), "window": 0.321, "joint_terms": ("none",)}


def test_live_messages_give_the_same(robot, true_robot, readings, tmp_path):
    feet = {f"/{foot}/wrench" for foot in FEET}
    short = {topic: values for topic, values in readings.items() if topic not in feet}
    bag = record_log(short, robot, tmp_path / "bag")
    options = IdentifyOptions(contact=POINTS, no_holdout=True, **EXACT)
    offline = load_problem(robot, load_bag(bag, robot), options).solve().estimate
    feed = feed_of(bag)
    start = InitialState.of(robot, replace(options, sensor_errors=()))
    live = OnlineIdentification(start, feed.selected, Pace(share=1.0))
    try:
        feed.into(live, solving=6.0)
        found = live.solve(exactly=True).found.estimate
    finally:
        live.close()
    np.testing.assert_allclose(found.value, offline.value, atol=1e-3 * offline.std.max())
    assert found.value[:130:10].sum() == pytest.approx(true_robot.phi[:, 0].sum(), rel=0.02)


def test_live_messages_show_where_the_robot_stands(robot, readings, tmp_path):
    feet = {f"/{foot}/wrench" for foot in FEET}
    short = {topic: values for topic, values in readings.items() if topic not in feet}
    feed = feed_of(record_log(short, robot, tmp_path / "bag"))
    start = InitialState.of(robot, IdentifyOptions(no_holdout=True, joint_terms=("none",)))
    live = OnlineIdentification(start, feed.selected, Pace(share=1.0))
    try:
        assert live.setup_fault
        assert not live.standing_on
        feed.into(live)
        live.advance()
        assert live.standing_on == POINTS
        # No message is lost, so that another identification can take them all.
        for topic in feed.selected.all:
            fed = [payload for _, one, payload in feed.messages if one == topic]
            assert [payload for one, payload in live.streams.messages() if one == topic] == fed
    finally:
        live.close()


@pytest.fixture(scope="module")
def steps(true_robot):
    """It lifts one foot after the other; its drives do not rub."""
    return standing_log(true_robot, 16.0, 3, friction=0.0, steps=True)


def with_flags(robot, steps, *, flags=True):
    touches = {foot: steps[f"/{foot}/contact"]["touches"] for foot in FEET}
    return log_of(robot, steps, touches=touches if flags else None)


def test_flags_of_contacts_keep_the_rows_of_legs_that_swing(robot, true_robot, steps):
    options = {"contact": POINTS, "window": 0.161, "joint_terms": ("none",), "no_holdout": True}
    found = {
        flags: identify(robot, with_flags(robot, steps, flags=flags), **options)
        for flags in (False, True)
    }
    gained = {flags: one.estimate.verdict.gain for flags, one in found.items()}
    assert gained[True] > gained[False] + 20
    known = {flags: np.sum(one.estimate.determined) for flags, one in found.items()}
    assert known[True] > known[False] + 5
    errors = {}
    for flags, one in found.items():
        assert one.robot.phi[:, 0].sum() == pytest.approx(true_robot.phi[:, 0].sum(), rel=0.01)
        legs = slice(1, None)
        shift = one.robot.phi[legs, 1:4] - true_robot.phi[legs, 1:4]
        errors[flags] = np.sqrt(np.mean(shift**2))
    assert errors[True] < errors[False]


@pytest.mark.parametrize("flags", [False, True])
def test_intervals_hold_for_efforts_without_what_contacts_balance(
    robot, true_robot, steps, tmp_path, flags
):
    options = {"contact": POINTS, "window": 0.161, "joint_terms": "none", "no_holdout": True}
    other = standing_log(true_robot, 16.0, 9, friction=0.0, steps=True)
    training, held_out = (
        one | {"/imu": one["/imu"] | {"linear_acceleration": felt + BIAS}}
        for one in (steps, other)
        for felt in [one["/imu"]["linear_acceleration"]]
    )
    found = identify(robot, with_flags(robot, training, flags=flags), **options)
    found.save(tmp_path)
    for result in (found, tmp_path):
        again = validate(result, with_flags(robot, held_out, flags=flags))
        assert again.coverage == pytest.approx(0.9, abs=0.04)
        assert again.normalized_square == pytest.approx(1.0, abs=0.25)
        by_joint = {one.name: one.coverage for one in again.coordinates}
        assert set(by_joint) == set(robot.coordinates)
        assert min(by_joint.values()) > 0.75
        assert again.is_covered


BIAS = np.array([0.06, -0.08, 0.04])


@pytest.mark.parametrize("flags", [True, False])
def test_biases_of_the_imu_are_identified_unless_others_are_named(
    robot, true_robot, steps, flags, tmp_path
):
    """Those of MEMS sensors would shift centres of mass by many standard deviations."""
    exact = steps["/imu"]["linear_acceleration"]
    spoilt = steps | {"/imu": steps["/imu"] | {"linear_acceleration": exact + BIAS}}
    log = with_flags(robot, spoilt, flags=flags)
    options = {"contact": POINTS, "joint_terms": ("none",)}
    found, rigid = (
        identify(robot, log, **options, sensor_errors=errors) for errors in ((), ("none",))
    )
    assert not found.alarms
    of_imu = {one.name.rpartition("_bias_")[2]: one for one in found.estimate.verdict.sensors}
    for axis, bias in zip("xyz", BIAS, strict=True):
        one = of_imu[f"accelerometer_{axis}"]
        assert abs(one.value - bias) < 4 * one.std
    assert of_imu["accelerometer_x"].std < 0.2 * BIAS[0]
    truth, scores = true_robot.inertial_parameters, {}
    for name, one in (("found", found), ("rigid", rigid)):
        known = one.estimate.determined[: len(truth)]
        errors = (one.estimate.value - truth) / one.estimate.std
        scores[name] = float(np.sqrt(np.mean(errors[known] ** 2)))
    assert scores["found"] < 1.6
    assert scores["found"] < scores["rigid"] / (1.5 if flags else 1.0)
    # Another log has other biases, so information of both contains none.
    found.save(tmp_path)
    saved = load_archive(tmp_path / "information.npz")
    assert saved[0].layout.parameters == ParameterSet(robot).names
    alone = load_information(robot, saved, IdentifyOptions(**options)).solve()
    assert not alone.estimate.verdict.sensors


def test_an_alarm_names_the_sensor_error_and_its_option_corrects_it(robot, steps):
    """A rotated IMU looks like other forces, beside the biases that are identified anyway."""
    turn = Rotation.from_euler("z", 6, degrees=True)
    channels = ("angular_velocity", "linear_acceleration")
    turned = {name: turn.apply(steps["/imu"][name]) for name in channels}
    log = with_flags(robot, steps | {"/imu": steps["/imu"] | turned})
    options = {"contact": POINTS, "joint_terms": ("none",), "unchecked": True}
    found = identify(robot, log, **options)
    assert any("give `sensor_errors` imu_mounting" in one for one in found.alarms)
    mended = identify(robot, log, **options, sensor_errors=("imu_mounting",))
    assert not any("white noise" in one for one in mended.alarms)
    errors = {one.name: one for one in mended.estimate.verdict.sensors}
    angle = errors["imu_link/imu_mounting_z"]
    assert np.degrees(angle.value) == pytest.approx(-6, abs=0.3)
    assert "imu_link/imu_bias_accelerometer_x" in errors
    before, after = (one.estimate.holdout.percent_after for one in (found, mended))
    assert after < 0.5 * before


def test_the_data_choose_the_friction_of_legs_that_swing(robot, true_robot):
    rubbing = standing_log(true_robot, 24.0, 4, friction=0.1, steps=True)
    found = identify(
        robot, with_flags(robot, rubbing), contact=POINTS, window=0.161, no_holdout=True
    )
    terms = found.estimate.joint_terms
    assert sum("viscous" in one for one in terms.values()) >= 10
    assert sum("coulomb" in one for one in terms.values()) >= 10
    assert not any("load" in one for one in terms.values())
    named = {name: one for name, one in found.parameters.items() if name.endswith("viscous")}
    assert sum(one.is_determined for one in named.values()) >= 10


def test_the_friction_of_legs_that_stand_may_be_chosen(robot, true_robot):
    """Rows combine all twelve joints. They were not used to choose Coulomb friction."""
    rubbing = standing_log(true_robot, 8.0, 4, friction=0.3)
    parameters = ParameterSet(with_contacts(robot, POINTS), ("viscous", "coulomb"), candidates=True)
    segments = AlignedLog(log_of(robot, rubbing), parameters.model)
    observations = fold_dataset(segments, "log", parameters, Processing(windows=(0.081,)))
    assert _any_slips(observations.observations, parameters)
    # Each of them has enough rows, which are not those of its own coordinate.
    assert not resting_joints(observations.observations[0].slipping, parameters).any()
    second = [joined_segments(segments)[0].cut(0, int(RATE))]
    brief = fold_dataset(second, "log", parameters, Processing(windows=(0.081,)))
    assert resting_joints(brief.observations[0].slipping, parameters).all()


def test_windows_that_leave_a_leg_hardly_any_row_are_not_chosen(robot, true_robot):
    """Each leg swings a fifth of the time: 5 windows of 321 ms, which its friction fits exactly."""
    rubbing = standing_log(true_robot, 16.0, 5, friction=0.1, steps=True)
    found = identify(robot, with_flags(robot, rubbing), contact=POINTS)
    assert found.estimate.rows.window < 0.2
    assert found.estimate.holdout.percent_after < 1.0


def test_flags_in_a_bag_and_live_are_those_of_arrays(robot, steps, tmp_path):
    feet = {f"/{foot}/wrench" for foot in FEET}
    short = {topic: values for topic, values in steps.items() if topic not in feet}
    bag = record_log(short, robot, tmp_path / "bag")
    flags = tuple(f"{foot}/contact:={foot}" for foot in FEET)
    log = load_bag(bag, robot, contact_flag=flags)
    model = with_contacts(robot, POINTS)
    options = IdentifyOptions(contact=POINTS, no_holdout=True, **EXACT)
    recorded = joined_segments(AlignedLog(log, model))
    expected = joined_segments(AlignedLog(with_flags(robot, steps), model))
    np.testing.assert_array_equal(recorded[0].touching, expected[0].touching)
    assert 0.5 < recorded[0].touching.mean() < 0.95
    offline = load_problem(robot, log, options).solve().estimate
    feed = feed_of(bag, TopicSelection.of(LogOptions(contact_flag=flags)))
    start = InitialState.of(robot, replace(options, sensor_errors=()))
    live = OnlineIdentification(start, feed.selected, Pace(share=1.0))
    try:
        feed.into(live, solving=6.0)
        found = live.solve(exactly=True).found.estimate
    finally:
        live.close()
    np.testing.assert_allclose(found.value, offline.value, atol=1e-3 * offline.std.max())


def test_flags_of_a_contact_that_is_not_named_are_refused(robot, steps):
    with pytest.raises(DataError, match=r"for RH_foot, .*add RH_foot to `contact`") as caught:
        identify(robot, with_flags(robot, steps), contact=POINTS[:3], unchecked=True)
    assert caught.value.code == "E366"


def test_flags_that_let_a_standing_robot_fly_are_refused(robot, readings):
    flags = np.zeros(len(readings["/joint_states"]["time"]), bool)
    log = log_of(robot, readings, touches=dict.fromkeys(FEET, flags))
    with pytest.raises(DataError, match="no contact touches anything, but the IMU") as caught:
        identify(robot, log, contact=POINTS, unchecked=True)
    assert caught.value.code == "E368"


@pytest.mark.parametrize("factor", [0.2, 1.5])
def test_a_common_factor_of_all_efforts_raises_an_alarm(robot, true_robot, readings, factor):
    """Right efforts raise none, see above, and residuals show no common factor."""
    wrong = log_of(robot, readings, effort=factor * readings["/joint_states"]["effort"])
    options = {"contact": POINTS, "window": 0.321, "no_holdout": True, "joint_terms": "none"}
    (alarm,) = identify(robot, wrong, **options).alarms
    assert "total mass went from" in alarm
    assert "a wrong scale in common" in alarm
    # A weighing shows it.
    mass = float(true_robot.phi[:, 0].sum())
    alarms = identify(robot, wrong, total_mass=mass, total_mass_std=0.05, **options).alarms
    assert any("the weighing of" in one for one in alarms)
    assert not any("total mass went from" in one for one in alarms)


def test_a_flag_that_is_stuck_is_named(robot, steps):
    options = {"contact": POINTS, "joint_terms": ("none",), "no_holdout": True}
    touches = {foot: steps[f"/{foot}/contact"]["touches"] for foot in FEET}
    stuck = touches | {FEET[1]: np.zeros_like(touches[FEET[1]])}
    found = identify(robot, log_of(robot, steps, touches=stuck), **options)
    assert found.estimate.verdict.is_coloured
    assert f"according to the flags, {FEET[1]} hardly touches anything" in found.alarms[-1]
    assert identify(robot, log_of(robot, steps, touches=touches), **options).alarms == ()


def test_readings_at_a_contact_that_is_named_are_left_out(robot, readings):
    model = with_contacts(robot, POINTS[:3])
    segment = next(iter(AlignedLog(log_of(robot, readings, feet=FEET), model)))
    assert segment.wrench_frames == FEET[3:]


def test_with_neither_efforts_nor_wrenches_the_mass_is_said_to_be_unknown(robot, readings):
    silent = np.full_like(readings["/joint_states"]["effort"], np.nan)
    with pytest.raises(DataError, match="not even the robot's mass"):
        identify(
            robot,
            log_of(robot, readings, effort=silent),
            contact=POINTS,
            unchecked=True,
            window=0.321,
        )


def test_wrenches_alone_identify_a_robot_whose_drives_measure_nothing(robot, true_robot, readings):
    silent = np.full_like(readings["/joint_states"]["effort"], np.nan)
    log = log_of(robot, readings, feet=FEET, effort=silent)
    found = identify(robot, log, no_holdout=True, unchecked=True, window=0.321)
    assert found.robot.phi[:, 0].sum() == pytest.approx(true_robot.phi[:, 0].sum(), rel=2e-3)
    (remark,) = found.estimate.remarks
    assert remark.endswith(
        "no usable effort, so their friction, armature and offset remain unknown"
    )
    assert not any(terms for terms in found.estimate.joint_terms.values())
    rubbing = replace(robot, joints=tuple(replace(joint, damping=0.06) for joint in robot.joints))
    stated = identify(rubbing, log, no_holdout=True, unchecked=True, window=0.321)
    assert not any(terms for terms in stated.estimate.joint_terms.values())
    assert [joint.damping for joint in stated.robot.joints] == pytest.approx(
        [0.06] * len(robot.joints)
    )
    named = identify(robot, log, friction=True, no_holdout=True, unchecked=True, window=0.321)
    assert named.estimate.remarks == found.estimate.remarks
    assert not any(one.is_determined for name, one in named.parameters.items() if "viscous" in name)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"contact": ("foot:heel",)}, "not a contact"),
        ({"contact": ("foot",), "joint_terms": ("load",)}, "name other terms"),
        ({"contact": ("foot",), "sensor_errors": ("link_length",)}, "leaves link_length unknown"),
        ({"contact": ("foot",), "drive_gain": ("all",)}, "`drive_gain` needs the wrenches"),
        ({"contact": ("foot",), "tare": ("bag",)}, "`tare` is of foot sensors"),
    ],
)
def test_options_that_contradict_contacts_are_refused(fields, message):
    with pytest.raises(OptionError, match=message):
        IdentifyOptions(**fields)
