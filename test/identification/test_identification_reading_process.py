"""A log read by a process of its own against the same log read by the test's process."""

import inspect
import logging
import multiprocessing
import os
import signal
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from bag_editing import Messages, edit_bag

from symbid_ros.bags import bag_log
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import BagError, DataError
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.identification.rows.reading_process import (
    can_read_in_process,
    read_in_process,
    reading_processes,
)
from symbid_ros.identification.rows.segment_store import SegmentStore
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.progress import report, reported_to
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.weak_form import BLOCK

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux")


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def gappy(simulated, tmp_path_factory) -> Path:
    """Return a bag whose IMU is silent for 400 ms."""

    def silenced(messages: Messages) -> None:
        heard = ~messages.between(4.0, 4.4)
        messages.order, messages.log_time = messages.order[heard], messages.log_time[heard]

    bag = simulated("smooth", moves=3, motion_seed=21, noise_seed=5)
    return edit_bag(bag, tmp_path_factory.mktemp("gappy") / "bag", {"/imu/data": silenced})


@pytest.fixture(scope="module")
def segments(model, gappy) -> list[Segment]:
    return list(AlignedLog(bag_log([gappy], model), model, span=BLOCK, warns=False))


def assert_equal(found: Segment, expected: Segment) -> None:
    for one in fields(Segment):
        values = getattr(expected, one.name)
        np.testing.assert_array_equal(getattr(found, one.name), values, err_msg=one.name)


@pytest.fixture(autouse=True)
def _no_process_is_left():
    yield
    assert multiprocessing.active_children() == []


def test_segments_checks_warnings_and_progress_are_the_same(model, gappy, caplog) -> None:
    def read(*, in_process: bool) -> tuple[list, list, list, list, StreamChecks]:
        checks, steps = StreamChecks(model), []
        log = AlignedLog(
            bag_log([gappy], model), model, span=BLOCK, checks=checks, in_process=in_process
        )
        caplog.clear()
        with reported_to(lambda *step: steps.append(step)):
            first = list(log)
        return first, list(log), list(caplog.messages), steps, checks

    first, again, told, steps, checks = read(in_process=True)
    expected, _, expected_told, expected_steps, expected_checks = read(in_process=False)
    for found in (first, again):
        assert len(found) == len(expected) > 2
        for one, other in zip(found, expected, strict=True):
            assert_equal(one, other)
    assert told == expected_told
    assert "400 of" in told[0]
    assert steps == expected_steps
    assert len(steps) > 2
    assert checks.findings("bag") == expected_checks.findings("bag")
    assert checks.spans == expected_checks.spans


def test_an_identification_reads_in_a_process_and_finds_the_same(model, gappy, caplog) -> None:
    log = bag_log([gappy], model)
    alone = load_problem(model, log, IdentifyOptions(jobs=1))
    with reading_processes():
        together = load_problem(model, log, IdentifyOptions(jobs=2))
    readers = [one.process for one in caplog.records if "lie in gaps" in one.getMessage()]
    assert len(set(readers)) == 2
    assert readers[0] == os.getpid()
    assert together.checks == alone.checks
    for found, expected in zip(
        together.dataset.observations, alone.dataset.observations, strict=True
    ):
        np.testing.assert_array_equal(found.rows.factor, expected.rows.factor)
        np.testing.assert_array_equal(found.noise.factor, expected.noise.factor)
        assert found.seconds == expected.seconds


def test_an_error_comes_after_what_was_read(segments) -> None:
    def failing():
        yield segments[0]
        raise DataError("no wrench", "E520")

    items = read_in_process("bag", failing(), SegmentStore(0), None)
    assert_equal(next(items), segments[0])
    with pytest.raises(DataError, match="no wrench") as raised:
        next(items)
    assert raised.value.code == "E520"
    assert "in failing" in "".join(raised.value.__notes__)


def test_a_process_that_is_killed_is_named(segments) -> None:
    def dying():
        yield segments[0]
        os.kill(os.getpid(), signal.SIGKILL)

    items = read_in_process("a bag", dying(), SegmentStore(0), None)
    next(items)
    with pytest.raises(BagError, match="a bag: the process that reads it was killed") as raised:
        next(items)
    assert raised.value.code == "E235"


def test_a_process_that_is_killed_within_a_message_is_named(
    segments, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    large = max(segments, key=len)
    assert large.nbytes > 1 << 20
    items = read_in_process("a bag", iter([large, large]), SegmentStore(0), None)
    next(items)
    (process,) = multiprocessing.active_children()
    # The second segment has begun to arrive, and is larger than the pipe.
    inspect.getgeneratorlocals(items)["receiving"].poll(None)
    process.kill()
    process.join()
    with pytest.raises(BagError, match="a bag: the process that reads it was killed"):
        next(items)


def test_the_process_ends_with_its_reader(segments) -> None:
    def endless():
        while True:
            yield segments[0]

    items = read_in_process("bag", endless(), SegmentStore(0), None)
    next(items)
    assert len(multiprocessing.active_children()) == 1
    items.close()


def test_ctrl_c_ends_the_process_through_its_reader(segments) -> None:
    def interrupted():
        os.kill(os.getpid(), signal.SIGINT)  # as a terminal does to both
        yield from segments

    items = read_in_process("bag", interrupted(), SegmentStore(0), None)
    assert_equal(next(items), segments[0])
    with pytest.raises(KeyboardInterrupt):
        items.throw(KeyboardInterrupt)


def test_without_room_for_a_file_segments_are_sent(
    segments, tmp_path: Path, monkeypatch, caplog
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    store = SegmentStore(0)
    with caplog.at_level(logging.INFO):
        found = list(read_in_process("bag", iter(segments), store, None))
    for one, expected in zip(found, segments, strict=True):
        assert_equal(one, expected)
    assert not store.is_complete
    assert caplog.text.count("is read again") == 1


def test_messages_keep_their_logger_and_level(segments, caplog) -> None:
    def telling():
        logging.getLogger("symbid_ros.signals.alignment").info("%d of %s", 3, "them")
        report("reading", 0.5)
        yield segments[0]

    with caplog.at_level(logging.INFO):
        list(read_in_process("bag", telling(), SegmentStore(0), None))
    (record,) = caplog.records
    assert (record.name, record.levelname) == ("symbid_ros.signals.alignment", "INFO")
    assert record.getMessage() == "3 of them"


def test_only_a_command_reads_in_a_process() -> None:
    assert not can_read_in_process()
    with reading_processes():
        assert can_read_in_process()
