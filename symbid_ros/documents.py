"""YAML and JSON by another hand, read within limits."""

import json
from pathlib import Path
from typing import Any, NoReturn

import yaml

MAX_YAML_BYTES = 1 << 20
MAX_JSON_BYTES = 64 << 20
MAX_DEPTH = 50
MAX_NODES = 100_000  # keys, values and lists

# Many times faster where PyYAML was built with libyaml, as its wheels are.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def load_yaml(path: Path) -> Any:
    """Return what a YAML file says, as plain data.

    Raises
    ------
    OSError
        When the file cannot be read.
    ValueError
        When it is larger than ``MAX_YAML_BYTES``, or as :func:`parse_yaml`.
    """
    return parse_yaml(_read(path, MAX_YAML_BYTES))


def parse_yaml(text: str, most_nodes: int = MAX_NODES) -> Any:
    """Return what a YAML text says, as plain data.

    Raises
    ------
    ValueError
        When it is no YAML, says one key of a mapping twice, or, with what ``*name`` repeats
        written out, is nested deeper than ``MAX_DEPTH`` or has more than ``most_nodes`` parts:
        a few lines can stand for gigabytes.
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
    except yaml.YAMLError as error:
        raise ValueError(f"not valid YAML: {' '.join(str(error).split())}") from None


def load_json(path: Path) -> Any:
    """Return what a JSON file says.

    Raises
    ------
    OSError
        When the file cannot be read.
    ValueError
        When it is no JSON, larger than ``MAX_JSON_BYTES`` or nested too deeply.
    """
    try:
        return json.loads(_read(path, MAX_JSON_BYTES))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _read(path: Path, limit: int) -> str:
    # A device or a pipe would be read without end.
    if path.exists() and not path.is_file():
        raise ValueError("no regular file")
    with path.open("rb") as stream:
        content = stream.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"larger than {limit >> 20} MiB, the limit")
    return content.decode("utf-8")


def _check_events(text: str, most_nodes: int) -> None:
    """Refuse what would take much memory or stack to be put together at all."""
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
    """How large and deep nodes are with every repetition written out."""

    def __init__(self, most_nodes: int) -> None:
        self._most = most_nodes
        self._known: dict[int, tuple[int, int]] = {}

    def of(self, node: yaml.Node, depth: int = 1) -> tuple[int, int]:
        """Return the number of nodes and of levels."""
        if depth > MAX_DEPTH:  # as of a part that contains itself
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
    """Return what a node holds, keys before values; no key may come twice."""
    if isinstance(node, yaml.SequenceNode):
        return list(node.value)
    if not isinstance(node, yaml.MappingNode):
        return []
    keys = [key for key, _ in node.value]
    seen: set[str] = set()
    for key in keys:
        if isinstance(key, yaml.ScalarNode):
            if key.value in seen:
                _refuse(key.start_mark, f"{key.value} is said twice")
            seen.add(key.value)
    return keys + [value for _, value in node.value]


def _refuse(mark: Any, reason: str) -> NoReturn:
    raise ValueError(f"line {mark.line + 1}: {reason}")
