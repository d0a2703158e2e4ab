"""A result is judged on a log that was not used: errors, intervals, mass and verdict."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from analytic_log import analytic_samples
from hypothesis import given
from hypothesis import strategies as st
from random_logs import LogPlan, random_streams, small_robot

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.comparison import compare
from symbid_ros.identification.predictions.error_changes import percent, percent_change
from symbid_ros.identification.predictions.force_errors import compare_errors
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation import validate_segments
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet

TRAINING, HELD_OUT = 3, 4  # seeds of motions
START = 100_000_000_000


def log_of(robot, seed, *, count=3000, noise=1.0, start=0, rate=250.0):
    streams = random_streams(robot, LogPlan(rate, count, start=start, noise=noise), seed)
    return sy.Log.from_streams(streams)


def identify(robot, log, **options) -> sy.Result:
    """Identify without what takes long and is tested elsewhere."""
    given = {"unchecked": True, "no_holdout": True}
    if not {"friction", "joint_terms"} & set(options):
        given["joint_terms"] = "none"
    return sy.identify(robot, log, **given, **options)


class Case:
    """A robot, a model of it that is wrong by 25 %, and two logs of different motions."""

    def __init__(self, folder, *, floating, suffix="xml") -> None:
        robot = small_robot(5, floating=floating, links=4)
        text = mjcf_text if suffix == "xml" else urdf_text
        file = folder / f"robot.{suffix}"
        file.write_text(text(robot))
        base = "auto" if suffix == "xml" else ("fixed", "floating")[floating]
        self.robot = sy.load_model(file, base)
        self.parameters = ParameterSet(self.robot)
        drawn = draw_prior(self.parameters, "consistent", 25, 1)
        wrong = folder / f"wrong.{suffix}"
        wrong.write_text(text(self.parameters.apply(drawn.mean)))
        self.wrong = sy.load_model(wrong, base)
        self.training = log_of(self.robot, TRAINING)
        self.held_out = log_of(self.robot, HELD_OUT, start=START)

    def identified(self, **options) -> sy.Result:
        return identify(self.wrong, self.training, **options)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Case:
    return Case(tmp_path_factory.mktemp("arm"), floating=False)


@pytest.fixture(scope="module")
def walker(tmp_path_factory) -> Case:
    return Case(tmp_path_factory.mktemp("walker"), floating=True)


@pytest.fixture(scope="module")
def found(arm) -> sy.Validation:
    return sy.validate(arm.identified(), arm.held_out)


def test_the_error_before_is_that_of_the_original_model(arm, found) -> None:
    stamp = np.arange(0, 12_000_000_000, 4_000_000)
    samples = analytic_samples(arm.parameters, stamp, HELD_OUT)
    rows = equation_of_motion(arm.parameters, samples)
    error = rows.y - rows.K @ ParameterSet(arm.wrong).values
    expected = np.sqrt(np.mean(error**2, axis=0))
    assert [one.name for one in found.coordinates] == list(arm.robot.joint_names)
    np.testing.assert_allclose([one.rmse_before for one in found.coordinates], expected, rtol=0.05)
    np.testing.assert_allclose(
        [one.measured for one in found.coordinates],
        np.sqrt(np.mean(samples.effort**2, axis=0)),
        rtol=0.05,
    )
    norm = np.sqrt(np.sum(expected**2))
    assert found.torque.rmse_before == pytest.approx(norm, rel=0.05)
    assert found.percent_before == pytest.approx(100 * norm / found.torque.measured, rel=0.05)


def test_the_error_after_is_that_of_the_prediction(arm, found) -> None:
    prediction = arm.identified().predict(arm.held_out)
    expected = prediction.rmse
    assert {one.name: one.rmse_after for one in found.coordinates} == pytest.approx(expected)
    efforts = found.efforts
    np.testing.assert_array_equal(efforts.stamp, prediction.stamp)
    np.testing.assert_allclose(efforts.measured - efforts.after, prediction.error, atol=1e-9)


def test_an_identified_model_is_recommended(found) -> None:
    assert found.is_better
    assert found.percent_after < 0.2 * found.percent_before
    assert found.seconds_used == 0
    assert found.seconds == pytest.approx(12, abs=0.1)
    assert found.verdict.startswith("use it: ")
    assert "on 12 s that were not used" in found.verdict
    assert found.verdict in repr(found)
    assert "<td>joint_0</td>" in found._repr_html_()


def test_a_recommendation_repeats_the_alarms_of_the_identification(arm, found) -> None:
    """Forces can be predicted although the numbers cannot be trusted."""
    assert "alarm" not in found.verdict
    predictor = arm.identified().predictor
    verdict = predictor.estimate.verdict
    assert verdict is not None
    doubtful = replace(verdict, alarms=("the prior is wrong; widen it", "a sensor drifts"))
    doubted = replace(predictor, estimate=replace(predictor.estimate, verdict=doubtful))
    log = AlignedLog(arm.held_out, predictor.parameters.model)
    judged = validate_segments(doubted, log, "log")
    said = judged.verdict
    assert judged.is_recommended
    assert said.startswith("use it, although its identification raised 2 alarms: ")
    assert judged.document()["identification_alarms"] == 2
    assert found.document()["identification_alarms"] == 0
    assert said.endswith("; alarms of its identification: the prior is wrong; a sensor drifts")


def test_intervals_hold_the_share_of_errors_that_they_claim(found) -> None:
    assert found.coverage == pytest.approx(0.9, abs=0.06)
    assert found.normalized_square == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_intervals_hold_for_logs_of_another_rate(arm, rate, tmp_path):
    """The noise of averages falls with the number of samples in a window."""
    result = identify(arm.wrong, log_of(arm.robot, TRAINING, count=round(12 * rate), rate=rate))
    result.save(tmp_path / "result")
    other = 1250.0 - rate
    log = log_of(arm.robot, HELD_OUT, count=round(12 * other), rate=other, start=START)
    found = sy.validate(tmp_path / "result", log)
    assert found.coverage == pytest.approx(0.9, abs=0.08)
    assert 0.6 < found.normalized_square < 1.6


def test_a_log_that_was_used_is_named(arm) -> None:
    verdict = sy.validate(arm.identified(), arm.training).verdict
    assert "of which the identification used 12 s; repeat this with another log" in verdict


def test_a_model_that_became_worse_is_refused(arm) -> None:
    """A payload in the identified log is absent from the other one."""
    phi = arm.robot.phi.copy()
    phi[-1] *= 3
    loaded = log_of(arm.robot.with_phi(phi), TRAINING)
    result = identify(arm.robot, loaded)
    found = sy.validate(result, arm.held_out)
    assert (found.advice, found.is_better) == ("worse", False)
    assert found.percent_after > 2 * found.percent_before
    assert found.verdict.startswith("do not use it")


def test_a_joint_that_got_worse_is_named_with_its_error(arm) -> None:
    """The efforts of one joint, small beside the others', err in the identified log only."""
    joint = arm.robot.joint_names[-1]
    streams = random_streams(arm.robot, LogPlan(250.0, 3000, noise=1.0), TRAINING)
    scale = np.array([1.0, 1.0, 0.5])
    joints = replace(streams.joints, effort=streams.joints.effort * scale)
    log = sy.Log.from_streams(replace(streams, joints=joints))
    found = sy.validate(identify(arm.wrong, log), arm.held_out)
    assert found.torque.rmse_after < found.torque.rmse_before
    (error,) = [one for one in found.coordinates if one.name == joint]
    assert (found.advice, found.is_better, found.worse) == ("mixed", False, (joint,))
    assert found.verdict.startswith(f"do not use it yet, {joint} got worse: ")
    change = percent_change(error.percent_before, error.percent_after)
    assert f"{change} of the measured effort of {joint}" in found.verdict


