"""JSON documents of commands and results: versions of their keys, and their JSON Schemas.

Keys are snake_case and end with the unit of a number (``_s``, ``_hz``, ``_kg``), unless a key
``unit`` beside it or the description in the schema says the unit.
"""

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from symbid_ros.package_paths import PACKAGE
from symbid_ros.user_files import load_json

# Documents and the version of their keys. A new version is one that earlier readers misunderstand.
VERSIONS = {
    "bag_info": 1,
    "bag_recovery": 1,
    "comparison": 1,
    "diagnosis": 1,
    "difference": 1,
    "estimate": 1,
    "evaluation": 1,
    "fleet": 1,
    "live_model": 1,
    "plan": 1,
    "prior": 1,
    "validation": 1,
}


def versioned(kind: str, document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document that begins with the version of its keys."""
    return {"schema_version": VERSIONS[kind], **document}


def with_keys(document: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """Return a document in which some keys have other names, in the same order."""
    return {names.get(key, key): value for key, value in document.items()}


def is_document(path: Path, kind: str) -> bool:
    """Return whether a file is a document of a kind, such as ``"estimate"``, of any version."""
    try:
        content = load_json(path)
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.keys() >= {*schema(kind)["required"]}


def schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a document, such as ``"estimate"``."""
    text = (files(PACKAGE) / "schemas" / f"{kind}.schema.json").read_text(encoding="utf-8")
    content: dict[str, Any] = json.loads(text)
    return content
