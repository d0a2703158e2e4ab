"""Convert decoded messages to sensor streams and drop messages unfit for identification.

Joint states of one topic are split by the joints that the messages name: drivers of arms and legs
may share a topic, each publishing its own joints.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.messages.decoder import DecodedBatch, TopicDecoder
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.messages.types import IMU, ODOMETRY, read_stamp
from symbid_ros.options import robot_file_line
from symbid_ros.signals.base_pose import PoseStream
from symbid_ros.signals.defects import (
    LARGEST,
    Defect,
    DefectCounts,
    DefectError,
    drop_impossible,
    kept_in_order,
    seconds,
)
from symbid_ros.signals.driving import driving_intervals, is_accelerating, is_driving
from symbid_ros.signals.joint_merging import merged_joints
from symbid_ros.signals.spikes import without_spikes
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

AXES = ("x", "y", "z", "w")

# Without a model, a group of joints counts as the robot's if its number of messages is at least
# this share of the largest group's.
MIN_GROUP_SHARE = 0.5
MAX_INVALID_SHARE = 0.5  # from here on a topic is useless


def split_by_joints(
    decoder: TopicDecoder, needed: frozenset[str], tally: DefectCounts
) -> tuple[TopicDecoder, ...]:
    """Split the messages of a topic into one decoder for each group of joints published together.

    Parameters
    ----------
    decoder : TopicDecoder
        Decoder of a JointState topic.
    needed : frozenset of str
        Joints of the model; messages that name none of them are counted and ignored. If it is
        empty, a group counts when it has about as many messages as the largest one.
    tally : DefectCounts
        Defects of the topic.
    """
    groups = group_joints(decoder, needed)
    if not groups:
        return (decoder,)
    members: list[list[DecodedBatch]] = [[] for _ in groups]
    for batch in decoder.batches:
        names = _names(batch)
        if needed and names and not names & needed:
            tally.add(
                Defect.OTHER_JOINTS,
                read_stamp(batch.records),
                np.ones(len(batch.index), dtype=bool),
            )
            continue
        shared = [len(group & names) for group in groups]
        members[shared.index(max(shared))].append(batch)
    return tuple(_select_batches(decoder, batches) for batches in members)


def group_joints(decoder: TopicDecoder, needed: frozenset[str]) -> list[frozenset[str]]:
    """Return which joints of a topic are published together; empty if all messages agree."""
    counts: Counter[frozenset[str]] = Counter()
    for batch in decoder.batches:
        counts[_names(batch)] += len(batch.index)
    counts.pop(frozenset(), None)
    return _groups(counts, needed) if len(counts) > 1 else []


def read_split_stamps(decoder: TopicDecoder, needed: frozenset[str]) -> tuple[IntArray, ...]:
    """Return the stamps, ns in order of recording, of the messages of each set of joints.

    Joints that no message names together are published by different drivers, so that each set has
    a period of its own.
    """
    return tuple(
        read_stamps(part)
        for part in split_by_joints(decoder, needed, DefectCounts(decoder.source, ""))
    )


def _names(batch: DecodedBatch) -> frozenset[str]:
    return frozenset(batch.layout.text["name"])


def _groups(counts: Counter[frozenset[str]], needed: frozenset[str]) -> list[frozenset[str]]:
    """Return the groups of joints, sorted by their names."""
    most = max(counts.values())
    groups: list[frozenset[str]] = []
    covered: set[str] = set()
    for names, count in sorted(counts.items(), key=lambda entry: (-entry[1], sorted(entry[0]))):
        own = names & needed if needed else names
        # Messages that share a joint come from one driver, some of them incomplete.
        if own and not own & covered and (needed or count >= MIN_GROUP_SHARE * most):
            groups.append(names)
            covered |= own
    return sorted(groups, key=sorted)


def _select_batches(decoder: TopicDecoder, batches: list[DecodedBatch]) -> TopicDecoder:
    """Return a decoder with some of the batches and their messages renumbered in order."""
    index = np.sort(np.concatenate([batch.index for batch in batches]))
    renumbered = [
        DecodedBatch(batch.layout, np.searchsorted(index, batch.index), batch.records)
        for batch in batches
    ]
    return TopicDecoder(decoder.source, decoder.topic, renumbered, len(index))


def build_joints(
    source: str,
    chosen: SelectedTopics,
    decoders: Mapping[Topic, TopicDecoder],
    tallies: Mapping[Topic, DefectCounts],
) -> JointStream:
    """Return the joint states of a robot, merged from its topics, as the model defines them."""
    joints = [
        without_spikes(chosen.unwrapper.unwrapped(read), tallies[topic])
        for topic in chosen.joints
        for part in split_by_joints(decoders[topic], chosen.recorded_joints, tallies[topic])
        for read in [chosen.mapping.with_radians(build_joint_stream(part, tallies[topic]))]
    ]
    merged = merged_joints(joints, source, chosen.recorded_joints)
    return chosen.held_joints.added_to(chosen.mapping.converted_joints(merged), source)


def build_streams(
    source: str,
    chosen: SelectedTopics,
    decoders: Mapping[Topic, TopicDecoder],
    tallies: Mapping[Topic, DefectCounts],
) -> Streams:
    """Return the streams of a robot's topics, each of which must have messages.

    Defects of messages are counted in ``tallies``.
    """
    mapping = chosen.mapping
    poses = [
        build_pose_stream(decoders[topic], mapping.tracked, tallies[topic])
        for topic in chosen.poses
    ]
    worlds = {pose.world: pose for pose in poses}

    def converted_wrench(stream: WrenchStream) -> WrenchStream:
        converted = mapping.converted_wrench(stream)
        pose = worlds.get(converted.frame_id)
        if pose is None:
            return converted
        return pose.on_robot(converted, mapping.plate_links.get(stream.topic, ""))

    imus = tuple(
        mapping.converted_imu(build_imu_stream(decoders[topic], tallies[topic]))
        for topic in chosen.imus
    )
    return Streams(
        source=source,
        joints=build_joints(source, chosen, decoders, tallies),
        imus=imus or tuple(pose.imu() for pose in poses),
        wrenches=tuple(
            converted_wrench(build_wrench_stream(decoders[topic], tallies[topic]))
            for topic in chosen.wrenches
        ),
        driving=tuple(
            interval
            for topic in chosen.drives
            for interval in read_driving(decoders[topic], tallies[topic])
        ),
        poses=tuple(poses),
    )


def read_stamps(decoder: TopicDecoder) -> IntArray:
    """Return (N,) header stamps, nanoseconds, in order of recording."""
    stamp = np.empty(decoder.count, dtype=np.int64)
    for batch in decoder.batches:
        stamp[_rows(batch)] = read_stamp(batch.records)
    return stamp


def read_field(decoder: TopicDecoder, path: str) -> FloatArray:
    """Return one field of all messages, (N, width)."""
    width = decoder.batches[0].records[path].shape[1]
    values = np.empty((decoder.count, width))
    for batch in decoder.batches:
        values[_rows(batch)] = batch.records[path]
    return values


def _rows(batch: DecodedBatch) -> IntArray | slice:
    """Return the positions of a batch's messages, as a slice if they are consecutive.

    A slice copies faster.
    """
    first, last = int(batch.index[0]), int(batch.index[-1])
    if last - first == len(batch.index) - 1:
        return slice(first, last + 1)
    return batch.index


def build_joint_stream(decoder: TopicDecoder, tally: DefectCounts) -> JointStream:
    """Return the states of the joints that most messages name, in the order of the first of these.

    Messages that name only other joints, such as a gripper's, are dropped. Missing values become
    NaN, which drivers use for unknown values. Whether a joint is needed depends on the model.
    """
    topic = decoder.topic.name
    names = _joint_names(decoder)
    place = {name: column for column, name in enumerate(names)}
    fields = {
        name: np.empty((decoder.count, len(names))) for name in ("position", "velocity", "effort")
    }
    stamp = read_stamps(decoder)
    unknown = np.zeros(decoder.count, dtype=bool)
    reordered = np.zeros(decoder.count, dtype=bool)
    foreign = np.zeros(decoder.count, dtype=bool)
    for batch in decoder.batches:
        given, rows = batch.layout.text["name"], _rows(batch)
        if len(set(given)) != len(given):
            raise DefectError(
                topic,
                Defect.NAMED_TWICE,
                f"{decoder.source}: {topic}: a joint is named twice at "
                f"{seconds(stamp[batch.index[0]])}; fix the driver",
                "E230",
            )
        sources = [column for column, name in enumerate(given) if name in place]
        targets = [place[given[column]] for column in sources]
        foreign[rows] = len(given) > 0 and not sources
        unknown[rows] = 0 < len(sources) < len(given)
        reordered[rows] = targets != sorted(targets)
        for name, values in fields.items():
            read = batch.records[name]
            if read.shape[1] != len(given):  # empty or too short to match names
                values[rows] = np.nan
                continue
            if given == names:
                values[rows] = read
            else:
                values[rows] = np.nan
                values[batch.index[:, None], targets] = read[:, sources]
    tally.add(Defect.OTHER_JOINTS, stamp, foreign)
    tally.add(Defect.UNKNOWN_JOINT, stamp, unknown)
    tally.add(Defect.REORDERED_JOINTS, stamp, reordered)
    kept = _in_order(np.flatnonzero(~foreign), stamp, tally)
    ordered = {name: drop_impossible(values)[kept] for name, values in fields.items()}
    return JointStream(
        topic, names, stamp[kept], ordered["position"], ordered["velocity"], ordered["effort"]
    )


def build_imu_stream(decoder: TopicDecoder, tally: DefectCounts) -> ImuStream:
    """Return an IMU's messages; orientation is None if every message marks it absent (REP-145)."""
    topic = decoder.topic.name
    frame = frame_id(decoder)
    stamp = read_stamps(decoder)
    readings = {}
    for name in ("angular_velocity", "linear_acceleration"):
        if (read_field(decoder, f"{name}_covariance")[:, 0] == -1).any():
            raise DefectError(
                topic,
                Defect.ABSENT,
                f"{decoder.source}: {topic}: {name} is marked absent (covariance -1); "
                "leave the topic out",
                "E231",
            )
        readings[name] = read_field(decoder, name)
    usable = _usable(tally, stamp, readings)
    orientation = read_field(decoder, "orientation")
    absent = read_field(decoder, "orientation_covariance")[:, 0] == -1
    orientation[absent] = np.nan
    if not absent.all():
        tally.add(Defect.NO_ORIENTATION, stamp, absent)
    kept = _in_order(usable, stamp, tally)
    return ImuStream(
        topic=topic,
        frame_id=frame,
        stamp=stamp[kept],
        orientation=None if absent.all() else orientation[kept],
        **{name: values[kept] for name, values in readings.items()},
    )


