"""Read files that users name: regular files of limited size, YAML and JSON of limited depth."""

import errno
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import yaml

from symbid_ros.errors import DataError

MEBI = 1 << 20
MAX_YAML_BYTES = MEBI
MAX_JSON_BYTES = 64 * MEBI
MAX_DEPTH = 50
MAX_NODES = 100_000  # keys, values and lists

LARGEST_INTEGER = 2**63 - 1
LONGEST_QUOTE = 40


def as_path(what: str, given: object) -> Path:
    """Return the path of a file or folder that a Python user gave.

    Raises
    ------
    DataError
        When it is neither a text nor a path; ``what`` names it.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise DataError(f"{what} must be a path, not {type(given).__name__}", "E511")


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Reading a device such as /dev/zero would never end, and opening a pipe without a writer would
    block.

    Raises
    ------
    OSError
        If it is missing, unreadable or not a regular file; ``strerror`` says which.
    """
    try:
        # Checked before opening, as opening a device may have side effects.
        _require_regular(path, os.stat(path))
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from None
    try:
        # It may have been replaced since.
        _require_regular(path, os.fstat(handle))
    except OSError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def read_regular(path: Path, limit: int) -> bytes:
    """Return the content of a regular file of at most ``limit`` bytes.

    Raises
    ------
    OSError
        As :func:`open_regular`.
    ValueError
        If it is larger than ``limit`` bytes.
    """
    with open_regular(path) as stream:
        # read() allocates as much as it is asked for, and the limit may far exceed the file.
        size = os.fstat(stream.fileno()).st_size
        content = stream.read(min(size, limit) + 1)
    if len(content) > limit:
        raise ValueError(f"larger than {limit // MEBI} MiB, the limit")
    return content


def begins_with_mark(path: Path, mark: str) -> bool:
    """Return whether a text is in the first KiB of a regular file.

    This package marks the files that it writes, so that it replaces no others.
    """
    try:
        with open_regular(path) as stream:
            return mark.encode() in stream.read(1024)
    except OSError:
        return False


def _require_regular(path: Path, status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "a folder, not a file", str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


if TYPE_CHECKING:
    from yaml import SafeLoader as _SafeLoader
else:
    # Many times faster where PyYAML was built with libyaml, as its wheels are.
    _SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):
    """PyYAML's safe loader, which also rejects invalid scalars and names their line."""


def _checked(construct: Callable[[Any, yaml.ScalarNode], Any]) -> Callable[[Any, Any], Any]:
    """Return a scalar's constructor that reports every failure as ValueError."""

    def constructed(loader: Any, node: yaml.ScalarNode) -> Any:
        quote = repr(node.value[:LONGEST_QUOTE])
        if ":" in node.value and "timestamp" not in node.tag:
            # YAML 1.1 reads 1:30 as 90, which hardly anyone intends.
            _refuse(node.start_mark, f"{quote} is a number in base 60; write it with decimals")
        try:
            value = construct(loader, node)
        except (ValueError, ArithmeticError, LookupError, AttributeError, TypeError):
            kind = node.tag.rpartition(":")[2]
            _refuse(node.start_mark, f"{quote} is not a valid {kind}; correct it")
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            _refuse(node.start_mark, f"{quote} has more than 64 bits; give a smaller number")
        return value

    return constructed


for _kind in ("int", "float", "bool", "timestamp"):
    _tag = f"tag:yaml.org,2002:{_kind}"
    _Loader.add_constructor(_tag, _checked(_SafeLoader.yaml_constructors[_tag]))


def load_yaml(path: Path) -> Any:
    """Return the content of a YAML file as plain data.

    Raises
    ------
    OSError
        If the file cannot be read or is not a regular file.
    ValueError
        If it is larger than ``MAX_YAML_BYTES``, or as :func:`parse_yaml`.
    """
    return parse_yaml(_text(read_regular(path, MAX_YAML_BYTES)))


