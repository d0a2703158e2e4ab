"""What a report shows of a log: motion, spectra, faults and forces, saved and read again."""

import re
from dataclasses import replace

import numpy as np
import pytest
from arm_log import arm_streams
from documented_robots import ur5_urdf

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.timing import GAPS_KEPT, TimingCheck
from symbid_ros.errors import EstimateError
from symbid_ros.identification.predictions.validation_result import PredictedEfforts
from symbid_ros.identification.report_data import FILE_NAME, QUANTILES, load_report_data
from symbid_ros.identification.report_series import MOST_ROWS, PositionTrace, force_series
from symbid_ros.identification.result_files import write_identification
from symbid_ros.report.compose import compose
from symbid_ros.report.page import render
from symbid_ros.report.saved_results import load_result, with_forces_of
from symbid_ros.signals.segments import Segment

RATE, SECONDS, STILL = 25.0, 200.0, 60.0


@pytest.fixture(scope="module")
def arm():
    return sy.load_model(ur5_urdf())


@pytest.fixture(scope="module")
def streams(arm):
    return arm_streams(arm, seconds=24.0)


@pytest.fixture(scope="module")
def log(arm, streams):
    joints = streams.joints
    return sy.Log.from_arrays(
        arm, time=joints.stamp * 1e-9, position=joints.position, effort=joints.effort
    )


@pytest.fixture(scope="module")
def result(arm, log):
    return sy.identify(arm, log, joint_terms=("none",))


@pytest.fixture(scope="module")
def saved(result, tmp_path_factory):
    return result.save(tmp_path_factory.mktemp("results") / "result")


class TestSavedResult:
    def test_is_read_as_it_was_written(self, result, saved):
        found, written = load_report_data(saved), result._identification.report
        assert found.forces.coordinates == written.forces.coordinates
        np.testing.assert_allclose(found.forces.measured, written.forces.measured, rtol=1e-6)
        np.testing.assert_allclose(found.coverage.position, written.coverage.position, rtol=1e-6)
        assert found.coverage.findings == written.coverage.findings
        np.testing.assert_array_equal(found.spread.prior_std, written.spread.prior_std)

    def test_forces_are_those_of_the_held_out_part(self, result, saved):
        forces, holdout = load_report_data(saved).forces, result.estimate.holdout
        assert forces.is_held_out
        assert forces.stop - forces.start == pytest.approx(holdout.seconds, abs=1.0)
        for name, before, after in zip(
            forces.coordinates, forces.rmse_before, forces.rmse_after, strict=True
        ):
            assert holdout.coordinates[name] == pytest.approx((before, after))

    def test_the_page_states_the_length_of_the_held_out_part_once(self, result, saved):
        page = render(compose({"A": load_result(saved)}, chosen="A", metadata={}))
        lengths = set(re.findall(r"[Tt]he last ([\d.]+)\s*s", page.replace("\xa0", " ")))
        assert lengths == {f"{result.estimate.holdout.seconds:.0f}"}

    def test_motion_is_that_of_the_log(self, arm, streams, saved):
        log = load_report_data(saved).coverage
        order = [streams.joints.names.index(name) for name in arm.joint_names]
        position = streams.joints.position[:, order]
        speed = np.abs(np.diff(position, axis=0)) / np.diff(streams.joints.stamp * 1e-9)[:, None]
        median, largest = QUANTILES.index(0.5), QUANTILES.index(0.95)
        np.testing.assert_allclose(log.position[:, median], np.median(position, axis=0), atol=0.05)
        expected = np.quantile(speed, 0.95, axis=0)
        np.testing.assert_allclose(log.speed[:, largest], expected, rtol=0.1)
        np.testing.assert_allclose(log.mean_posture, position.mean(axis=0), atol=0.05)
        assert log.duration == pytest.approx(24.0, abs=0.5)

    @pytest.mark.parametrize("content", [b"", b"PK\3\4 damaged", b"{}"])
    def test_a_damaged_file_is_named(self, tmp_path, content):
        (tmp_path / FILE_NAME).write_bytes(content)
        with pytest.raises(EstimateError, match=FILE_NAME) as caught:
            load_report_data(tmp_path)
        assert caught.value.code == "E470"

    def test_arrays_that_do_not_match_are_refused(self, saved, tmp_path):
        data = load_report_data(saved)
        replace(data, coverage=replace(data.coverage, mean_posture=np.zeros(2))).write(
            tmp_path / FILE_NAME
        )
        with pytest.raises(EstimateError, match="mean_posture"):
            load_report_data(tmp_path)

    def test_that_of_an_earlier_result_is_removed(self, result, tmp_path):
        folder = result.save(tmp_path / "result")
        assert load_report_data(folder) is not None
        live = replace(result._identification, report=None)
        write_identification(live, result._parameters, folder)
        assert load_report_data(folder) is None


def page_with_forces_of(saved, joints, arm, *, later=0.0):
    log = sy.Log.from_arrays(
        arm,
        time=joints.stamp * 1e-9 + later,
        position=joints.position,
        effort=joints.effort,
        name="other",
    )
    result = with_forces_of(load_result(saved), saved, log)
    text = render(compose({"A": result}, chosen="A", metadata={}))
    return re.sub(r"<style>.*?</style>|<[^>]*>", "", text, flags=re.S).replace("\xa0", " ")