def build_wrench_stream(decoder: TopicDecoder, tally: DefectCounts) -> WrenchStream:
    """Return a wrench sensor's messages."""
    topic = decoder.topic.name
    frame = frame_id(decoder)
    stamp = read_stamps(decoder)
    force, torque = read_field(decoder, "wrench.force"), read_field(decoder, "wrench.torque")
    usable = _usable(tally, stamp, {"wrench.force": force, "wrench.torque": torque})
    kept = _in_order(usable, stamp, tally)
    read = WrenchStream(
        topic=topic,
        frame_id=frame,
        stamp=stamp[kept],
        force=force[kept],
        torque=torque[kept],
    )
    return without_spikes(read, tally)


def build_pose_stream(decoder: TopicDecoder, tracked: str, tally: DefectCounts) -> PoseStream:
    """Return the poses of a tracked frame, by default an Odometry's ``child_frame_id``.

    Raises
    ------
    DataError
        When a PoseStamped does not say which frame it tracks.
    """
    is_odometry = decoder.topic.msgtype == ODOMETRY
    frame = tracked or (_text(decoder, "child_frame_id") if is_odometry else "")
    if not frame:
        raise DataError(
            f"{decoder.source}: {decoder.topic.name} does not say which frame of the robot it "
            f"tracks; give `pose_frame`, or write {robot_file_line('pose_frame', 'FRAME')}",
            "E328",
        )
    path = "pose.pose" if is_odometry else "pose"
    stamp = read_stamps(decoder)
    read = {name: read_field(decoder, f"{path}.{name}") for name in ("position", "orientation")}
    kept = _in_order(_usable(tally, stamp, read), stamp, tally)
    return PoseStream(
        topic=decoder.topic.name,
        frame_id=frame,
        world=frame_id(decoder),
        stamp=stamp[kept],
        position=read["position"][kept],
        orientation=read["orientation"][kept],
    )


