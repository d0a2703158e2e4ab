"""A list of recordings is identified as one log, and the pauses between them are not gaps."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from expected_errors import raises_code

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.signals.joined_log import joined
from symbid_ros.signals.segments import MINUTE, SECOND

SECONDS, PAUSE, DAY = 14.0, 900.0, 1.7e9


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


def recordings(robot, starts):
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    return [
        log_of(robot, truth, seed=seed, seconds=SECONDS, start=start)
        for seed, start in enumerate(starts)
    ]


@pytest.mark.parametrize("starts", [(0.0, 0.0), (DAY, DAY + PAUSE)])
def test_rows_of_all_recordings_count_and_pauses_are_no_gaps(robot, starts) -> None:
    logs = recordings(robot, starts)
    assert sy.diagnose(robot, logs).findings == ()
    both = sy.identify(robot, logs, no_holdout=True)
    single = [sy.identify(robot, one, no_holdout=True) for one in logs]
    for whole, *parts in zip(
        *(one.information.observations for one in (both, *single)), strict=True
    ):
        np.testing.assert_array_equal(whole.counts, sum(one.counts for one in parts))
        np.testing.assert_allclose(
            whole.rows.target_squares, sum(one.rows.target_squares for one in parts), rtol=1e-9
        )
    assert not both.alarms
    assert sy.validate(single[0], logs).percent_after < 0.1


def test_recordings_of_one_array_are_named_as_the_cause_of_a_gap(robot) -> None:
    joints = [one.streams().joints for one in recordings(robot, (DAY, DAY + PAUSE))]
    time, position, effort = (
        np.concatenate([getattr(one, name) for one in joints])
        for name in ("stamp", "position", "effort")
    )
    log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    (finding,) = sy.diagnose(robot, log).findings
    assert finding.kind is Kind.GAP
    assert "as several bags or logs" in finding.message


def test_stamps_of_all_topics_move_by_whole_minutes_behind_the_recording_before(robot) -> None:
    first, _ = recordings(robot, (0.0, 0.0))
    joints = first.streams().joints
    driving = (joints.stamp > 2 * SECOND) & (joints.stamp < 3 * SECOND)
    second = sy.Log.from_arrays(
        robot,
        time=joints.stamp,
        position=joints.position,
        effort=joints.effort,
        driving=driving,
        imus={robot.link_names[0]: np.zeros((len(joints.stamp), 6))},
    )
    before, after = joined([first, second]).slices()
    assert (before.recording, after.recording) == (0, 1)
    streams = after.streams
    moved = streams.joints.stamp - joints.stamp
    assert set(moved) == {MINUTE}
    np.testing.assert_array_equal(streams.imus[0].stamp, streams.joints.stamp)
    np.testing.assert_array_equal(after.stamps["joints"], streams.joints.stamp)
    assert (after.start, after.stop) == (streams.joints.stamp[0], streams.joints.stamp[-1] + 1)
    ((begin, end),) = second.streams().driving
    assert streams.driving == ((begin + MINUTE, end + MINUTE),)


def test_what_is_no_sequence_of_logs_in_the_order_of_time_is_refused(robot) -> None:
    logs = recordings(robot, (DAY, DAY + PAUSE))
    with raises_code("E530", "in the order of time"):
        sy.identify(robot, logs[::-1])
    with raises_code("E530", "given twice"):
        sy.identify(robot, [logs[0], logs[0]])
    with raises_code("E510", "no log is given"):
        sy.identify(robot, [])
    with raises_code("E511", "log must be a Log"):
        sy.diagnose(robot, [logs[0], "bag"])
