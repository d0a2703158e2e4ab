"""The files of a bag, and all messages in them."""

import filecmp
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import combinations, product
from pathlib import Path
from typing import Any

from symbid_ros.bags.container.blocks import MessageBlock, read_mcap_blocks
from symbid_ros.bags.container.mcap_records import advise_to_recover, quote_path, report_damage
from symbid_ros.bags.container.mcap_summary import read_summary
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX, read_sqlite_blocks, read_sqlite_summary
from symbid_ros.errors import BagError
from symbid_ros.messages.limits import MAX_METADATA, MAX_YAML_NODES
from symbid_ros.messages.topics import Topic
from symbid_ros.user_files import parse_yaml, read_regular

STORAGES = (".mcap", ".db3")
ZSTD_SUFFIX = ".zstd"


def list_files(bag: Path) -> list[Path]:
    """Return the files of a bag in order of recording; of a single file, the file itself."""
    metadata = bag / "metadata.yaml"
    if not metadata.is_file():
        return find_files(bag)
    listed = [_decompressed(bag / name) for name in list_file_names(read_metadata(metadata))]
    present = _sorted_files(bag)
    if len(present) == len(listed) and not any(file.is_file() for file in listed):
        listed = present  # all were renamed
    for file in listed:
        if _require_uncompressed(file).suffix not in STORAGES:
            raise BagError(
                f"{file}: neither MCAP nor SQLite; convert the bag to MCAP storage", "E204"
            )
        if not file.is_file():
            raise BagError(
                f"{file}: no such file, though {metadata} lists it; restore it, or give the other "
                "files one by one",
                "E203",
            )
    return listed


def find_files(bag: Path) -> list[Path]:
    """Return the files of a bag that exist, whether or not its metadata.yaml lists them."""
    if bag.is_file():
        return [_require_uncompressed(bag)]
    if not bag.is_dir():
        raise BagError(f"{bag}: no such bag; give a bag's folder or an .mcap file", "E201")
    files = _sorted_files(bag)
    if not files:
        # A common mistake: the folder contains several recordings.
        inside = sorted(
            {file.parent.name for kind in STORAGES for file in bag.glob(f"[!.]*/[!.]*{kind}")}
        )
        if inside:
            raise BagError(f"{bag}: a folder of several bags; give {', '.join(inside)}", "E201")
        raise BagError(
            f"{bag}: not a bag, it holds no .mcap file; give the folder of a recording", "E201"
        )
    for file in files:
        if not file.is_file():  # opening a pipe would block, and a device has no end
            raise BagError(f"{file}: not a regular file; move it out of the bag's folder", "E201")
    return [_require_uncompressed(file) for file in files]


def read_metadata(metadata: Path) -> dict[str, Any]:
    """Read a metadata.yaml, and check only that rosbag2 wrote it."""
    try:
        state = metadata.stat()
        return _read_metadata(metadata, state.st_size, state.st_mtime_ns)
    except (OSError, ValueError, KeyError, TypeError):
        raise BagError(
            f"{metadata}: not a rosbag2 metadata file; give the .mcap file instead", "E209"
        ) from None


@lru_cache(maxsize=64)
def _read_metadata(metadata: Path, size: int, modified_ns: int) -> dict[str, Any]:
    """Read the metadata in the state of the file that size and time of change tell."""
    content = parse_yaml(read_regular(metadata, MAX_METADATA).decode("utf-8"), MAX_YAML_NODES)
    information: dict[str, Any] = content["rosbag2_bagfile_information"]
    if not all(isinstance(name, str) for name in information["relative_file_paths"]):
        raise TypeError("the name of a file is not a text")
    return information


def list_file_names(information: dict[str, Any]) -> list[str]:
    """Return the names of a bag's files, all of which are in its folder.

    Up to version 3 of its metadata, rosbag2 put the original folder before each name.
    """
    return [Path(name).name for name in information["relative_file_paths"]]


