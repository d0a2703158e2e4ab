"""Bags of real robots and other tools are read correctly, or rejected with a one-line error."""

import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from bag_editing import topic_counts
from expected_errors import raises_code
from foreign_bags import STORE, imu, joint_state, joints_only, wrench, write_rosbags
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from symbid_ros.bags import Recording, bag_info, read_streams, recover
from symbid_ros.bags.slices import iterate_slices
from symbid_ros.errors import BagError, DataError
from symbid_ros.messages.limits import MIB
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

COUNT = 50
VALUES = list(range(1, COUNT + 1))
# As Galactic to Iron wrote it, by number; Jazzy writes words.
NUMERIC_QOS = """- history: 1
  depth: 7
  reliability: 2
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false"""


def state(n: int) -> bytes:
    return joint_state(n, ["hip"], [n], [n], [n])


def positions(bag: Path) -> list[float]:
    return read_streams([bag]).joints.position[:, 0].tolist()


def refusal(bag: Path) -> str:
    with pytest.raises((BagError, DataError)) as caught:
        read_streams([bag])
    assert "\n" not in str(caught.value)
    return str(caught.value)


def run_as_told(command: str) -> None:
    """Run a command that an error message suggests."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    subprocess.run(["sh", "-c", command], check=True, env={**os.environ, "PATH": path})


def plain_file(file: Path, count: int = COUNT, **changes: Any) -> Path:
    """Write an MCAP file of joint states with the mcap package."""
    text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
    schema = {"name": JOINT_STATE, "encoding": "ros2msg", "data": text, **changes}
    encoding = schema.pop("message_encoding", "cdr")
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(schema.pop("profile", "ros2"))
        channel = writer.register_channel(
            "/joint_states", encoding, writer.register_schema(**schema)
        )
        for n in range(1, count + 1):
            writer.add_message(channel, n, state(n), n)
        writer.finish()
    return file


def sqlite_tables(database: sqlite3.Connection, version: int) -> None:
    """Create the tables of rosbag2's schema versions, from Dashing (1) to Jazzy (4)."""
    qos = ", offered_qos_profiles TEXT NOT NULL" if version >= 2 else ""
    type_hash = ", type_description_hash TEXT NOT NULL" if version >= 4 else ""
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
        f"serialization_format TEXT NOT NULL{qos}{type_hash})"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
        "timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
    )
    database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    if version >= 3:
        database.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        database.execute("INSERT INTO schema VALUES(?, 'humble')", (version,))
    if version >= 4:
        database.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
            "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
        )


def sqlite_file(file: Path, version: int = 3, definition: tuple[str, str] | None = None) -> Path:
    file.parent.mkdir(exist_ok=True)
    with sqlite3.connect(file) as database:
        sqlite_tables(database, version)
        row = [1, "/joint_states", JOINT_STATE, "cdr", NUMERIC_QOS, ""]
        row = row[: {1: 4, 2: 5, 3: 5, 4: 6}[version]]
        database.execute(f"INSERT INTO topics VALUES({', '.join('?' * len(row))})", row)
        if definition is not None:
            database.execute(
                "INSERT INTO message_definitions VALUES(1, ?, ?, ?, '')",
                (JOINT_STATE, *definition),
            )
        for n in VALUES:
            database.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (n, n, state(n)))
    database.close()
    return file


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_sqlite_of_every_version(tmp_path: Path, version: int) -> None:
    file = sqlite_file(tmp_path / "log.db3", version)
    assert positions(file) == VALUES
    info = bag_info(file)
    assert (info.count, info.start, info.end, info.is_finished) == (COUNT, 1, COUNT, True)
    assert info.duration == pytest.approx(1e-9 * (COUNT - 1))
    (topic,) = info.topics
    assert [(one.depth, one.reliability) for one in topic.qos] == (
        [(7, "best_effort")] if version >= 2 else []
    )


