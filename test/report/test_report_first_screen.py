"""The first sentence follows from alarms and held-out data; bars have a scale that fits most."""

from dataclasses import replace

import numpy as np
import pytest
from report_pages import VERDICT, content, content_of_a_log

from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.estimation.unexplained import UnexplainedForce
from symbid_ros.identification.calibration.extended_problem import ASSUMED, WITH_PAYLOAD
from symbid_ros.report.content import MethodResult
from symbid_ros.report.first_screen import (
    error_bars,
    key_figures,
    recommend,
    robust_maximum,
    rounded_up,
)
from symbid_ros.report.robot_summary import RobotSummary

ALARM = "the residuals are not white noise"
OTHER = "the poses of resting soles vary"


@pytest.mark.parametrize(
    ("has_moved", "source"), [(False, ", mostly the model file’s"), (True, "")]
)
def test_a_mass_that_is_not_measured_says_so(has_moved, source):
    shown = content_of_a_log(3)
    zeros = np.zeros(3)
    summary = RobotSummary(
        *(True, 20.0, 1.0, 21.0, False, has_moved, zeros, zeros, zeros, zeros),
        is_mean_posture=True,
        link_com_std={},
    )
    methods = tuple(replace(one, summary=summary) for one in shown.methods)
    mass = key_figures(replace(shown, methods=methods))[0]
    assert mass.note == f"not measured by this log{source}; original 21.00 kg"


def estimate(advice="better", *, alarms=(), **fields):
    summary = "9.4 % → 1.2 % of the measured torque on the last 34 s"
    holdout = HoldOut(34.0, 9.4, 1.2, advice, 0.1, {}, summary)
    verdict = replace(VERDICT, alarms=alarms)
    return replace(
        content(2, truth=False).estimate, holdout=replace(holdout, **fields), verdict=verdict
    )


