"""Read SQLite files, the older storage of rosbag2, in all its versions.

rosbags' reader is not used: it ignores the journal of an interrupted recording, cannot read
damaged files, and does not limit the sizes of messages.
"""

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import apsw
import numpy as np
from mcap.records import Channel, Schema

from symbid_ros.bags.container.blocks import BLOCK_SIZE, MessageBlock
from symbid_ros.bags.container.file_index import (
    EXTENT_SIZE,
    Extent,
    FileIndex,
    StoredMessage,
    list_topics,
)
from symbid_ros.bags.container.mcap_records import (
    MAGIC,
    SQLITE_MAGIC,
    damage_error,
    identify_other_format,
    unreadable_error,
)
from symbid_ros.bags.container.schema_registry import SchemaRegistry
from symbid_ros.errors import BagError
from symbid_ros.messages.limits import MAX_CHANNELS, MAX_CHUNK, check_limit, decompress_message
from symbid_ros.messages.topics import OfferedQos, Topic

logger = logging.getLogger("symbid_ros.bags")

SQLITE_SUFFIX = ".db3"
# Suffixes of the journals that an interrupted recording leaves beside its file.
JOURNALS = ("-wal", "-journal")


@dataclass(frozen=True)
class SqliteSummary:
    """Topics, times and state of an SQLite file."""

    counts: Mapping[Topic, int]  # messages
    qos: Mapping[Topic, tuple[OfferedQos, ...]]  # offered by publishers; empty if unknown
    start: int | None  # first log time, nanoseconds; None without a message
    end: int | None  # last log time, nanoseconds; None without a message
    is_finished: bool  # whether its recorder closed it


