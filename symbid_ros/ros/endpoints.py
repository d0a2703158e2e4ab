"""Message classes and qualities of service by the names that bags use."""

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

SETTLE = 0.5  # s; discovery of the remaining subscribers after the needed ones are there
POLL = 0.02  # s
ACKNOWLEDGE = 20.0  # s; a subscriber that takes longer is given up, as by the middleware
FAREWELL = 0.5  # s; the same for a node that was asked to end


def message_class(msgtype: str) -> type[Any]:
    """Return the rclpy class of, for example, ``sensor_msgs/msg/Imu``."""
    try:
        package, kind, name = msgtype.split("/")
        found: type[Any] = getattr(import_module(f"{package}.{kind}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise SymbidError(
            f"message type {msgtype}: not installed; install its package or leave the topic out"
        ) from error
    return found


def reliable_qos(depth: int) -> QoSProfile:
    """Return reliable, volatile, keep-last with a queue of ``depth``."""
    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=QoSDurabilityPolicy.VOLATILE,
    )


def strictest_common_qos(offers: Sequence[QoSProfile], depth: int) -> QoSProfile:
    """Return the strictest profile that all publishers satisfy.

    Reliable publishers are told to wait where they can: nothing is overwritten that has been
    acknowledged. Of others ``depth`` messages are kept.
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
    """Tell whether a publisher's offer is enough for a subscription's request."""
    is_reliable = offer.reliability == QoSReliabilityPolicy.RELIABLE
    is_latched = offer.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    asks_reliable = request.reliability == QoSReliabilityPolicy.RELIABLE
    asks_latched = request.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    return bool((is_reliable or not asks_reliable) and (is_latched or not asks_latched))


def recorded_qos(profile: QoSProfile) -> OfferedQos:
    """Return a publisher's profile in a bag's words."""
    latched = profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
    dependable = profile.reliability == QoSReliabilityPolicy.RELIABLE
    return OfferedQos(
        depth=profile.depth,
        # Discovery tells neither history nor depth; rosbag2 writes the same word.
        history={
            QoSHistoryPolicy.KEEP_LAST: "keep_last",
            QoSHistoryPolicy.KEEP_ALL: "keep_all",
        }.get(profile.history, "unknown"),
        reliability="reliable" if dependable else "best_effort",
        durability="transient_local" if latched else "volatile",
    )


def latched_qos() -> QoSProfile:
    """Return reliable and transient local: whoever subscribes later gets the last message."""
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
    """Wait until no count is 0 that is needed, and none has changed for a while."""
    seen: tuple[int, ...] = ()
    since = time.monotonic()
    while not stop.is_set():
        wanted = needed()
        counts = (*wanted, *others())
        if counts != seen or not all(wanted):
            seen, since = counts, time.monotonic()
        elif time.monotonic() - since >= SETTLE:
            return
        stop.wait(POLL)


def await_acknowledgement(publishers: Iterable[Publisher], stop: Event) -> None:
    """Give reliable subscribers time to fetch what is still on its way; little once stopped."""
    begun = time.monotonic()
    stopped: float | None = None
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=POLL)):
            now = time.monotonic()
            if stop.is_set():
                stopped = stopped or now
                if now - stopped > FAREWELL:
                    return
            if now - begun > ACKNOWLEDGE:
                return
