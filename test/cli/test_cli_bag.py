"""``symbid bag info`` and ``symbid bag recover`` as a user runs them."""

import json
import os
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import pytest
from bag_editing import topic_counts
from foreign_bags import STORE, imu, joint_state
from json_schemas import require_valid
from rosbags.rosbag2 import Writer as RosbagsWriter

from symbid_ros.bags import BagWriter
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.messages.types import IMU, JOINT_STATE
from symbid_ros.package_paths import config_file

STEPS = 100
START = 1_700_000_000_000_000_000


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    latched = OfferedQos(depth=1, durability="transient_local")
    with BagWriter(tmp_path / "log", chunk_size=1000) as writer:
        joints = writer.add_topic("/robot/joint_states", JOINT_STATE)
        sensor = writer.add_topic("/robot/imu/data", IMU, [latched])
        for n in range(STEPS):
            time = START + n * 10_000_000
            writer.write(joints, time, joint_state(time, ["hip"], [n], [n], [n]))
            if n % 2:
                writer.write(sensor, time, imu(time))
    return tmp_path / "log"


def cut(bag: Path, share: float) -> Path:
    file = bag / "log_0.mcap"
    image = file.read_bytes()
    file.write_bytes(image[: int(share * len(image))])
    return file


def test_info_lists_files_and_topics(symbid_here, bag) -> None:
    told = json.loads(symbid_here("bag", "info", bag, "--json").stdout)
    require_valid("bag_info", told)
    assert told["count"] == STEPS * 3 // 2
    assert (told["start_ns"], told["end_ns"]) == (START, START + 990_000_000)
    assert told["duration_s"] == pytest.approx(0.99)
    assert told["ros_distro"] == "jazzy"
    assert told["is_finished"] is True
    (file,) = told["files"]
    assert file["name"] == "log_0.mcap"
    assert file["size_bytes"] == told["size_bytes"] == (bag / "log_0.mcap").stat().st_size
    assert (file["storage"], file["compression"]) == ("mcap", ["zstd"])
    assert file["recorded_by"] == "symbid_ros"
    assert file["is_indexed"]
    sensor, joints = told["topics"]
    assert (sensor["name"], sensor["msgtype"], sensor["count"]) == ("/robot/imu/data", IMU, 50)
    assert sensor["qos"][0]["durability"] == "transient_local"
    assert joints["rate_hz"] == pytest.approx(100 / 0.99)
    assert {topic["name"]: topic["count"] for topic in told["topics"]} == topic_counts(bag)


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_tables_fit_the_terminal_and_lose_nothing(symbid_here, bag, columns) -> None:
    told = symbid_here("bag", "info", bag, columns=columns)
    saved = symbid_here("bag", "recover", bag, "--out", bag.with_name("saved"), columns=columns)
    for ended in (told, saved):
        assert ended.returncode == 0, ended.stderr
        lines = ended.stdout.splitlines()
        head = next(line for line in lines if line.split()[:2] == ["topic", "type"])
        below = lines[lines.index(head) :]
        rows = list(takewhile(lambda line: "messages kept" not in line, below))
        assert all(len(line) <= columns for line in rows)
        middle = head.index("type")
        names = "".join(row[:middle].strip() for row in rows)
        types = "".join(row[middle:].split()[0] for row in rows if row[middle:].strip())
        assert "/robot/joint_states" in names
        assert "sensor_msgs/JointState" in types
        assert "…" not in ended.stdout


def test_in_a_pipe_each_topic_has_a_line(bag) -> None:
    told = subprocess.run(
        [Path(sys.executable).parent / "symbid", "bag", "info", bag],
        capture_output=True,
        text=True,
        check=True,
        env={name: value for name, value in os.environ.items() if name != "COLUMNS"},
    )
    lines = [line.split() for line in told.stdout.splitlines()]
    assert ["/robot/joint_states", "sensor_msgs/JointState"] in [line[:2] for line in lines]


