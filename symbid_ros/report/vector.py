"""Matplotlib figures as SVG elements that can stand many to a page."""

import io
import re
from xml.etree import ElementTree

from matplotlib.figure import Figure

_XLINK = "{http://www.w3.org/1999/xlink}href"
_LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """Return the figure as an ``<svg>`` element for a page of HTML.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What to draw; text stays text.
    name : str
        Unique on the page; prefixes every id, which are one space for all SVGs of a page.
    description : str
        What the figure shows, for those who hear the page.
    """
    buffer = io.BytesIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=nothing)
    return page_svg(buffer.getvalue(), name, description)


def page_svg(svg: bytes, name: str, description: str) -> str:
    """Return an SVG file that Matplotlib wrote as such an element."""
    root = ElementTree.fromstring(svg)
    used = set(re.findall(r'(?:url\(|")#([^)"]+)', ElementTree.tostring(root, encoding="unicode")))
    for element in root.iter():
        _make_local(element, name, used)
    for parent in list(root.iter()):
        for child in list(parent):
            # A style element inside an SVG would rule the whole page: the page's own sheet does.
            if child.tag in {"style", "metadata"}:
                parent.remove(child)
    root.attrib.pop("width")
    root.attrib.pop("height")
    root.attrib |= {"role": "img", "aria-label": description}
    return ElementTree.tostring(root, encoding="unicode", short_empty_elements=True)


def _make_local(element: ElementTree.Element, name: str, used: set[str]) -> None:
    """Strip namespaces, prefix the ids in use, drop the others and shorten coordinates."""
    element.tag = element.tag.rpartition("}")[2]
    element.tail = None
    attributes = element.attrib
    if _XLINK in attributes:
        attributes["href"] = attributes.pop(_XLINK)
    identifier = attributes.pop("id", None)
    if identifier in used:
        attributes["id"] = f"{name}-{identifier}"
    if attributes.get("href", "").startswith("#"):
        attributes["href"] = f"#{name}-{attributes['href'][1:]}"
    if "clip-path" in attributes:
        attributes["clip-path"] = attributes["clip-path"].replace("url(#", f"url(#{name}-")
    for key in ("d", "x", "y", "transform"):
        if key in attributes:
            # A hundredth of a point is finer than any screen.
            attributes[key] = _LONG_DECIMALS.sub(r"\1", " ".join(attributes[key].split()))
