"""Bags in several files."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from whole_bags import whole_messages

from symbid_ros.bags import BagWriter
from symbid_ros.messages.types import IMU, WRENCH

MILLISECOND = 10**6


def write_noise(bag: BagWriter, count: int) -> list[tuple[str, int, bytes]]:
    """Write messages that do not compress, of two topics, one of them announced late."""
    draw = np.random.default_rng(1)
    imu = bag.add_topic("/imu", IMU)
    written = []
    plate = 0
    for number in range(count):
        if number == count // 2:
            plate = bag.add_topic("/plate", WRENCH)
        is_plate = plate and number % 3 == 0
        topic, channel = ("/plate", plate) if is_plate else ("/imu", imu)
        written.append((topic, number * MILLISECOND, draw.bytes(300)))
        bag.write(channel, written[-1][1], written[-1][2])
    return written


@pytest.mark.parametrize(
    "limits", [{"split_size": 100_000}, {"split_duration": 77 * MILLISECOND}], ids=str
)
def test_no_message_is_lost_at_a_split(tmp_path: Path, limits: dict[str, int]) -> None:
    with BagWriter(tmp_path / "log", chunk_size=4096, **limits) as bag:
        written = write_noise(bag, 2000)
    assert whole_messages(tmp_path / "log") == written
    assert bag.files == tuple(f"log_{number}.mcap" for number in range(len(bag.files)))
    assert len(bag.files) > 5


def test_files_stay_near_the_requested_size(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log", chunk_size=4096, split_size=100_000) as bag:
        write_noise(bag, 2000)
    *full, last = [(tmp_path / "log" / name).stat().st_size for name in bag.files]
    # One chunk and the summary follow the message that fills a file.
    assert all(100_000 <= size < 120_000 for size in full)
    assert last < 120_000
    assert bag.size == sum([*full, last])


def test_files_stay_within_the_requested_duration(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log", split_duration=77 * MILLISECOND) as bag:
        write_noise(bag, 1000)
    content = yaml.safe_load((tmp_path / "log" / "metadata.yaml").read_text())
    files = content["rosbag2_bagfile_information"]["files"]
    starts = [file["starting_time"]["nanoseconds_since_epoch"] for file in files]
    assert starts == list(range(0, 1000 * MILLISECOND, 77 * MILLISECOND))
    assert {file["duration"]["nanoseconds"] for file in files[:-1]} == {76 * MILLISECOND}


def test_each_file_can_be_read_alone(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log", split_size=100_000) as bag:
        written = write_noise(bag, 1000)
    last = tmp_path / "log" / bag.files[-1]
    with last.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert {channel.topic for channel in summary.channels.values()} == {"/imu", "/plate"}
    assert {schema.name for schema in summary.schemas.values()} == {IMU, WRENCH}
    with AnyReader([last]) as reader:
        alone = [(c.topic, time, raw) for c, time, raw in reader.messages()]
    assert alone == written[-len(alone) :]


def test_first_record_of_a_file_describes_the_previous_files(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log", split_size=100_000) as bag:
        write_noise(bag, 1000)
    with (tmp_path / "log" / bag.files[1]).open("rb") as stream:
        opening, closing = (
            yaml.safe_load(record.metadata["serialized_metadata"])
            for record in make_reader(stream).iter_metadata()
        )
    assert opening["relative_file_paths"] == closing["relative_file_paths"] == list(bag.files[:2])
    assert opening["files"][0] == closing["files"][0]
    assert opening["files"][1]["message_count"] == 0 < closing["files"][1]["message_count"]


def test_the_end_and_the_counts_are_those_of_all_files(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log", split_duration=10) as bag:
        assert (bag.end, bag.counts) == (0, {})
        channel = bag.add_topic("/imu", IMU)
        for time in (5, 30, 12, 14):
            bag.write(channel, time, b"payload")
        bag.flush()
        # Times go back within a file; a file begins ten nanoseconds after the first of the last.
        assert (bag.end, bag.counts, len(bag.files)) == (30, {"/imu": 4}, 2)
    bag.close()
    assert [time for _, time, _ in whole_messages(tmp_path / "log")] == [5, 30, 12, 14]
