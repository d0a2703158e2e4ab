"""HTML templates, and the style that all pages share."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from symbid_ros.options import spelled
from symbid_ros.report.formatting import significant, with_std
from symbid_ros.user_files import begins_with_mark

PACKAGE = "symbid_ros.report"
GENERATOR = '<meta name="generator" content="symbid_ros">'  # in page_base.html

_UNIT = re.compile(
    r"(?<=[\d±]) (?=(?:%|±|mm|kg|Nms|Nm|Ns|N|Hz|ms|s|rad/s²|bit|times)(?!\w))|(?<=±) "
)


def page_template(
    name: str, package: str = PACKAGE, filters: Mapping[str, Callable[..., str]] | None = None
) -> jinja2.Template:
    """Return a template of a subpackage, which may extend and import those of the report.

    A template that extends ``page_base.html`` needs the variables ``title`` and ``css``.

    Parameters
    ----------
    name, package : str
        The template's file and the subpackage that holds it.
    filters : mapping of str to callable, optional
        Filters of this template alone.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(one, "") for one in (package, PACKAGE)]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "significant": significant,
        "with_std": with_std,
        "unbroken_units": unbroken_units,
        "with_flags": with_flags,
        **(filters or {}),
    }
    return environment.get_template(name)


def is_page(path: Path) -> bool:
    """Return whether a file is a page of this package."""
    return begins_with_mark(path, GENERATOR)


def unbroken_units(text: str) -> str:
    """Return a text without line breaks between numbers and their units."""
    return _UNIT.sub("\N{NO-BREAK SPACE}", text)


def with_flags(message: str) -> Markup:
    """Return a message as HTML in which options, named in backquotes, are flags of the command."""
    return Markup(
        spelled(str(escape(message)), lambda name: f"<code>--{name.replace('_', '-')}</code>")
    )


def shared_css() -> str:
    """Return the style that all pages share."""
    return Path(__file__).with_name("report.css").read_text(encoding="utf-8")