def read_driving(decoder: TopicDecoder, tally: DefectCounts) -> tuple[tuple[int, int], ...]:
    """Return the times, ns, at which a base drives according to its Odometry or IMU."""
    if decoder.topic.msgtype == IMU:
        imu = build_imu_stream(decoder, tally)
        moves = is_accelerating(imu.stamp, imu.angular_velocity, imu.linear_acceleration)
        return driving_intervals(imu.stamp, moves)
    stamp = read_stamps(decoder)
    linear, angular = (read_field(decoder, f"twist.twist.{name}") for name in ("linear", "angular"))
    kept = _in_order(np.arange(len(stamp)), stamp, tally)
    return driving_intervals(stamp[kept], is_driving(linear[kept], angular[kept]))


def _text(decoder: TopicDecoder, path: str) -> str:
    return str(decoder.batches[0].layout.text[path][0])


def _joint_names(decoder: TopicDecoder) -> tuple[str, ...]:
    first: dict[frozenset[str], tuple[str, ...]] = {}
    counts: Counter[frozenset[str]] = Counter()
    for batch in sorted(decoder.batches, key=lambda batch: int(batch.index[0])):
        if names := batch.layout.text["name"]:
            first.setdefault(frozenset(names), names)
            counts[frozenset(names)] += len(batch.index)
    if counts:
        return first[max(counts, key=counts.__getitem__)]
    raise DefectError(
        decoder.topic.name,
        Defect.NO_NAMES,
        f"{decoder.source}: {decoder.topic.name}: no message names its joints; "
        "have the driver fill JointState.name",
        "E232",
    )