def test_intervals_that_are_too_narrow_are_part_of_the_verdict(arm) -> None:
    predictor = arm.identified().predictor
    narrow = replace(predictor, factor=0.2 * predictor.factor, noise=0.04 * predictor.noise)
    log = AlignedLog(arm.held_out, predictor.parameters.model)
    found = validate_segments(narrow, log, "log")
    assert found.is_better
    assert not found.is_covered
    assert found.verdict.startswith("use it, but not its standard deviations: ")
    assert "; too few errors lie in their 90 % interval (all " in found.verdict
    assert ", joint_0 " in found.verdict


def test_another_load_is_part_of_the_verdict(arm) -> None:
    """Its errors are far larger than those of the identified log."""
    predictor = arm.identified().predictor
    exact = replace(predictor, factor=0.02 * predictor.factor, noise=4e-4 * predictor.noise)
    log = AlignedLog(arm.held_out, predictor.parameters.model)
    found = validate_segments(exact, log, "log")
    assert (found.is_better, found.is_recommended) == (True, False)
    assert found.verdict.startswith("better than the original, but not fit for this robot or load")
    said = re.search(r"the errors are (\d+) times as large as in the identified log", found.verdict)
    assert said is not None
    assert float(said[1]) == pytest.approx(np.sqrt(found.normalized_square), abs=0.5)
    assert "give what it carries as `payload`" in found.verdict
    assert "alarms" not in found.verdict
    verdict = exact.estimate.verdict
    assert verdict is not None
    doubtful = replace(verdict, alarms=("no joint moves; move them",))
    doubted = replace(exact, estimate=replace(exact.estimate, verdict=doubtful))
    said = validate_segments(doubted, log, "log").verdict
    assert "so the identification is wrong, as its alarms say, or the robot or its load" in said
    assert said.endswith("; alarms of its identification: no joint moves")


