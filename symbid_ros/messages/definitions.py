"""Message definitions and type hashes of ROS 2 Jazzy and of installed packages."""

import json
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError, get_types_from_msg

from symbid_ros.errors import BagError
from symbid_ros.messages.layout import typestore

SEPARATOR = "=" * 80


@dataclass(frozen=True)
class Definition:
    """The definition of a message type, as bags store it.

    Attributes
    ----------
    text : str
        Definition in ros2msg, followed by those of its parts.
    type_hash : str
        RIHS01 hash; empty if the package does not state it.
    """

    text: str
    type_hash: str


@cache
def find_definition(msgtype: str) -> Definition:
    """Return the definition of, for example, ``sensor_msgs/msg/Imu``.

    Raises
    ------
    BagError
        When neither ROS 2 Jazzy nor an installed package defines the type.
    """
    store = typestore()
    if msgtype in store.fielddefs:
        return Definition(
            store.generate_msgdef(msgtype, ros_version=2)[0], store.hash_rihs01(msgtype)
        )
    texts: dict[str, str] = {}
    _collect(msgtype, texts)
    own = texts.pop(msgtype)
    parts = [f"{SEPARATOR}\nMSG: {_short(name)}\n{text}" for name, text in texts.items()]
    return Definition("\n".join([own, *parts]), _type_hash(msgtype))


def _collect(msgtype: str, texts: dict[str, str]) -> None:
    """Add the definitions of a type and of all its parts."""
    if msgtype in texts:
        return
    file = _installed(msgtype, ".msg")
    try:
        texts[msgtype] = text = file.read_text(encoding="utf-8")
        fields = get_types_from_msg(text, msgtype)[msgtype][1]
    except (TypesysError, OSError, ValueError) as error:
        raise BagError(
            f"message type {msgtype}: its definition cannot be read; leave the topic out", "E215"
        ) from error
    for name in _parts(fields):
        _collect(name, texts)


def _parts(fields: Iterable[tuple[str, Any]]) -> Iterator[str]:
    for _, (node, detail) in fields:
        inner = detail[0] if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (node, detail)
        if inner[0] == Nodetype.NAME:
            yield str(inner[1])


def _installed(msgtype: str, suffix: str) -> Path:
    """Return a file of the package that defines a type.

    The prefixes in ``AMENT_PREFIX_PATH`` (colcon, apt) are searched before the Python environment,
    whose wheels set no such variable.
    """
    package, _, name = msgtype.partition("/")
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in [*prefixes, Path(sys.prefix)]:
        file = prefix / "share" / package / f"{name}{suffix}"
        if file.is_file():
            return file
    raise BagError(
        f"message type {msgtype}: neither part of ROS 2 Jazzy nor installed; "
        "source its workspace or leave the topic out",
        "E215",
    )


def _type_hash(msgtype: str) -> str:
    try:
        content = json.loads(_installed(msgtype, ".json").read_text(encoding="utf-8"))
        hashes = {each["type_name"]: each["hash_string"] for each in content["type_hashes"]}
        return str(hashes.get(msgtype, ""))
    except (BagError, OSError, ValueError, KeyError, TypeError):
        return ""  # another rosidl wrote the file; rosbag2 stores no hash either


def _short(msgtype: str) -> str:
    return msgtype.replace("/msg/", "/")
