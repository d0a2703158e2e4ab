"""Logs of arrays are cut and aligned like a bag with the same measurements."""

import pickle
import re
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from random_robots import random_robot

from symbid_ros.bags import bag_log, read_streams
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.signals.alignment import align_checked
from symbid_ros.signals.defects import Defect
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import TimeRange

SPAN = 1_000_000_000


@pytest.fixture(scope="module")
def bag(simulated):
    return simulated("smooth", moves=1, motion_seed=3, noise_seed=4)


@pytest.fixture(scope="module")
def robot():
    return load_model(config_file("symbitron.urdf"))


@pytest.fixture(scope="module")
def arm_model():
    model = random_robot(3, 8, floating=False)
    return replace(model, joints=tuple(replace(one, effort=50.0) for one in model.joints))


def test_a_time_range_is_the_whole_recording_by_default() -> None:
    assert TimeRange() == TimeRange(0.0, np.inf)


@pytest.mark.parametrize("part", [TimeRange(), TimeRange(0.75, 3.25)])
@pytest.mark.parametrize("span", [None, SPAN])
def test_streams_in_memory_are_cut_like_a_bag(bag, part, span) -> None:
    cut = list(Log.from_streams(read_streams([bag]), part).slices(span))
    read = list(bag_log([bag], part=part).slices(span))
    assert len(cut) == len(read) > 0
    for one, other in zip(cut, read, strict=True):
        inside = [
            slice(*np.searchsorted(s.stamp, [one.start, one.stop]))
            for s in (one.streams.joints, other.streams.joints)
        ]
        for name in ("stamp", "position", "effort"):
            ours, theirs = (
                getattr(s.joints, name)[i]
                for s, i in zip((one.streams, other.streams), inside, strict=True)
            )
            np.testing.assert_array_equal(ours, theirs)
        assert {t: s.tolist() for t, s in one.stamps.items()} == {
            t: s.tolist() for t, s in other.stamps.items()
        }


def arrays(robot, count=200):
    joints = len(robot.measured_joint_names)
    rng = np.random.default_rng(1)
    return {
        "time": 1.7e9 + np.arange(count) / 100,
        "position": rng.normal(size=(count, joints)),
        "effort": rng.normal(size=(count, joints)),
        "imus": {"imu_link": rng.normal(size=(count, 6))},
        "wrenches": {"left_sole": rng.normal(size=(count, 6))},
    }


def test_arrays_become_streams_in_the_models_order(robot) -> None:
    given = arrays(robot)
    given["imus"]["imu_link"][3, 2] = np.nan
    streams = Log.from_arrays(robot, **given).streams()
    np.testing.assert_array_equal(streams.joints.position, given["position"])
    assert streams.joints.names == robot.measured_joint_names
    np.testing.assert_array_equal(streams.wrenches[0].force, given["wrenches"]["left_sole"][:, :3])
    (imu,) = streams.imus
    assert len(imu.stamp) == 199  # the row with NaN is left out
    np.testing.assert_array_equal(
        imu.linear_acceleration[2:4], given["imus"]["imu_link"][[2, 4], 3:]
    )


def test_a_message_with_a_spike_leaves_no_gap(robot) -> None:
    given = arrays(robot, 400)
    given["effort"][150, 3] = 1e6
    given["wrenches"]["left_sole"][170, 1] = -1e6
    (piece,) = Log.from_arrays(robot, **given).slices(warn=False)
    streams = piece.streams
    for stream in (streams.joints, *streams.wrenches):
        assert len(stream.stamp) == 399
        assert len(piece.stamps[stream.topic]) == 400
    counts = {one.topic: one for one in piece.tallies if one.counts}
    assert set(counts) == {"joints", "wrenches['left_sole']"}
    assert f"effort of {robot.measured_joint_names[3]}" in counts["joints"].description(
        Defect.SPIKE
    )


@pytest.mark.parametrize("unit", [1_000, 1_000_000])
def test_integer_instants_in_milliseconds_or_microseconds_are_refused(robot, unit) -> None:
    given = arrays(robot)
    whole = np.rint((given["time"] - given["time"][0]) * unit).astype(int)
    with raises_code("E518", f"median step.*{unit // 100} ns.*give seconds"):
        Log.from_arrays(robot, **(given | {"time": whole}))


