"""The simulator's ground truth out of its three topics."""

import logging
from functools import reduce

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.sensor_streams import column, stamps
from symbid_ros.signals.defects import Tally
from symbid_ros.signals.stamps import kept_in_order
from symbid_ros.signals.streams import TruthStreams

logger = logging.getLogger("symbid_ros.bags")


def truth_streams(
    joints: TopicDecoder, odometry: TopicDecoder, accel: TopicDecoder
) -> TruthStreams:
    """Return the instants that all three topics have.

    Parameters
    ----------
    joints, odometry, accel : TopicDecoder
        Of ``ground_truth/joints``, ``ground_truth/odom`` and ``ground_truth/base_accel``.
    """
    source = joints.source
    names = _joint_names(joints)
    decoders = (joints, odometry, accel)
    kept, stamp = [], []
    for decoder in decoders:
        recorded = stamps(decoder)
        tally = Tally(source, decoder.topic.name)
        tally.see(recorded)
        places = kept_in_order(recorded, tally)
        tally.report()
        kept.append(places)
        stamp.append(recorded[places])
    common = reduce(np.intersect1d, stamp)
    if not len(common):
        raise DataError(
            f"{source}: the ground_truth/ topics have no instant in common; record all three"
        )
    left_out = max(map(len, stamp)) - len(common)
    if left_out:
        logger.warning("%s: ground truth: %d instants lack one of its topics", source, left_out)
    rows = [
        places[np.searchsorted(recorded, common)]
        for places, recorded in zip(kept, stamp, strict=True)
    ]

    def values(which: int, path: str) -> FloatArray:
        return column(decoders[which], path)[rows[which]]

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
    """Return the joints, the same in every message and each with all four values."""
    names = joints.pieces[0].layout.text["joint_names"]
    paths = [f"points.0.{kind}" for kind in ("positions", "velocities", "accelerations", "effort")]
    for piece in joints.pieces:
        present = piece.layout.dtype.names or ()
        complete = all(
            path in present and piece.records[path].shape[1] == len(names) for path in paths
        )
        if not complete or piece.layout.text["joint_names"] != names:
            raise DataError(
                f"{joints.source}: {joints.topic.name}: not one full point of the same joints in "
                "every message; use a bag of this package's simulator"
            )
    return names
