"""Directives that write tables from the code, so that no page repeats what the code says.

``{options} identify`` lists the options of a command, ``{parameters} identifier`` the parameters
of a node, ``{schema} estimate`` the keys of a JSON document. ``{public-api}`` documents every
public name of the package. Formulas become MathML, which browsers show without a script from
elsewhere.
"""

import inspect
import json
import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

import latex2mathml.converter
import typer.main
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata
from sphinx.writers.html5 import HTML5Translator

import symbid_ros
from symbid_ros.cli.app import app as command_line
from symbid_ros.json_documents import schema
from symbid_ros.options import Option, options_of
from symbid_ros.ros.launch_arguments import node_parameters


def markdown_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table; a bar within a cell is escaped."""
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in line) + " |"
        for line in lines
    )


class GeneratedTable(SphinxDirective):
    """A table in place of a block, whose text tells readers of the repository where to find it."""

    required_arguments = 1
    has_content = True


class Options(GeneratedTable):
    """The options of a command of ``symbid``, one table for each group."""

    optional_arguments = 3

    def run(self) -> list[nodes.Node]:
        command: Any = typer.main.get_command(command_line)
        for name in self.arguments:
            command = command.commands[name]
        groups: dict[str, list[tuple[str, ...]]] = defaultdict(list)
        for option in command.params:
            is_general = option.name in ("help", "verbose", "quiet")
            if option.param_type_name != "option" or is_general or option.hidden:
                continue
            flags = " ".join(f"`{flag}`" for flag in option.opts)
            shown = option.default
            is_default = shown not in (None, False, (), [], "", math.inf) and not callable(shown)
            default = f"`{getattr(shown, 'value', shown)}`" if is_default else ""
            if option.required:
                default = "required"
            group = getattr(option, "rich_help_panel", None) or ""
            groups[group].append((flags, default, option.help or ""))
        parts = []
        for group, rows in groups.items():
            parts += [f"**{group}**"] if group else []
            parts.append(markdown_table(("option", "default", "meaning"), rows))
        return self.parse_text_to_nodes("\n\n".join(parts))


class Parameters(GeneratedTable):
    """The parameters of a node."""

    def run(self) -> list[nodes.Node]:
        rows = []
        for each in node_parameters(self.arguments[0]):
            meaning = each.description
            if each.choices:
                meaning += " One of " + ", ".join(f"`{choice}`" for choice in each.choices) + "."
            if each.live:
                meaning += " Can be set while the node runs."
            rows.append((f"`{each.name}`", f"`{json.dumps(each.default)}`", meaning))
        return self.parse_text_to_nodes(markdown_table(("parameter", "default", "meaning"), rows))


class Schema(GeneratedTable):
    """The keys of a JSON document."""

    def run(self) -> list[nodes.Node]:
        content = schema(self.arguments[0])
        rows = list(keys_of(content, content.get("$defs", {}), ""))
        return self.parse_text_to_nodes(markdown_table(("key", "type", "meaning"), rows))


def keys_of(
    node: dict[str, Any], definitions: dict[str, Any], path: str
) -> Iterator[tuple[str, str, str]]:
    """Yield path, type and meaning of each key below a node of a schema."""
    for name, value in node.get("properties", {}).items():
        yield from entries_of(value, definitions, f"{path}{name}", name in node["required"])


def entries_of(
    value: dict[str, Any], definitions: dict[str, Any], path: str, is_required: bool
) -> Iterator[tuple[str, str, str]]:
    meaning, kinds = value.get("description", ""), []
    inner = value
    for one in value.get("anyOf", [value]):
        target = definitions[one["$ref"].rpartition("/")[2]] if "$ref" in one else one
        kind = target.get("type", "integer" if "const" in target else "")
        kinds += [kind] if isinstance(kind, str) else kind
        if target.get("type") != "null":
            inner = target
    words = [" or ".join(kinds), "" if is_required else "optional"]
    if "enum" in inner:
        meaning += " One of " + ", ".join(f"`{one}`" for one in inner["enum"] if one) + "."
    yield f"`{path}`", ", ".join(filter(None, words)), meaning or inner.get("description", "")
    below, mark = inner, "."
    if inner.get("type") == "array":
        below, mark = inner["items"], "[]."
    elif isinstance(inner.get("additionalProperties"), dict):
        below, mark = inner["additionalProperties"], ".*."
    if "$ref" in below:
        below = definitions[below["$ref"].rpartition("/")[2]]
    yield from keys_of(below, definitions, f"{path}{mark}")


def kind_of(value: Any) -> str:
    """Return which part of the API a public value belongs to."""
    if inspect.isclass(value):
        if issubclass(value, Exception):
            return "errors"
        return "options" if is_dataclass(value) and options_of(value) else "classes"
    return "functions" if callable(value) else "constants"


class PublicApi(GeneratedTable):
    """Functions, classes, options or errors that ``import symbid_ros`` offers."""

    def run(self) -> list[nodes.Node]:
        (kind,) = self.arguments
        public = {name: getattr(symbid_ros, name) for name in symbid_ros.__all__}
        parts = [
            entry(kind, name, value) for name, value in public.items() if kind_of(value) == kind
        ]
        return self.parse_text_to_nodes("\n\n".join(parts))


def entry(kind: str, name: str, value: Any) -> str:
    if kind == "functions":
        return f"```{{eval-rst}}\n.. autofunction:: symbid_ros.{name}\n```"
    if kind != "options":
        directive = f".. autoclass:: symbid_ros.{name}\n   :members:\n   :exclude-members: __init__"
        return f"```{{eval-rst}}\n{directive}\n```"
    rows = [
        (f"`{each.name}`", f"`{each.default!r}`", field_help(each)) for each in options_of(value)
    ]
    table = markdown_table(("field", "default", "meaning"), rows)
    summary, *_ = (inspect.getdoc(value) or "").splitlines()
    return f"**symbid_ros.{name}**\n\n{summary}\n\n{table}"


def field_help(option: Option) -> str:
    words = [option.help]
    if option.choices:
        words.append("One of " + ", ".join(f"`{each}`" for each in option.choices) + ".")
    if option.unit:
        words.append(f"Unit: {option.unit}.")
    if option.unset:
        words.append(f"If left out: {option.unset}.")
    return " ".join(words)


def write_formula(translator: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML."""
    is_block = isinstance(node, nodes.math_block)
    formula = latex2mathml.converter.convert(
        node.astext().strip(), display="block" if is_block else "inline"
    )
    translator.body.append(f'<div class="math">{formula}</div>' if is_block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directives."""
    for name, directive in {
        "options": Options,
        "parameters": Parameters,
        "schema": Schema,
        "public-api": PublicApi,
    }.items():
        app.add_directive(name, directive)
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
    return {"parallel_read_safe": True}
