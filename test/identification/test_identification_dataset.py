"""A log read slice by slice equals the log read at once."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from analytic_log import analytic_segment
from bag_editing import Messages, edit_bag
from random_robots import random_robot

from symbid_ros.bags import bag_log
from symbid_ros.errors import BagError, DataError
from symbid_ros.identification.rows import dataset
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.signals.alignment import align
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.streams import TimeRange
from symbid_ros.signals.weak_form import BLOCK

ALL = TopicSelection()
KEPT = (2**30, 2_000_000, 0)  # bytes in memory: all, some, none of a log


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated("smooth", moves=3, motion_seed=21, noise_seed=5)


def joined(segments) -> dict[str, np.ndarray]:
    parts = list(segments)
    return {
        entry.name: np.concatenate([getattr(part, entry.name) for part in parts])
        for entry in fields(Segment)
        if isinstance(getattr(parts[0], entry.name), np.ndarray)
    }


def assert_equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_joined_slices_equal_the_log_read_at_once(model, bag: Path) -> None:
    (whole,) = align(bag_log([bag], model).streams(), model)
    sliced = AlignedLog(bag_log([bag], model), model, span=BLOCK)
    parts = list(sliced)
    assert len(parts) == whole.stamp[-1] // BLOCK - whole.stamp[0] // BLOCK + 1
    assert {part.stamp[0] // BLOCK for part in parts} == {p.stamp[-1] // BLOCK for p in parts}
    assert_equal(joined(parts), joined([whole]))
    (again,) = sliced.contiguous_segments()
    assert_equal(joined([again]), joined([whole]))


def test_a_log_is_read_once_and_kept_in_memory_or_in_a_file(model, bag: Path, tmp_path) -> None:
    link = tmp_path / "bag"
    link.symlink_to(bag)
    logs = [AlignedLog(bag_log([link], model), model, span=BLOCK, most_kept=most) for most in KEPT]
    (whole,) = align(bag_log([bag], model).streams(), model)
    for log in logs:
        assert_equal(joined(log), joined([whole]))
    link.unlink()
    for log in logs:
        again = list(log)
        assert_equal(joined(again), joined([whole]))
        assert again[0].frames == whole.frames
        assert all(one.effort.flags.writeable for one in again)
    assert next(iter(logs[-1])).stamp[0] == whole.stamp[0]


def test_segments_without_wrenches_are_kept_in_a_file() -> None:
    arm = random_robot(3, links=4, floating=False, wrench_frames=0)
    exact = analytic_segment(ParameterSet(arm), 9.0, 3, rate=103.0)
    log = Log.from_arrays(arm, time=exact.stamp, position=exact.position, effort=exact.effort)
    in_file = AlignedLog(log, arm, span=BLOCK, most_kept=0)
    assert_equal(joined(in_file), joined(in_file))
    assert joined(in_file)["wrenches"].shape[1:] == (0, 6)


def test_without_room_for_a_file_a_log_is_read_again(
    model, bag: Path, tmp_path: Path, monkeypatch, caplog
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    link = tmp_path / "bag"
    link.symlink_to(bag)
    log = AlignedLog(bag_log([link], model), model, most_kept=0)
    with caplog.at_level("INFO"):
        first = joined(log)
    assert "is read again" in caplog.text
    assert_equal(joined(log), first)
    link.unlink()
    with pytest.raises(BagError, match="no such bag"):
        list(log)


def test_start_and_stop_select_a_part(model, bag: Path) -> None:
    (whole,) = align(bag_log([bag], model).streams(), model)
    begin = int(whole.stamp[0])
    parts = AlignedLog(bag_log([bag], model, ALL, TimeRange(1.5, 6.25)), model, span=BLOCK)
    inside = (whole.stamp >= begin + 1_500_000_000) & (whole.stamp < begin + 6_250_000_000)
    np.testing.assert_array_equal(joined(parts)["effort"], whole.effort[inside])
    with pytest.raises(DataError, match="`start`"):
        list(AlignedLog(bag_log([bag], model, ALL, TimeRange(1e5)), model))
    with pytest.raises(DataError, match="start 2 s and stop 1 s are invalid"):
        TimeRange(2, 1)


def test_instants_in_a_gap_are_counted_once(model, bag: Path, tmp_path: Path, caplog) -> None:
    def silenced(messages: Messages) -> None:
        heard = ~messages.between(4.0, 4.4)
        messages.order, messages.log_time = messages.order[heard], messages.log_time[heard]

    gappy = edit_bag(bag, tmp_path / "gappy", {"/imu/data": silenced})
    (whole,) = align(bag_log([bag], model).streams(), model)
    log = AlignedLog(bag_log([gappy], model), model, span=BLOCK, most_kept=0)
    left = joined(log)["stamp"]
    after = (whole.stamp - whole.stamp[0]) * 1e-9
    np.testing.assert_array_equal(left, whole.stamp[(after < 4.0) | (after >= 4.4)])
    joined(log)
    told = [one for one in caplog.messages if "lie in gaps" in one]
    assert told == [f"{gappy}: 400 of {len(whole)} instants lie in gaps and are left out"]


def test_a_slice_that_is_left_out_is_named_by_its_time(model, bag: Path, tmp_path, caplog) -> None:
    def silenced(messages: Messages) -> None:
        heard = ~messages.between(1.0, 11.0)
        messages.order, messages.log_time = messages.order[heard], messages.log_time[heard]

    silent = edit_bag(bag, tmp_path / "silent", {"/imu/data": silenced})
    whole = joined(AlignedLog(bag_log([bag], model), model))["stamp"]
    left = joined(AlignedLog(bag_log([silent], model), model, span=BLOCK, most_kept=0))["stamp"]
    (told,) = [one for one in caplog.messages if "left out: " in one]
    start, stop = map(float, re.search(r"left out: ([\d.]+) to ([\d.]+) s after", told).groups())
    inside = ((whole - whole[0]) * 1e-9 > start + 0.1) & ((whole - whole[0]) * 1e-9 < stop - 0.1)
    assert inside.any()
    assert not np.isin(left, whole[inside]).any()
    assert 1.0 < start < stop < 11.0


def test_probes_of_a_long_log_are_thinned(model, bag: Path, monkeypatch) -> None:
    segments = list(AlignedLog(bag_log([bag], model), model, span=BLOCK))
    every = dataset.Probes(model)
    assert list(every.watch(segments)) == segments
    monkeypatch.setattr(dataset, "MOST_PROBES", 100)
    few = dataset.Probes(model)
    list(few.watch(segments))
    all_stamps, stamps = (
        np.concatenate([one.stamp for one in probes.parts]) for probes in (every, few)
    )
    assert len(all_stamps) > 200
    assert 50 < len(stamps) <= 100
    assert set(stamps) <= set(all_stamps)
    steps = np.diff(stamps)
    assert steps.max() <= 2 * np.median(steps)
    assert stamps[-1] >= all_stamps[-1] - np.median(steps)