def test_the_page_tells_another_log_from_that_of_the_identification(arm, log, saved):
    own = load_report_data(saved).coverage
    joints = arm_streams(arm, seconds=12.0, seed=5).joints
    page = page_with_forces_of(saved, joints, arm, later=3600.0)
    assert f"{own.log}, 24.0 s used" in page
    assert page.count("other, which the identification did not use") == 2
    assert "The given bag" in page


def test_the_page_says_that_a_given_log_was_used(arm, streams, saved):
    page = page_with_forces_of(saved, streams.joints, arm)
    assert page.count("other, which the identification used") == 2


def test_without_a_trial_the_end_is_predicted_by_the_estimate(arm, log):
    found = sy.identify(arm, log, joint_terms=("none",), no_holdout=True)
    forces = found._identification.report.forces
    assert not forces.is_held_out
    assert forces.start > 0.6 * 24.0


@pytest.fixture(scope="module")
def swinging(arm):
    """Return rows of an arm that rests for a minute, with an error of 3 Hz at the first joint."""
    time = np.arange(0.0, SECONDS, 1 / RATE)
    moves = (time > STILL)[:, None]
    phase = np.arange(6.0)
    measured = moves * (5.0 + np.sin(2 * np.pi * 0.7 * time[:, None] + phase))
    error = np.zeros_like(measured)
    error[:, 0] = 0.4 * np.sin(2 * np.pi * 3.0 * time)
    nothing = np.zeros((len(time), 0))
    stamp = (time * 1e9).astype(np.int64)
    efforts = PredictedEfforts(
        stamp, arm.joint_names, measured, measured, measured - error, "", *3 * (nothing,)
    )
    joint_time = np.arange(-0.1, SECONDS + 0.1, 0.002)
    position = np.sin(joint_time[:, None] * np.arange(0.5, 3.5, 0.5))
    none = np.zeros((len(joint_time), 0))
    segment = Segment(
        (joint_time * 1e9).astype(np.int64),
        *(500.0, position, position),
        *(none[..., None], none[..., None], none[..., None], (), ()),
    )
    trace = PositionTrace()
    assert list(trace.of([segment])) == [segment]
    return time, force_series(efforts, arm, trace, begin=0, window=0.04, is_held_out=True)


class TestForceSeries:
    def test_the_spectrum_shows_frequency_and_power_of_an_error(self, swinging):
        _, forces = swinging
        power = forces.power_after[:, 0]
        assert forces.frequency[np.argmax(power)] == pytest.approx(3.0, abs=0.4)
        step = forces.frequency[1] - forces.frequency[0]
        assert power.sum() * step == pytest.approx(0.4**2 / 2, rel=0.05)
        assert np.all(forces.power_after[:, 1:] == 0)

    def test_speeds_are_those_of_the_positions(self, swinging):
        time, forces = swinging
        rows = np.unique(np.linspace(0, len(time) - 1, len(forces.speed)).round()).astype(int)
        rate = np.arange(0.5, 3.5, 0.5)
        expected = rate * np.cos(time[rows, None] * rate)
        np.testing.assert_allclose(forces.speed[1:-1], expected[1:-1], atol=2e-3)

    def test_the_stretch_shown_is_one_in_which_the_robot_moves(self, swinging):
        _, forces = swinging
        assert len(forces.time) == MOST_ROWS
        assert forces.time[0] > STILL - 1
        np.testing.assert_allclose(np.diff(forces.time), 1 / RATE, rtol=1e-6)
        assert forces.rmse_after[0] == pytest.approx(0.4 / np.sqrt(2), rel=1e-3)


def test_a_gap_shorter_than_a_glance_ends_a_used_part(arm, streams):
    joints = streams.joints
    time = joints.stamp * 1e-9 - joints.stamp[0] * 1e-9
    kept = (time < 12.0) | (time > 12.15)
    log = sy.Log.from_arrays(
        arm,
        time=joints.stamp[kept] * 1e-9,
        position=joints.position[kept],
        effort=joints.effort[kept],
    )
    found = sy.identify(arm, log, joint_terms=("none",), no_holdout=True, unchecked=True)
    (_, stop), (start, _) = found._identification.report.coverage.used
    assert (stop, start) == pytest.approx((12.0, 12.15), abs=0.02)


def test_gaps_are_kept_with_their_times_and_the_longest_of_many():
    stamps = np.arange(0, 40_000_000_000, 10_000_000)
    gap = (stamps > 12_000_000_000) & (stamps < 13_000_000_000)
    timing = TimingCheck("/joint_states")
    timing.add(stamps[~gap])
    (span,) = timing.spans
    assert (span.kind, span.stream) == (Kind.GAP, "/joint_states")
    assert (span.start, span.stop) == (12_000_000_000, 13_000_000_000)
    each = np.arange(len(stamps)) % 10 < 8
    lossy = TimingCheck("/imu")
    lossy.add(stamps[each & ~gap])
    assert len(lossy.spans) == GAPS_KEPT
    assert max(one.stop - one.start for one in lossy.spans) >= 1_000_000_000