def test_a_joint_whose_effort_is_not_predicted_is_part_of_the_verdict(arm) -> None:
    """It hardly counts among all joints."""
    result = arm.identified()
    streams = arm.held_out.streams()
    joints = replace(streams.joints, effort=streams.joints.effort * [1.0, 1.0, -1.0])
    found = sy.validate(result, sy.Log.from_streams(replace(streams, joints=joints)))
    assert found.unpredicted == (arm.robot.joint_names[-1],)


def test_a_joint_that_rests_is_not_judged_and_named(arm) -> None:
    """Static friction balances any effort of a joint at rest."""
    result = identify(arm.wrong, arm.training, joint_terms=("coulomb",))
    streams = random_streams(arm.robot, LogPlan(250.0, 3000, start=START, noise=1.0), HELD_OUT)
    still = np.array([1.0, 1.0, 0.0])
    joints = replace(
        streams.joints,
        position=streams.joints.position * still,
        velocity=streams.joints.velocity * still,
    )
    found = sy.validate(result, sy.Log.from_streams(replace(streams, joints=joints)))
    assert found.not_judged == (arm.robot.joint_names[-1],)
    assert f"; {found.not_judged[0]} is not judged, because in this log it hardly" in found.verdict


def test_a_log_in_other_units_has_no_use_for_the_model(arm) -> None:
    """The original model errs even more, so that the identified one is better than it."""
    phi = arm.robot.phi.copy()
    phi[-1] *= 3
    result = identify(arm.robot.with_phi(phi), arm.training)
    # Efforts of a tenth.
    light = log_of(arm.robot.with_phi(0.1 * arm.robot.phi), HELD_OUT, start=START)
    found = sy.validate(result, light)
    assert found.percent_before > found.percent_after > 100
    assert (found.advice, found.is_better) == ("unfit", False)
    assert found.verdict.startswith("do not use it, its error is larger than the measured forces")


def test_a_model_that_was_right_hardly_differs(arm) -> None:
    result = identify(arm.robot, arm.training)
    found = sy.validate(result, arm.held_out)
    assert (found.advice, found.is_better) == ("equal", False)
    assert found.verdict.startswith("hardly differs from the original")


def test_a_log_of_a_moment_tells_too_little(arm) -> None:
    moment = log_of(arm.robot, HELD_OUT, count=130, start=START)
    found = sy.validate(arm.identified(), moment)
    assert found.percent_after < 0.5 * found.percent_before
    assert (found.advice, found.is_better) == ("equal", False)
    assert found.verdict.startswith("too few data to tell whether it is better, repeat this with a")


@pytest.fixture(scope="module")
def wrong_trunk(walker) -> sy.RobotModel:
    """A model whose only error, in the first link, shows in the wrench on the base alone."""
    parameters = ParameterSet(walker.robot)
    phi = walker.robot.phi.copy()
    phi[0, 1:4] += 0.05 * phi[0, 0]
    return parameters.model.with_phi(phi)


def figures(verdict: str) -> list[tuple[str, str]]:
    """Return the errors before and after that a verdict shows."""
    return re.findall(r"([0-9.e-]+ %) → ([0-9.e-]+ %)", verdict)


def test_a_model_that_is_better_at_the_base_alone_shows_its_errors_there(
    walker, wrong_trunk
) -> None:
    found = sy.validate(identify(wrong_trunk, walker.training), walker.held_out)
    assert found.torque.rmse_after == pytest.approx(found.torque.rmse_before, rel=0.05)
    assert (found.advice, found.is_better) == ("better", True)
    assert found.verdict.startswith("use it, base moment and base force got better: ")
    moment = found.base_moment
    (before, after), _, torque = figures(found.verdict)
    assert (before, after) == (percent(moment.percent_before), percent(moment.percent_after))
    assert "of the measured moment on the base, " in found.verdict
    assert torque == tuple(percent_change(found.percent_before, found.percent_after).split(" → "))


