"""The schemas of JSON documents; the tests of each command validate what it prints."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from json_schemas import require_valid
from jsonschema import Draft202012Validator

import symbid_ros
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.json_documents import VERSIONS, is_document, schema, versioned, with_keys

FOLDER = Path(symbid_ros.__file__).parent / "schemas"


def properties(node: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(node, dict):
        yield from node.get("properties", {}).items()
        for child in node.values():
            yield from properties(child)
    elif isinstance(node, list):
        for child in node:
            yield from properties(child)


def test_each_document_has_a_schema_file() -> None:
    assert {path.name for path in FOLDER.iterdir()} == {f"{kind}.schema.json" for kind in VERSIONS}


@pytest.mark.parametrize("kind", sorted(VERSIONS))
def test_a_schema_is_valid_and_states_its_version(kind) -> None:
    content = schema(kind)
    Draft202012Validator.check_schema(content)
    assert content["$id"].endswith(f"/{kind}.schema.json")
    assert content["properties"]["schema_version"]["const"] == VERSIONS[kind]


def test_the_schema_knows_every_kind_of_finding() -> None:
    finding = schema("diagnosis")["properties"]["findings"]["items"]["properties"]
    assert finding["kind"]["enum"] == [kind.value for kind in Kind]


@pytest.mark.parametrize("kind", sorted(VERSIONS))
def test_keys_are_snake_case(kind) -> None:
    # sha256 aside, the field's symbols are lower-case as well.
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", name) for name, _ in properties(schema(kind)))


def test_a_document_with_a_key_too_many_or_too_few_is_invalid() -> None:
    document = versioned(
        "bag_info",
        {
            "bag": "log",
            "size_bytes": 10,
            "duration_s": 1.0,
            "start_ns": 0,
            "end_ns": 10**9,
            "count": 2,
            "is_finished": True,
            "ros_distro": "jazzy",
            "files": [],
            "topics": [],
        },
    )
    require_valid("bag_info", json.loads(json.dumps(document)))
    for wrong in (document | {"size": 10}, {"bag": "log"}, document | {"count": "2"}):
        with pytest.raises(AssertionError):
            require_valid("bag_info", wrong)


def test_renamed_keys_keep_their_order() -> None:
    document = {"bag": "log", "size": 3, "end": None}
    found = with_keys(document, {"size": "size_bytes", "start": "start_ns"})
    assert list(found.items()) == [("bag", "log"), ("size_bytes", 3), ("end", None)]


def test_a_document_is_known_by_its_keys(tmp_path) -> None:
    file = tmp_path / "file.json"
    assert not is_document(file, "fleet")
    for text in ("no JSON", "[]", "{}", '{"schema_version": 1}'):
        file.write_text(text)
        assert not is_document(file, "fleet")
    file.write_text(json.dumps(dict.fromkeys(schema("fleet")["required"])))
    assert is_document(file, "fleet")
    assert not is_document(file, "evaluation")