def test_integer_instants_are_nanoseconds_and_sorted(robot) -> None:
    given = arrays(robot, 60)
    order = np.random.default_rng(2).permutation(60)
    stamp = 10_000_000 * order
    streams = Log.from_arrays(robot, **(given | {"time": stamp})).streams()
    np.testing.assert_array_equal(streams.joints.stamp, np.sort(stamp))
    np.testing.assert_array_equal(streams.joints.position, given["position"][np.argsort(order)])


@pytest.mark.parametrize(
    ("change", "error", "named"),
    [
        ({"position": np.zeros((200, 2))}, DataError, "position"),
        ({"effort": np.zeros(200)}, DataError, "effort"),
        ({"time": np.full(200, np.nan)}, DataError, "time"),
        ({"time": np.zeros((2, 2))}, DataError, "time"),
        ({"time": np.zeros(200)}, DataError, "time"),
        ({"imus": {"nowhere": np.zeros((200, 6))}}, ModelError, "nowhere"),
        ({"wrenches": {"left_sole": np.zeros((200, 3))}}, DataError, "left_sole"),
        ({"imus": np.zeros((200, 6))}, DataError, "imus is a ndarray; give a mapping from frames"),
        ({"touches": np.zeros(200)}, DataError, "touches is a ndarray; give a mapping"),
        ({"position": 0.0}, DataError, "position has shape"),
        ({"effort": [[1.0], [1.0, 2.0]]}, DataError, "effort is not an array of numbers"),
        ({"time": np.ma.masked_less(np.arange(200), 3)}, DataError, "time is masked"),
        (
            {"driving": np.ma.masked_array(np.zeros(200, bool), np.arange(200) == 3)},
            DataError,
            "driving has masked",
        ),
    ],
)
def test_invalid_arrays_are_named(robot, change, error, named) -> None:
    with pytest.raises(error, match=named):
        Log.from_arrays(robot, **(arrays(robot) | change))


def test_masked_readings_are_missing(robot) -> None:
    given = arrays(robot)
    missing = np.random.default_rng(2).random(given["position"].shape) < 0.1
    for name, garbage in (("position", 99.0), ("effort", -999.0)):
        values = np.where(missing, garbage, given[name])
        given[name] = np.ma.masked_array(values, mask=missing)
    joints = Log.from_arrays(robot, **given).streams().joints
    np.testing.assert_array_equal(np.isnan(joints.effort), missing)
    np.testing.assert_array_equal(np.isnan(joints.position), missing)


class Table:
    """Columns by name, as a pandas.DataFrame."""

    def __init__(self, columns, values):
        self.columns, self.values = list(columns), np.asarray(values)

    def __getitem__(self, names):
        places = [self.columns.index(name) for name in names]
        return Table(names, self.values[:, places])

    def __array__(self, dtype=None, copy=None):
        return self.values.astype(dtype)


def test_columns_of_a_table_are_taken_by_their_names(robot) -> None:
    given = arrays(robot)
    names = robot.measured_joint_names
    order = np.random.default_rng(3).permutation(len(names))
    mixed = [names[one] for one in order]
    tables = {name: Table(mixed, given[name][:, order]) for name in ("position", "effort")}
    joints = Log.from_arrays(robot, **(given | tables)).streams().joints
    np.testing.assert_array_equal(joints.position, given["position"])
    np.testing.assert_array_equal(joints.effort, given["effort"])
    numbered = Table(range(len(names)), given["effort"])
    joints = Log.from_arrays(robot, **(given | {"effort": numbered})).streams().joints
    np.testing.assert_array_equal(joints.effort, given["effort"])
    wrong = Table(["elsewhere", *names[1:]], given["effort"])
    with raises_code("E511", f"effort has no column {names[0]}; its columns are elsewhere"):
        Log.from_arrays(robot, **(given | {"effort": wrong}))


@pytest.mark.parametrize("rename", ["{}_pos".format, lambda name: ("q", name)])
def test_a_table_without_any_joints_name_is_not_read_by_position(robot, rename) -> None:
    given, names = arrays(robot), robot.measured_joint_names
    renamed = Table([rename(name) for name in names], given["position"])
    with raises_code("E511", f"position has no column {', '.join(names)}; its columns are"):
        Log.from_arrays(robot, **(given | {"position": renamed}))


