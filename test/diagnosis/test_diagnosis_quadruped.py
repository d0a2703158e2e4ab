"""A robot on point feet whose drives rub: nothing is found, and each fault at its own sensor."""

import copy
import json
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from json_schemas import require_valid
from quadruped_log import FEET, quadruped_urdf, record_log, standing_log
from scipy.spatial.transform import Rotation

from symbid_ros.bags import bag_log, read_streams
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Diagnosis, Kind, Severity
from symbid_ros.diagnosis.like_limbs import joints_of_limbs, limbs_without_sensor
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stance_gyro_check import StanceGyroMoments, fit_gyro
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.alignment import align_checked

JOINTS, IMU, FIRST, SECOND = "/joint_states", "/imu", "/LF_foot/wrench", "/RF_foot/wrench"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return load_model(path)


@pytest.fixture(scope="module")
def log(model):
    """What the real robot says, whose inertias are not the model's."""
    return standing_log(real_robot(model), 8.0, 3)


def real_robot(model):
    parameters = ParameterSet(model)
    return model.with_phi(parameters.link_phi(draw_prior(parameters, "consistent", 20, 3).mean))


@pytest.fixture
def judged(log, model, tmp_path) -> Callable[..., Diagnosis]:
    def judge(spoil: Callable[[dict], None] = lambda log: None) -> Diagnosis:
        spoilt = copy.deepcopy(log)
        spoil(spoilt)
        diagnosis = diagnose(bag_log([record_log(spoilt, model, tmp_path / "bag")], model), model)
        require_valid("diagnosis", json.loads(json.dumps(diagnosis.as_dict())))
        return diagnosis

    return judge


def found(diagnosis: Diagnosis) -> list[tuple[Kind, str]]:
    return [(one.kind, one.stream) for one in diagnosis.findings]


@pytest.mark.parametrize(("factor", "is_found"), [(0.6, True), (0.85, False), (1.5, True)])
def test_forces_that_all_carry_another_mass_are_named(judged, model, factor, is_found) -> None:
    def spoil(spoilt: dict) -> None:
        spoilt[JOINTS]["effort"] *= factor
        for foot in FEET:
            spoilt[f"/{foot}/wrench"]["wrench"] *= factor

    diagnosis = judged(spoil)
    real, stated = (float(one.phi[:, 0].sum()) for one in (real_robot(model), model))
    carried = factor * real / stated
    assert diagnosis.figures["mass_ratio"] == pytest.approx(carried, rel=0.01)
    assert found(diagnosis) == [(Kind.WEIGHT, "")] * is_found


def test_nothing_is_found_though_drives_rub(judged) -> None:
    diagnosis = judged()
    assert [one.message for one in diagnosis.findings] == []
    assert diagnosis.left_out == ()
    assert diagnosis.figures["/imu/angle_deg"] < 1


@pytest.mark.parametrize("what", ["effort", "wrench"])
def test_the_noise_of_rows_follows_from_that_of_the_sensors(log, model, tmp_path, what) -> None:
    """Of two logs that differ in white noise, the averaged rows differ as much."""

    def statistics(noise: float) -> ModelStatistics:
        noisy = copy.deepcopy(log)
        rng = np.random.default_rng(4)
        for topic in [JOINTS] if what == "effort" else [f"/{foot}/wrench" for foot in FEET]:
            reading = noisy[topic][what]
            channels = reading[:, :3] if what == "wrench" else reading
            channels += noise * rng.standard_normal(channels.shape)
        bag = record_log(noisy, model, tmp_path / f"bag{noise:g}")
        found = None
        for segment in align_checked(read_streams([bag]), model):
            if found is None:
                found = ModelStatistics(model, segment.wrench_frames, segment.imu_frames)
            found.add(segment)
        assert found is not None
        return found

    (few, before), (many, after) = (
        (
            one.rows.residual_squares(one.problem.expected)[6:],
            one.problem.load_noise.sum(axis=0) + one.problem.noise[6:],
        )
        for one in (statistics(0.0), statistics(200.0))
    )
    np.testing.assert_allclose(after - before, many - few, rtol=0.5)
    assert np.sum(after - before) == pytest.approx(np.sum(many - few), rel=0.1)


