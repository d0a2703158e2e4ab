"""Copy a bag with some of its messages changed."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.bags import BagWriter
from symbid_ros.bags.container.files import read_blocks
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.types import (
    IMU,
    JOINT_STATE,
    NANO,
    imu_layout,
    joint_state_layout,
    read_stamp,
    wrench_layout,
)

PER_JOINT = ("position", "velocity", "effort")


def topic_counts(bag: Path) -> dict[str, int]:
    """Return the number of messages of every topic, counted in the files themselves."""
    counts: Counter[str] = Counter()
    for block in read_blocks([bag]):
        for topic, spans in block.spans.items():
            counts[topic.name] += len(spans)
    return dict(counts)


@dataclass
class Messages:
    """All messages of one topic in order of recording.

    Edits change numbers in place in ``records``. ``order`` selects and sorts the messages to write,
    ``log_time`` (ns) are the times of their recording.
    """

    msgtype: str
    text: dict[str, tuple[str, ...]]
    records: Any
    order: np.ndarray
    log_time: np.ndarray
    rewritten: list[tuple[np.ndarray, Layout, list[int]]] = field(default_factory=list)

    @property
    def stamp(self) -> np.ndarray:
        return read_stamp(self.records)

    @stamp.setter
    def stamp(self, stamp: np.ndarray) -> None:
        self.records["header.stamp.sec"] = stamp // NANO
        self.records["header.stamp.nanosec"] = stamp % NANO

    @property
    def joints(self) -> tuple[str, ...]:
        return self.text["name"]

    def between(self, start: float, stop: float) -> np.ndarray:
        """Return which messages are from ``start`` to ``stop`` seconds after the first."""
        after = (self.stamp - self.stamp[0]) * 1e-9
        return (after >= start) & (after < stop)

    def rename(self, rows: np.ndarray, columns: Sequence[int], names: Sequence[str]) -> None:
        """Keep only some joints of some messages, under new names."""
        self.rewritten.append((rows, joint_state_layout(tuple(names)), list(columns)))

    def reframe(self, frame: str) -> None:
        """Change the frame of all messages."""
        layout = imu_layout(frame) if self.msgtype == IMU else wrench_layout(frame)
        self.rewritten.append((np.ones(len(self.records), dtype=bool), layout, []))

    def payloads(self) -> list[bytes]:
        """Return the edited messages, unsorted."""
        payloads = [record.tobytes() for record in self.records]
        for rows, layout, columns in self.rewritten:
            records = layout.records(int(rows.sum()))
            for path in records.dtype.names:
                values = self.records[path][rows]
                is_chosen = self.msgtype == JOINT_STATE and path in PER_JOINT
                records[path] = values[:, columns] if is_chosen else values
            for row, record in zip(np.flatnonzero(rows), records, strict=True):
                payloads[row] = record.tobytes()
        return payloads


BagEdit = Callable[[Messages], None]


def edit_bag(bag: Path, out: Path, edits: dict[str, BagEdit]) -> Path:
    """Copy the sensor topics of a simulated bag into a new one, and edit the named ones."""
    decoders: dict[str, TopicDecoder] = {}
    for block in read_blocks([bag]):
        for topic, spans in block.spans.items():
            if "ground_truth" not in topic.name:
                decoder = decoders.setdefault(topic.name, TopicDecoder(str(bag), topic))
                decoder.add(block.data, spans)
    assert set(edits) <= set(decoders)
    written: list[tuple[int, int, bytes]] = []
    with BagWriter(out) as writer:
        for name, decoder in decoders.items():
            channel = writer.add_topic(name, decoder.topic.msgtype)
            layout = decoder.batches[0].layout
            records = layout.records(decoder.count)
            for piece in decoder.batches:
                for path in records.dtype.names:
                    records[path][piece.index] = piece.records[path]
            stamp, order = read_stamp(records), np.arange(len(records))
            messages = Messages(decoder.topic.msgtype, layout.text, records, order, stamp)
            edits.get(name, lambda _: None)(messages)
            payloads = messages.payloads()
            times = messages.log_time.tolist()
            written += [
                (times[place], channel, payloads[row]) for place, row in enumerate(messages.order)
            ]
        # As a recorder does: by time of arrival, each topic in its own order.
        for time, channel, payload in sorted(written, key=lambda each: each[0]):
            writer.write(channel, time, payload)
    return out
