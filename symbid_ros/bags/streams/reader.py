"""Bags into streams of arrays."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from symbid_ros.bags.container.contents import all_blocks, bag_names
from symbid_ros.bags.streams.slices import DEFAULT_SELECTION, iterate_slices
from symbid_ros.bags.streams.truth import truth_streams
from symbid_ros.errors import BagError
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.topics import TRUTH, Topic, TopicSelection, listing
from symbid_ros.messages.types import ACCEL, ODOMETRY, TRAJECTORY
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.log import Log
from symbid_ros.signals.slices import ALL_OF_IT, Slice, TimeRange
from symbid_ros.signals.streams import Streams, TruthStreams

TRUTH_TYPES = {"joints": TRAJECTORY, "odom": ODOMETRY, "base_accel": ACCEL}


def bag_log(
    bags: Sequence[Path],
    model: RobotModel | None = None,
    topics: TopicSelection = DEFAULT_SELECTION,
    part: TimeRange = ALL_OF_IT,
) -> Log:
    """Return the log in bags that continue one another; nothing is read yet.

    Parameters
    ----------
    bags : sequence of Path
        Bag folders or files; give separate runs separately.
    model : RobotModel, optional
        Whose joints must be in the log; messages that name none of them are ignored.
    topics : TopicSelection
        Topics to read.
    part : TimeRange
        Part of the recording.
    """
    if model is not None:
        topics = replace(topics, joint_names=model.measured_joint_names)

    def read(span: int | None, warn: bool) -> Iterator[Slice]:
        return iterate_slices(bags, topics, span=span, part=part, warn=warn)

    return Log(bag_names(bags), tuple(bags), _read=read)


def read_streams(bags: Sequence[Path], topics: TopicSelection = DEFAULT_SELECTION) -> Streams:
    """Read the sensor topics of one recording at once.

    Stamps increase strictly in every stream.
    """
    return bag_log(bags, topics=topics).streams()


def read_truth(bags: Sequence[Path]) -> TruthStreams:
    """Read the ``ground_truth/`` topics of one recording, for validation only.

    Instants that one of the three topics lacks are left out and counted in a
    warning.
    """
    source = bag_names(bags)
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
    for block in all_blocks(bags):
        for topic, spans in block.spans.items():
            counts[topic] = counts.get(topic, 0) + len(spans)
            if wants(topic):
                decoder = decoders.setdefault(topic, TopicDecoder(source, topic))
                decoder.add(block.data, spans)
    return decoders


def _truth_kind(topic: Topic) -> str | None:
    """Return which of the ground-truth topics this is."""
    *_, folder, kind = ["", "", *topic.name.split("/")]
    return kind if folder == TRUTH and TRUTH_TYPES.get(kind) == topic.msgtype else None