class Nullable(Table):
    """Values of pandas of which some are missing, which no float can hold."""

    MISSING = object()

    def isna(self):
        return np.equal(self.values, self.MISSING)

    def astype(self, dtype):
        assert dtype is object
        return self

    def where(self, condition, other):
        return np.where(condition, self.values, other)

    def __getitem__(self, names):
        return Nullable(names, super().__getitem__(names).values)

    def __array__(self, dtype=None, copy=None):
        return self.values if dtype is None else self.values.astype(dtype)


def test_missing_values_of_pandas_are_missing_readings(robot) -> None:
    given, names = arrays(robot), robot.measured_joint_names
    values = given["effort"].astype(object)
    values[7, 2] = Nullable.MISSING
    joints = (
        Log.from_arrays(robot, **(given | {"effort": Nullable(names, values)})).streams().joints
    )
    assert np.argwhere(np.isnan(joints.effort)).tolist() == [[7, 2]]
    np.testing.assert_array_equal(np.delete(joints.effort, 7, 0), np.delete(given["effort"], 7, 0))


@pytest.mark.filterwarnings("error")
def test_instants_with_a_time_zone_are_converted_to_utc(robot) -> None:
    given = arrays(robot)
    start = datetime(2026, 3, 1, 12, tzinfo=timezone(timedelta(hours=2)))
    times = [start + timedelta(milliseconds=10 * row) for row in range(200)]
    stamp = Log.from_arrays(robot, **(given | {"time": times})).streams().joints.stamp
    assert stamp[0] == 1_000_000_000 * round(start.timestamp())
    np.testing.assert_array_equal(stamp - stamp[0], 10_000_000 * np.arange(200))


@pytest.mark.parametrize(
    ("time", "code", "says"),
    [
        ((1.7e9 + np.arange(200) / 100).astype(np.float32), "E518", "float32.*give float64"),
        (np.float64((1.7e9 + np.arange(200) / 100).astype(np.float32)), "E315", "precision"),
        (1e4 * np.arange(200) / 100, "E518", "median step of time is 100.000 s.*give seconds"),
        (np.roll(np.arange(200) / 100, 50), "E314", "row 49; sort the rows"),
        (np.full(200, np.datetime64("NaT", "ns")), "E518", "NaT"),
    ],
)
def test_implausible_times_are_named_by_their_cause(robot, time, code, says) -> None:
    with raises_code(code, says):
        Log.from_arrays(robot, **(arrays(robot) | {"time": time}))


def test_single_precision_suffices_for_times_from_the_start(robot) -> None:
    time = (np.arange(200) / 100).astype(np.float32)
    stamp = Log.from_arrays(robot, **(arrays(robot) | {"time": time})).streams().joints.stamp
    np.testing.assert_allclose(stamp, 10_000_000 * np.arange(200), atol=100)


@pytest.mark.parametrize("ends", [{"start": "2"}, {"stop": None}, {"start": 3.0, "stop": 2.0}])
def test_an_invalid_part_is_refused(robot, ends) -> None:
    with raises_code("E316", "start of at least 0 and a later stop"):
        Log.from_arrays(robot, **arrays(robot), **ends)


def test_errors_about_arrays_do_not_speak_of_topics(robot) -> None:
    """Each names the array, and what to give instead."""
    given = arrays(robot)
    no_imu = given | {"imus": None}
    short = {
        name: one[:40] for name, one in given.items() if name in ("time", "position", "effort")
    }
    for change, code, says in (
        (no_imu, "E307", "imus={FRAME: values}.*poses="),
        (given | {"position": given["position"] * np.nan}, "E304", "rows.*interpolate"),
        (short | {"imus": {"imu_link": np.ones((40, 6))}}, "E303", "joints has 40 rows"),
    ):
        streams = Log.from_arrays(robot, **change).streams()
        with raises_code(code, says) as error:
            align_checked(streams, robot)
        assert not re.search("topic|header|bag|message|driver|publish", str(error.value))