@pytest.fixture(scope="module")
def smooth_log(model):
    """What a robot says whose drives hardly rub and whose inertias are not the model's."""
    parameters = ParameterSet(model)
    real = parameters.link_phi(draw_prior(parameters, "consistent", 20, 3).mean)
    return standing_log(model.with_phi(real), 20.0, 3, friction=0.01)


@pytest.mark.parametrize("noise", [5.0, 50.0, 100.0])
def test_noise_of_efforts_accuses_no_sensor(smooth_log, model, tmp_path, noise) -> None:
    """Gains near zero would remove the noise, and offsets or forces would explain the rest."""
    noisy = copy.deepcopy(smooth_log)
    effort = noisy[JOINTS]["effort"]
    effort += noise * np.random.default_rng(3).standard_normal(effort.shape)
    log = bag_log([record_log(noisy, model, tmp_path / "bag")], model)
    assert {one.kind for one in diagnose(log, model).findings} <= {Kind.EFFORT_NOISE}


def test_nothing_is_found_at_a_low_rate(judged) -> None:
    def spoil(log) -> None:
        for columns in log.values():
            for name in columns:
                columns[name] = columns[name][::2]

    assert [one.message for one in judged(spoil).findings] == []


def test_a_gyroscopes_constant_bias_is_no_fault_of_its_mounting(log, model, tmp_path) -> None:
    """The bias is twice the size of the motion; the standing feet tell only what changes."""
    biased = copy.deepcopy(log)
    size = np.sqrt(np.mean(np.sum(biased[IMU]["angular_velocity"] ** 2, axis=1)))
    biased[IMU]["angular_velocity"] += 2 * size * np.array([0.6, -0.8, 0.0])
    streams = read_streams([record_log(biased, model, tmp_path / "bag")])
    standing = StanceGyroMoments(model, 0)
    twice = StanceGyroMoments(model, 0)
    for segment in align_checked(streams, model):
        standing.add(segment)
        twice.add(segment)
        twice.add(segment)
    assert twice.count == 2 * standing.count
    assert twice.slope_square == pytest.approx(2 * standing.slope_square, rel=1e-12)
    found = fit_gyro(standing)
    assert found is not None
    assert np.degrees(found.angle) < 1
    assert abs(found.delay) < 1e-3
    assert found.left < 0.1
    assert found.scale == pytest.approx(1, abs=0.05)
    # Motion a hundred thousand times calmer says the same: nothing depends on the unit of rates.
    standing.cross *= 1e-10
    standing.read *= 1e-10
    standing.expected *= 1e-10
    standing.slope_square *= 1e-10
    calm = fit_gyro(standing)
    assert calm is not None
    assert calm.delay == pytest.approx(found.delay, abs=1e-9)
    assert (calm.angle, calm.left) == pytest.approx((found.angle, found.left), rel=1e-6)
    assert calm.rate == pytest.approx(1e-5 * found.rate)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 10), ("z", 90), ("x", 180)])
def test_a_turned_imu(judged, axis, degrees) -> None:
    turn = Rotation.from_euler(axis, degrees, degrees=True)

    def spoil(log) -> None:
        imu = log[IMU]
        imu["orientation"] = (Rotation.from_quat(imu["orientation"]) * turn).as_quat()
        for name in ("angular_velocity", "linear_acceleration"):
            imu[name] = turn.apply(imu[name], inverse=True)

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.IMU_MOUNTING, IMU)]
    assert diagnosis.findings[0].figures["angle_deg"] == pytest.approx(degrees, abs=1)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 3), ("y", -4), ("z", 5)])
def test_an_imu_a_few_degrees_off_is_a_warning_with_its_angles(judged, axis, degrees) -> None:
    turn = Rotation.from_euler(axis, degrees, degrees=True)

    def spoil(log) -> None:
        imu = log[IMU]
        imu["orientation"] = (Rotation.from_quat(imu["orientation"]) * turn).as_quat()
        for name in ("angular_velocity", "linear_acceleration"):
            imu[name] = turn.apply(imu[name], inverse=True)

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.IMU_MOUNTING, IMU)]
    (finding,) = diagnosis.findings
    assert finding.severity is Severity.WARNING
    angles = {"x": "roll", "y": "pitch", "z": "yaw"}
    for other, name in angles.items():
        expected = degrees if other == axis else 0.0
        assert finding.figures[f"{name}_deg"] == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize("gain", [0.9, 1.1])
