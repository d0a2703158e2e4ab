"""The metadata of a bag as rosbag2 writes it: metadata.yaml, and a record in each file.

rosbags writes metadata only when its own writer closes a bag.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from symbid_ros.messages.layout import CDR
from symbid_ros.messages.topics import OfferedQos

METADATA_VERSION = 9  # of ROS 2 Jazzy


@dataclass(frozen=True)
class TopicMetadata:
    """A topic as rosbag2 describes it."""

    name: str
    msgtype: str
    qos: tuple[OfferedQos, ...]  # one entry for each publisher
    type_hash: str  # RIHS01 hash of the type; empty if unknown
    encoding: str = CDR

    def channel_metadata(self) -> dict[str, str]:
        """Return the metadata of the topic's MCAP channel."""
        profiles = _dump([entry.as_dict() for entry in self.qos])
        return {"offered_qos_profiles": profiles.strip(), "topic_type_hash": self.type_hash}

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``topics_with_message_count``."""
        return {
            "name": self.name,
            "type": self.msgtype,
            "serialization_format": self.encoding,
            "offered_qos_profiles": [entry.as_dict() for entry in self.qos],
            "type_description_hash": self.type_hash,
        }


@dataclass(frozen=True)
class FileMetadata:
    """One file of a bag."""

    name: str
    start: int  # first log time, nanoseconds; 0 without a message
    end: int  # last log time, nanoseconds; 0 without a message
    counts: Mapping[int, int]  # messages by channel

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(self.counts.values())

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``files``."""
        return {
            "path": self.name,
            "starting_time": {"nanoseconds_since_epoch": self.start},
            "duration": {"nanoseconds": self.end - self.start},
            "message_count": self.count,
        }


def describe_bag(
    topics: Mapping[int, TopicMetadata], files: Sequence[FileMetadata], compression_mode: str = ""
) -> dict[str, Any]:
    """Return the content of ``rosbag2_bagfile_information``.

    Parameters
    ----------
    topics : mapping of int to TopicMetadata
        By channel.
    files : sequence of FileMetadata
    compression_mode : str
        ``MESSAGE`` if each message is compressed by itself.
    """
    filled = [file for file in files if file.count]
    start = min((file.start for file in filled), default=0)
    end = max((file.end for file in filled), default=0)
    return {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.count for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": topic.as_dict(),
                "message_count": sum(file.counts.get(channel, 0) for file in files),
            }
            for channel, topic in topics.items()
        ],
        "compression_format": "zstd" if compression_mode else "",
        "compression_mode": compression_mode,
        "relative_file_paths": [file.name for file in files],
        "files": [file.as_dict() for file in files],
        "custom_data": None,
        "ros_distro": "jazzy",
    }


def write_metadata(folder: Path, information: Mapping[str, Any]) -> None:
    """Write a bag's metadata.yaml in one step; it is synced to the disk before it is renamed.

    Raises
    ------
    OSError
        When it does not fit; an earlier file is then unchanged.
    """
    temporary = folder / "metadata.yaml.part"
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(_dump({"rosbag2_bagfile_information": dict(information)}))
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(folder / "metadata.yaml")


def encode_metadata_record(information: Mapping[str, Any]) -> dict[str, str]:
    """Return the content of the MCAP metadata record ``rosbag2``.

    rosbag2 reads topics and counts from it if metadata.yaml is missing.
    """
    return {"serialized_metadata": _dump(dict(information))}


def _dump(content: object) -> str:
    # libyaml is ten times faster, and the metadata is rewritten for each file of the bag.
    text: str = yaml.dump(content, Dumper=yaml.CSafeDumper, sort_keys=False)
    return text
