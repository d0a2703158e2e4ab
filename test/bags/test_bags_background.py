"""Writing a bag through a queue: slow disks, full queues, failures."""

import resource
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from expected_errors import raises_code
from mcap.reader import make_reader
from whole_bags import whole_messages

from symbid_ros.bags import BackgroundWriter, BagWriter, QueuedMessage
from symbid_ros.errors import BagError
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.messages.types import IMU, WRENCH

PAYLOAD = np.random.default_rng(0).bytes(320)
DEADLINE = 300.0  # s; only a hang takes as long


class SlowDisk(BagWriter):
    """A bag whose disk responds when told to."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.writes, self.syncs, self.asked = Event(), Event(), Event()

    def flush(self) -> None:
        self.asked.set()
        assert self.writes.wait(DEADLINE)
        super().flush()

    def sync(self) -> None:
        assert self.syncs.wait(DEADLINE)
        super().sync()


def in_background(bag: BagWriter, *, capacity: int = 10**9) -> BackgroundWriter:
    return BackgroundWriter(bag, flush_period=0.01, sync_period=0.05, capacity=capacity)


def messages(topic: int, numbers: range) -> list[QueuedMessage]:
    return [QueuedMessage(topic, number, number + 1, PAYLOAD) for number in numbers]


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come about"
        time.sleep(0.001)


def test_slow_disk_loses_nothing_and_does_not_block(tmp_path: Path) -> None:
    bag = SlowDisk(tmp_path / "log")
    writer = in_background(bag)
    imu = writer.add_topic("/imu", IMU, [OfferedQos()])
    writer.put(messages(imu, range(10)))
    assert bag.asked.wait(DEADLINE)
    for start in range(10, 5000, 10):  # returns, though nothing is written
        writer.put(messages(imu, range(start, start + 10)))
    assert writer.state.queued >= 4990 * len(PAYLOAD)
    bag.writes.set()
    bag.syncs.set()
    writer.close()
    assert [time for _, time, _ in whole_messages(tmp_path / "log")] == list(range(5000))
    assert (writer.lost, writer.state.dropped, writer.state.queued) == ({}, {}, 0)


def test_slow_sync_does_not_block_writing(tmp_path: Path) -> None:
    bag = SlowDisk(tmp_path / "log")
    bag.writes.set()
    writer = in_background(bag)
    imu = writer.add_topic("/imu", IMU, [OfferedQos()])
    writer.put(messages(imu, range(1000)))
    wait_until(lambda: writer.state.messages == 1000)
    age = writer.state.sync_age
    bag.syncs.set()
    wait_until(lambda: writer.state.sync_age < age)
    writer.close()
    assert len(whole_messages(tmp_path / "log")) == 1000


def test_full_queue_drops_from_the_largest_topic_and_counts(tmp_path: Path) -> None:
    bag = SlowDisk(tmp_path / "log")
    writer = in_background(bag, capacity=100 * len(PAYLOAD))
    imu, plate = (
        writer.add_topic(name, kind, [OfferedQos()]) for name, kind in (("/i", IMU), ("/p", WRENCH))
    )
    assert bag.asked.wait(DEADLINE)
    for start in range(0, 300, 10):
        writer.put(
            messages(imu, range(start, start + 9)) + messages(plate, range(start, start + 1))
        )
    assert writer.state.dropped == {"/i": 200}
    bag.writes.set()
    bag.syncs.set()
    writer.close()
    found = whole_messages(tmp_path / "log")
    assert [time for topic, time, _ in found if topic == "/p"] == list(range(0, 300, 10))
    assert writer.lost == {"/i": 200}
    assert writer.failure is None


def test_message_larger_than_the_queue_passes_alone(tmp_path: Path) -> None:
    writer = in_background(BagWriter(tmp_path / "log"), capacity=10)
    writer.put(messages(writer.add_topic("/imu", IMU, [OfferedQos()]), range(1)))
    writer.close()
    assert whole_messages(tmp_path / "log") == [("/imu", 0, PAYLOAD)]


def test_failed_write_ends_the_bag_and_lost_messages_are_counted(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        writer = in_background(BagWriter(tmp_path / "log"))
        imu = writer.add_topic("/imu", IMU, [OfferedQos()])
        payloads = np.random.default_rng(1).bytes(320 * 4000)
        sent = 0
        while writer.failure is None:
            payload = payloads[320 * (sent % 4000) :][:320]
            writer.put([QueuedMessage(imu, sent, sent, payload)])
            sent += 1
        writer.put(messages(imu, range(sent, sent + 7)))
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert isinstance(writer.failure, BagError)
    assert "File too large" in str(writer.failure)
    found = whole_messages(tmp_path / "log")
    assert [time for _, time, _ in found] == list(range(len(found)))
    assert writer.lost == {"/imu": sent + 7 - len(found)}
    assert writer.latest == sent + 6


def test_unknown_type_is_rejected_before_queueing(tmp_path: Path) -> None:
    writer = in_background(BagWriter(tmp_path / "log"))
    with raises_code("E215", "foo_msgs/msg/Bar"):
        writer.add_topic("/x", "foo_msgs/msg/Bar", [OfferedQos()])
    assert writer.add_topic("/imu", IMU, [OfferedQos()]) == 0
    writer.discard()
    assert list(tmp_path.iterdir()) == []


def unlink(bag: Path) -> None:
    (bag / "log_0.mcap").unlink()


def replace(bag: Path) -> None:
    (bag / "copy").write_bytes((bag / "log_0.mcap").read_bytes())
    (bag / "copy").replace(bag / "log_0.mcap")


def move(bag: Path) -> None:
    bag.rename(bag.with_name("elsewhere"))


@pytest.mark.parametrize(
    ("remove", "word"),
    [(unlink, "deleted"), (shutil.rmtree, "deleted"), (replace, "deleted"), (move, "moved")],
)
def test_deleted_or_moved_file_ends_the_recording(
    tmp_path: Path, remove: Callable[[Path], None], word: str
) -> None:
    writer = in_background(BagWriter(tmp_path / "log"))
    imu = writer.add_topic("/imu", IMU, [OfferedQos()])
    writer.put(messages(imu, range(5)))
    wait_until(lambda: writer.state.messages == 5)
    remove(tmp_path / "log")
    wait_until(lambda: writer.failure is not None)
    writer.close()
    assert isinstance(writer.failure, BagError)
    assert f"log_0.mcap: the file or its folder was {word} while" in str(writer.failure)
    assert writer.lost == {"/imu": 5}
    assert not (tmp_path / "log" / "metadata.yaml").exists()
    if remove is move:
        # Where it is now, the file is complete, with the messages if they were flushed before.
        file = tmp_path / "elsewhere" / "log_0.mcap"
        assert sum(1 for _ in make_reader(file.open("rb")).iter_messages()) in (0, 5)


def test_file_deleted_after_a_split_is_named(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "log", split_duration=10)
    imu = bag.add_topic("/imu", IMU)
    for number in range(30):
        bag.write(imu, number, PAYLOAD)
    (tmp_path / "log" / "log_1.mcap").unlink()
    with raises_code("E220", r"log: log_1\.mcap"):
        bag.close()
    assert [time for _, time, _ in whole_messages(tmp_path / "log")] == [
        *range(10),
        *range(20, 30),
    ]
