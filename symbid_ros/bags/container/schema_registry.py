"""Schemas and channels of an MCAP file: each announced once, or always in the same words."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from rosbags.rosbag2.metadata import parse_qos
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
from symbid_ros.messages.topics import ENCODED, OfferedQos
from symbid_ros.messages.types import ACCEL, IMU, JOINT_STATE, ODOMETRY, TRAJECTORY, WRENCH
from symbid_ros.safe_yaml import parse_yaml

ROS2_TEXT = "ros2msg"
READ = frozenset({JOINT_STATE, IMU, WRENCH, TRAJECTORY, ODOMETRY, ACCEL})

R = TypeVar("R")


class UnknownSchemaError(ValueError):
    """A channel names a schema that was not announced."""

    def __init__(self) -> None:
        super().__init__("a channel's schema was never announced")


class _Fields(ReadDataStream):
    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def parse_record(read: Callable[[ReadDataStream], R], body: Buffer) -> R:
    """Return a record of the mcap package, whose own parser lets short strings pass."""
    check_limit("a record", len(body), MAX_RECORD)
    return read(_Fields(BytesIO(body)))


@dataclass
class SchemaRegistry:
    """The schemas and channels that were announced so far, by their numbers.

    An announcement that contradicts an earlier one raises ValueError: which of them
    the messages follow cannot be known.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    _size: int = 0

    def add(self, opcode: int, body: Buffer) -> None:
        """Take a schema or channel record's body; any other record is none of its concern."""
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
        """Return the schema of a channel, if it has one."""
        return self.schemas.get(channel.schema_id)

    def msgtype(self, channel: Channel) -> str:
        """Return the message type; with a remark where its messages are not what the name says."""
        return describe_type(self.schema(channel), channel.message_encoding)

    def offers(self, channel: Channel) -> tuple[OfferedQos, ...]:
        """Return what the publishers of a channel offered, empty where it does not tell."""
        return parse_qos_profiles(channel.topic, channel.metadata.get("offered_qos_profiles", ""))


def describe_type(schema: Schema | None, message_encoding: str) -> str:
    """Return a message type; with a remark where its messages are not what the name says."""
    name = "" if schema is None else full_type_name(schema.name)
    if message_encoding != CDR:
        return f"{name or 'something'}{ENCODED}{message_encoding or 'nothing known'}"
    if schema is not None and name in READ and not _is_jazzy(name, schema):
        return f"{name} of another definition"
    return name


def full_type_name(name: str) -> str:
    """Return a type's name as ROS 2 has it; some writers leave ``msg`` out, as ROS 1 did."""
    package, _, short = name.partition("/")
    return f"{package}/msg/{short}" if short and "/" not in short else name


def parse_qos_profiles(topic: str, text: str) -> tuple[OfferedQos, ...]:
    """Return what publishers of a topic offered, given as rosbag2 writes it.

    Raises
    ------
    ValueError
        When it is something else.
    """
    try:
        check_limit("a quality of service", len(text), MAX_QOS)
        profiles = parse_qos(parse_yaml(text, MAX_YAML_NODES) or [])
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the quality of service of {topic} is no list") from error
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
    """Tell whether a definition has ROS 2 Jazzy's fields; none at all is taken at its name."""
    if schema.encoding != ROS2_TEXT or not schema.data:
        return True
    return len(schema.data) <= MAX_DEFINITION and _has_fields_of_jazzy(name, schema.data)


@lru_cache(maxsize=64)  # parsing takes ten milliseconds
def _has_fields_of_jazzy(name: str, definition: bytes) -> bool:
    try:
        # Packages that were built on Windows have its line ends.
        types = get_types_from_msg(definition.decode().replace("\r\n", "\n"), name)
    except (TypesysError, ValueError, RecursionError):
        return False
    known = typestore().fielddefs
    return all(part in known and known[part][1] == found[1] for part, found in types.items())
