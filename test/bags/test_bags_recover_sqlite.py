"""Recovery of intact, interrupted and damaged SQLite bags."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import joint_state
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from test_bags_foreign import NUMERIC_QOS, sqlite_tables

from symbid_ros.bags import read_streams, recover
from symbid_ros.errors import BagError
from symbid_ros.messages.types import JOINT_STATE

COUNT = 400
PAGE = 4096


def payload(n: int) -> bytes:
    draw = np.random.default_rng(n).standard_normal
    return joint_state(n, ["hip"], draw(1), draw(1), draw(1))


def write(file: Path, version: int = 3) -> Path:
    """Joint states, each followed by a text of a type that is not installed."""
    with sqlite3.connect(file) as database:
        sqlite_tables(database, version)
        end = [""] if version == 4 else []
        for row in (
            [1, "/joint_states", JOINT_STATE, "cdr", NUMERIC_QOS, *end],
            [2, "/vendor", "vendor_msgs/msg/Secret", "cdr", "", *end],
        ):
            database.execute(f"INSERT INTO topics VALUES({', '.join('?' * len(row))})", row)
        for n in range(1, COUNT + 1):
            rows = [(2 * n - 1, 1, n, payload(n)), (2 * n, 2, n, b"secret")]
            database.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows)
    database.close()
    return file


def message_pages(image: bytes) -> list[int]:
    """Offsets of the leaf pages of messages: table leaves with more than a few cells."""
    return [
        offset
        for offset in range(PAGE, len(image), PAGE)
        if image[offset] == 0x0D and int.from_bytes(image[offset + 3 : offset + 5], "big") > 10
    ]


@pytest.mark.parametrize("version", [3, 4])
def test_intact_file_becomes_an_mcap_bag(tmp_path: Path, version: int) -> None:
    file = write(tmp_path / "log.db3", version)
    before = file.read_bytes()
    recovery = recover(file)
    assert recovery.is_whole
    assert {topic.name: (topic.kept, topic.lost) for topic in recovery.topics} == {
        "/joint_states": (COUNT, 0),
        "/vendor": (COUNT, 0),
    }
    assert file.read_bytes() == before
    with (recovery.out / "log_recovered_0.mcap").open("rb") as stream:
        found = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]
    assert sorted(found) == sorted(
        [("/joint_states", n, payload(n)) for n in range(1, COUNT + 1)]
        + [("/vendor", n, b"secret") for n in range(1, COUNT + 1)]
    )
    with AnyReader([recovery.out]) as reader:
        (joints, _) = sorted(reader.connections, key=lambda link: link.topic)
        assert joints.msgtype == JOINT_STATE
        assert joints.ext.offered_qos_profiles[0].depth == 7
        (_, _, raw) = next(reader.messages([joints]))
        assert reader.deserialize(raw, JOINT_STATE).name == ["hip"]


def test_interrupted_recording_is_recovered_with_its_journal(tmp_path: Path) -> None:
    source = write(tmp_path / "log.db3")
    killed = tmp_path / "killed"
    killed.mkdir()
    with sqlite3.connect(source) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        database.execute("INSERT INTO messages VALUES(9999, 1, 9999, ?)", (payload(9999),))
        database.commit()
        for name in ("log.db3", "log.db3-wal"):
            shutil.copy(tmp_path / name, killed)
    database.close()
    recovery = recover(killed)
    assert recovery.kept == 2 * COUNT + 1
    assert read_streams([recovery.out]).joints.stamp[-1] == 9999


def test_damaged_pages_cost_only_their_rows(tmp_path: Path) -> None:
    file = write(tmp_path / "log.db3")
    image = bytearray(file.read_bytes())
    pages = message_pages(image)
    assert len(pages) > 8
    for page in (pages[2], pages[3], pages[6]):
        image[page : page + PAGE] = bytes(PAGE)
    file.write_bytes(image)
    with raises_code("E206", "`symbid bag recover"):
        read_streams([file])
    recovery = recover(file)
    assert not recovery.is_whole
    assert recovery.is_counted
    first, second = recovery.holes
    assert recovery.kept + first.messages + second.messages == 2 * COUNT
    assert recovery.lost == first.messages + second.messages
    assert second.messages < first.messages < recovery.kept / 2
    joints = read_streams([recovery.out]).joints
    kept = [
        n for n in range(1, COUNT + 1) if not any(h.after < n < h.before for h in recovery.holes)
    ]
    assert set(joints.stamp.tolist()) <= set(kept)
    # The two topics of one time may be on two pages.
    assert len(kept) - len(joints.stamp) <= 4


@pytest.mark.parametrize("share", [0.6, 0.9])
def test_truncated_file_keeps_its_first_rows(tmp_path: Path, share: float) -> None:
    file = write(tmp_path / "log.db3")
    image = file.read_bytes()
    file.write_bytes(image[: int(share * len(image))])
    recovery = recover(file)
    assert not recovery.is_counted
    joints = read_streams([recovery.out]).joints.stamp.tolist()
    assert joints == list(range(1, len(joints) + 1))
    assert len(joints) > 0.5 * share * COUNT


def test_invalid_rows_are_dropped(tmp_path: Path) -> None:
    file = write(tmp_path / "log.db3")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET data = 'text' WHERE id = 9")
        database.execute("UPDATE messages SET topic_id = 7 WHERE id = 20")
        database.execute("UPDATE messages SET timestamp = 'noon' WHERE id = 800")
    database.close()
    recovery = recover(file)
    assert (recovery.kept, recovery.is_whole) == (2 * COUNT - 3, False)
    assert [hole.fault.split(":")[0] for hole in recovery.holes] == [
        "rows 9 to 9",
        "rows 20 to 20",
        "rows 800 to the last",
    ]


@pytest.mark.parametrize("size", [0, 90, PAGE])
def test_file_without_readable_tables_is_rejected(tmp_path: Path, size: int) -> None:
    file = write(tmp_path / "log.db3")
    image = bytearray(file.read_bytes())
    image[:size] = bytes(size)
    file.write_bytes(image if size else b"")
    with pytest.raises(BagError) as caught:
        recover(file)
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["log.db3"]


def test_random_damage_costs_only_messages(tmp_path: Path) -> None:
    image = write(tmp_path / "log.db3").read_bytes()
    good = {payload(n) for n in range(1, COUNT + 1)}
    draw = np.random.default_rng(0)
    recovered = 0
    for number in range(40):
        damaged = bytearray(image)
        for _ in range(int(draw.integers(1, 20))):
            place = int(draw.integers(100, len(image)))
            damaged[place] = int(draw.integers(0, 256))
        file = tmp_path / f"{number}.db3"
        file.write_bytes(damaged)
        try:
            recovery = recover(file, tmp_path / f"out{number}")
        except BagError:
            continue
        recovered += 1
        with (recovery.out / f"out{number}_0.mcap").open("rb") as stream:
            found = [m.data for _, _, m in make_reader(stream).iter_messages(["/joint_states"])]
        assert len(good.intersection(found)) > 0.5 * COUNT or not recovery.is_whole
    assert recovered > 30
