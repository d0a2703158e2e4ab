"""Split the joint states of a simulated bag into parts, as drivers of arms and legs do."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.bags import BagWriter
from symbid_ros.bags.container.files import read_blocks
from symbid_ros.messages.decoder import TopicDecoder
from symbid_ros.messages.types import JOINT_STATE, fill_message, joint_state_layout, read_stamp

JOINTS = "/joint_states"
FIELDS = ("position", "velocity", "effort")


@dataclass(frozen=True)
class Part:
    """Joints published on a separate or a shared topic; ``delay`` in ns.

    Fields that it does not publish are NaN.
    """

    topic: str
    joints: Callable[[str], bool]
    delay: int = 0
    every: int = 1
    fields: tuple[str, ...] = FIELDS


def left(name: str) -> bool:
    return name.startswith("L_")


def right(name: str) -> bool:
    return not left(name)


def split_joints(bag: Path, out: Path, parts: Sequence[Part]) -> Path:
    """Copy the sensor topics of a bag into a new one, and split its joint states."""
    written: list[tuple[int, int, bytes]] = []
    with BagWriter(out) as writer:
        channels: dict[str, int] = {}

        def channel(topic: str, msgtype: str) -> int:
            if topic not in channels:
                channels[topic] = writer.add_topic(topic, msgtype)
            return channels[topic]

        for block in read_blocks([bag]):
            for topic, spans in block.spans.items():
                if "ground_truth" in topic.name:
                    continue
                decoder = TopicDecoder(str(bag), topic)
                decoder.add(block.data, spans)
                (piece,) = decoder.batches
                stamps = read_stamp(piece.records)
                if topic.name != JOINTS:
                    payloads = [block.data[at : at + size].tobytes() for at, size in spans]
                    written += [
                        (stamp, channel(topic.name, topic.msgtype), payload)
                        for stamp, payload in zip(stamps.tolist(), payloads, strict=True)
                    ]
                    continue
                names = piece.layout.text["name"]
                for part in parts:
                    chosen = [place for place, name in enumerate(names) if part.joints(name)]
                    layout = joint_state_layout(tuple(names[place] for place in chosen))
                    rows = slice(None, None, part.every)
                    stamp = stamps[rows] + part.delay
                    records = layout.records(len(stamp))
                    fill_message(
                        layout.columns(records),
                        stamp,
                        **{
                            field: piece.records[field][rows][:, chosen]
                            * (1.0 if field in part.fields else np.nan)
                            for field in FIELDS
                        },
                    )
                    written += [
                        (int(when), channel(part.topic, JOINT_STATE), record.tobytes())
                        for when, record in zip(stamp, records, strict=True)
                    ]
        for stamp, number, payload in sorted(written, key=lambda each: each[0]):
            writer.write(number, stamp, payload)
    return out


def stamped(payload: bytes, stamp: int) -> bytes:
    """Return a copy of a serialised little-endian message with another header stamp, ns."""
    seconds, rest = divmod(stamp, 10**9)
    return payload[:4] + np.array([seconds, rest], dtype="<u4").tobytes() + payload[12:]