def test_efforts_of_one_joint_in_each_row_are_told_from_no_efforts(arm_model) -> None:
    joints = len(arm_model.measured_joint_names)
    rng = np.random.default_rng(4)
    given = {"time": np.arange(400) / 100, "position": rng.normal(size=(400, joints))}
    effort = rng.normal(size=(400, joints))
    one_each = np.arange(400)[:, None] % joints == np.arange(joints)
    for efforts, says in (
        (np.where(one_each, effort, np.nan), "gaps of more than 5 efforts.*interpolate"),
        (0.0 * effort, "no effort of any joint.*give efforts in Nm"),
    ):
        streams = Log.from_arrays(arm_model, **given, effort=efforts).streams()
        with raises_code("E305", says):
            align_checked(streams, arm_model)


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_instants_may_be_dates_and_durations(robot, unit) -> None:
    given = arrays(robot)
    expected = 10_000_000 * np.arange(200)
    durations = expected.astype("timedelta64[ns]").astype(f"timedelta64[{unit}]")
    dates = np.datetime64("2026-01-01", unit) + durations
    for time in (durations, dates):
        streams = Log.from_arrays(robot, **(given | {"time": time})).streams()
        stamp = streams.joints.stamp
        np.testing.assert_array_equal(stamp - stamp[0], expected)


def test_logs_of_arrays_and_bags_can_be_pickled(robot, bag) -> None:
    for log in (Log.from_arrays(robot, **arrays(robot)), bag_log((bag,), robot), bag_log((bag,))):
        again = pickle.loads(pickle.dumps(log))
        assert again.source == log.source
        found = again.of_robot(robot).streams().joints
        np.testing.assert_array_equal(found.position, log.of_robot(robot).streams().joints.position)


def test_a_sensor_without_readings_is_named(robot) -> None:
    log = Log.from_arrays(robot, **arrays(robot))
    streams = log.streams()
    imu = replace(streams.imus[0], stamp=streams.imus[0].stamp + 10**12)
    (whole,) = Log.from_streams(replace(streams, imus=(imu,))).slices()
    assert whole.streams is None
    assert "imus['imu_link']" in whole.fault


def test_a_log_of_arrays_has_no_other_bags(robot) -> None:
    log = Log.from_arrays(robot, **arrays(robot), name="mine")
    with raises_code("E526", "later.*mine is a log of arrays"):
        log.other((Path("later"),))


@pytest.mark.parametrize(("seconds", "is_valid"), [(4.6e9, True), (4.7e9, False), (-4.7e9, False)])
def test_instants_fit_into_nanoseconds(robot, seconds, is_valid) -> None:
    given = arrays(robot) | {"time": seconds + np.arange(200) / 100}
    if is_valid:
        assert Log.from_arrays(robot, **given).streams().joints.stamp[0] == round(seconds * 1e9)
    else:
        with raises_code("E518", "in seconds"):
            Log.from_arrays(robot, **given)


@pytest.mark.parametrize("span", [None, 700_000_000])
def test_a_part_of_a_log_is_cut_at_its_ends(robot, span) -> None:
    """From the start up to the stop, in seconds after the first instant."""
    first = 1_700_000_000_000_000_000
    given = arrays(robot) | {"time": first + 10_000_000 * np.arange(200)}
    log = Log.from_arrays(robot, **given, start=0.5, stop=1.25)
    pieces = list(log.slices(span))
    assert pieces[0].start == first + 500_000_000
    assert pieces[-1].stop == first + 1_250_000_000
    assert [one.stop for one in pieces[:-1]] == [one.start for one in pieces[1:]]
    assert all(one.stop % 700_000_000 == 0 for one in pieces[:-1])
    counts = [len(one.stamps["joints"]) for one in pieces]
    assert sum(counts) == 75
    for one in pieces:
        stamp = one.streams.joints.stamp
        # Twenty periods more at both ends, as far as the log goes.
        assert stamp[0] - max(first, one.start - 200_000_000) < 10_000_000
        assert min(first + 2_000_000_000, one.stop + 200_000_000) - stamp[-1] <= 10_000_000
        assert one.start - 200_000_000 <= stamp[0]
        assert stamp[-1] < one.stop + 200_000_000


def test_a_warning_about_missing_efforts_fits_arrays(arm_model, caplog) -> None:
    joints = len(arm_model.measured_joint_names)
    values = np.random.default_rng(5).normal(size=(2, 400, joints))
    values[1, :, 2] = np.nan
    given = dict(zip(("position", "effort"), values, strict=True))
    log = Log.from_arrays(arm_model, time=np.arange(400) / 100, **given)
    align_checked(log.streams(), arm_model)
    (warning,) = (one for one in caplog.messages if arm_model.joint_names[2] in one)
    assert warning.endswith("give efforts in Nm (N)")
    finding = next(
        one for one in diagnose(log, arm_model).findings if one.kind is Kind.MISSING_JOINT
    )
    assert "is in no row" in finding.message
    assert "give the effort of every joint in each row, or, of a joint without" in finding.message