class TestRecommendation:
    @pytest.mark.parametrize(
        ("advice", "kind", "start"),
        [
            ("better", "good", "Use this model: "),
            (
                "equal",
                "caution",
                "The data held out are too few to tell whether this model is better: ",
            ),
            ("worse", "bad", "Do not use this model, it is worse than the original: "),
            ("mixed", "bad", "Do not use this model, it is partly worse than the original: "),
            (
                "unfit",
                "bad",
                "Do not use this model, its error is larger than the measured forces: ",
            ),
        ],
    )
    def test_follows_the_advice_on_held_out_data(self, advice, kind, start):
        found = recommend(estimate(advice))
        figure = "torque error on data held out 9.4 % → 1.2 %; no alarm."
        assert (found.kind, found.sentence) == (kind, start + figure)
        assert bool(found.remark) == (advice == "equal")

    def test_a_small_change_is_none(self):
        found = recommend(estimate("equal", percent_after=9.3))
        assert found.sentence.startswith("This model hardly differs from the original: ")

    def test_errors_of_files_that_hold_less_are_said(self):
        files = {"model.urdf": 4.5, "model.xml": 1.21}
        remark = recommend(estimate(file_percents=files)).remark
        # The whole log may show terms that the trial lacks, so nothing is said about model.xml's.
        assert remark == (
            "Error of model.urdf alone 4.5 %: it cannot contain all joint terms; "
            "error of model.xml alone 1.2 %."
        )
        both = recommend(estimate(file_percents={"model.urdf": 4.5, "model.xml": 3.0})).remark
        assert (
            "alone 4.5 %, error of model.xml alone 3 %: they cannot contain all joint terms" in both
        )
        for small in (1.2, 0.1):
            files = {"model.urdf": small, "model.xml": 1.2}
            assert not recommend(estimate(file_percents=files)).remark

    def test_an_alarm_comes_first(self):
        found = recommend(estimate(alarms=(OTHER,)))
        assert found.kind == "bad"
        assert found.sentence == (
            "Do not use this model yet: 1 alarm; torque error on data held out 9.4 % → 1.2 %."
        )
        assert "2 alarms" in recommend(estimate(alarms=(ALARM, OTHER))).sentence

    def test_a_model_that_lacks_an_effect_may_be_used_for_predictions(self):
        shown = estimate("better", alarms=(ALARM,))
        coloured = replace(
            shown.verdict,
            whiteness=2.0,
            unexplained=(UnexplainedForce("knee", "Nm", 2.0, 80.0, 0.025),),
        )
        found = recommend(replace(shown, verdict=coloured))
        assert found.kind == "caution"
        assert found.sentence == (
            "Use this model for predictions, not its single parameters: 1 alarm; torque error on "
            "data held out 9.4 % → 1.2 %."
        )
        others = replace(coloured, alarms=(ALARM, OTHER))
        assert recommend(replace(shown, verdict=others)).kind == "bad"
        for change in ({"advice": "worse"}, {"percent_after": 20.0}):
            worse = replace(shown, holdout=replace(shown.holdout, **change), verdict=coloured)
            assert recommend(worse).kind == "bad"
        lost = replace(coloured, unexplained=(UnexplainedForce("knee", "Nm", 75.0, 80.0, 0.94),))
        assert recommend(replace(shown, verdict=lost)).kind == "bad"

    @pytest.mark.parametrize(("base", "kind"), [("fixed", "caution"), ("floating", "bad")])
    def test_a_prior_that_was_widened_much_is_a_fault_of_a_floating_robot(self, base, kind):
        shown = estimate("better", alarms=(ALARM,))
        widened = replace(shown.verdict, prior_scale=40.0, whiteness=2.0)
        found = recommend(replace(shown, verdict=widened, base=base))
        assert found.kind == kind
        assert ("The data widened the prior 40 times." in found.remark) == (base == "floating")
        less = replace(widened, prior_scale=8.0)
        assert recommend(replace(shown, verdict=less, base=base)).kind == "caution"

    def test_a_motion_that_repeats_itself_limits_the_advice(self):
        found = recommend(estimate(repeats=0.95))
        assert found.kind == "good"
        assert "repeats itself" in found.remark

    def test_a_scale_that_was_not_measured_is_said(self):
        shown = replace(estimate(), remarks=(ASSUMED + WITH_PAYLOAD,))
        found = recommend(shown)
        assert found.kind == "good"
        assert "scale of efforts and masses was not measured" in found.remark

    @pytest.mark.parametrize("tried", [False, True])
    def test_without_held_out_data_validation_is_advised(self, tried):
        reason = "no part of the log: too short"
        shown = estimate("none", seconds=0.0, summary=reason)
        found = recommend(shown if tried else replace(shown, holdout=None))
        assert found.kind == "caution"
        assert "symbid validate" in found.remark
        assert (reason in found.remark) is tried

    def test_forces_on_a_base_are_called_so(self):
        summary = "9.4 % → 1.2 % of the measured force on the base on the last 34 s"
        assert "force error on data held out" in recommend(estimate(summary=summary)).sentence


