"""A study as one self-contained page of HTML."""

import re
from dataclasses import dataclass
from pathlib import Path

import jinja2

import symbid_ros.report
from symbid_ros.study.drawing import Drawing, inline
from symbid_ros.study.examination import Conclusion
from symbid_ros.study.sheet import Sheet

_UNIT = re.compile(r"(?<=\d) (?=(?:%|mm|Nm|Nms|Ns|N|Hz|s|kg|rad/s²|ms|times)(?!\w))")
_METHOD = re.compile(r"(WLS|MAP)-(?=[A-Z])")


@dataclass(frozen=True)
class Section:
    """A part of the page; what it has none of is left out.

    Attributes
    ----------
    anchor, title, caption : str
        Fragment of the address, heading, and the sentence under it.
    conclusions : tuple of Conclusion
    sentences : tuple of str
        What the numbers say beside these.
    sheets : tuple of Sheet
    drawings : tuple of Drawing
    folded : bool
        Whether its tables open only when asked for: long ones.
    """

    anchor: str
    title: str
    caption: str = ""
    conclusions: tuple[Conclusion, ...] = ()
    sentences: tuple[str, ...] = ()
    sheets: tuple[Sheet, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """All that a study shows.

    Attributes
    ----------
    title, about, headline : str
        At the head of the page; the headline is the outcome in a sentence.
    sections : tuple of Section
    facts : dict of str to str
        What was done, in the order shown.
    plan : str
        The study's file, for those who want to do it again.
    software : str
    """

    title: str
    about: str
    headline: str
    sections: tuple[Section, ...]
    facts: dict[str, str]
    plan: str
    software: str


def render(page: Page) -> str:
    """Return the page: no script, no address outside itself."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symbid_ros", "study"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"inline": inline, "unbroken": unbroken}
    report = Path(symbid_ros.report.__file__).parent
    return environment.get_template("study.html").render(
        page=page,
        css=(report / "report.css").read_text(encoding="utf-8")
        + Path(__file__).with_name("study.css").read_text(encoding="utf-8"),
    )


def unbroken(text: str) -> str:
    """Return a sentence whose figures stay with their units, and methods' names whole."""
    return _METHOD.sub("\\1\N{NON-BREAKING HYPHEN}", _UNIT.sub("\N{NO-BREAK SPACE}", text))