def test_a_model_that_is_worse_at_the_base_alone_shows_its_errors_there(
    walker, wrong_trunk
) -> None:
    """The trunk carried a load while the log was recorded."""
    loaded = log_of(wrong_trunk, TRAINING)
    found = sy.validate(identify(walker.robot, loaded), walker.held_out)
    assert found.torque.rmse_after == pytest.approx(found.torque.rmse_before, rel=0.05)
    assert (found.advice, found.is_better) == ("worse", False)
    before, after = figures(found.verdict)[0]
    moment = found.base_moment
    assert (before, after) == (percent(moment.percent_before), percent(moment.percent_after))


def test_a_model_that_is_better_at_the_joints_shows_their_error_alone(walker) -> None:
    found = sy.validate(walker.identified(), walker.held_out)
    assert found.deciding == (found.torque,)
    assert found.verdict.startswith("use it: ")
    assert len(figures(found.verdict)) == 1


@given(before=st.floats(0.01, 150), share=st.floats(1.05, 2.0))
def test_a_relevant_change_shows_in_the_digits(before: float, share: float) -> None:
    first, second = percent_change(before, before / share).split(" → ")
    assert first != second


OPTIONS = [
    {},
    {"friction": True, "offset": True},
    {"sensor_errors": "typical"},
    {"joint_terms": "auto"},
    {"filter": "butterworth", "cutoff": 30.0},
    {"filter": "savitzky_golay", "window": 0.05},
    {"method": "wls_rc", "window": 0.161},
]


CASES = [
    *(("xml", options) for options in OPTIONS),
    *(("urdf", options) for options in OPTIONS[:3]),
]


@pytest.mark.parametrize(("suffix", "options"), CASES, ids=str)
def test_a_saved_result_suffices(options, suffix, tmp_path) -> None:
    case = Case(tmp_path, floating=True, suffix=suffix)
    result = case.identified(**options)
    folder = result.save(tmp_path / "result")
    predictor = ForcePredictor.load(folder)
    assert predictor.parameters.model.floating
    expected = sy.validate(result, case.held_out)
    found = sy.validate(folder, case.held_out)
    assert (found.coverage is None) == (result.estimate.method == "wls_rc")
    np.testing.assert_allclose(found.efforts.before, expected.efforts.before, atol=1e-6)
    np.testing.assert_allclose(found.efforts.after, expected.efforts.after, atol=1e-6)
    figures = ["percent_before", "percent_after"]
    figures += ["coverage", "normalized_square"] if expected.coverage is not None else []
    for name in figures:
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-4)
    assert (found.advice, found.seconds_used) == (expected.advice, expected.seconds_used)
    assert json.loads(json.dumps(found.document(), allow_nan=False))["advice"] == found.advice


def test_the_forces_on_a_floating_base_weigh_the_robot(walker) -> None:
    found = sy.validate(walker.identified(), walker.held_out)
    true = walker.robot.phi[:, 0].sum()
    mass = found.mass
    assert mass.before == pytest.approx(walker.wrong.phi[:, 0].sum())
    assert abs(mass.before - true) > 10 * mass.std
    assert mass.measured == pytest.approx(true, abs=max(4 * mass.std, 1e-3 * true))
    assert mass.after == pytest.approx(true, rel=0.01)
    force = found.base_force
    assert (force.unit, found.base_moment.unit) == ("N", "Nm")
    assert force.percent_after < 0.1 * force.percent_before
    wrench = found.efforts.wrench_measured
    rms = np.sqrt(np.mean(np.sum(wrench[:, 3:] ** 2, axis=1)))
    assert force.measured == pytest.approx(rms)


def test_slow_stretches_show_gravity_alone(arm) -> None:
    """A model with right masses and centres of mass but wrong inertias errs in fast motion only."""
    robot = arm.robot
    time = np.arange(0, 24, 0.004)
    speed = np.where(time < 12, 0.1, 4.0)
    angle = np.cumsum(speed) * 0.004
    ratio = np.array([1.0, 1.3, 0.7])
    position = np.sin(np.outer(angle, ratio))
    velocity = np.gradient(position, 0.004, axis=0)
    acceleration = np.gradient(velocity, 0.004, axis=0)
    effort = sy.regressor(robot, position, velocity, acceleration) @ arm.parameters.values
    noise = np.random.default_rng(1).normal(0, 0.02, effort.shape)
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort + noise)
    phi = robot.phi.copy()
    phi[:, 4:] *= 2
    wrong = robot.with_phi(phi)
    found = sy.validate(identify(wrong, arm.training), log)
    assert found.slow_seconds == pytest.approx(12, abs=2)
    assert found.slow.rmse_before < 0.05 * found.torque.rmse_before
    assert found.slow.name == "slow stretches"


