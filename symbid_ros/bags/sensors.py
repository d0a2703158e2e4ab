"""Decoded messages into sensor streams, checked for what would spoil an identification."""

import logging
from collections.abc import Sequence

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.bags.decoder import Piece, TopicDecoder
from symbid_ros.bags.messages import read_stamp
from symbid_ros.bags.stamps import kept_in_order, seconds
from symbid_ros.errors import DataError
from symbid_ros.signals.streams import ImuStream, JointStream, WrenchStream

AXES = ("x", "y", "z")

logger = logging.getLogger("symbid_ros.bags")


def stamps(decoder: TopicDecoder) -> IntArray:
    """Return (N,) header stamps in order of recording."""
    stamp = np.empty(decoder.count, dtype=np.int64)
    for piece in decoder.pieces:
        stamp[piece.index] = read_stamp(piece.records)
    return stamp


def column(decoder: TopicDecoder, path: str) -> FloatArray:
    """Return one field of all messages, (N, width)."""
    width = decoder.pieces[0].records[path].shape[1]
    values = np.empty((decoder.count, width))
    for piece in decoder.pieces:
        values[piece.index] = piece.records[path]
    return values


def joint_stream(decoder: TopicDecoder) -> JointStream:
    """Return joint states, columns in the order of the first message that has names."""
    topic = decoder.topic.name
    names = _joint_names(decoder)
    place = {name: column for column, name in enumerate(names)}
    fields = {
        name: np.full((decoder.count, len(names)), np.nan)
        for name in ("position", "velocity", "effort")
    }
    stamp = stamps(decoder)
    unknown: set[str] = set()
    for piece in decoder.pieces:
        given = piece.layout.text["name"]
        if len(set(given)) != len(given):
            raise DataError(
                f"{decoder.source}: {topic}: a joint is named twice at "
                f"{seconds(stamp[piece.index[0]])}; repair the driver"
            )
        sources = [column for column, name in enumerate(given) if name in place]
        targets = [place[given[column]] for column in sources]
        unknown.update(name for name in given if name not in place)
        for name, values in fields.items():
            read = piece.records[name]
            if read.shape[1] != len(given):  # empty or short: no value belongs to a name
                continue
            if name != "velocity":
                labels = [f"{name} of {joint}" for joint in given]
                _check_finite(decoder, piece, read, labels)
            values[piece.index[:, None], targets] = read[:, sources]
    if unknown:
        logger.warning(
            "%s: %s: joints not in the first message, left out: %s",
            decoder.source,
            topic,
            ", ".join(sorted(unknown)),
        )
    for name in ("position", "effort"):
        absent = int(np.isnan(fields[name]).any(axis=1).sum())
        if absent:
            logger.warning(
                "%s: %s: %d of %d messages lack the %s of a joint",
                decoder.source,
                topic,
                absent,
                decoder.count,
                name,
            )
    kept = kept_in_order(decoder.source, topic, stamp)
    ordered = {name: values[kept] for name, values in fields.items()}
    return JointStream(topic=topic, names=names, stamp=stamp[kept], **ordered)


def imu_stream(decoder: TopicDecoder) -> ImuStream:
    """Return an IMU's messages; the orientation is None where REP-145 says it is absent."""
    topic = decoder.topic.name
    frame_id = _frame_id(decoder)
    for field in ("angular_velocity", "linear_acceleration"):
        if (column(decoder, f"{field}_covariance")[:, 0] == -1).any():
            raise DataError(
                f"{decoder.source}: {topic}: {field} is marked absent (covariance -1); "
                "leave the topic out"
            )
        _check_vectors(decoder, field)
    stamp = stamps(decoder)
    kept = kept_in_order(decoder.source, topic, stamp)
    orientation = column(decoder, "orientation")
    absent = column(decoder, "orientation_covariance")[:, 0] == -1
    orientation[absent] = np.nan
    if absent.any() and not absent.all():
        logger.warning(
            "%s: %s: %d of %d messages have no orientation",
            decoder.source,
            topic,
            np.count_nonzero(absent),
            decoder.count,
        )
    return ImuStream(
        topic=topic,
        frame_id=frame_id,
        stamp=stamp[kept],
        orientation=None if absent.all() else orientation[kept],
        angular_velocity=column(decoder, "angular_velocity")[kept],
        linear_acceleration=column(decoder, "linear_acceleration")[kept],
    )


def wrench_stream(decoder: TopicDecoder) -> WrenchStream:
    """Return a wrench sensor's messages."""
    topic = decoder.topic.name
    frame_id = _frame_id(decoder)
    _check_vectors(decoder, "wrench.force")
    _check_vectors(decoder, "wrench.torque")
    stamp = stamps(decoder)
    kept = kept_in_order(decoder.source, topic, stamp)
    return WrenchStream(
        topic=topic,
        frame_id=frame_id,
        stamp=stamp[kept],
        force=column(decoder, "wrench.force")[kept],
        torque=column(decoder, "wrench.torque")[kept],
    )


def _joint_names(decoder: TopicDecoder) -> tuple[str, ...]:
    for piece in sorted(decoder.pieces, key=lambda piece: int(piece.index[0])):
        if piece.layout.text["name"]:
            return piece.layout.text["name"]
    raise DataError(
        f"{decoder.source}: {decoder.topic.name}: no message names its joints; "
        "let the driver fill JointState.name"
    )


def _frame_id(decoder: TopicDecoder) -> str:
    frames = {piece.layout.text["header.frame_id"][0] for piece in decoder.pieces}
    if len(frames) > 1:
        raise DataError(
            f"{decoder.source}: {decoder.topic.name}: header.frame_id changes between "
            f"{', '.join(sorted(frames))}; give every sensor a topic of its own"
        )
    return frames.pop()


def _check_vectors(decoder: TopicDecoder, path: str) -> None:
    labels = [f"{path}.{axis}" for axis in AXES]
    for piece in decoder.pieces:
        _check_finite(decoder, piece, piece.records[path], labels)


def _check_finite(
    decoder: TopicDecoder, piece: Piece, values: FloatArray, labels: Sequence[str]
) -> None:
    finite = np.isfinite(values)
    if finite.all():
        return
    row, bad = np.argwhere(~finite)[0]
    raise DataError(
        f"{decoder.source}: {decoder.topic.name}: {labels[bad]} is {values[row, bad]} at "
        f"{seconds(read_stamp(piece.records[row : row + 1])[0])}; repair the driver or cut the bag"
    )
