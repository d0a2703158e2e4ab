"""The command as a user runs it, and bags that several tests read."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from symbid_ros.package_paths import config_file

Command = Callable[..., subprocess.CompletedProcess[str]]


def copy_without(bag: Path, copy: Path, part: str) -> Path:
    """Copy a bag without the topics whose names have this part."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with (
        AnyReader([bag], default_typestore=store) as reader,
        Writer(copy, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        kept = [c for c in reader.connections if part not in c.topic]
        assert len(kept) < len(reader.connections)
        to = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in kept}
        for connection, time, data in reader.messages(kept):
            writer.write(to[connection.id], time, data)
    return copy


@pytest.fixture(scope="session")
def copied_without() -> Callable[[Path, Path, str], Path]:
    return copy_without


@pytest.fixture(scope="session")
def symbid() -> Command:
    """Return what runs the command in a process of its own."""

    def run(*arguments: object, columns: int = 100) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [Path(sys.executable).parent / "symbid", *map(str, arguments)],
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
            env={**os.environ, "COLUMNS": str(columns)},
        )

    return run


@pytest.fixture(scope="session")
def model() -> Path:
    return config_file("symbitron.xml")


@pytest.fixture(scope="session")
def log(simulated: Callable[..., Path]) -> Path:
    return simulated("smooth", moves=3, motion_seed=21, noise_seed=5)


@pytest.fixture(scope="session")
def short(simulated: Callable[..., Path]) -> Path:
    """Return a log just long enough to be identified."""
    return simulated("smooth", moves=1, motion_seed=21, noise_seed=5)


@pytest.fixture(scope="session")
def ideal(simulated: Callable[..., Path]) -> Path:
    return simulated("smooth", moves=1, motion_seed=22, ideal=True)