def test_errors_differ_beyond_chance_and_by_a_relevant_amount() -> None:
    rng = np.random.default_rng(2)
    force = np.full((400, 2), 10.0)
    first = rng.normal(size=(400, 2))
    smaller = compare_errors(first, 0.5 * rng.normal(size=(400, 2)), force)
    assert smaller.is_decrease
    assert smaller.log_ratio == pytest.approx(np.log(0.5), abs=0.1)
    assert compare_errors(0.5 * first, first, force).is_increase
    same = compare_errors(first, rng.normal(size=(400, 2)), force)
    assert not same.is_decrease
    assert not same.is_increase
    irrelevant = compare_errors(first, 0.99 * first, force)
    assert irrelevant.half_width < 1e-9
    assert not irrelevant.is_decrease
    nothing = compare_errors(0 * first, 0 * first, force)
    assert (nothing.log_ratio, nothing.half_width) == (0, 0)
    # One block that errs by chance is no evidence.
    burst = first.copy()
    burst[:40] *= 5
    assert not compare_errors(first, burst, force).is_increase


def test_results_are_ranked_on_equal_rows(arm, tmp_path) -> None:
    good = arm.identified().save(tmp_path / "good")
    rough = arm.identified(method="wls_rc", rank=3, window=0.081).save(tmp_path / "rough")
    found = compare([rough, good], arm.held_out)
    assert [one.result for one in found.ranking] == [str(good), str(rough)]
    best, second = found.ranking
    assert best.main.rows == second.main.rows
    assert best.main.measured == pytest.approx(second.main.measured)
    assert best.percent_after < second.percent_after
    assert found.verdict.startswith(f"{good} predicts best: ")
    assert "alarm" not in found.verdict
    file = good / "estimate.json"
    estimate = json.loads(file.read_text())
    estimate["verdict"]["alarms"] = ["a sensor drifts; let it warm up"]
    file.write_text(json.dumps(estimate))
    doubted = compare([rough, good], arm.held_out).verdict
    assert doubted.endswith(f"; {good}: its identification raised 1 alarm")
    alike = compare([good, arm.identified()], arm.held_out)
    assert "hardly differ" in alike.verdict
    assert compare([good], arm.held_out).verdict.startswith(f"{good}: use it")
    assert found.recommended == str(good)


def test_results_that_are_all_useless_are_not_recommended(arm) -> None:
    """The one with the smallest error is no better than the model file, which was right."""
    phi = arm.robot.phi.copy()
    phi[-1] *= 3
    loaded = identify(arm.robot, log_of(arm.robot.with_phi(phi), TRAINING))
    same = identify(arm.robot, arm.training)
    found = compare([loaded, same], arm.held_out)
    assert found.verdict.startswith("none is clearly better than the original model: ")
    assert found.recommended is None


def test_a_comparison_names_the_results_that_used_its_log(arm) -> None:
    mine, other = arm.identified(), arm.identified(method="wls_rc", rank=3)
    known = compare([mine, other], arm.training).verdict
    assert known.count(" s for the identification; repeat this with another log") == 1
    assert known.count(" used 1") == 2
    assert "used" not in compare([mine, other], arm.held_out).verdict


def test_results_of_different_robots_are_not_compared(arm, walker) -> None:
    with pytest.raises(sy.EstimateError, match="its joints are not those of"):
        compare([arm.identified(), walker.identified()], arm.held_out)


def test_a_log_of_other_sensors_is_refused(walker) -> None:
    result = walker.identified(sensor_errors="wrench_offset")
    streams = random_streams(walker.robot, LogPlan(250.0, 3000), HELD_OUT)
    wrench, *others = streams.wrenches
    log = sy.Log.from_streams(
        replace(streams, wrenches=(replace(wrench, frame_id="imu_link"), *others))
    )
    with pytest.raises(sy.EstimateError, match="its sensors are not those whose errors"):
        sy.validate(result, log)


def test_a_log_that_is_too_short_is_refused(arm) -> None:
    with pytest.raises(sy.SymbidError, match="too short"):
        sy.validate(arm.identified(), log_of(arm.robot, HELD_OUT, count=60))


def test_an_incomplete_folder_is_refused(arm, tmp_path) -> None:
    folder = arm.identified().save(tmp_path / "result")
    (folder / "model.xml").unlink()
    with pytest.raises(sy.EstimateError, match="its model cannot be read") as refusal:
        sy.validate(folder, arm.held_out)
    assert refusal.value.code == "E527"
    with pytest.raises(sy.EstimateError, match="no such folder"):
        sy.validate(tmp_path / "elsewhere", arm.held_out)