def frame_id(decoder: TopicDecoder) -> str:
    """Return the frame that all messages of a sensor have in common."""
    frames = {batch.layout.text["header.frame_id"][0] for batch in decoder.batches}
    if len(frames) > 1:
        raise DefectError(
            decoder.topic.name,
            Defect.OTHER_FRAME,
            f"{decoder.source}: {decoder.topic.name}: header.frame_id changes between "
            f"{', '.join(sorted(frames))}; give each sensor its own topic",
            "E233",
        )
    return frames.pop()


def _usable(tally: DefectCounts, stamp: IntArray, readings: dict[str, FloatArray]) -> IntArray:
    """Return the positions of the messages whose vectors (N, 3 or 4) a sensor may read."""
    finite = np.hstack([np.abs(values) <= LARGEST for values in readings.values()])
    if finite.all():
        return np.arange(len(stamp))
    labels = [
        f"{name}.{axis}" for name, values in readings.items() for axis in AXES[: values.shape[1]]
    ]
    wrong = np.logical_or.reduce(~finite, axis=1)
    if np.count_nonzero(wrong) >= MAX_INVALID_SHARE * len(stamp):
        row, bad = np.argwhere(~finite)[0]
        values = np.hstack(list(readings.values()))
        raise DefectError(
            tally.topic,
            Defect.NOT_FINITE,
            f"{tally.source}: {tally.topic}: {labels[bad]} is {values[row, bad]} at "
            f"{seconds(stamp[row])}, and at least half of the messages hold NaN, infinite "
            "or impossible values; fix the driver or leave the topic out",
            "E234",
        )
    bad_labels = [labels[column] for column in np.flatnonzero(~finite.all(axis=0)).tolist()]
    tally.add(Defect.NOT_FINITE, stamp, wrong, bad_labels)
    places: IntArray = np.flatnonzero(~wrong)
    return places


def _in_order(usable: IntArray, stamp: IntArray, tally: DefectCounts) -> IntArray | slice:
    """Return which messages to keep, sorted; a slice of all avoids copying a clean log."""
    kept = usable[kept_in_order(stamp[usable], tally)]
    if len(kept) == len(stamp) and np.all(np.diff(kept) == 1):
        return slice(None)
    return kept
