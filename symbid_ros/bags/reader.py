"""Read bags as logs, sensor streams or ground truth."""

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.bags.container.files import count_messages, join_names, read_blocks
from symbid_ros.bags.slices import DEFAULT_SELECTION, iterate_slices
from symbid_ros.errors import BagError, DataError
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.sensor_streams import frame_id, read_field, read_stamps
from symbid_ros.messages.static_transforms import is_static, static_transforms
from symbid_ros.messages.topics import TRUTH, Topic, TopicSelection, describe_topics
from symbid_ros.messages.types import ACCEL, ODOMETRY, TRAJECTORY, WRENCH
from symbid_ros.model.fixed_frames import FixedTransform
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.defects import DefectCounts, kept_in_order
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import WHOLE_LOG, Slice, Streams, TimeRange, TruthStreams

TRUTH_TYPES = {"joints": TRAJECTORY, "odom": ODOMETRY, "base_accel": ACCEL}


def bag_log(
    bags: Sequence[Path],
    model: RobotModel | None = None,
    topics: TopicSelection = DEFAULT_SELECTION,
    part: TimeRange = WHOLE_LOG,
) -> Log:
    """Return the log in bags; messages are read when needed.

    Parameters
    ----------
    bags : sequence of Path
        Bag folders or files of one robot, in any order.
    model : RobotModel, optional
        Robot whose joints the log must contain; messages that name none of them are ignored.
    topics : TopicSelection
        Topics to read.
    part : TimeRange
        Part of the recording.
    """
    topics = topics if model is None else topics.of_model(model)
    return _log_of(bags, replace(topics, logged=set()), part)


def _log_of(bags: Sequence[Path], topics: TopicSelection, part: TimeRange) -> Log:
    """Return the log in bags, which shares the set of its logged messages with the selection."""
    return Log(
        join_names(bags),
        tuple(bags),
        _read=partial(_slices, bags, topics, part),
        _open=partial(_other_log, topics),
        _frames=partial(_frames, bags, topics),
        _of_robot=None if topics.joint_names else partial(_of_robot, bags, topics, part),
    )


# A log holds these functions with their first arguments. Local ones could not be pickled.
def _slices(
    bags: Sequence[Path], topics: TopicSelection, part: TimeRange, span: int | None, warn: bool
) -> Iterator[Slice]:
    return iterate_slices(bags, topics, span=span, part=part, warn=warn)


def _other_log(topics: TopicSelection, bags: tuple[Path, ...]) -> Log:
    count_messages(bags)
    return bag_log(bags, topics=replace(topics, mapping=topics.mapping.of_any_log()))


def _of_robot(
    bags: Sequence[Path], topics: TopicSelection, part: TimeRange, robot: RobotModel
) -> Log:
    return _log_of(bags, topics.of_model(robot), part)


def _frames(bags: Sequence[Path], topics: TopicSelection) -> tuple[FixedTransform, ...]:
    mapping = topics.mapping
    try:
        transforms = read_static_transforms(bags)
    except BagError:
        # Options are checked before bags; reading the messages raises this error again.
        return ()
    return tuple(
        replace(one, parent=mapping.frame(one.parent), child=mapping.frame(one.child))
        for one in transforms
    )


def read_static_transforms(bags: Sequence[Path]) -> tuple[FixedTransform, ...]:
    """Read the transforms of fixed frames; of a transform that is sent again, the last one.

    Reading ends when all messages of these topics have been found, usually near the beginning.
    """
    left = sum(count for topic, count in count_messages(bags).items() if is_static(topic))
    found: dict[tuple[str, str], FixedTransform] = {}
    blocks = read_blocks(bags) if left else ()
    for block in blocks:
        for topic, spans in block.spans.items():
            if is_static(topic):
                left -= len(spans)
                for start, size in spans.tolist():
                    payload = block.data[start : start + size].tobytes()
                    found |= {(one.parent, one.child): one for one in static_transforms(payload)}
        if left <= 0:
            break
    return tuple(found.values())


def read_wrench_frames(bags: Sequence[Path], topics: Collection[str]) -> dict[str, str]:
    """Read the frames of WrenchStamped topics, which the first message of each tells."""
    found: dict[str, str] = {}
    for block in read_blocks(bags):
        for topic, spans in block.spans.items():
            if topic.name in topics and topic.name not in found and topic.msgtype == WRENCH:
                decoder = TopicDecoder(join_names(bags), topic)
                decoder.add(block.data, spans[:1])
                found[topic.name] = frame_id(decoder)
        if len(found) == len(topics):
            break
    return found