@pytest.mark.parametrize("oriented", [True, False])
def test_a_gyroscopes_gain_is_named_once(judged, gain, oriented) -> None:
    def spoil(log) -> None:
        log[IMU]["angular_velocity"] *= gain
        if not oriented:  # as if at rest, which tells nothing of rates
            log[IMU]["orientation"] = np.tile([0.0, 0, 0, 1], (len(log[IMU]["time"]), 1))

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.GYROSCOPE_GAIN, IMU)]
    assert diagnosis.findings[0].figures["gain"] == pytest.approx(gain, abs=0.01)


def test_an_accelerometer_that_is_turned_while_the_gyroscope_is_not(judged) -> None:
    turn = Rotation.from_euler("y", 60, degrees=True)

    def spoil(log) -> None:
        force = log[IMU]["linear_acceleration"]
        log[IMU]["linear_acceleration"] = turn.apply(force, inverse=True)

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.IMU_MOUNTING, IMU)]
    assert diagnosis.figures["/imu/angle_deg"] < 1
    assert diagnosis.figures["/imu/force_angle_deg"] == pytest.approx(60, rel=0.2)


@pytest.mark.parametrize("milliseconds", [5, -20, 90])
def test_a_late_imu(judged, milliseconds) -> None:
    def spoil(log) -> None:
        log[IMU]["time"] = log[IMU]["time"] + 1e-3 * milliseconds

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.DELAY, IMU)]
    assert diagnosis.findings[0].figures["delay_ms"] == pytest.approx(milliseconds, abs=1)


def test_late_joint_states(judged) -> None:
    def spoil(log) -> None:
        log[JOINTS]["time"] = log[JOINTS]["time"] + 0.02

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.DELAY, JOINTS)]
    assert diagnosis.findings[0].figures["delay_ms"] == pytest.approx(20, rel=0.2)


def test_late_efforts(judged) -> None:
    def spoil(log) -> None:
        effort = log[JOINTS]["effort"]
        log[JOINTS]["effort"] = np.concatenate([np.repeat(effort[:1], 5, axis=0), effort[:-5]])

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.DELAY, JOINTS)]
    assert "efforts" in diagnosis.findings[0].message
    assert diagnosis.findings[0].figures["delay_ms"] == pytest.approx(20, rel=0.2)


@pytest.mark.parametrize("factor", [1000.0, 0.05])
def test_efforts_in_another_unit(judged, factor) -> None:
    def spoil(log) -> None:
        log[JOINTS]["effort"] *= factor

    (finding,) = judged(spoil).findings
    assert (finding.kind, finding.stream) == (Kind.TORQUE_GAIN, JOINTS)
    assert "all joints" in finding.message
    assert finding.figures["reads"] == pytest.approx(factor, rel=0.4)


def test_efforts_that_are_not_filled(judged) -> None:
    def spoil(log) -> None:
        log[JOINTS]["effort"] *= 0

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.MISSING_JOINT, JOINTS)]
    assert diagnosis.severity is Severity.WARNING  # the base's own rows are left


def test_a_gyroscope_in_degrees_without_an_orientation(judged) -> None:
    def spoil(log) -> None:
        log[IMU]["orientation"] = np.tile([0.0, 0, 0, 1], (len(log[IMU]["time"]), 1))
        log[IMU]["angular_velocity"] *= 180 / np.pi

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.UNIT, IMU)]
    assert diagnosis.findings[0].figures["rate_ratio"] == pytest.approx(57.3, rel=0.1)


def test_positions_in_degrees(judged) -> None:
    def spoil(log) -> None:
        for name in ("position", "velocity"):
            log[JOINTS][name] *= 180 / np.pi

    assert found(judged(spoil)) == [(Kind.UNIT, JOINTS)]