def test_sqlite_definitions_are_checked(tmp_path: Path) -> None:
    """A recorder may lack a definition; a different one is rejected."""
    unknown = sqlite_file(tmp_path / "unknown.db3", 4, ("unknown", ""))
    assert positions(unknown) == VALUES
    other = sqlite_file(tmp_path / "other.db3", 4, ("ros2msg", "float64 x"))
    assert f"/joint_states ({JOINT_STATE} of another definition)" in refusal(other)


def test_sqlite_is_replayed_in_order_of_time(tmp_path: Path) -> None:
    """Rows overtake each other by up to ten rows, also between ranges that are read together."""
    file = sqlite_file(tmp_path / "log.db3")
    order = [n ^ 7 for n in range(1000)]
    large = bytes(10_000)
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM messages")
        database.execute("DROP INDEX timestamp_idx")
        for n in order:
            row = (3 * n, 1000 + n, n.to_bytes(4, "big") + large)
            database.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", row)
    database.close()
    recording = Recording.of([file])
    assert (recording.start, recording.end) == (1000, 1999)
    assert recording.topics["/joint_states"].msgtype == JOINT_STATE
    assert recording.topics["/joint_states"].qos[0].depth == 7
    played = list(recording.messages({"/joint_states"}, 1100, 1900))
    assert [message.log_time for message in played] == list(range(1100, 1900))
    assert all(
        message.payload[:4] == (message.log_time - 1000).to_bytes(4, "big") for message in played
    )


def test_sqlite_and_mcap_files_are_replayed_together(tmp_path: Path) -> None:
    sqlite, mcap = sqlite_file(tmp_path / "log.db3"), plain_file(tmp_path / "log.mcap")
    recording = Recording.of([sqlite, mcap])
    played = recording.messages({"/joint_states"}, 0, COUNT + 1)
    assert [message.payload for message in played] == [state(n) for n in VALUES for _ in range(2)]


def test_journal_of_an_interrupted_sqlite_recording_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = sqlite_file(tmp_path / "log.db3")
    with sqlite3.connect(source) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        database.execute("INSERT INTO messages VALUES(?, 1, ?, ?)", (99, 99, state(99)))
        database.commit()
        killed = tmp_path / "killed"
        killed.mkdir()
        for name in ("log.db3", "log.db3-wal"):
            shutil.copy(tmp_path / name, killed)
    database.close()
    before = {path.name: path.read_bytes() for path in killed.iterdir()}
    assert positions(killed) == [*VALUES, 99]
    assert "log.db3: the recording was interrupted" in caplog.text
    assert not bag_info(killed).is_finished
    assert {path.name: path.read_bytes() for path in killed.iterdir()} == before


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE messages SET topic_id = 7 WHERE id = 9",
        "UPDATE messages SET data = 'text' WHERE id = 9",
        "UPDATE topics SET type = x'00'",
        "UPDATE messages SET topic_id = 'one'",
        "DROP TABLE messages",
        "ALTER TABLE topics RENAME COLUMN type TO kind",
        "DROP TABLE messages; CREATE VIEW messages AS SELECT 1 AS topic_id, 1 AS data",
    ],
)
def test_invalid_sqlite_tables_are_rejected(tmp_path: Path, statement: str) -> None:
    file = sqlite_file(tmp_path / "log.db3")
    with sqlite3.connect(file) as database:
        database.executescript(statement)
    database.close()
    assert "log.db3: damaged SQLite file: " in refusal(file)