def read_sqlite_summary(file: Path) -> SqliteSummary:
    """Return topics, times and state of an SQLite file."""
    counts: Counter[Topic] = Counter()
    qos: dict[Topic, tuple[OfferedQos, ...]] = {}
    with open_database(file) as database:
        registry = read_registry(database)
        topics = registry.topics
        for number, topic in topics.items():
            counts[topic] += 0
            with suppress(ValueError):
                qos[topic] = qos.get(topic) or registry.offered_qos(registry.channels[number])
        for number, count in database.execute(
            "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        ):
            counts[topics[_require_known(topics, number)]] += count
        ((start, end),) = database.execute("SELECT min(timestamp), max(timestamp) FROM messages")
    return SqliteSummary(counts, qos, start, end, not _find_journals(file))


def read_sqlite_blocks(file: Path) -> Iterator[MessageBlock]:
    """Yield all messages in order of recording, as `blocks.read_mcap_blocks` does."""
    warn_of_journals(file)
    with open_database(file) as database:
        topics = read_registry(database).topics
        waiting: dict[Topic, list[tuple[int, int]]] = {topic: [] for topic in topics.values()}
        data = bytearray()
        for number, payload in database.execute(
            "SELECT topic_id, data FROM messages ORDER BY rowid"
        ):
            if not isinstance(payload, bytes):
                raise TypeError("a message is not a blob")
            waiting[topics[_require_known(topics, number)]].append((len(data), len(payload)))
            data += payload
            if len(data) >= BLOCK_SIZE:
                yield _block(data, waiting)
                data = bytearray()
        yield _block(data, waiting)


def read_sqlite_index(file: Path) -> FileIndex:
    """Return the index of an SQLite file."""
    warn_of_journals(file)
    with open_database(file) as database:
        registry = read_registry(database)
        extents = tuple(_split_rows(database))

    def messages(extent: Extent) -> list[StoredMessage]:
        with open_database(file) as database:
            rows = database.execute(
                "SELECT topic_id, timestamp, data FROM messages "
                "WHERE rowid BETWEEN ? AND ? ORDER BY rowid",
                (extent.offset, extent.offset + extent.length - 1),
            )
            return [
                StoredMessage(
                    time,
                    _require_known(registry.channels, number),
                    decompress_message(payload, MAX_CHUNK),
                )
                for number, time, payload in rows
            ]

    return FileIndex(file, list_topics(registry), extents, None, messages)


def _split_rows(database: apsw.Connection) -> Iterator[Extent]:
    """Yield ranges of rows with about `EXTENT_SIZE` bytes of messages each."""
    first = last = start = end = size = 0
    rows = database.execute(
        "SELECT rowid, timestamp, length(data), typeof(timestamp) || typeof(data) "
        "FROM messages ORDER BY rowid"
    )
    for number, (row, time, length, types) in enumerate(rows):
        if types != "integerblob":
            raise TypeError("a message is not a blob, or its time is not an integer")
        if number and size + length > EXTENT_SIZE:
            yield Extent(start, end, first, last - first + 1)
            size = 0
        if not size:
            first, start, end = row, time, time
        last, start, end = row, min(start, time), max(end, time)
        size += max(length, 1)
    if size:
        yield Extent(start, end, first, last - first + 1)


def _block(data: bytearray, waiting: dict[Topic, list[tuple[int, int]]]) -> MessageBlock:
    spans = {}
    for topic, places in waiting.items():
        spans[topic] = np.array(places, dtype=np.int64).reshape(-1, 2)
        places.clear()
    return MessageBlock(np.frombuffer(bytes(data), dtype=np.uint8), spans)


def read_registry(database: apsw.Connection) -> SchemaRegistry:
    """Return the topics of a file as channels, each with its own schema of the same number."""
    definitions = {}
    # Jazzy and later; rosbag2 writes "unknown" for types without a definition.
    if _columns(database, "message_definitions"):
        rows = database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        for name, encoding, definition in map(_texts, rows):
            definitions[name] = encoding, definition.encode()
            check_limit("a number of definitions", len(definitions), MAX_CHANNELS)
    columns = _columns(database, "topics")
    if not columns or not _columns(database, "messages"):
        raise ValueError("it has no tables for topics and messages")
    profiles, type_hash = (
        name if name in columns else "''"
        for name in ("offered_qos_profiles", "type_description_hash")
    )
    registry = SchemaRegistry()
    for identifier, *texts in database.execute(
        f"SELECT id, name, type, serialization_format, {profiles}, {type_hash} FROM topics"
    ):
        number = int(identifier)
        topic, msgtype, message_encoding, offers, digest = _texts(texts)
        encoding, data = definitions.get(msgtype, ("", b""))
        registry.schemas[number] = Schema(id=number, name=msgtype, encoding=encoding, data=data)
        registry.channels[number] = Channel(
            id=number,
            topic=topic,
            message_encoding=message_encoding,
            metadata={"offered_qos_profiles": offers, "topic_type_hash": digest},
            schema_id=number,
        )
        check_limit("a number of topics", len(registry.channels), MAX_CHANNELS)
    return registry


def _texts(values: Sequence[object]) -> list[str]:
    """Return the values of a row, which must be text: SQLite columns accept any type."""
    texts = [value for value in values if isinstance(value, str)]
    if len(texts) < len(values):
        raise TypeError("the description of a topic is not text")
    return texts


def _require_known(topics: Collection[int], number: int) -> int:
    if number not in topics:
        raise ValueError("a message's topic was never announced")
    return number


def _columns(database: apsw.Connection, table: str) -> set[str]:
    """Return the names of a table's columns; none if there is no such table or it is a view."""
    found = database.execute(
        "SELECT c.name FROM sqlite_master AS t, pragma_table_info(t.name) AS c "
        "WHERE t.type = 'table' AND t.name = ?",
        (table,),
    )
    return {str(name) for (name,) in found}


@contextmanager
def open_database(file: Path, *, is_damaged: bool = False) -> Iterator[apsw.Connection]:
    """Open a file without writing to it or its folder; a damaged one as far as possible."""
    journals = _find_journals(file)
    # Only this VFS reads the journals without writing a lock or an index beside them.
    base, mode = ("unix-none", "mode=ro") if journals else ("", "immutable=1")
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    try:
        _refuse_other_format(file)
        whole_pages = WholePages(base, file) if is_damaged else None  # registered while it lives
        vfs = whole_pages.name if whole_pages else base or None
        with closing(apsw.Connection(f"file:{quote(str(file))}?{mode}", flags, vfs)) as database:
            database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
            # Closing would otherwise remove an empty journal.
            database.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
            database.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            if is_damaged:  # otherwise SQLite does not open a truncated file
                database.execute("PRAGMA writable_schema = ON")
            yield database
    except (apsw.Error, ValueError, TypeError, MemoryError, OverflowError) as error:
        raise damage_error(file, "SQLite", error) from error
    except OSError as error:
        raise unreadable_error(file, error) from error


def _refuse_other_format(file: Path) -> None:
    with file.open("rb") as stream:
        head = stream.read(len(SQLITE_MAGIC))
    if head.startswith(MAGIC):
        raise BagError(f"{file}: an MCAP file; rename it to end in .mcap", "E204")
    # An empty file is an empty database.
    if head and head != SQLITE_MAGIC and (known := identify_other_format(file)):
        raise BagError(f"{file}: {known}", "E204")


def warn_of_journals(file: Path) -> None:
    """Warn if the recording of a file was interrupted."""
    if journals := _find_journals(file):
        logger.warning(
            "%s: the recording was interrupted; its last messages are read from %s",
            file,
            ", ".join(place.name for place in journals),
        )


def _find_journals(file: Path) -> list[Path]:
    """Return the journals that an interrupted recording left beside its file."""
    places = (file.with_name(file.name + ending) for ending in JOURNALS)
    return [place for place in places if place.is_file() and place.stat().st_size]


class WholePages(apsw.VFS):
    """Reads a database up to its last complete page.

    SQLite would fill a truncated page with zeros.
    """

    def __init__(self, base: str, file: Path) -> None:
        with file.open("rb") as stream:
            size = int.from_bytes(stream.read(18)[16:], "big")
        self.name = f"whole pages {id(self)}"
        self._base, self._page = base, 65536 if size == 1 else max(size, 1)
        super().__init__(self.name, base)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:
        """Open one of SQLite's files."""
        page = self._page if flags[0] & apsw.SQLITE_OPEN_MAIN_DB else 1
        return _WholePagesFile(self._base, name, flags, page)


class _WholePagesFile(apsw.VFSFile):
    def __init__(self, base: str, name: Any, flags: list[int], page: int) -> None:
        self._page = page
        super().__init__(base, name, flags)

    def xFileSize(self) -> int:
        """Return the size in bytes."""
        size = super().xFileSize()
        return size - size % self._page
