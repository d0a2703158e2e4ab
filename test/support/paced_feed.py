"""Sensor messages at fixed rates, stamped with the time of publishing, and what became of them."""

import os
import signal
import struct
import time
from array import array
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import numpy as np
import rclpy
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from rclpy.context import Context
from rclpy.node import Node

from symbid_ros.cli.processes import NodeProcess, unused_domain
from symbid_ros.messages.layout import ENCAPSULATION, Layout
from symbid_ros.messages.types import (
    imu_layout,
    joint_state_layout,
    read_leading_stamp,
    wrench_layout,
)
from symbid_ros.ros.endpoints import message_class, reliable_qos

STAMP = struct.Struct("<iI")
JOINTS = tuple(f"joint_{number}" for number in range(10))
SENSORS = {
    "joint_states": joint_state_layout(JOINTS),
    "imu/data": imu_layout("imu_link"),
    "left_foot/wrench": wrench_layout("left_sole"),
    "right_foot/wrench": wrench_layout("right_sole"),
}


RATES = {"joint_states": 1000.0, "imu/data": 5.0}  # Hz; of a recorder to be killed
DEADLINE = 300.0  # s; only a hang takes longer
LOOK = 0.002  # s
WINDOW = 0.3  # s before a kill in which the recorder's waits for a processor are counted
VARIETY = 64  # different messages in rotation, because equal ones would compress too well


class Feed:
    """Publishes one topic with pre-serialised noise; the stamp is patched in place."""

    def __init__(self, node: Node, topic: str, layout: Layout, rate: float) -> None:
        self.topic, self.rate = topic, rate
        self.stamps = array("q")
        self.publisher = node.create_publisher(
            message_class(layout.msgtype), topic, reliable_qos(5000)
        )
        self._payloads = _noise(layout)

    def publish(self) -> None:
        payload = self._payloads[len(self.stamps) % VARIETY]
        stamp = time.time_ns()
        STAMP.pack_into(payload, ENCAPSULATION, *divmod(stamp, 10**9))
        self.publisher.publish(bytes(payload))
        self.stamps.append(stamp)


def _noise(layout: Layout) -> list[bytearray]:
    draw = np.random.default_rng(0)
    records = layout.records(VARIETY)
    for values in layout.columns(records).values():
        if values.dtype.kind == "f":
            values[...] = draw.standard_normal(values.shape)
    return [bytearray(record.tobytes()) for record in records]


def feed(feeds: Sequence[Feed], stop: Event, seconds: float = float("inf")) -> float:
    """Publish until stopped or finished; return the longest delay of a message, s."""
    begin = time.monotonic()
    counts = [0] * len(feeds)
    latest = 0.0
    while not stop.is_set():
        due = [begin + count / each.rate for count, each in zip(counts, feeds, strict=True)]
        first = min(due)
        if first - begin >= seconds:
            break
        now = time.monotonic()
        if first > now:
            time.sleep(first - now)
            continue
        latest = max(latest, now - first)
        for place, each in enumerate(feeds):
            if due[place] <= now:
                each.publish()
                counts[place] += 1
    return latest


@dataclass(frozen=True)
class Kill:
    """Losses caused by a kill.

    ``lost`` is the age of the oldest missing message, s, by topic. ``standstill`` is the longest
    delay, s, of the publisher or of a thread on each processor that only reads the clock.
    ``waited`` is how long the threads of the recorder were ready to run but had no processor in the
    last ``WINDOW`` seconds, s.
    """

    lost: dict[str, float]
    standstill: float
    waited: float


def kill_recorder(seconds: float, folder: Path) -> Kill:
    """Feed a recorder for a while, kill it with SIGKILL and examine its unfinished bag.

    Each run has its own domain, because a killed subscriber still counts for seconds.
    """
    context = Context()
    bag = folder / "bag"
    with unused_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = rclpy.create_node("robot", context=context)
        feeds = [Feed(node, f"fed/{topic}", SENSORS[topic], rate) for topic, rate in RATES.items()]
        parameters = {"bag": str(bag), "topics": [each.topic for each in feeds]}
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        log = folder / "recorder.log"
        try:
            with NodeProcess("recorder", parameters, environment, log) as recorder:
                await_subscribers(feeds)
                cost = _kill_while_feeding(recorder.pid, feeds, seconds, bag)
        finally:
            node.destroy_node()
            context.try_shutdown()
    assert not (bag / "metadata.yaml").exists()
    return cost


def await_subscribers(feeds: Sequence[Feed]) -> None:
    """Wait until every topic has a subscriber."""
    deadline = time.monotonic() + DEADLINE
    while not all(each.publisher.get_subscription_count() for each in feeds):
        assert time.monotonic() < deadline, "nobody subscribes"
        time.sleep(0.02)


def _kill_while_feeding(pid: int, feeds: Sequence[Feed], seconds: float, bag: Path) -> Kill:
    stop = Event()
    with ThreadPoolExecutor() as pool:
        late = [pool.submit(feed, feeds, stop)]
        late += [pool.submit(_watch, cpu, stop) for cpu in os.sched_getaffinity(0)]
        stop.wait(max(0.0, seconds - WINDOW))
        begin = _time_without_processor(pid)
        stop.wait(min(seconds, WINDOW))
        waited = _lost_to_others(begin, _time_without_processor(pid))
        os.kill(pid, signal.SIGKILL)
        killed = time.time_ns()
        stop.set()
    (file,) = bag.glob("*.mcap")
    stored = stored_stamps(file)
    lost = {}
    for each in feeds:
        found = set(stored.get(f"/{each.topic}", ()))
        published = [stamp for stamp in each.stamps if stamp < killed]
        assert published, f"nothing was published on {each.topic}"
        missing = [stamp for stamp in published if stamp not in found]
        lost[each.topic] = (killed - min(missing)) * 1e-9 if missing else 0.0
    return Kill(lost, max(each.result() for each in late), waited)


def _time_without_processor(pid: int) -> dict[str, int]:
    """Return how long each thread of a process has waited for a processor, ns.

    It is the second number of /proc/PID/task/TID/schedstat, see sched-stats.rst of the kernel.
    """
    return {
        file.parent.name: int(file.read_text().split()[1])
        for file in Path(f"/proc/{pid}/task").glob("*/schedstat")
    }


def _lost_to_others(begin: dict[str, int], end: dict[str, int]) -> float:
    """Return how long a message may have waited for a processor, s.

    Two threads handle it, one after the other: one receives, one writes.
    """
    waits = sorted(wait - begin.get(thread, 0) for thread, wait in end.items())
    return sum(waits[-2:]) * 1e-9


def _watch(cpu: int, stop: Event) -> float:
    """Return the longest delay with which this thread woke up on one processor, s."""
    os.sched_setaffinity(0, {cpu})  # of this thread
    latest = 0.0
    while not stop.is_set():
        begin = time.monotonic()
        time.sleep(LOOK)
        latest = max(latest, time.monotonic() - begin - LOOK)
    return latest


def stored_stamps(file: Path) -> dict[str, list[int]]:
    """Return the stamps of all complete messages of a file, finished or not, by topic."""
    topics: dict[int, str] = {}
    stamps: dict[str, list[int]] = {}
    with file.open("rb") as stream, suppress(EndOfFile):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                stamps.setdefault(topics[record.channel_id], []).append(
                    read_leading_stamp(record.data)
                )
    return stamps
