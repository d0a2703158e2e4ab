"""Bags into streams of arrays."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from symbid_ros.bags.blocks import Topic, iterate_blocks
from symbid_ros.bags.decoder import TopicDecoder
from symbid_ros.bags.files import bag_files
from symbid_ros.bags.messages import ACCEL, ODOMETRY, TRAJECTORY
from symbid_ros.bags.selection import TRUTH, Selector, TopicSelection, listing
from symbid_ros.bags.sensors import imu_stream, joint_stream, wrench_stream
from symbid_ros.bags.truth import truth_streams
from symbid_ros.errors import BagError
from symbid_ros.signals.streams import Streams, TruthStreams

DEFAULT_SELECTION = TopicSelection()
TRUTH_TYPES = {"joints": TRAJECTORY, "odom": ODOMETRY, "base_accel": ACCEL}

logger = logging.getLogger("symbid_ros.bags")


def read_streams(bags: Sequence[Path], topics: TopicSelection = DEFAULT_SELECTION) -> Streams:
    """Read the sensor topics of one recording.

    Parameters
    ----------
    bags : sequence of Path
        Bag folders or .mcap files that continue one another; separate runs are
        to be read separately.
    topics : TopicSelection
        Topics to read.

    Returns
    -------
    Streams
        Stamps strictly increasing in every stream.
    """
    source = _source(bags)
    selector = Selector(source, topics)
    decoders = _decode(bags, source, selector.counts, selector.wants)
    chosen = selector.selected()
    return Streams(
        source=source,
        joints=joint_stream(decoders[chosen.joints]),
        imus=tuple(imu_stream(decoders[topic]) for topic in chosen.imus),
        wrenches=tuple(wrench_stream(decoders[topic]) for topic in chosen.wrenches),
    )


def read_truth(bags: Sequence[Path]) -> TruthStreams:
    """Read the ``ground_truth/`` topics of one recording, for validation only.

    Instants that one of the three topics lacks are left out and counted in a
    warning.
    """
    source = _source(bags)
    counts: dict[Topic, int] = {}
    decoders = _decode(bags, source, counts, lambda topic: _truth_kind(topic) is not None)
    by_kind = {_truth_kind(topic): decoder for topic, decoder in decoders.items()}
    for kind in TRUTH_TYPES:
        if kind not in by_kind or not by_kind[kind].count:
            raise BagError(
                f"{source}: no message on {TRUTH}/{kind}, it holds {listing(counts)}; "
                "use a simulated bag with ground truth"
            )
    joints, odometry, accel = (by_kind[kind] for kind in TRUTH_TYPES)
    return truth_streams(joints, odometry, accel)


def topic_counts(bag: Path) -> dict[str, int]:
    """Return the number of messages of every topic, counted in the file itself."""
    counts: dict[Topic, int] = {}
    _decode([bag], str(bag), counts, lambda _: False)
    return {topic.name: count for topic, count in counts.items()}


def _decode(
    bags: Sequence[Path],
    source: str,
    counts: dict[Topic, int],
    wants: Callable[[Topic], bool],
) -> dict[Topic, TopicDecoder]:
    """Decode the wanted topics and count the messages of all."""
    decoders: dict[Topic, TopicDecoder] = {}
    for file in [file for bag in bags for file in bag_files(bag)]:
        for block in iterate_blocks(file):
            for topic, spans in block.spans.items():
                counts[topic] = counts.get(topic, 0) + len(spans)
                if wants(topic):
                    decoder = decoders.setdefault(topic, TopicDecoder(source, topic))
                    decoder.add(block.data, spans)
    for decoder in decoders.values():
        if decoder.decoded_singly:
            logger.warning(
                "%s: %s: %d of %d messages decoded one by one, their bytes follow no layout",
                source,
                decoder.topic.name,
                decoder.decoded_singly,
                decoder.count,
            )
    return decoders


def _source(bags: Sequence[Path]) -> str:
    if not bags:
        raise BagError("no bag given; name at least one")
    return ", ".join(str(bag) for bag in bags)


def _truth_kind(topic: Topic) -> str | None:
    """Return which of the ground-truth topics this is."""
    *_, folder, kind = ["", "", *topic.name.split("/")]
    return kind if folder == TRUTH and TRUTH_TYPES.get(kind) == topic.msgtype else None
