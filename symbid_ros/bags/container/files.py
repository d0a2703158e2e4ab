"""Which files make up a bag."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from symbid_ros.bags.container.blocks import MessageBlock, read_mcap_blocks
from symbid_ros.bags.container.mcap_records import quote_path, report_damage
from symbid_ros.bags.container.mcap_summary import read_summary
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX, read_sqlite_blocks, read_sqlite_summary
from symbid_ros.errors import BagError
from symbid_ros.messages.limits import MAX_METADATA, MAX_YAML_NODES
from symbid_ros.messages.topics import Topic
from symbid_ros.safe_yaml import parse_yaml
from symbid_ros.user_files import read_regular

STORAGES = (".mcap", ".db3")
ZSTD_SUFFIX = ".zstd"


def bag_files(bag: Path) -> list[Path]:
    """Return the files of a bag: a folder's in recorded order, or the file itself."""
    metadata = bag / "metadata.yaml"
    if not metadata.is_file():
        return files_present(bag)
    listed = [_unpacked(bag / name) for name in listed_names(read_metadata(metadata))]
    present = _sorted_files(bag)
    if len(present) == len(listed) and not any(file.is_file() for file in listed):
        listed = present  # renamed, all of them
    for file in listed:
        if _read_as_it_is(file).suffix not in STORAGES:
            raise BagError(f"{file}: neither MCAP nor SQLite; convert the bag to MCAP storage")
        if not file.is_file():
            raise BagError(f"{file}: no such file, though {metadata} lists it; restore it")
    return listed


def files_present(bag: Path) -> list[Path]:
    """Return the files of a bag that are there, whatever its metadata.yaml says."""
    if bag.is_file():
        return [_read_as_it_is(bag)]
    if not bag.is_dir():
        raise BagError(f"{bag}: no such bag; give a bag's folder or an .mcap file")
    files = _sorted_files(bag)
    if not files:
        # A common slip: runs are kept in one folder.
        inside = sorted(
            {file.parent.name for kind in STORAGES for file in bag.glob(f"[!.]*/[!.]*{kind}")}
        )
        if inside:
            raise BagError(f"{bag}: a folder of bags, {', '.join(inside)}; give these")
        raise BagError(f"{bag}: not a bag, it holds no .mcap file; give the folder of a recording")
    for file in files:
        if not file.is_file():  # a pipe would be waited for, a device read without end
            raise BagError(f"{file}: not a regular file; move it out of the bag's folder")
    return [_read_as_it_is(file) for file in files]


def read_metadata(metadata: Path) -> dict[str, Any]:
    """Return what a metadata.yaml says, no more checked than that it is rosbag2's."""
    try:
        text = read_regular(metadata, MAX_METADATA).decode("utf-8")
        content = parse_yaml(text, MAX_YAML_NODES)
        information: dict[str, Any] = content["rosbag2_bagfile_information"]
        names = information["relative_file_paths"]
        is_listing = all(isinstance(name, str) for name in names)
    except (OSError, ValueError, KeyError, TypeError):
        is_listing = False
    if not is_listing:
        raise BagError(f"{metadata}: not a rosbag2 metadata file; give the .mcap file instead")
    return information


def listed_names(information: dict[str, Any]) -> list[str]:
    """Return the names of a bag's files, which are in its folder and nowhere else.

    Up to version 3 of its metadata rosbag2 put the folder as it was then before them.
    """
    return [Path(name).name for name in information["relative_file_paths"]]


def _unpacked(file: Path) -> Path:
    """Return what a file that was compressed as a whole has been unpacked to, if it has."""
    plain = file.with_suffix("")
    return plain if file.suffix == ZSTD_SUFFIX and plain.is_file() else file


def _sorted_files(folder: Path) -> list[Path]:
    """Return a folder's files of the first kind of storage that it holds, numbers in order."""
    suffixes = (*STORAGES, *(storage + ZSTD_SUFFIX for storage in STORAGES))
    # Hidden ones are file managers' notes (._log_0.mcap) or unfinished.
    found = (list(folder.glob(f"[!.]*{suffix}")) for suffix in suffixes)
    return sorted(next(filter(None, found), []), key=lambda file: (len(file.name), file.name))


def _read_as_it_is(file: Path) -> Path:
    if file.suffix == ZSTD_SUFFIX:
        raise BagError(
            f"{file}: the whole file is compressed; decompress all files of the bag, this one by "
            f"`zstd -d {quote_path(file)}`, or record with `--storage-preset-profile zstd_fast`"
        )
    return file


def join_names(bags: Sequence[Path]) -> str:
    """Return the names of one recording's bags, for messages to the user."""
    if not bags:
        raise BagError("no bag given; name at least one")
    return ", ".join(map(str, bags))


def count_messages(bags: Sequence[Path]) -> dict[Topic, int]:
    """Return the number of messages of every topic, as the summaries of the bags tell it.

    A file whose summary does not is read.
    """
    counts: Counter[Topic] = Counter()
    for bag in bags:
        for file in bag_files(bag):
            counts.update(_of_file(file))
    return dict(counts)


def _of_file(file: Path) -> dict[Topic, int]:
    if file.suffix == SQLITE_SUFFIX:
        return dict(read_sqlite_summary(file).counts)
    with report_damage(file):
        summary = read_summary(file)
    catalogue, told = summary.catalogue, summary.statistics
    counts: Counter[Topic] = Counter()
    if told is not None and summary.tells_topics:
        for number, channel in catalogue.channels.items():
            topic = Topic(channel.topic, catalogue.msgtype(channel))
            counts[topic] += told.channel_message_counts.get(number, 0)
        return counts
    for block in read_mcap_blocks(file):
        for topic, spans in block.spans.items():
            counts[topic] += len(spans)
    return counts


def read_blocks(bags: Sequence[Path]) -> Iterator[MessageBlock]:
    """Yield all messages of bags that continue one another, a few megabytes at a time."""
    for bag in bags:
        for file in bag_files(bag):
            if file.suffix == SQLITE_SUFFIX:
                yield from read_sqlite_blocks(file)
            else:
                yield from read_mcap_blocks(file)
