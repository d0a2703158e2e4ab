"""Bars of time, position and speed are where the log has them."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from report_pages import content_of_a_log

from symbid_ros.identification.report_data import QUANTILES
from symbid_ros.report.content import JointLimits
from symbid_ros.report.interactive import figure_data
from symbid_ros.report.log_bars import joint_ranges, timeline
from symbid_ros.report.log_figures import (
    ORIGINAL,
    STYLES,
    binned_medians,
    error_limit,
    force_panels,
    force_range,
    pauses,
    shown_error,
    shown_joints,
    spectrum_panels,
)


@pytest.fixture(scope="module")
def log():
    return content_of_a_log(4).shown.log


def test_the_timeline_shows_used_times_the_held_out_part_and_faults(log):
    rows = {row.name: row.bars for row in timeline(log.coverage, log.forces).rows}
    assert [(bar.left, bar.width) for bar in rows["used"]] == [(0, 30), (32.5, 67.5)]
    assert [(bar.left, bar.width) for bar in rows["held out"]] == [(50, 50)]
    (fault,) = rows["/joint_states"]
    assert (fault.kind, fault.left, fault.width) == ("gap", 30, 2.5)
    assert fault.text == "gap from 12.00 to 13.00 s"


def test_a_short_gap_shows_in_the_used_part(log):
    coverage = replace(log.coverage, used=np.array([[0.0, 20.0], [20.01, 40.0]]), faults=())
    *_, gap = timeline(coverage, None).rows[0].bars
    assert (gap.kind, gap.text) == ("break", "not used from 20.00 to 20.01 s")
    assert gap.left == pytest.approx(50, abs=0.3)
    assert gap.width >= 0.3


def test_a_pause_between_recordings_is_short(log):
    used = np.array([[0.0, 28.0], [3600.0, 3628.0]])
    coverage = replace(log.coverage, used=used, faults=())
    shown = timeline(coverage, None)
    assert [(bar.left, bar.width) for bar in shown.rows[0].bars] == [(0, 49), (51, 49)]
    assert shown.ticks == ((0, "0 s"), (51, "3600 s"), (100, "3628 s"))


@pytest.mark.parametrize(
    ("stop", "labels"),
    [(39.988, "0 10 20 30 40"), (10.294, "0 5 10"), (41.0, "0 20 40"), (0.31, "0 0.1 0.2 0.3")],
)
def test_ticks_are_round(log, stop, labels):
    used = np.array([[-0.008, stop]])
    ticks = timeline(replace(log.coverage, used=used, faults=()), None).ticks
    assert [label.removesuffix(" s") for _, label in ticks] == labels.split()
    assert ticks[-1][0] == pytest.approx(min(100, 100 * float(labels.split()[-1]) / stop), abs=0.1)


def test_a_short_fault_stays_visible_and_inside(log):
    fault = {"kind": "frozen", "stream": "/imu", "start": 39.999, "stop": 40.0}
    coverage = replace(log.coverage, faults=(fault,))
    (bar,) = timeline(coverage, None).rows[-1].bars
    assert bar.width >= 0.3
    assert bar.left + bar.width <= 100.001


def test_positions_are_shown_within_the_limits_of_the_joint(log):
    limits = {"joint_0": JointLimits(-2.0, 2.0, False), "joint_2": JointLimits(-np.inf, 9, True)}
    turning, sliding = joint_ranges(log.coverage, limits)
    assert (turning.left, turning.width, turning.share) == (25, 50, "50 %")
    edge = np.linspace(-1, 1, len(QUANTILES))[QUANTILES.index(0.05)]
    assert turning.inner_left == pytest.approx(100 * (edge + 2) / 4, abs=0.06)
    assert turning.positions == "−1.00 to 1.00 rad"
    assert (sliding.left, sliding.width, sliding.share) == (0, 100, "")
    assert sliding.speeds.endswith("m/s")


class TestAxes:
    def test_errors_beyond_the_measured_force_do_not_set_the_axis(self):
        forces = content_of_a_log(3, outlier=1e5).shown.log.forces
        place = forces.coordinates.index("joint_0")
        measured = np.ptp(forces.measured[:, place][np.isfinite(forces.measured[:, place])])
        assert shown_error(forces, place) <= measured
        low, high = force_range(forces, place)
        assert high - low < 1.3 * measured
        assert forces.coordinates[place] in {panel.title for panel in force_panels(forces)}

    def test_errors_of_the_original_model_on_the_base_are_in_view(self):
        forces = content_of_a_log(3, outlier=1e5).shown.log.forces
        for place in np.flatnonzero(forces.has_rows).tolist():
            if forces.coordinates[place].startswith("base/"):
                error = forces.measured[:, place] - forces.before[:, place]
                assert shown_error(forces, place) >= error_limit(error)
                low, high = force_range(forces, place)
                before = forces.before[np.isfinite(forces.before[:, place]), place]
                assert low <= before.min()
                assert high >= before.max()

    def test_single_outliers_are_cut(self):
        errors = np.ones(1000)
        errors[3] = 1e6
        assert error_limit(errors) < 5

    def test_the_joints_with_the_largest_errors_are_shown_in_order(self):
        forces = content_of_a_log(9).shown.log.forces
        errors = forces.rmse_after.copy()
        errors[[7, 14]] = 2 * forces.rms_measured[[7, 14]]
        worse = replace(forces, rmse_after=errors)
        assert (
            next(panel.title for panel in spectrum_panels(worse) if panel.is_printed)
            == (forces.coordinates[7])
        )
        assert len([panel for panel in spectrum_panels(worse) if panel.is_printed]) == 3
        shown = shown_joints(worse).tolist()
        assert len(shown) == 6
        assert {7, 14} <= set(shown)
        assert shown == sorted(shown)
        assert min(shown) >= 6


def test_medians_show_the_step_of_coulomb_friction():
    rng = np.random.default_rng(0)
    speed = rng.uniform(-1, 1, 2000)
    error = 3.0 * np.sign(speed) + rng.normal(0, 0.3, 2000)
    error[::50] = 1e4
    middle, median = binned_medians(speed, error)
    np.testing.assert_allclose(median, 3.0 * np.sign(middle), atol=0.2)
    assert np.all(np.diff(middle) > 0)
    assert STYLES[ORIGINAL].colour == "#d55e00"


def test_without_rows_there_is_no_median():
    middle, median = binned_medians(np.full(4, np.nan), np.zeros(4))
    assert len(middle) == len(median) == 0


def test_lines_break_where_rows_are_missing(log):
    forces = log.forces
    time = np.append(forces.time[:40], forces.time[40:] + 2.0)
    broken_log = replace(forces, time=time)
    (place,) = pauses(time)
    assert place == 40
    content = content_of_a_log(4)
    shown = replace(content.shown, log=replace(log, forces=broken_log))
    data = figure_data(replace(content, methods=(shown,)))
    times = np.frombuffer(base64.b64decode(data["time"]), "<f4")
    measured = np.frombuffer(base64.b64decode(data["coordinates"][0]["measured"]), "<f4")
    assert np.all(np.diff(times) > 0)
    assert np.flatnonzero(np.isnan(measured)).tolist() == [40]
    assert len(times) == len(measured) == len(time) + 1


def test_a_series_without_pauses_is_one_line():
    assert not len(pauses(np.arange(0, 4, 0.04)))
    assert not len(pauses(np.array([1.0])))
