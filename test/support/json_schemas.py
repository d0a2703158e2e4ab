"""Validate JSON documents against the schemas that the package ships."""

from typing import Any

from jsonschema import Draft202012Validator

from symbid_ros.json_documents import schema


def require_valid(kind: str, document: Any) -> None:
    """Require that a document, as read from JSON, has exactly the keys and types of its schema."""
    validator = Draft202012Validator(
        schema(kind), format_checker=Draft202012Validator.FORMAT_CHECKER
    )
    errors = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(document)]
    assert not errors