def read_streams(bags: Sequence[Path], topics: TopicSelection = DEFAULT_SELECTION) -> Streams:
    """Read the sensor topics of one recording at once; stamps increase strictly in each stream."""
    return bag_log(bags, topics=topics).streams()


def read_truth(bags: Sequence[Path]) -> TruthStreams:
    """Read the ``ground_truth/`` topics of one recording, for validation only.

    Instants that one of the three topics lacks are dropped; a warning counts them.
    """
    source = join_names(bags)
    counts: dict[Topic, int] = {}
    decoders = _decode(bags, source, counts, lambda topic: _truth_kind(topic) is not None)
    by_kind = {_truth_kind(topic): decoder for topic, decoder in decoders.items()}
    for kind in TRUTH_TYPES:
        if kind not in by_kind or not by_kind[kind].count:
            raise BagError(
                f"{source}: no message on {TRUTH}/{kind}, it holds {describe_topics(counts)}; "
                "use a simulated bag with ground truth",
                "E223",
            )
    joints, odometry, accel = (by_kind[kind] for kind in TRUTH_TYPES)
    return _truth_streams(joints, odometry, accel)


def _decode(
    bags: Sequence[Path],
    source: str,
    counts: dict[Topic, int],
    wants: Callable[[Topic], bool],
) -> dict[Topic, TopicDecoder]:
    """Decode the wanted topics and count the messages of all."""
    decoders: dict[Topic, TopicDecoder] = {}
    for block in read_blocks(bags):
        for topic, spans in block.spans.items():
            counts[topic] = counts.get(topic, 0) + len(spans)
            if wants(topic):
                decoder = decoders.setdefault(topic, TopicDecoder(source, topic))
                decoder.add(block.data, spans)
    return decoders


def _truth_kind(topic: Topic) -> str | None:
    """Return which ground-truth topic this is; None if it is not one."""
    *_, folder, kind = ["", "", *topic.name.split("/")]
    return kind if folder == TRUTH and TRUTH_TYPES.get(kind) == topic.msgtype else None


logger = logging.getLogger("symbid_ros.bags")


def _truth_streams(
    joints: TopicDecoder, odometry: TopicDecoder, accel: TopicDecoder
) -> TruthStreams:
    """Return the instants that all three topics have in common."""
    source = joints.source
    names = _joint_names(joints)
    decoders = (joints, odometry, accel)
    kept, stamp = [], []
    for decoder in decoders:
        recorded = read_stamps(decoder)
        tally = DefectCounts(source, decoder.topic.name)
        tally.count_messages(recorded)
        places = kept_in_order(recorded, tally)
        tally.report()
        kept.append(places)
        stamp.append(recorded[places])
    common = reduce(np.intersect1d, stamp)
    if not len(common):
        raise DataError(
            f"{source}: the ground_truth/ topics have no instant in common; record all three",
            "E223",
        )
    left_out = max(map(len, stamp)) - len(common)
    if left_out:
        logger.warning("%s: ground truth: %d instants lack one of its topics", source, left_out)
    rows = [
        places[np.searchsorted(recorded, common)]
        for places, recorded in zip(kept, stamp, strict=True)
    ]

    def values(which: int, path: str) -> FloatArray:
        return read_field(decoders[which], path)[rows[which]]

    return TruthStreams(
        source=source,
        joint_names=names,
        stamp=common,
        position=values(0, "points.0.positions"),
        velocity=values(0, "points.0.velocities"),
        acceleration=values(0, "points.0.accelerations"),
        effort=values(0, "points.0.effort"),
        base_position=values(1, "pose.pose.position"),
        base_orientation=values(1, "pose.pose.orientation"),
        base_linear_velocity=values(1, "twist.twist.linear"),
        base_angular_velocity=values(1, "twist.twist.angular"),
        base_linear_acceleration=values(2, "accel.linear"),
        base_angular_acceleration=values(2, "accel.angular"),
    )


def _joint_names(joints: TopicDecoder) -> tuple[str, ...]:
    """Return the joints, which must be the same in each message, with all four values."""
    names = joints.batches[0].layout.text["joint_names"]
    paths = [f"points.0.{kind}" for kind in ("positions", "velocities", "accelerations", "effort")]
    for batch in joints.batches:
        present = batch.layout.dtype.names or ()
        complete = all(
            path in present and batch.records[path].shape[1] == len(names) for path in paths
        )
        if not complete or batch.layout.text["joint_names"] != names:
            raise DataError(
                f"{joints.source}: {joints.topic.name}: the messages do not have one complete "
                "point each for the same joints; use a bag of this package's simulator",
                "E223",
            )
    return names