@pytest.mark.parametrize("topics", [(FIRST, SECOND), (FIRST, "/RH_foot/wrench")])
def test_exchanged_feet(judged, topics) -> None:
    def spoil(log) -> None:
        one, other = topics
        log[one]["wrench"], log[other]["wrench"] = log[other]["wrench"], log[one]["wrench"]

    diagnosis = judged(spoil)
    assert diagnosis.severity is Severity.UNUSABLE, [one.message for one in diagnosis.findings]
    assert found(diagnosis) == [(Kind.CONTRADICTION, "")]
    assert "white noise" not in diagnosis.findings[0].message


def test_noise_of_wrenches_is_named_where_it_may_be_the_cause(judged) -> None:
    def spoil(log) -> None:
        log[FIRST]["wrench"], log[SECOND]["wrench"] = log[SECOND]["wrench"], log[FIRST]["wrench"]
        noise = np.random.default_rng(0).normal(0.0, 5.0, log[FIRST]["wrench"].shape)
        log[FIRST]["wrench"] = log[FIRST]["wrench"] + noise

    diagnosis = judged(spoil)
    assert found(diagnosis) == [(Kind.CONTRADICTION, "")]
    noise = re.search(
        r"white noise of the wrenches, (.*) Nm and (.*) N, is", diagnosis.findings[0].message
    )
    assert [float(one) for one in noise.groups()] == pytest.approx([5.0, 5.0], rel=0.1)


def test_a_foot_without_its_sensor(judged) -> None:
    """It comes first, since what follows would be blamed on other sensors."""
    first, other = judged(lambda log: log.pop(FIRST)).findings
    assert first.kind is Kind.MISSING_WRENCH
    assert f"no wrench at {FIRST.split('/')[1]}," in first.message
    assert other.kind in (Kind.CONTRADICTION, Kind.WEIGHT)
    assert first.severity is other.severity


def test_two_feet_without_their_sensors_are_no_wrong_signs(judged) -> None:
    def spoil(log) -> None:
        log.pop(FIRST)
        log.pop(SECOND)

    first, *_ = judged(spoil).findings
    assert first.kind is Kind.MISSING_WRENCH
    assert all(topic.split("/")[1] in first.message for topic in (FIRST, SECOND))


def test_limbs_with_the_same_joints_are_alike(model) -> None:
    assert limbs_without_sensor(model, FEET[:2]) == tuple(
        foot for foot in (frame.name for frame in model.frames) if foot in FEET[2:]
    )
    assert limbs_without_sensor(model, FEET) == ()
    legs = {name.split("_")[0] for name in joints_of_limbs(model, FEET[2:])}
    assert legs == {foot.split("_")[0] for foot in FEET[2:]}
    assert joints_of_limbs(model, ()) == ()
    assert limbs_without_sensor(model, FEET[:1]) == ()  # a single sensor may be the only one
    assert limbs_without_sensor(replace(model, floating=False), FEET[:2]) == ()


@pytest.mark.parametrize("topic", [f"/{foot}/wrench" for foot in FEET[::3]])
def test_a_wrench_with_its_sign_reversed(judged, topic) -> None:
    def spoil(log) -> None:
        log[topic]["wrench"] *= -1

    assert found(judged(spoil)) == [(Kind.WRENCH_SIGN, topic)]


@pytest.mark.parametrize("count", [3, 4])
def test_wrenches_with_the_same_fault_are_named_one_by_one(judged, count) -> None:
    """A convention may be wrong for all feet: that is no contradiction."""
    topics = sorted(f"/{foot}/wrench" for foot in FEET)[:count]

    def spoil(log) -> None:
        for topic in topics:
            log[topic]["wrench"] *= -1

    assert sorted(found(judged(spoil))) == [(Kind.WRENCH_SIGN, topic) for topic in topics]


@pytest.mark.parametrize("seed", [3, 4])
def test_a_reversed_accelerometer_is_not_blamed_on_forces_and_efforts(
    model, tmp_path, seed
) -> None:
    parameters = ParameterSet(model)
    real = parameters.link_phi(draw_prior(parameters, "consistent", 25, seed).mean)
    spoilt = standing_log(model.with_phi(real), 8.0, seed)
    spoilt[IMU]["linear_acceleration"] *= -1
    diagnosis = diagnose(bag_log([record_log(spoilt, model, tmp_path / "bag")], model), model)
    assert found(diagnosis) == [(Kind.IMU_MOUNTING, IMU)]
    assert "wrong sign" in diagnosis.findings[0].message