@pytest.mark.parametrize("name", ["Läufe 1", "50%20", "a#b", "what?"])
def test_unusual_file_names_work(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    sqlite_file(folder / f"{name}.db3")
    assert positions(folder) == VALUES
    mcap = plain_file(tmp_path / f"{name}.mcap")
    assert positions(mcap) == VALUES
    mcap.write_bytes(mcap.read_bytes()[:-100])
    command = refusal(mcap).rsplit("`", 2)[1]
    # What the line tells a user to type is one argument to a shell.
    told = subprocess.run(
        ["sh", "-c", command.replace("symbid bag recover", "echo")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout == f"{mcap}\n"


def listing(bag: Path, *names: str) -> None:
    """Change the files listed in metadata.yaml."""
    file = bag / "metadata.yaml"
    content = yaml.safe_load(file.read_text())
    content["rosbag2_bagfile_information"]["relative_file_paths"] = list(names)
    file.write_text(yaml.safe_dump(content))


def test_metadata_outdated_by_renaming(tmp_path: Path) -> None:
    bag = joints_only(tmp_path / "log", *map(state, VALUES))
    (file,) = bag.glob("*.mcap")
    for listed in (f"old_folder/{file.name}", f"/home/robot/bags/{file.name}", "renamed_0.mcap"):
        listing(bag, listed)
        assert positions(bag) == VALUES
    listing(bag, file.name, "log_1.mcap")
    assert "log_1.mcap: no such file, though" in refusal(bag)
    (bag / "metadata.yaml").unlink()
    assert positions(bag) == VALUES


def test_empty_last_file_of_a_crash_does_not_hide_the_others(tmp_path: Path) -> None:
    bag = tmp_path / "log"
    bag.mkdir()
    plain_file(bag / "log_0.mcap")
    (bag / "._log_0.mcap").write_bytes(b"a note of a file manager")
    assert positions(bag) == VALUES
    (bag / "log_1.mcap").write_bytes(b"")
    assert "log_1.mcap: empty; record it again, or give the other files" in refusal(bag)
    info = bag_info(bag)
    assert info.count == COUNT
    assert [file.fault[:5] for file in info.files] == ["", "empty"]
    recovery = recover(bag)
    assert recovery.kept == COUNT
    assert not recovery.is_whole
    assert [(hole.file, hole.fault) for hole in recovery.holes] == [("log_1.mcap", "empty")]
    assert positions(recovery.out) == VALUES


def test_folder_of_bags_is_rejected_with_their_names(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        joints_only(tmp_path / name, state(1))
    assert "a folder of several bags; give monday, tuesday" in refusal(tmp_path)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_messages_that_were_compressed_one_by_one(tmp_path: Path, storage: StoragePlugin) -> None:
    writer = RosbagsWriter(tmp_path / "log", version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        joints = writer.add_connection("/joint_states", JOINT_STATE, typestore=STORE)
        sensor = writer.add_connection("/imu", IMU, typestore=STORE)
        for n in VALUES:
            writer.write(joints, n, state(n))
            writer.write(sensor, n, imu(n, (n, 0.0, 0.0)))
    assert positions(tmp_path / "log") == VALUES
    rates = read_streams([tmp_path / "log"]).imus[0].angular_velocity[:, 0]
    assert rates.tolist() == VALUES
    if storage is not StoragePlugin.MCAP:
        return
    recording = Recording.of([tmp_path / "log"])
    played = recording.messages({"/joint_states"}, 0, COUNT + 1)
    assert [message.payload for message in played] == [state(n) for n in VALUES]
    with AnyReader([recover(tmp_path / "log").out]) as reader:
        saved = [bytes(raw) for link, _, raw in reader.messages() if link.topic == "/joint_states"]
    assert saved == [state(n) for n in VALUES]


def test_messages_that_decompress_beyond_the_limit_are_rejected(tmp_path: Path) -> None:
    for name, frames in {
        "one": [zstandard.compress(bytes(64 * MIB))],
        "unknown-size": [zstandard.ZstdCompressor(write_content_size=False).compress(bytes(MIB))],
        "together": [zstandard.compress(state(1) + bytes(200_000))] * 1000,
        "cut": [zstandard.compress(state(1))[:-5]],
    }.items():
        assert "/joint_states: message " in refusal(joints_only(tmp_path / name, *frames))


def test_files_compressed_as_a_whole(tmp_path: Path) -> None:
    writer = RosbagsWriter(tmp_path / "log", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=STORE)
        for n in VALUES:
            writer.write(connection, n, state(n))
    (packed,) = (tmp_path / "log").glob("*.zstd")
    for job in (read_streams, lambda bags: bag_info(*bags), lambda bags: recover(*bags)):
        with raises_code("E204", rf"`zstd -d {packed}`"):
            job([tmp_path / "log"])
    # What the line says helps, whether or not the packed file is kept.
    packed.with_suffix("").write_bytes(zstandard.decompress(packed.read_bytes(), 10 * MIB))
    assert positions(tmp_path / "log") == VALUES
    packed.unlink()
    assert positions(tmp_path / "log") == VALUES


def test_error_names_the_actual_file_format(tmp_path: Path) -> None:
    image = plain_file(tmp_path / "log.mcap").read_bytes()
    for name, content, line in (
        ("log.mcap.zst", zstandard.compress(image), "decompress it with `zstd -d "),
        ("log.mcap.lz4", lz4.frame.compress(image), "decompress it with `lz4 -d "),
        ("empty.mcap", b"", "empty; record it again"),
        ("db.mcap", sqlite_file(tmp_path / "x.db3").read_bytes(), "rename it to end in .db3"),
        ("log.db3", image, "an MCAP file; rename it to end in .mcap"),
        ("page.mcap", b"<html>404</html>", "not an MCAP file; give a bag"),
    ):
        file = tmp_path / name
        file.write_bytes(content)
        assert line in refusal(file)
        with pytest.raises(BagError):
            bag_info(file)
        with pytest.raises(BagError):
            recover(file)


def test_ros_1_bag_is_read_after_the_suggested_conversion(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    file = tmp_path / "a run.bag"
    with Rosbag1Writer(file) as writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for n in VALUES:
            time = store.types["builtin_interfaces/msg/Time"](sec=n, nanosec=0)
            message = store.types[JOINT_STATE](
                header=store.types["std_msgs/msg/Header"](seq=n, stamp=time, frame_id=""),
                name=["hip"],
                position=np.array([float(n)]),
                velocity=np.zeros(1),
                effort=np.zeros(1),
            )
            writer.write(connection, n, store.serialize_ros1(message, JOINT_STATE))
    run_as_told(refusal(file).split("`")[1])
    assert positions(tmp_path / "a run") == VALUES


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"message_encoding": "ros1", "encoding": "ros1msg"}, "convert its messages"),
        ({"message_encoding": "json", "encoding": "jsonschema"}, "encoded as json"),
        ({"message_encoding": "protobuf", "encoding": "protobuf"}, "encoded as protobuf"),
        ({"profile": "ros1"}, "a ROS 1 recording; convert the .bag that it was made from"),
    ],
)
def test_errors_name_unsupported_encodings(
    tmp_path: Path, changes: dict[str, str], line: str
) -> None:
    file = plain_file(tmp_path / "log.mcap", **changes)
    assert line in refusal(file)
    assert bag_info(file).count == COUNT
    recovery = recover(file)
    assert (recovery.kept, recovery.is_whole) == (COUNT, True)


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "sensor_msgs/JointState"},
        {"data": b""},
        {"encoding": "ros2idl", "data": b"module sensor_msgs {};"},
        {"data": STORE.generate_msgdef(JOINT_STATE)[0].replace("\n", "\r\n").encode()},
        {"profile": ""},
    ],
    ids=["short-name", "no-definition", "idl", "windows", "no-profile"],
)
def test_equivalent_type_definitions_are_accepted(tmp_path: Path, changes: dict[str, Any]) -> None:
    assert positions(plain_file(tmp_path / "log.mcap", **changes)) == VALUES


