"""What publishers and subscriptions share: message classes, QoS profiles and waiting."""

import time
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from threading import Event
from typing import Any

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from symbid_ros.errors import SymbidError
from symbid_ros.messages.topics import OfferedQos

SETTLE = 0.5  # s without a new subscriber after which discovery counts as complete
POLL = 0.02  # s
ACKNOWLEDGE = 20.0  # s; the middleware also abandons a subscriber that takes longer
SHUTDOWN_ACKNOWLEDGE = 0.5  # s; limit for a node that has been told to stop


def message_class(msgtype: str) -> type[Any]:
    """Return the rclpy class of, for example, ``sensor_msgs/msg/Imu``."""
    try:
        package, kind, name = msgtype.split("/")
        found: type[Any] = getattr(import_module(f"{package}.{kind}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise SymbidError(
            f"message type {msgtype}: not installed; install its package or leave the topic out",
            "E802",
        ) from error
    return found


def reliable_qos(depth: int) -> QoSProfile:
    """Return a profile that is reliable, volatile and keeps the last ``depth`` messages."""
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.VOLATILE,
    )


def strictest_common_qos(offers: Sequence[QoSProfile], depth: int) -> QoSProfile:
    """Return the strictest profile that is compatible with the offers of all publishers.

    If all are reliable, the history keeps all messages, so that a full queue blocks publishers
    instead of dropping messages. Otherwise it keeps the last ``depth`` messages.
    """
    is_reliable = all(offer.reliability == QoSReliabilityPolicy.RELIABLE for offer in offers)
    is_latched = all(offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_ALL if is_reliable else QoSHistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=QoSReliabilityPolicy.RELIABLE
        if is_reliable
        else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
        if is_latched
        else QoSDurabilityPolicy.VOLATILE,
    )


def is_compatible(offer: QoSProfile, request: QoSProfile) -> bool:
    """Return whether a publisher's offer satisfies a subscription's request."""
    is_reliable = offer.reliability == QoSReliabilityPolicy.RELIABLE
    is_latched = offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    asks_reliable = request.reliability == QoSReliabilityPolicy.RELIABLE
    asks_latched = request.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    return bool((is_reliable or not asks_reliable) and (is_latched or not asks_latched))


def recorded_qos(profile: QoSProfile) -> OfferedQos:
    """Return a publisher's profile as the metadata of a bag describes it."""
    is_latched = profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    is_reliable = profile.reliability == QoSReliabilityPolicy.RELIABLE
    return OfferedQos(
        depth=profile.depth,
        # Discovery reports neither history nor depth; rosbag2 writes "unknown" as well.
        history={
            QoSHistoryPolicy.KEEP_LAST: "keep_last",
            QoSHistoryPolicy.KEEP_ALL: "keep_all",
        }.get(profile.history, "unknown"),
        reliability="reliable" if is_reliable else "best_effort",
        durability="transient_local" if is_latched else "volatile",
    )


def latched_qos() -> QoSProfile:
    """Return a reliable, transient-local profile: late subscribers get the last message."""
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL,
    )


def await_settled(
    needed: Callable[[], Sequence[int]],
    stop: Event,
    others: Callable[[], Sequence[int]] = tuple,
) -> None:
    """Wait until all needed counts are positive and no count has changed for ``SETTLE`` seconds."""
    seen: tuple[int, ...] = ()
    since = time.monotonic()
    while not stop.is_set():
        required = needed()
        counts = (*required, *others())
        if counts != seen or not all(required):
            seen, since = counts, time.monotonic()
        elif time.monotonic() - since >= SETTLE:
            return
        stop.wait(POLL)


def await_acknowledgement(publishers: Iterable[Publisher], stop: Event) -> None:
    """Wait until reliable subscribers have received all messages, at most ``ACKNOWLEDGE`` seconds.

    After ``stop`` is set, the limit is ``SHUTDOWN_ACKNOWLEDGE`` seconds.
    """
    began = time.monotonic()
    stopped: float | None = None
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=POLL)):
            now = time.monotonic()
            if stop.is_set():
                stopped = stopped or now
                if now - stopped > SHUTDOWN_ACKNOWLEDGE:
                    return
            if now - began > ACKNOWLEDGE:
                return
