"""Edits of an XML file that leave every other byte as it was."""

import re
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from symbid_ros.model.xml_tree import MAX_BYTES, Element, read_bytes

_HEAD = re.compile(rb"""<[^\s/>]+((?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*)(\s*/?>)""")
_ATTRIBUTE = re.compile(rb"""\s+([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


class XmlEditor:
    """Changes attributes and inserts elements; comments, order and white space stay.

    The file must use an encoding that contains ASCII, see :func:`is_editable`.

    Parameters
    ----------
    path : Path
        The file that :func:`symbid_ros.model.xml_tree.read_xml` has read.
    """

    def __init__(self, path: Path) -> None:
        self._content = read_bytes(path, MAX_BYTES)
        self._edits: list[tuple[int, int, bytes]] = []

    def set(self, element: Element, key: str, value: str) -> None:
        """Replace the value of an attribute in place, or add the attribute as the last one."""
        markup = quoteattr(value).encode("ascii", "xmlcharrefreplace")
        attribute = self._attribute(element, key)
        if attribute is not None:
            self._edits.append((*attribute.span(2), markup))
        else:
            end = self._head(element).end(1)
            self._edits.append((end, end, b" " + key.encode() + b"=" + markup))

    def set_numbers(
        self, element: Element, key: str, values: Sequence[float], rounding: float
    ) -> None:
        """Replace those numbers of an attribute that differ by more than ``rounding``.

        An attribute that is missing stands for zeros.
        """
        attribute = self._attribute(element, key)
        if attribute is None or b"&" in attribute[2]:
            if np.abs(values).max() > rounding:
                self.set(element, key, " ".join(repr(float(value)) for value in values))
            return
        start = attribute.start(2) + 1
        words = re.finditer(rb"\S+", attribute[2][1:-1])
        for word, value in zip(words, values, strict=True):
            if abs(value - float(word[0])) > rounding:
                number = b"%r" % float(value)
                self._edits.append((start + word.start(), start + word.end(), number))

    def drop(self, element: Element, key: str) -> None:
        """Remove an attribute, if the element has it."""
        attribute = self._attribute(element, key)
        if attribute is not None:
            self._edits.append((*attribute.span(), b""))

    def insert(self, parent: Element, *markup: str, last: bool = False) -> None:
        """Insert an element, one line of markup per argument, as the first or last child.

        It is indented like the child that it precedes or follows. A parent written as
        ``<a/>`` takes one insertion.
        """
        head = self._head(parent)
        newline = b"\r\n" if b"\r\n" in self._content else b"\n"
        margin = newline + self._indentation(parent.start)
        if parent.close == parent.start:
            inside = margin + b"  "
            closing = margin + b"</" + parent.tag.encode() + b">"
            lines = _joined(markup, inside)
            self._edits.append((*head.span(2), b">" + inside + lines + closing))
            return
        between = self._content[head.end() : parent.close]
        inside = between[: len(between) - len(between.lstrip())]
        if not between.strip():
            inside = margin + b"  " if inside else b""
        place = head.end() + len(between.rstrip()) if last else head.end()
        # Blank lines before the first child are not repeated.
        inside = newline + inside.rpartition(b"\n")[2] if b"\n" in inside else inside
        self._edits.append((place, place, inside + _joined(markup, inside)))

    @property
    def changed(self) -> bool:
        """Whether any edit was made."""
        return bool(self._edits)

    def text(self) -> str:
        """Return the edited file.

        Bytes that are not UTF-8, such as a comment in Latin-1, become surrogates, from which
        :func:`symbid_ros.atomic_write.write_text` makes the same bytes again.
        """
        parts, done = [], 0
        for start, stop, markup in sorted(self._edits, key=lambda edit: edit[:2]):
            parts += [self._content[done:start], markup]
            done = stop
        parts.append(self._content[done:])
        return b"".join(parts).decode("utf-8", "surrogateescape")

    def _head(self, element: Element) -> re.Match[bytes]:
        head = _HEAD.match(self._content, element.start)
        if head is None:
            raise ValueError(f"{element.place}: no start tag at byte {element.start}")
        return head

    def _attribute(self, element: Element, key: str) -> re.Match[bytes] | None:
        head = self._head(element)
        for attribute in _ATTRIBUTE.finditer(self._content, head.start(1), head.end(1)):
            if attribute[1] == key.encode():
                return attribute
        return None

    def _indentation(self, offset: int) -> bytes:
        line = self._content[self._content.rfind(b"\n", 0, offset) + 1 : offset]
        return line if not line.strip() else b""


def is_editable(path: Path) -> bool:
    """Return whether the file's encoding contains ASCII, as all but UTF-16 do."""
    return not read_bytes(path, MAX_BYTES).startswith(_UTF16)


def _joined(markup: tuple[str, ...], indentation: bytes) -> bytes:
    separator = indentation if b"\n" in indentation else b""
    return separator.join(line.encode("ascii", "xmlcharrefreplace") for line in markup)
