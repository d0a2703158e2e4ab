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

from symbid_ros.share import config_file
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

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
    def run(*arguments: object, columns: int = 100) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [Path(sys.executable).parent / "symbid", *map(str, arguments)],
            capture_output=True,
            text=True,
            check=False,
            timeout=300,
            env={**os.environ, "COLUMNS": str(columns)},
        )

    return run


@pytest.fixture(scope="session")
def model() -> Path:
    return config_file("symbitron.xml")


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "log"
    record(Simulator("smooth", moves=3, motion_seed=21, noise_seed=5), bag)
    return bag


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a log just long enough to be identified."""
    bag = tmp_path_factory.mktemp("bags") / "short"
    record(Simulator("smooth", moves=1, motion_seed=21, noise_seed=5), bag)
    return bag


@pytest.fixture(scope="session")
def ideal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "ideal"
    record(Simulator("smooth", moves=3, motion_seed=22, ideal=True), bag)
    return bag