@pytest.mark.parametrize("header", [b"\0\2", b"\0\3", b"\0\7", b"\0\x09", b"\0\x0b"])
def test_errors_name_unsupported_encapsulations(tmp_path: Path, header: bytes) -> None:
    bag = joints_only(tmp_path / "log", header + state(1)[2:])
    assert f"its encapsulation 0x{header.hex()} is not plain CDR" in refusal(bag)


def test_large_and_small_chunks_are_decompressed_correctly(tmp_path: Path) -> None:
    """Large and small chunks are decompressed at the same time by different threads."""
    file = tmp_path / "log.mcap"
    cloud = np.random.default_rng(0).bytes(12 * MIB)
    text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
    count = 20_000
    with file.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=512 * 1024)
        writer.start("ros2")
        states = writer.register_schema(JOINT_STATE, "ros2msg", text)
        joints = writer.register_channel("/joint_states", "cdr", states)
        clouds = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"")
        points = writer.register_channel("/points", "cdr", clouds)
        for n in range(1, count + 1):
            writer.add_message(joints, n, state(n), n)
            if n % 5000 == 0:
                writer.add_message(points, n, cloud, n)
        writer.finish()
    for _ in range(3):
        assert positions(file) == list(range(1, count + 1))
    assert topic_counts(file) == {"/joint_states": count, "/points": count // 5000}


def test_arm_and_gripper_on_one_topic(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Two drivers publish different joints with equal stamps, the gripper's first."""
    payloads = [joint_state(1, ["finger"], [0.5], [0.0], [0.0])]
    for n in VALUES:
        payloads.append(joint_state(n, ["hip", "knee"], [n, -n], [0.0] * 2, [0.0] * 2))
        if n % 5 == 0:
            payloads.append(joint_state(n, ["finger"], [0.5], [0.0], [0.0]))
    streams = read_streams([joints_only(tmp_path / "log", *payloads)])
    assert streams.joints.names == ("hip", "knee")
    assert streams.joints.stamp.tolist() == VALUES
    assert streams.joints.position.tolist() == [[n, -n] for n in VALUES]
    assert "11 of 61 messages name only other joints" in caplog.text
    assert "repeat a stamp" not in caplog.text
    assert np.isfinite(streams.joints.position).all()


def test_vendor_types_do_not_affect_reading(tmp_path: Path) -> None:
    """Three hundred topics with unparsable definitions, and the events of a service."""
    file = tmp_path / "log.mcap"
    text = STORE.generate_msgdef(JOINT_STATE, ros_version=2)[0].encode()
    with file.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2")
        for number in range(300):
            schema = writer.register_schema(
                f"vendor_msgs/msg/T{number}", "ros2msg", b"vendor_msgs/Missing[<=3] x = ?\xff"
            )
            channel = writer.register_channel(f"/vendor/t{number}", "cdr", schema)
            writer.add_message(channel, 1, bytes(7), 1)
        events = writer.register_schema("std_srvs/srv/Trigger_Event", "ros2idl", b"")
        service = writer.register_channel("/arm/_service_event", "cdr", events)
        writer.add_message(service, 1, bytes(7), 1)
        states = writer.register_schema(JOINT_STATE, "ros2msg", text)
        joints = writer.register_channel("/joint_states", "cdr", states)
        for n in VALUES:
            writer.add_message(joints, n, state(n), n)
        writer.finish()
    assert positions(file) == VALUES
    assert len(bag_info(file).topics) == 302
    recovery = recover(file)
    assert (recovery.kept, recovery.is_whole) == (COUNT + 301, True)
    assert topic_counts(recovery.out) == topic_counts(file)


def test_sensors_on_different_clocks_are_reported(tmp_path: Path) -> None:
    """Joint states have simulated time, the other sensors wall time."""
    wall = 1_700_000_000_000_000_000
    messages = []
    for n in VALUES:
        messages.append(("/joint_states", JOINT_STATE, state(n * 1_000_000)))
        messages.append(("/imu", IMU, imu(wall + n * 1_000_000)))
        messages.append(("/foot/wrench", WRENCH, wrench(wall + n * 1_000_000, (0.0, 0.0, 1.0))))
    bag = write_rosbags(tmp_path / "log", messages)
    # As one piece both are whole; piece by piece, as a long log is read, they are seen apart.
    (piece,) = iterate_slices([bag], span=10_000_000_000)
    assert piece.streams is None
    assert "/imu, /foot/wrench was silent" in piece.fault
    assert "stamped by another clock; record it again" in piece.fault
