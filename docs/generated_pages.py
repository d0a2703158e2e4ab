"""Directives that write tables from the code, so that no page repeats what the code says.

``{options} identify`` tables the options of a command, ``{parameters} identifier`` the parameters
of a node, ``{error-codes}`` the codes of the errors and ``{public-api}`` documents every public
name of the package.
"""

import inspect
import json
import math
from collections import defaultdict
from typing import Any

import typer.main
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

import symbid_ros
from symbid_ros.cli.app import app as command_line
from symbid_ros.error_codes import CODES
from symbid_ros.ros.launch_arguments import node_parameters


def markdown_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Return a table; a bar within a cell is escaped."""
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in line) + " |"
        for line in lines
    )


class Options(SphinxDirective):
    """The options of a command of ``symbid``, one table for each group."""

    required_arguments = 1
    optional_arguments = 3

    def run(self) -> list[nodes.Node]:
        command: Any = typer.main.get_command(command_line)
        for name in self.arguments:
            command = command.commands[name]
        groups: dict[str, list[tuple[str, ...]]] = defaultdict(list)
        for option in command.params:
            if option.param_type_name != "option" or option.name == "help":
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


class Parameters(SphinxDirective):
    """The parameters of a node."""

    required_arguments = 1

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


class ErrorCodes(SphinxDirective):
    """The codes of the errors, each with cause and fix."""

    def run(self) -> list[nodes.Node]:
        rows = [(f"`SYMBID-{code}`", entry.cause, entry.fix) for code, entry in CODES.items()]
        table = markdown_table(("code", "cause", "fix"), rows)
        return self.parse_text_to_nodes(table) if rows else []


class PublicApi(SphinxDirective):
    """Every name that ``import symbid_ros`` offers, with its docstring."""

    def run(self) -> list[nodes.Node]:
        parts = []
        for name in getattr(symbid_ros, "__all__", ()):
            value = getattr(symbid_ros, name)
            if inspect.isclass(value):
                parts.append(f".. autoclass:: symbid_ros.{name}\n   :members:")
            elif callable(value):
                parts.append(f".. autofunction:: symbid_ros.{name}")
        text = "```{eval-rst}\n" + "\n\n".join(parts) + "\n```" if parts else ""
        return self.parse_text_to_nodes(text)


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directives."""
    for name, directive in {
        "options": Options,
        "parameters": Parameters,
        "error-codes": ErrorCodes,
        "public-api": PublicApi,
    }.items():
        app.add_directive(name, directive)
    return {"parallel_read_safe": True}
