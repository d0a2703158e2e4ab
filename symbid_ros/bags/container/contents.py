"""What bags hold: topics, how many messages of each, and all of these."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from symbid_ros.bags.container.blocks import Block, iterate_blocks
from symbid_ros.bags.container.files import bag_files
from symbid_ros.bags.container.framing import damage_named
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX, sqlite_blocks, sqlite_contents
from symbid_ros.bags.container.summary import read_summary
from symbid_ros.errors import BagError
from symbid_ros.messages.topics import Topic


def bag_names(bags: Sequence[Path]) -> str:
    """Return the names of one recording's bags, for messages to the user."""
    if not bags:
        raise BagError("no bag given; name at least one")
    return ", ".join(map(str, bags))


def contents(bags: Sequence[Path]) -> dict[Topic, int]:
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
        return dict(sqlite_contents(file).counts)
    with damage_named(file):
        summary = read_summary(file)
    catalogue, told = summary.catalogue, summary.statistics
    counts: Counter[Topic] = Counter()
    if told is not None and summary.tells_topics:
        for number, channel in catalogue.channels.items():
            topic = Topic(channel.topic, catalogue.msgtype(channel))
            counts[topic] += told.channel_message_counts.get(number, 0)
        return counts
    for block in iterate_blocks(file):
        for topic, spans in block.spans.items():
            counts[topic] += len(spans)
    return counts


def all_blocks(bags: Sequence[Path]) -> Iterator[Block]:
    """Yield all messages of bags that continue one another, a few megabytes at a time."""
    for bag in bags:
        for file in bag_files(bag):
            if file.suffix == SQLITE_SUFFIX:
                yield from sqlite_blocks(file)
            else:
                yield from iterate_blocks(file)
