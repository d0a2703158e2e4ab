"""Message types that are not part of ROS 2 Jazzy."""

from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from symbid_ros.bags import BagWriter
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition

GOALS = "nav_msgs/msg/Goals"  # installed, and younger than rosbags' list


def store_with(msgtype: str, text: str):
    store = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(text, msgtype)
    store.register({name: each for name, each in types.items() if name not in store.fielddefs})
    return store


def test_definition_of_an_installed_type_includes_its_parts() -> None:
    assert GOALS not in get_typestore(Stores.ROS2_JAZZY).fielddefs
    definition = find_definition(GOALS)
    parts = [line[5:] for line in definition.text.splitlines() if line.startswith("MSG: ")]
    assert sorted(parts) == [
        "builtin_interfaces/Time",
        "geometry_msgs/Point",
        "geometry_msgs/Pose",
        "geometry_msgs/PoseStamped",
        "geometry_msgs/Quaternion",
        "std_msgs/Header",
    ]
    assert definition.text.count("=" * 80 + "\nMSG: ") == len(parts)
    assert definition.type_hash == store_with(GOALS, definition.text).hash_rihs01(GOALS)


def test_other_readers_decode_an_installed_type(tmp_path: Path) -> None:
    store = store_with(GOALS, find_definition(GOALS).text)
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    message = types[GOALS](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="map"), goals=[]
    )
    with BagWriter(tmp_path / "log") as bag:
        topic = bag.add_topic("/goals", GOALS)
        bag.write(topic, 5, bytes(store.serialize_cdr(message, GOALS)))
    with AnyReader([tmp_path / "log"]) as reader:
        ((connection, _, raw),) = reader.messages()
        read = reader.deserialize(raw, connection.msgtype)
    assert (read.header.frame_id, read.header.stamp.sec) == ("map", 1)
    assert connection.digest == store.hash_rihs01(GOALS)


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "share" / "toy_msgs" / "msg"
    folder.mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    return folder


def test_types_of_a_sourced_workspace_are_found(workspace: Path) -> None:
    (workspace / "Pair.msg").write_text("Half[2] halves  # equal\nHalf[<=3] more\nstring name\n")
    (workspace / "Half.msg").write_text("geometry_msgs/Point point\nint32 MOST=3\n")
    definition = find_definition("toy_msgs/msg/Pair")
    store = store_with("toy_msgs/msg/Pair", definition.text)
    assert definition.type_hash == ""
    assert [name for name, _ in store.fielddefs["toy_msgs/msg/Pair"][1]] == [
        "halves",
        "more",
        "name",
    ]
    assert [name for name, _ in store.fielddefs["toy_msgs/msg/Half"][1]] == ["point"]


def test_types_that_contain_each_other_terminate(workspace: Path) -> None:
    (workspace / "Egg.msg").write_text("Hen[] hens\n")
    (workspace / "Hen.msg").write_text("Egg[] eggs\n")
    assert "MSG: toy_msgs/Hen" in find_definition("toy_msgs/msg/Egg").text


def test_errors_name_types_without_definition(workspace: Path) -> None:
    (workspace / "Odd.msg").write_text("Missing part\n")
    (workspace / "Bad.msg").write_text("int32[ broken\n")
    for msgtype, words in (
        ("toy_msgs/msg/Odd", "toy_msgs/msg/Missing: neither part of ROS 2 Jazzy nor installed"),
        ("toy_msgs/msg/Bad", "toy_msgs/msg/Bad: its definition cannot be read"),
        ("toy_msgs/srv/Ask_Request", "toy_msgs/srv/Ask_Request: neither"),
    ):
        with pytest.raises(BagError, match=words):
            find_definition(msgtype)
