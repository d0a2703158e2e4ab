"""After a power cut, the disk holds what was synced to it."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from whole_bags import whole_messages

from symbid_ros.bags import BagWriter, recover
from symbid_ros.messages.types import IMU

PAYLOADS = [np.random.default_rng(n).bytes(320) for n in range(300)]


@contextmanager
def mounted(image: Path, folder: Path) -> Iterator[Path]:
    folder.mkdir()
    subprocess.run(["mount", "-o", "loop", image, folder], check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@dataclass
class Disk:
    """A file system in a file, which holds what the kernel has sent to the device."""

    image: Path
    folder: Path

    @contextmanager
    def after_power_cut(self) -> Iterator[Path]:
        """Give the file system as it is found after the next start."""
        copy = self.image.with_name("cut.img")
        shutil.copyfile(self.image, copy)
        with mounted(copy, self.image.with_name("cut")) as folder:
            yield folder


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    image = tmp_path / "disk.img"
    with image.open("wb") as stream:
        stream.truncate(1 << 24)
    try:
        subprocess.run(["mkfs.ext4", "-q", "-F", image], check=True, capture_output=True)
        with mounted(image, tmp_path / "disk") as folder:
            yield Disk(image, folder)
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("this user may not mount")


def write(bag: BagWriter) -> None:
    imu = bag.add_topic("/imu", IMU)
    for number, payload in enumerate(PAYLOADS):
        bag.write(imu, number, payload)


def test_synced_data_are_on_the_disk(disk: Disk) -> None:
    """Both in the current file and in the previous one, which a split has finished."""
    bag = BagWriter(disk.folder / "runs" / "log", split_size=60_000)
    write(bag)
    bag.flush()
    images = {
        file.name: file.read_bytes() for file in sorted((disk.folder / "runs" / "log").iterdir())
    }
    assert list(images) == ["log_0.mcap", "log_1.mcap"]
    bag.sync()
    with disk.after_power_cut() as folder:
        for name, image in images.items():
            assert (folder / "runs" / "log" / name).read_bytes() == image
    bag.discard()


def test_closed_bag_is_on_the_disk(disk: Disk) -> None:
    with BagWriter(disk.folder / "log") as bag:
        write(bag)
    with disk.after_power_cut() as folder:
        assert [payload for _, _, payload in whole_messages(folder / "log")] == PAYLOADS


def test_recovered_bag_is_on_the_disk(disk: Disk, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "log") as bag:
        write(bag)
    recover(tmp_path / "log", disk.folder / "log")
    with disk.after_power_cut() as folder:
        assert recover(folder / "log", tmp_path / "again").kept == len(PAYLOADS)
        assert (folder / "log" / "metadata.yaml").read_bytes() == (
            disk.folder / "log" / "metadata.yaml"
        ).read_bytes()