def parse_yaml(text: str, most_nodes: int = MAX_NODES) -> Any:
    """Return the content of a YAML text as plain data.

    Raises
    ------
    ValueError
        If it is not valid YAML, repeats a key of a mapping, or holds an invalid value: a number in
        base 60 or beyond 64 bits, or a date that does not exist. Also if, with aliases (``*name``)
        expanded, it is nested deeper than ``MAX_DEPTH`` or has more than ``most_nodes`` nodes, as
        a few lines can expand to gigabytes.
    """
    try:
        _check_events(text, most_nodes)
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _Extent(most_nodes).of(node)
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark, problem = error.problem_mark or error.context_mark, error.problem or error.context
        place = "" if mark is None else f"line {mark.line + 1}: "
        raise ValueError(f"{place}not valid YAML ({problem}); correct it") from None
    except yaml.YAMLError as error:  # a character that YAML does not allow
        reason = " ".join(str(error).split())
        raise ValueError(f"not valid YAML ({reason}); correct it") from None


def load_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises
    ------
    OSError
        If the file cannot be read or is not a regular file.
    ValueError
        If it is not valid JSON, is larger than ``MAX_JSON_BYTES``, is nested too deeply, or
        repeats a key of an object.
    """
    content = _text(read_regular(path, MAX_JSON_BYTES))
    try:
        return json.loads(content, object_pairs_hook=_reject_repeated_keys)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _text(content: bytes) -> str:
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: not UTF-8 text; save the file in UTF-8") from None


def _reject_repeated_keys(entries: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise ValueError for a repeated key, whose last value JSON keeps."""
    content = dict(entries)
    if len(content) < len(entries):
        seen: set[str] = set()
        for key, _ in entries:
            if key in seen:
                raise ValueError(f"key {key!r} is given twice")
            seen.add(key)
    return content


def _check_events(text: str, most_nodes: int) -> None:
    """Reject text whose parsing would take too much memory or stack."""
    depth = nodes = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.NodeEvent):
            nodes += 1
            depth += isinstance(event, yaml.CollectionStartEvent)
        if depth > MAX_DEPTH:
            _refuse(event.start_mark, f"more than {MAX_DEPTH} levels deep")
        if nodes > most_nodes:
            _refuse(event.start_mark, f"more than {most_nodes} parts")


class _Extent:
    """Size and depth of nodes with all aliases expanded."""

    def __init__(self, most_nodes: int) -> None:
        self._most = most_nodes
        self._known: dict[int, tuple[int, int]] = {}

    def of(self, node: yaml.Node, depth: int = 1) -> tuple[int, int]:
        """Return the number of nodes and the number of levels."""
        if depth > MAX_DEPTH:  # a node may contain itself
            _refuse(node.start_mark, f"more than {MAX_DEPTH} levels deep")
        if id(node) not in self._known:
            below = [self.of(child, depth + 1) for child in _children(node)]
            count = 1 + sum(size for size, _ in below)
            levels = 1 + max((level for _, level in below), default=0)
            if count > self._most or levels > MAX_DEPTH:
                _refuse(node.start_mark, f"more than {self._most} parts or {MAX_DEPTH} levels")
            self._known[id(node)] = count, levels
        return self._known[id(node)]


def _children(node: yaml.Node) -> list[yaml.Node]:
    """Return a node's children, keys before values; repeated keys are an error."""
    if isinstance(node, yaml.SequenceNode):
        return list(node.value)
    if not isinstance(node, yaml.MappingNode):
        return []
    keys = [key for key, _ in node.value]
    seen: set[str] = set()
    for key in keys:
        if isinstance(key, yaml.ScalarNode):
            if key.value in seen:
                _refuse(key.start_mark, f"{key.value} is given twice; remove one of them")
            seen.add(key.value)
    return keys + [value for _, value in node.value]


def _refuse(mark: Any, reason: str) -> NoReturn:
    raise ValueError(f"line {mark.line + 1}: {reason}")
