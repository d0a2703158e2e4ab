"""A full disk leaves a complete bag of all messages written before."""

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from mcap.reader import make_reader
from small_disks import small_disk
from whole_bags import whole_messages

from symbid_ros.bags import BagWriter
from symbid_ros.bags.writing.mcap_writer import McapWriter
from symbid_ros.messages.types import IMU

PAYLOADS = [np.random.default_rng(0).bytes(320) for _ in range(64)]


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk") as folder:
        yield folder


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit the size of this process's files; the kernel then also shortens a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def write_until_full(bag: BagWriter) -> list[tuple[str, int, bytes]]:
    """Write until it fails; return the accepted messages."""
    accepted: list[tuple[str, int, bytes]] = []
    with raises_code("E219", r"(No space left|File too large)"):
        write_into(bag, accepted)
    return accepted


def write_into(bag: BagWriter, accepted: list[tuple[str, int, bytes]]) -> None:
    channels = {name: bag.add_topic(name, IMU) for name in ("/left", "/right")}
    for number in range(100_000):
        topic = ("/left", "/right")[number % 2]
        payload = PAYLOADS[number % 64][: 200 + number % 100]
        bag.write(channels[topic], number, payload)
        accepted.append((topic, number, payload))
        if number % 50 == 0:
            bag.flush()


@pytest.mark.parametrize("limits", [{}, {"split_size": 300_000}, {"split_size": 20_000}], ids=str)
def test_full_disk_leaves_a_complete_bag(disk: Path, limits: dict[str, int]) -> None:
    bag = BagWriter(disk / "log", **limits)
    accepted = write_until_full(bag)
    bag.close_after_failure()
    found = whole_messages(disk / "log")
    assert found == accepted[: len(found)]
    assert sum(bag.counts.values()) == len(found)
    # Nothing that lay on the disk in whole chunks had to give way to the index.
    assert len(accepted) - len(found) <= 50
    assert {file.suffix for file in (disk / "log").iterdir()} == {".mcap", ".yaml"}


@pytest.mark.parametrize("size", range(100_000, 300_000, 20_011))
def test_file_at_the_size_limit_drops_chunks_for_its_index(tmp_path: Path, size: int) -> None:
    with largest_file(size):
        bag = BagWriter(tmp_path / "log", chunk_size=4096)
        accepted = write_until_full(bag)
        bag.close_after_failure()
    found = whole_messages(tmp_path / "log")
    assert found == accepted[: len(found)]
    assert len(found) > 0.7 * len(accepted)
    assert list(bag.counts.values()) == [-(-len(found) // 2), len(found) // 2]


def test_messages_after_a_failed_write_are_rejected(tmp_path: Path) -> None:
    with largest_file(100_000):
        bag = BagWriter(tmp_path / "log")
        write_until_full(bag)
    for refused in (
        lambda: bag.write(1, 0, b"late"),
        bag.flush,
        bag.close,
        lambda: bag.add_topic("/late", IMU),
    ):
        with raises_code("E219", "an earlier write failed"):
            refused()
    assert not (tmp_path / "log" / "metadata.yaml").exists()


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("operation", "place"),
    [
        (lambda bag: bag.add_topic("/late", IMU), "_reserve.extend"),
        (lambda bag: bag.write(1, 0, b"payload"), "_current.mcap.add_message"),
        (lambda bag: bag.flush(), "_reserve.extend"),
        (lambda bag: bag.sync(), "_current.sync"),
        (lambda bag: bag.close(), "_current.finish"),
    ],
)
def test_each_operation_names_the_disks_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, operation, place: str
) -> None:
    bag = BagWriter(tmp_path / "log")
    assert bag.add_topic("/imu", IMU) == 1
    *path, name = place.split(".")
    with monkeypatch.context() as patched:
        patched.setattr(reduce(getattr, path, bag), name, full)
        with raises_code("E219", "log_0.mcap: cannot write: No space left on device"):
            operation(bag)
    # Nothing is accepted afterwards, although the disk has space again.
    with raises_code("E219", "an earlier write failed"):
        bag.flush()
    monkeypatch.setattr(bag._current, "finish_after_failure", full)
    with raises_code("E219", "cannot complete the bag: No space left on device"):
        bag.close_after_failure()
    bag.discard()
    assert not (tmp_path / "log").exists()


def test_failed_creation_leaves_a_full_disk_unchanged(disk: Path) -> None:
    room = os.statvfs(disk)
    (disk / "other").write_bytes(bytes(room.f_bavail * room.f_frsize - 20_000))
    with raises_code("E219", "No space left on device"):
        BagWriter(disk / "log")
    assert [file.name for file in disk.iterdir()] == ["other"]


def test_space_for_the_index_is_reserved_and_released(disk: Path) -> None:
    before = os.statvfs(disk).f_bfree
    bag = BagWriter(disk / "log")
    channel = bag.add_topic("/imu", IMU)
    bag.write(channel, 0, PAYLOADS[0])
    bag.flush()
    block = os.statvfs(disk).f_frsize
    held = (before - os.statvfs(disk).f_bfree) * block
    bag.close()
    used = (before - os.statvfs(disk).f_bfree) * block
    assert held > 60_000 > used


def test_the_reserve_covers_the_names_of_many_topics(disk: Path) -> None:
    """Each name is written three times at the end: in the index, metadata.yaml and its record."""
    before = os.statvfs(disk)
    bag = BagWriter(disk / "log")
    for number in range(100):
        bag.add_topic(f"/{'long_name' * 100}_{number}", IMU)
    bag.flush()
    held = (before.f_bfree - os.statvfs(disk).f_bfree) * before.f_frsize
    bag.close()
    used = (before.f_bfree - os.statvfs(disk).f_bfree) * before.f_frsize
    assert held > used


class Dribble(BytesIO):
    """A stream that accepts 100 bytes at a time, as the kernel may."""

    def write(self, data: bytes) -> int:
        return super().write(data[:100])


def test_partial_writes_are_continued() -> None:
    stream = Dribble()
    writer = McapWriter(stream, 1000)
    channel = writer.add_channel("/imu", writer.add_schema(IMU, b"text"), {})
    for number, payload in enumerate(PAYLOADS):
        writer.add_message(channel, number, number, payload)
    writer.finish()
    assert len(stream.getvalue()) == writer.size
    stream.seek(0)
    messages = make_reader(stream, validate_crcs=True).iter_messages()
    assert [message.data for _, _, message in messages] == PAYLOADS