class TestErrorBars:
    def test_errors_are_in_percent_of_the_measured_torque(self):
        shown = content_of_a_log(4).shown
        forces = shown.log.forces
        bars = {bar.name: bar for bar in error_bars(shown).bars}
        assert set(bars) == {"joint_0", "joint_1", "joint_2", "joint_3"}
        for name, bar in bars.items():
            place = forces.coordinates.index(name)
            percent = 100 * forces.rmse_after[place] / forces.rms_measured[place]
            assert float(bar.share_after.removesuffix(" %")) == pytest.approx(percent, rel=0.06)
            assert bar.width_after < bar.width_before <= 100

    def test_an_outlier_is_cut_and_the_others_stay_visible(self):
        found = error_bars(content_of_a_log(8, outlier=1e5).shown)
        first, *others = found.bars
        assert (first.name, first.cut_before, first.width_before) == ("joint_0", True, 100)
        assert found.has_cut
        assert all(bar.width_before > 20 and not bar.cut_before for bar in others)

    def test_the_largest_come_first_and_many_are_folded(self):
        found = error_bars(content_of_a_log(29).shown)
        widths = [bar.width_before for bar in found.bars]
        assert widths == sorted(widths, reverse=True)
        assert (len(found.shown), len(found.folded)) == (12, 17)

    def test_results_of_earlier_versions_have_errors_without_percentage(self):
        coordinates = {"base/force_z": (9.0, 3.0), "knee": (4.0, 1.0), "hip": (2.0, 0.5)}
        shown = MethodResult("MAP", estimate(coordinates=coordinates), None)
        knee, hip = error_bars(shown).bars
        assert (knee.name, knee.before, knee.after, knee.share_after) == (
            *("knee", "4.00 Nm", "1.00 Nm"),
            "",
        )
        assert (knee.width_before, hip.width_before, hip.width_after) == (80, 40, 10)

    def test_a_joint_without_load_has_no_percentage(self):
        shown = content_of_a_log(3).shown
        forces = shown.log.forces
        loads = forces.rms_measured.copy()
        loads[-1] = 0.0
        log = replace(shown.log, forces=replace(forces, rms_measured=loads))
        bars = {bar.name: bar for bar in error_bars(replace(shown, log=log)).bars}
        assert bars["joint_2"].share_after == ""
        assert (bars["joint_2"].width_before, bars["joint_2"].width_after) == (0, 0)

    def test_an_error_that_has_grown_is_marked_and_cut_by_itself(self):
        shown = content_of_a_log(3).shown
        forces = shown.log.forces
        after = forces.rmse_after.copy()
        place = forces.coordinates.index("joint_1")
        after[place] = 1.5 * max(forces.rmse_before[place], forces.rms_measured[place])
        log = replace(shown.log, forces=replace(forces, rmse_after=after))
        found = error_bars(replace(shown, log=log))
        bars = {bar.name: bar for bar in found.bars}
        assert [name for name, bar in bars.items() if bar.is_worse] == ["joint_1"]
        assert bars["joint_1"].width_after > bars["joint_1"].width_before

    def test_the_scale_is_a_round_number(self):
        assert [rounded_up(value) for value in (17.0, 77.0, 99.0, 100.0, 0.3, 0.0)] == [
            *(20, 100, 100, 100, 0.5, 0),
        ]


def test_the_robust_maximum_ignores_few_large_values():
    values = np.array([1.0, 2.0, 3.0, 2.0, 1.0, 1e6, np.nan])
    assert 3.0 <= robust_maximum(values) < 10.0
    assert robust_maximum(np.array([1.0, 2.0])) == 2.0
    assert robust_maximum(np.array([np.nan, 0.0])) == 0.0


def test_key_figures_name_what_was_measured_and_what_the_doctor_found():
    figures = {one.title: one for one in key_figures(content_of_a_log(4))}
    assert figures["Determined"].value == "2 of 50"
    assert figures["Log"].value == "39.0 s used"
    assert figures["Log"].note == "walk_bag; the doctor found 1 fault"


def test_bars_with_forces_of_a_wrist_sensor_say_torque_or_force():
    base = content_of_a_log(4).shown
    plain = error_bars(base)
    assert (plain.title, plain.scale.partition("% ")[2]) == (
        "Error on each joint",
        "of the measured torque",
    )
    forces = base.log.forces
    coordinates = (*forces.coordinates[:-1], "tool0/force_x")
    forces = replace(forces, coordinates=coordinates, units=(*forces.units[:-1], "N"))
    mixed = error_bars(replace(base, log=replace(base.log, forces=forces)))
    assert (mixed.title, mixed.scale.partition("% ")[2]) == (
        "Error on each joint and sensor axis",
        "of the measured torque or force",
    )