def _decompressed(file: Path) -> Path:
    """Return the decompressed copy of a file that was compressed as a whole, if there is one."""
    plain = file.with_suffix("")
    return plain if file.suffix == ZSTD_SUFFIX and plain.is_file() else file


def _sorted_files(folder: Path) -> list[Path]:
    """Return a folder's files of the first storage format found, in order of their numbers."""
    suffixes = (*STORAGES, *(storage + ZSTD_SUFFIX for storage in STORAGES))
    # Hidden files are metadata of file managers (._log_0.mcap) or unfinished.
    found = (list(folder.glob(f"[!.]*{suffix}")) for suffix in suffixes)
    return sorted(next(filter(None, found), []), key=lambda file: (len(file.name), file.name))


def _require_uncompressed(file: Path) -> Path:
    if file.suffix == ZSTD_SUFFIX:
        raise BagError(
            f"{file}: the whole file is compressed; decompress all files of the bag, this one by "
            f"`zstd -d {quote_path(file)}`, or record with `--storage-preset-profile zstd_fast`",
            "E204",
        )
    return file


def join_names(bags: Sequence[Path]) -> str:
    """Return the names of one recording's bags, for error messages."""
    if not bags:
        raise BagError("no bag given; name at least one", "E202")
    return ", ".join(map(str, bags))


def require_distinct(bags: Sequence[Path]) -> None:
    """Raise an error if a bag, a file of it or a copy of such a file is given twice.

    Raises
    ------
    BagError
        When one is, or a bag is missing.
    """
    if len({bag.resolve() for bag in bags}) < len(bags):
        raise BagError(f"{join_names(bags)}: a bag is named twice; name each bag once", "E202")
    for (one, files), (other, others) in combinations([(bag, list_files(bag)) for bag in bags], 2):
        for file, candidate in product(files, others):
            if file.samefile(candidate):
                raise BagError(f"{one}, {other}: both hold {file}; name one of them", "E202")
            # Files of different sizes are not opened, and others rarely begin alike.
            if filecmp.cmp(file, candidate, shallow=False):
                raise BagError(
                    f"{candidate}: a copy of {file}, which would count twice; leave {other} out",
                    "E202",
                )


def count_messages(bags: Sequence[Path]) -> dict[Topic, int]:
    """Return the number of messages of each topic, from the summaries of the bags' files.

    A file without these numbers in its summary is read.

    Raises
    ------
    BagError
        When a bag is missing or damaged, or a file is given twice.
    """
    require_distinct(bags)
    counts: Counter[Topic] = Counter()
    for bag in bags:
        with advise_to_recover(bag):
            for file in list_files(bag):
                counts.update(_count_messages_of_file(file))
    return dict(counts)


def _count_messages_of_file(file: Path) -> dict[Topic, int]:
    if file.suffix == SQLITE_SUFFIX:
        return dict(read_sqlite_summary(file).counts)
    with report_damage(file):
        state = file.stat()
    return dict(_counts_of_mcap(file, state.st_size, state.st_mtime_ns))


@lru_cache(maxsize=64)
def _counts_of_mcap(file: Path, size: int, modified_ns: int) -> dict[Topic, int]:
    """Return the counts in the state of the file that size and time of change tell."""
    with report_damage(file):
        summary = read_summary(file)
    stated = summary.statistics
    counts: Counter[Topic] = Counter()
    if stated is not None and summary.has_topic_counts:
        for number, topic in summary.registry.topics.items():
            counts[topic] += stated.channel_message_counts.get(number, 0)
        return counts
    for block in read_mcap_blocks(file):
        for topic, spans in block.spans.items():
            counts[topic] += len(spans)
    return counts


def read_blocks(bags: Sequence[Path]) -> Iterator[MessageBlock]:
    """Yield all messages of bags that continue one another, a few megabytes at a time."""
    for bag in bags:
        with advise_to_recover(bag):
            for file in list_files(bag):
                if file.suffix == SQLITE_SUFFIX:
                    yield from read_sqlite_blocks(file)
                else:
                    yield from read_mcap_blocks(file)
