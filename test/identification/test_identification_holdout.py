"""An identification is checked on the end of its log, then repeated with all of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from random_logs import LogPlan, random_streams, small_robot

import symbid_ros as sy
from symbid_ros.errors import DataError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.identification.predictions.holdout import repeated_share
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.data_summary import verdict_entries
from symbid_ros.signals.segments import Segment, split

RATE = 250.0
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> sy.RobotModel:
    file = tmp_path_factory.mktemp("robot") / "robot.xml"
    file.write_text(mjcf_text(small_robot(5, floating=False, links=4)))
    return sy.load_model(file)


@pytest.fixture(scope="module")
def wrong(robot) -> sy.RobotModel:
    drawn = draw_prior(ParameterSet(robot), "consistent", 25, 1)
    return replace(ParameterSet(robot).apply(drawn.mean), source=robot.source)


def streams(robot, *, count=4000, seed=3):
    return random_streams(robot, LogPlan(RATE, count), seed)


def identified(robot, log, **options) -> sy.Result:
    terms = {} if {"friction", "joint_terms"} & set(options) else {"joint_terms": "none"}
    return sy.identify(robot, log, unchecked=True, **terms, **options)


@pytest.fixture(scope="module")
def result(robot, wrong) -> sy.Result:
    return identified(wrong, sy.Log.from_streams(streams(robot)))


def test_a_log_of_one_posture_raises_an_alarm(robot, result):
    """Its end is the same posture, so that it cannot show that the model errs in others."""
    rng = np.random.default_rng(0)
    size = (4000, len(robot.joints))
    posture, load = rng.normal(size=(2, size[1]))
    log = sy.Log.from_arrays(
        robot,
        time=np.arange(size[0]) / RATE,
        position=posture + 2e-5 * rng.normal(size=size),
        effort=load + 0.03 * rng.normal(size=size),
    )
    for options in ({}, {"no_holdout": True}):
        resting = identified(robot, log, **options)
        assert any(Alarm.AT_REST in one for one in resting.alarms)
    assert not any(Alarm.AT_REST in one for one in result.alarms)


def segment(position, start=0) -> Segment:
    position = np.asarray(position, dtype=float)
    count = len(position)
    return Segment(
        stamp=start + np.arange(count) * round(SECOND / RATE),
        rate=RATE,
        position=position,
        effort=np.zeros_like(position),
        angular_velocity=np.zeros((count, 0, 3)),
        linear_acceleration=np.zeros((count, 0, 3)),
        wrenches=np.zeros((count, 0, 6)),
        imu_frames=(),
        wrench_frames=(),
    )


def length(parts) -> float:
    return sum(len(one) for one in parts) / RATE


def test_the_last_quarter_is_held_out_with_a_gap_before_it() -> None:
    whole = [segment(np.zeros((4001, 1)), start=7 * SECOND)]
    training, held_out = split(whole, 0.5, "log")
    assert length(training) == pytest.approx(12, abs=0.01)
    assert length(held_out) == pytest.approx(3.5, abs=0.01)
    (before,), (after,) = training, held_out
    assert after.stamp[0] - before.stamp[-1] == pytest.approx(0.5 * SECOND, abs=0.01 * SECOND)
    assert after.stamp[-1] == whole[0].stamp[-1]
    assert length(training) == pytest.approx(12, abs=0.01)  # iterates anew


def test_gaps_do_not_count_as_time() -> None:
    whole = [
        segment(np.zeros((1001, 1))),
        segment(np.zeros((2001, 1)), start=100 * SECOND),
        segment(np.zeros((1001, 1)), start=300 * SECOND),
    ]
    training, held_out = split(whole, 0.25, "log")
    assert length(training) == pytest.approx(12, abs=0.02)
    # The gap lies before the segment that is held out.
    assert length(held_out) == pytest.approx(4, abs=0.3)
    assert next(iter(held_out)).stamp[0] >= 300 * SECOND


def test_a_log_shorter_than_the_gap_is_refused() -> None:
    with pytest.raises(DataError, match="too short to hold out") as refusal:
        split([segment(np.zeros((100, 1)))], 0.4, "log")
    assert refusal.value.code == "E529"


def waves(time, frequencies, phase):
    return np.sin(2 * np.pi * np.outer(time, frequencies) + phase)


def test_a_motion_repeats_if_postures_and_speeds_occurred_before() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(0, 40, 1 / RATE)
    frequencies, phase = np.array([0.3, 0.5, 0.7]), rng.uniform(0, 6, 3)
    periodic = waves(time, frequencies, phase) + 1e-4 * rng.normal(size=(len(time), 3))
    before, after = segment(periodic[:7500]), segment(periodic[7500:])
    assert repeated_share([before], [after]) > 0.95
    # The same postures at other speeds are another motion.
    faster = segment(waves(2.2 * time[:2000], frequencies, phase))
    assert repeated_share([before], [faster]) < 0.3
    fresh = segment(waves(time[:2000], [0.41, 0.67, 0.29], rng.uniform(0, 6, 3)))
    assert repeated_share([before], [fresh]) < 0.3


def test_joints_at_rest_do_not_make_a_motion_new() -> None:
    time = np.arange(0, 40, 1 / RATE)
    rng = np.random.default_rng(2)
    moving = waves(time, [0.5], 0.0)
    noise = 1e-4 * rng.normal(size=(len(time), 1))
    both = np.hstack([moving, noise])
    assert repeated_share([segment(both[:7500])], [segment(both[7500:])]) > 0.95
    assert repeated_share([segment(noise)], [segment(noise)]) == 1.0
    assert repeated_share([segment(both[:10])], [segment(both)]) == 0.0


def test_the_stated_prior_is_kept_where_that_predicts_better(robot) -> None:
    """Torques that the model lacks, in the earlier part alone, widen the prior without bound."""
    log = random_streams(robot, LogPlan(RATE, 4000), 4)
    position, effort = log.joints.position, log.joints.effort.copy()
    angle = 4 * position + np.roll(2 * position, 1, axis=1) + np.arange(position.shape[1])
    effort[:3000] += 3.0 * effort.std(axis=0) * np.sin(angle[:3000])
    log = sy.Log.from_streams(replace(log, joints=replace(log.joints, effort=effort)))
    found = identified(robot, log)
    assert found.estimate.provenance.options["keep_prior"]
    (remark,) = [one for one in found.estimate.remarks if "keep_prior" in one]
    kept = identified(robot, log, keep_prior=True).estimate
    assert found.estimate.holdout == kept.holdout
    np.testing.assert_array_equal(found.estimate.value, kept.value)
    assert f"→ {kept.holdout.percent_after:.3g} %" not in remark  # that of the wider prior
    # Without the check, the data decide.
    unchecked = identified(robot, log, no_holdout=True).estimate
    assert unchecked.verdict.is_prior_scaled
    assert not kept.verdict.is_prior_scaled


def test_a_log_that_does_not_predict_its_own_end_raises_an_alarm(robot, wrong, result) -> None:
    assert not any(Alarm.UNPREDICTED_END in one for one in result.alarms)
    log = streams(robot)
    effort = log.joints.effort.copy()
    effort[3000:] *= -1
    log = sy.Log.from_streams(replace(log, joints=replace(log.joints, effort=effort)))
    found = identified(wrong, log, keep_prior=True)
    assert found.estimate.holdout.advice == "unfit"
    assert found.alarms[-1].startswith(
        "the first part of the log does not predict the last quarter: "
    )


def test_the_check_equals_a_validation_of_the_earlier_part(robot, wrong, result) -> None:
    """It is done as by hand: identify three quarters, validate on the rest."""
    holdout = result.estimate.holdout
    assert holdout.advice == "better"
    assert holdout.seconds == pytest.approx(4 - 0.321, abs=0.02)
    log = streams(robot)
    end = float(log.joints.stamp[-1]) * 1e-9
    arrays = {
        "time": log.joints.stamp,
        "position": log.joints.position,
        "effort": log.joints.effort,
    }
    window = result.estimate.rows.window
    first = identified(
        wrong,
        sy.Log.from_arrays(wrong, stop=0.75 * end, **arrays),
        no_holdout=True,
        window=window,
    )
    last = sy.Log.from_arrays(wrong, start=0.75 * end + 0.321, **arrays)
    expected = sy.validate(first, last)
    assert holdout.percent_before == pytest.approx(expected.percent_before, rel=0.02)
    assert holdout.percent_after == pytest.approx(expected.percent_after, rel=0.1)
    assert first.estimate.holdout is None


def test_the_result_uses_the_whole_log(robot, wrong, result) -> None:
    log = sy.Log.from_streams(streams(robot))
    plain = identified(wrong, log, no_holdout=True)
    np.testing.assert_array_equal(result.estimate.value, plain.estimate.value)
    assert plain.estimate.holdout is None
    assert result.information.seconds == plain.information.seconds


@pytest.mark.parametrize(
    "options",
    [
        {"filter": "butterworth", "cutoff": 30.0},
        {"method": "wls_rc"},
        {"sensor_errors": "torque_gain"},
        {"joint_terms": "auto"},
        {"friction": True, "total_mass": 1.0, "total_mass_std": 100.0},
    ],
    ids=str,
)
def test_every_kind_of_identification_is_checked(robot, wrong, options) -> None:
    log = sy.Log.from_streams(streams(robot))
    holdout = identified(wrong, log, **options).estimate.holdout
    assert holdout.advice == "better"
    assert holdout.percent_after < 0.5 * holdout.percent_before


def test_a_load_that_changes_at_the_end_is_noticed(robot) -> None:
    """The original model is right; the payload of the earlier part is gone at the end."""
    phi = robot.phi.copy()
    phi[-1] *= 3
    loaded, unloaded = streams(robot.with_phi(phi)), streams(robot)
    effort = np.where(
        (np.arange(4000) < 3000)[:, None], loaded.joints.effort, unloaded.joints.effort
    )
    log = replace(unloaded, joints=replace(unloaded.joints, effort=effort))
    result = identified(robot, sy.Log.from_streams(log))
    holdout = result.estimate.holdout
    assert holdout.advice == "worse"
    assert "worse than the original model" in holdout.summary
    (entry,) = (one for one in verdict_entries(result.estimate) if one.name == "Held out")
    assert entry.is_alarm


def test_a_repeated_motion_is_named(robot, wrong) -> None:
    time = np.arange(4000) / RATE
    position = waves(time, np.full(len(robot.joints), 0.5), np.arange(len(robot.joints)))
    velocity = np.gradient(position, 1 / RATE, axis=0)
    effort = sy.regressor(robot, position, velocity, np.gradient(velocity, 1 / RATE, axis=0))
    effort = effort @ ParameterSet(robot).values
    effort += np.random.default_rng(3).normal(0, 0.05, effort.shape)
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    holdout = identified(wrong, log).estimate.holdout
    assert holdout.repeats > 0.9
    assert "the motion repeats itself" in holdout.summary


def test_a_log_too_short_for_the_check_is_identified(robot, wrong) -> None:
    log = sy.Log.from_streams(streams(robot, count=200))
    result = identified(wrong, log)
    holdout = result.estimate.holdout
    assert (holdout.advice, holdout.percent_after) == ("none", None)
    assert holdout.summary.startswith("no part of the log: ")


def test_the_check_is_saved(result, tmp_path) -> None:
    result.save(tmp_path)
    document = json.loads((tmp_path / "estimate.json").read_text())["holdout"]
    found = load_estimate(tmp_path / "estimate.json")
    assert found.holdout == result.estimate.holdout
    assert document["percent_after"] == result.estimate.holdout.percent_after
    assert all(after < before for before, after in document["coordinates"].values())


def test_segments_are_read_again_for_long_logs(robot) -> None:
    aligned = AlignedLog(sy.Log.from_streams(streams(robot)), robot, most_kept=0)
    training, held_out = split(aligned, 0.3, "log")
    assert length(training) == pytest.approx(12, abs=0.02)
    assert length(held_out) == pytest.approx(3.7, abs=0.02)


def test_joints_that_rest_at_the_end_are_named() -> None:
    """Static friction balances any effort, so that nothing can be predicted there."""
    robot = arm(seed=2)
    joints = log_of(robot, drives(robot, coulomb=0.8), seconds=24.0).streams().joints
    time = (joints.stamp - joints.stamp[0]) * 1e-9
    rests = int(np.searchsorted(time, 16.0))
    position, effort = joints.position.copy(), joints.effort.copy()
    position[rests:], effort[rests:] = position[rests], effort[rests]
    noise = np.random.default_rng(1).normal(0.0, 1e-6, position.shape)
    position += noise  # an encoder that repeats itself would count as frozen
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    holdout = sy.identify(robot, log, unchecked=True).estimate.holdout
    assert holdout is not None
    assert holdout.advice == "none"
    assert "the joints rest in its last 8 s; leave these out with `stop`" in holdout.summary


@pytest.mark.parametrize(
    ("words", "text"),
    [([], ""), (["A"], "A"), (["A", "B"], "A and B"), (["A", "B", "C"], "A, B and C")],
)
def test_names_are_enumerated(words, text):
    assert enumerate_words(words) == text
