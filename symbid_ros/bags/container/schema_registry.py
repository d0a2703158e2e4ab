"""Schemas and channels of a bag's file, checked for contradictions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.base import TypesysError

from symbid_ros.bags.container.mcap_records import Buffer
from symbid_ros.messages.layout import CDR, typestore
from symbid_ros.messages.limits import (
    MAX_CHANNELS,
    MAX_DEFINITION,
    MAX_QOS,
    MAX_RECORD,
    MAX_REGISTRY,
    MAX_YAML_NODES,
    check_limit,
)
from symbid_ros.messages.topics import ENCODED, OfferedQos, Topic
from symbid_ros.messages.types import ACCEL, IMU, JOINT_STATE, ODOMETRY, POSE, TRAJECTORY, WRENCH
from symbid_ros.user_files import parse_yaml

ROS2_TEXT = "ros2msg"
DECODED_TYPES = frozenset({JOINT_STATE, IMU, WRENCH, TRAJECTORY, ODOMETRY, POSE, ACCEL})

R = TypeVar("R")


class UnknownSchemaError(ValueError):
    """A channel refers to a schema that was not announced."""

    def __init__(self) -> None:
        super().__init__("a channel's schema was never announced")


class _CheckedStream(ReadDataStream):
    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def parse_record(read: Callable[[ReadDataStream], R], body: Buffer) -> R:
    """Parse a record of the mcap package, whose own parser accepts truncated strings."""
    check_limit("a record", len(body), MAX_RECORD)
    return read(_CheckedStream(BytesIO(body)))


@dataclass
class SchemaRegistry:
    """The schemas and channels announced so far, by number.

    A record that contradicts an earlier one raises ValueError: nothing tells which of them applies
    to the messages.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    _size: int = 0

    def add(self, opcode: int, body: Buffer) -> None:
        """Add the body of a schema or channel record; ignore other records."""
        if opcode == Opcode.SCHEMA:
            schema = parse_record(Schema.read, body)
            self._add("schema", self.schemas, schema.id, schema, len(body))
        elif opcode == Opcode.CHANNEL:
            channel = parse_record(Channel.read, body)
            if channel.schema_id and channel.schema_id not in self.schemas:
                raise UnknownSchemaError
            self._add("channel", self.channels, channel.id, channel, len(body))

    def _add(self, kind: str, known: dict[int, R], number: int, record: R, size: int) -> None:
        if known.setdefault(number, record) is record:
            self._size += size
            check_limit(f"a number of {kind}s", len(known), MAX_CHANNELS)
            check_limit("the total size of schemas and channels", self._size, MAX_REGISTRY)
        elif known[number] != record:
            raise ValueError(f"{kind} {number} is announced twice, differently")

    def schema(self, channel: Channel) -> Schema | None:
        """Return the schema of a channel; None if it has none."""
        return self.schemas.get(channel.schema_id)

    @property
    def topics(self) -> dict[int, Topic]:
        """The topics by channel."""
        return {number: self.topic(channel) for number, channel in self.channels.items()}

    def topic(self, channel: Channel) -> Topic:
        """Return the topic of a channel.

        Its type has a remark if the encoding or the definition is not ROS 2 Jazzy's.
        """
        schema, encoding = self.schema(channel), channel.message_encoding
        name = "" if schema is None else full_type_name(schema.name)
        if encoding != CDR:
            name = f"{name or 'something'}{ENCODED}{encoding or 'nothing known'}"
        elif schema is not None and name in DECODED_TYPES and not _is_jazzy(name, schema):
            name = f"{name} of another definition"
        return Topic(channel.topic, name)

    def offered_qos(self, channel: Channel) -> tuple[OfferedQos, ...]:
        """Return the quality of service that a channel's publishers offered; empty if unknown."""
        return parse_qos_profiles(channel.topic, channel.metadata.get("offered_qos_profiles", ""))


def full_type_name(name: str) -> str:
    """Return a type's name in ROS 2; some writers omit ``msg``, as in ROS 1."""
    package, _, short = name.partition("/")
    return f"{package}/msg/{short}" if short and "/" not in short else name


def parse_qos_profiles(topic: str, text: str) -> tuple[OfferedQos, ...]:
    """Parse the quality of service that the publishers of a topic offered, as rosbag2 writes it.

    Raises
    ------
    ValueError
        When the text is not a list of profiles.
    """
    from rosbags.rosbag2.metadata import parse_qos  # noqa: PLC0415 - loads slowly

    try:
        check_limit("a quality of service", len(text), MAX_QOS)
        profiles = parse_qos(parse_yaml(text, MAX_YAML_NODES) or [])
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the quality of service of {topic} is not a list") from error
    return tuple(
        OfferedQos(
            depth=profile.depth,
            history=profile.history.name.lower(),
            reliability=profile.reliability.name.lower(),
            durability=profile.durability.name.lower(),
        )
        for profile in profiles
    )


def _is_jazzy(name: str, schema: Schema) -> bool:
    """Return whether a definition has the fields of ROS 2 Jazzy; an absent one is assumed to."""
    if schema.encoding != ROS2_TEXT or not schema.data:
        return True
    return len(schema.data) <= MAX_DEFINITION and _has_fields_of_jazzy(name, schema.data)


@lru_cache(maxsize=64)  # parsing takes ten milliseconds
def _has_fields_of_jazzy(name: str, definition: bytes) -> bool:
    try:
        # Packages built on Windows have its line endings.
        types = get_types_from_msg(definition.decode().replace("\r\n", "\n"), name)
    except (TypesysError, ValueError, RecursionError):
        return False
    known = typestore().fielddefs
    return all(part in known and known[part][1] == found[1] for part, found in types.items())