@pytest.mark.parametrize("columns", [60, 70, 80, 100])
def test_names_break_at_slashes_only(symbid_here, bag, columns) -> None:
    shown = symbid_here("bag", "info", bag, columns=columns).stdout
    words = set(shown.split())
    assert {"sensor_msgs/JointState"} <= words or {"sensor_msgs/", "JointState"} <= words
    assert {"/robot/joint_states"} <= words or {"/robot/", "joint_states"} <= words


def test_info_of_an_interrupted_bag_points_to_recover(symbid_here, bag) -> None:
    """The new bag has all files of a folder, of which the last one is unfinished."""
    file = cut(bag, 0.5)
    for named in (bag, file):
        told = symbid_here("bag", "info", named)
        assert told.returncode == 0
        assert "not finished, not indexed" in told.stdout
        assert f"run `symbid bag recover {named}`" in told.stdout


def test_info_of_an_sqlite_bag(symbid_here, tmp_path) -> None:
    with RosbagsWriter(tmp_path / "old", version=9) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=STORE)
        for n in range(5):
            writer.write(connection, START + n * 10**9, imu(START + n * 10**9))
    told = json.loads(symbid_here("bag", "info", tmp_path / "old", "--json").stdout)
    assert told["files"][0]["storage"] == "sqlite3"
    assert told["topics"][0]["count"] == 5
    assert (told["start_ns"], told["end_ns"]) == (START, START + 4 * 10**9)
    saved = symbid_here("bag", "recover", tmp_path / "old")
    assert saved.returncode == 0
    assert "5 messages kept, 0 lost" in saved.stdout
    assert topic_counts(tmp_path / "old_recovered") == {"/imu": 5}


def test_exit_status_of_recover_shows_whether_data_were_lost(symbid_here, bag) -> None:
    whole = symbid_here("bag", "recover", bag)
    assert whole.returncode == 0
    assert "150 messages kept, 0 lost" in whole.stdout
    assert whole.stdout.endswith(f"wrote {bag}_recovered\n")
    again = symbid_here("bag", "recover", bag)
    assert again.returncode == 2
    assert "log_recovered: exists already" in again.stderr
    file = cut(bag, 0.5)
    image = file.read_bytes()
    part = symbid_here("bag", "recover", bag, "--out", bag.with_name("part"), "--json")
    assert part.returncode == 1
    told = json.loads(part.stdout)
    require_valid("bag_recovery", told)
    assert told["kept"] + told["lost"] == 150
    assert told["is_counted"]
    assert told["holes"][-1]["fault"] == "cut off"
    assert topic_counts(bag.with_name("part")) == {
        topic["name"]: topic["kept"] for topic in told["topics"]
    }
    assert file.read_bytes() == image
    cut(bag, 0.05)
    nothing = symbid_here("bag", "recover", bag, "--out", bag.with_name("nothing"))
    assert nothing.returncode == 2
    assert "nothing in it can be recovered" in nothing.stderr
    assert not bag.with_name("nothing").exists()


@pytest.mark.parametrize("command", ["info", "recover"])
def test_a_missing_bag_is_a_one_line_error(symbid_here, tmp_path, command) -> None:
    ended = symbid_here("bag", command, tmp_path / "nowhere")
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "nowhere: no such bag" in ended.stderr


def test_a_usage_error_names_the_help(symbid_here) -> None:
    ended = symbid_here("bag", "recover")
    assert ended.returncode == 2
    assert "see `symbid bag recover --help`" in ended.stderr


def test_a_bag_at_a_url_needs_a_cluster(symbid_here, bag) -> None:
    command = ("identify", f"file://{bag}", "--model", config_file("symbitron.urdf"))
    ended = symbid_here(*command, "--out", bag.parent / "out")
    assert ended.returncode == 2
    assert "bags at URLs need --dask" in ended.stderr
    assert "E501" in ended.stderr
