"""rosbag2's older storage, SQLite files of whatever version."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import apsw
import numpy as np
from mcap.records import Schema

from symbid_ros.bags.container.blocks import BLOCK_SIZE, Block, Topic
from symbid_ros.bags.container.catalogue import described_type, offered
from symbid_ros.bags.container.framing import quoted
from symbid_ros.bags.limits import MAX_CHANNELS, MAX_CHUNK, within
from symbid_ros.bags.metadata import OfferedQos
from symbid_ros.errors import BagError

logger = logging.getLogger("symbid_ros.bags")

SQLITE_SUFFIX = ".db3"
# What an interrupted recording leaves beside its file: what was written last, or taken back.
LEFTOVERS = ("-wal", "-journal")


@dataclass(frozen=True)
class SqliteContents:
    """What an SQLite file holds.

    Attributes
    ----------
    counts : dict of Topic to int
        Messages.
    qos : dict of Topic to tuple of OfferedQos
        What publishers offered; empty where the file does not tell.
    start, end : int or None
        First and last log time, nanoseconds; None without a message.
    is_finished : bool
        Whether its recorder closed it.
    """

    counts: Mapping[Topic, int]
    qos: Mapping[Topic, tuple[OfferedQos, ...]]
    start: int | None
    end: int | None
    is_finished: bool


def sqlite_contents(file: Path) -> SqliteContents:
    """Return what an SQLite file holds."""
    counts: Counter[Topic] = Counter()
    qos: dict[Topic, tuple[OfferedQos, ...]] = {}
    with _opened(file) as database:
        topics = _topics(database)
        for topic, profiles in topics.values():
            counts[topic] += 0
            with suppress(ValueError):
                qos[topic] = qos.get(topic) or offered(topic.name, profiles)
        for number, count in database.execute(
            "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
        ):
            counts[_known(topics, number)] += count
        ((start, end),) = database.execute("SELECT min(timestamp), max(timestamp) FROM messages")
    return SqliteContents(counts, qos, start, end, not _leftovers(file))


def sqlite_blocks(file: Path) -> Iterator[Block]:
    """Yield all messages as they were recorded, as `blocks.iterate_blocks` does."""
    if leftovers := _leftovers(file):
        logger.warning(
            "%s: the recording was interrupted; what it wrote last is taken from %s",
            file,
            ", ".join(place.name for place in leftovers),
        )
    with _opened(file) as database:
        topics = _topics(database)
        waiting: dict[Topic, list[tuple[int, int]]] = {topic: [] for topic, _ in topics.values()}
        data = bytearray()
        for number, payload in database.execute(
            "SELECT topic_id, data FROM messages ORDER BY rowid"
        ):
            if not isinstance(payload, bytes):
                raise TypeError("a message is no bytes")
            waiting[_known(topics, number)].append((len(data), len(payload)))
            data += payload
            if len(data) >= BLOCK_SIZE:
                yield _block(data, waiting)
                data = bytearray()
        yield _block(data, waiting)


def _block(data: bytearray, waiting: dict[Topic, list[tuple[int, int]]]) -> Block:
    spans = {}
    for topic, places in waiting.items():
        spans[topic] = np.array(places, dtype=np.int64).reshape(-1, 2)
        places.clear()
    return Block(np.frombuffer(bytes(data), dtype=np.uint8), spans)


def _topics(database: apsw.Connection) -> dict[int, tuple[Topic, str]]:
    """Return topics, and what their publishers offered as it was written, by number."""
    schemas = {}
    # Of Jazzy and later; of a type whose definition its recorder did not find it says so.
    if _columns(database, "message_definitions"):
        rows = database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        for name, encoding, definition in map(_texts, rows):
            schemas[name] = Schema(id=1, name=name, encoding=encoding, data=definition.encode())
            within("a number of definitions", len(schemas), MAX_CHANNELS)
    columns = _columns(database, "topics")
    if not columns or not _columns(database, "messages"):
        raise ValueError("it has no tables of topics and messages")
    profiles = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    topics = {}
    for number, *texts in database.execute(
        f"SELECT id, name, type, serialization_format, {profiles} FROM topics"
    ):
        name, msgtype, encoding, offers = _texts(texts)
        schema = schemas.get(msgtype, Schema(id=1, name=msgtype, encoding="", data=b""))
        topics[int(number)] = Topic(name, described_type(schema, encoding)), offers
        within("a number of topics", len(topics), MAX_CHANNELS)
    return topics


def _texts(values: Sequence[object]) -> list[str]:
    """Return values of a row that are text; SQLite lets a column hold anything."""
    texts = [value for value in values if isinstance(value, str)]
    if len(texts) < len(values):
        raise TypeError("a topic is described by something else than text")
    return texts


def _known(topics: Mapping[int, tuple[Topic, str]], number: int) -> Topic:
    if number not in topics:
        raise ValueError("a message's topic was never announced")
    return topics[number][0]


def _columns(database: apsw.Connection, table: str) -> set[str]:
    """Return the names of a table's columns; none where there is no such table, or it is a view."""
    found = database.execute(
        "SELECT c.name FROM sqlite_master AS t, pragma_table_info(t.name) AS c "
        "WHERE t.type = 'table' AND t.name = ?",
        (table,),
    )
    return {str(name) for (name,) in found}


@contextmanager
def _opened(file: Path) -> Iterator[apsw.Connection]:
    """Open a file without writing anything to it or beside it."""
    leftovers = _leftovers(file)
    # What lies beside it is read by this VFS alone without a lock or an index written there.
    vfs, mode = ("unix-none", "mode=ro") if leftovers else (None, "immutable=1")
    flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
    try:
        with closing(apsw.Connection(f"file:{quote(str(file))}?{mode}", flags, vfs)) as database:
            # Whoever claims a larger blob is not believed.
            database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK)
            # Closing would remove a log in which it finds nothing.
            database.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
            database.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
            database.execute("PRAGMA locking_mode = EXCLUSIVE")
            yield database
    except (apsw.Error, ValueError, TypeError, MemoryError, OverflowError) as error:
        detail = " ".join(str(error).split())[:200] or "it ends early"
        remedy = f"take another copy, or save what can still be read by `{saving_command(file)}`"
        if leftovers:
            remedy = (
                "take another copy, or try "
                f"`sqlite3 {quoted(file)} 'PRAGMA wal_checkpoint(TRUNCATE)'`"
            )
        raise BagError(f"{file}: damaged SQLite file: {detail}; {remedy}") from error
    except OSError as error:
        raise BagError(f"{file}: cannot read: {error.strerror}") from error


def saving_command(file: Path) -> str:
    """Return the command that writes what can still be read of a damaged file into a new one.

    SQLite's own ``.recover`` is not in every distribution's build, and a dump ends with a
    rollback where it met damage.
    """
    saved = quoted(file.with_name(f"{file.stem}_recovered{SQLITE_SUFFIX}"))
    return f"sqlite3 {quoted(file)} .dump | sed 's/^ROLLBACK.*/COMMIT;/' | sqlite3 {saved}"


def _leftovers(file: Path) -> list[Path]:
    """Return what an interrupted recording left beside its file."""
    places = (file.with_name(file.name + ending) for ending in LEFTOVERS)
    return [place for place in places if place.is_file() and place.stat().st_size]
