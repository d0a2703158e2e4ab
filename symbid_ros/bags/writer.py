"""Bags as rosbag2 writes them: one MCAP file and its metadata.yaml in a folder."""

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml

from symbid_ros.bags.chunks import ChunkWriter
from symbid_ros.bags.layout import typestore
from symbid_ros.errors import BagError

CHUNK_SIZE = 64 * 1024  # what a killed recorder loses at most: 64 ms of four sensors at 1 kHz
METADATA_VERSION = 9  # ROS 2 Jazzy's
ENCODING = "cdr"
UNLIMITED = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True)
class OfferedQos:
    """What a publisher offers, in rosbag2's words."""

    depth: int = 10
    history: str = "keep_last"
    reliability: str = "reliable"
    durability: str = "volatile"

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``offered_qos_profiles``; unnamed policies are unlimited."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(UNLIMITED),
            "lifespan": dict(UNLIMITED),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(UNLIMITED),
            "avoid_ros_namespace_conventions": False,
        }


@dataclass
class _Topic:
    name: str
    msgtype: str
    qos: tuple[OfferedQos, ...]
    type_hash: str
    count: int = 0


class BagWriter:
    """Writes one bag; complete once closed, removed when left by an exception.

    The folder carries no metadata.yaml and the file no footer until `close`
    succeeds, so that an interrupted bag can be told from a complete one.

    Parameters
    ----------
    path : Path
        The bag's folder, which must not exist.
    chunk_size : int
        Bytes of serialised data collected before they are compressed and written.
    """

    def __init__(self, path: Path, *, chunk_size: int = CHUNK_SIZE) -> None:
        self.path = path
        self._topics: dict[int, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._start: int | None = None
        self._end = 0
        if path.exists() or path.is_symlink():
            raise BagError(f"{path}: exists already; choose another name or remove it")
        self.file = path / f"{path.name}_0.mcap"
        try:
            path.mkdir(parents=True)
            self._stream = self.file.open("xb")
        except OSError as error:
            raise BagError(f"{path}: cannot create the bag: {error.strerror}") from error
        self._mcap = ChunkWriter(self._stream, chunk_size)
        self._write_metadata_record()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        return {topic.name: topic.count for topic in self._topics.values()}

    def add_topic(
        self, name: str, msgtype: str, qos: Sequence[OfferedQos] = (OfferedQos(),)
    ) -> int:
        """Announce a topic and return the number that `write` wants.

        Parameters
        ----------
        name : str
            Fully qualified topic name.
        msgtype : str
            For example ``sensor_msgs/msg/Imu``; one of ROS 2 Jazzy's own types.
        qos : sequence of OfferedQos
            One entry per publisher.
        """
        if name in self.counts:
            raise BagError(f"{self.path}: topic {name} is announced twice; record it once")
        store = typestore()
        if msgtype not in store.fielddefs:
            raise BagError(
                f"{self.path}: topic {name} has type {msgtype}, which is not part of ROS 2 Jazzy; "
                "leave the topic out"
            )
        if msgtype not in self._schemas:
            definition = store.generate_msgdef(msgtype, ros_version=2)[0]
            self._schemas[msgtype] = self._mcap.add_schema(msgtype, definition)
        topic = _Topic(name, msgtype, tuple(qos), store.hash_rihs01(msgtype))
        profiles = yaml.safe_dump([entry.as_dict() for entry in topic.qos], sort_keys=False)
        channel = self._mcap.add_channel(
            name,
            self._schemas[msgtype],
            {"offered_qos_profiles": profiles.strip(), "topic_type_hash": topic.type_hash},
        )
        self._topics[channel] = topic
        return channel

    def write(
        self, topic: int, log_time: int, payload: bytes, publish_time: int | None = None
    ) -> None:
        """Append one serialised message; times in nanoseconds."""
        published = log_time if publish_time is None else publish_time
        try:
            self._mcap.add_message(topic, log_time, published, payload)
        except OSError as error:
            raise self._write_error(error) from error
        self._topics[topic].count += 1
        self._start = log_time if self._start is None else min(self._start, log_time)
        self._end = max(self._end, log_time)

    def flush(self) -> None:
        """Hand everything written so far to the operating system, closing the open chunk."""
        try:
            self._mcap.end_chunk()
            self._stream.flush()
        except OSError as error:
            raise self._write_error(error) from error

    def close(self) -> None:
        """Write index, footer and metadata.yaml; the bag is complete afterwards."""
        if self._stream.closed:
            return
        try:
            self._mcap.end_chunk()
            self._write_metadata_record()
            self._mcap.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._stream.close()
            temporary = self.path / "metadata.yaml.part"
            temporary.write_text(
                _dump({"rosbag2_bagfile_information": self._information()}), encoding="utf-8"
            )
            temporary.replace(self.path / "metadata.yaml")
        except OSError as error:
            raise self._write_error(error) from error

    def discard(self) -> None:
        """Remove the unfinished bag."""
        with suppress(OSError):  # what is still buffered may not fit on a full disk
            self._stream.close()
        shutil.rmtree(self.path, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _write_error(self, error: OSError) -> BagError:
        return BagError(f"{self.file}: cannot write: {error.strerror}; the bag is incomplete")

    def _write_metadata_record(self) -> None:
        # rosbag2 reads topics and counts from here when metadata.yaml is lost.
        self._mcap.add_metadata("rosbag2", {"serialized_metadata": _dump(self._information())})

    def _information(self) -> dict[str, Any]:
        total = sum(self.counts.values())
        start = {"nanoseconds_since_epoch": self._start or 0}
        duration = {"nanoseconds": self._end - (self._start or 0)}
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": total,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.msgtype,
                        "serialization_format": ENCODING,
                        "offered_qos_profiles": [entry.as_dict() for entry in topic.qos],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.count,
                }
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [
                {
                    "path": self.file.name,
                    "starting_time": dict(start),
                    "duration": dict(duration),
                    "message_count": total,
                }
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


def _dump(content: dict[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False)
