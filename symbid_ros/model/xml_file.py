"""XML model files: read within limits, with line numbers, and edited byte by byte."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from symbid_ros.errors import ModelError
from symbid_ros.user_files import read_regular

MAX_BYTES = 4 << 20
MAX_ELEMENTS = 10_000
# Several times those of any element of either format. MuJoCo's parser needs quadratic time.
MAX_ATTRIBUTES = 200
MAX_DEPTH = 200
LARGEST = 1e9  # SI units; above any mass, length or inertia of a robot

_HEAD = re.compile(rb"""<[^\s/>]+((?:\s+[^\s=]+\s*=\s*(?:"[^"]*"|'[^']*'))*)(\s*/?>)""")
_ATTRIBUTE = re.compile(rb"""\s+([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")
_UTF16 = (b"\xff\xfe", b"\xfe\xff")


class Element(ET.Element):
    """An element of a file.

    Attributes
    ----------
    file : Path
        Path of the file.
    line : int
        Line of the start tag.
    start, close : int
        Byte offsets of the start tag and the end tag in the file; for ``<a/>`` of its two ends.
    """

    file: Path = Path()
    line: int = 0
    start: int = 0
    close: int = 0

    @property
    def place(self) -> str:
        """File and line of the start tag, for messages."""
        return f"{self.file}: line {self.line}"


def read_xml(path: Path) -> Element:
    """Return the root element of a file, without text and comments.

    Raises
    ------
    ModelError
        When the file cannot be read, is not XML or exceeds a limit: ``MAX_BYTES``,
        ``MAX_ELEMENTS``, ``MAX_DEPTH`` levels or ``MAX_ATTRIBUTES`` of an element. A document
        type is rejected too, because its entities may expand without end or read other files.
    """
    return _Builder(path).root(read_bytes(path, MAX_BYTES))


def as_element(element: ET.Element | None) -> Element:
    """Return an element of :func:`read_xml` with its own type."""
    assert isinstance(element, Element)
    return element


def place(element: ET.Element) -> str:
    """Return the file and line of an element of :func:`read_xml`."""
    return as_element(element).place


def read_bytes(path: Path, limit: int) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    ModelError
        When there is no such file, or it is larger than ``limit`` bytes.
    """
    try:
        return read_regular(path, limit)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read the model ({error.strerror}); check the path", "E101"
        ) from None
    except ValueError as error:
        raise ModelError(f"{path}: {error}; reduce it", "E102") from None


class _Builder:
    """Builds the tree of one file from expat's events."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._top = Element("")
        self._open = [self._top]
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_document_type

    def root(self, content: bytes) -> Element:
        try:
            self._parser.Parse(content, True)
        except (expat.ExpatError, ValueError, LookupError) as error:
            # Expat raises ValueError or LookupError for unknown encodings.
            raise ModelError(
                f"{self._path}: not well-formed XML ({error}); correct the file", "E103"
            ) from None
        (root,) = self._top
        assert isinstance(root, Element)
        return root

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        element = Element(tag, attributes)
        element.file, element.line = self._path, self._parser.CurrentLineNumber
        element.start = self._parser.CurrentByteIndex
        if self._count > MAX_ELEMENTS:
            raise ModelError(
                f"{element.place}: more than {MAX_ELEMENTS} elements; split the model", "E102"
            )
        if len(attributes) > MAX_ATTRIBUTES:
            raise ModelError(
                f"{element.place}: <{tag}> has more than {MAX_ATTRIBUTES} attributes; remove those "
                "that its format does not know",
                "E102",
            )
        if len(self._open) > MAX_DEPTH:
            raise ModelError(
                f"{element.place}: <{tag}> is more than {MAX_DEPTH} levels deep; flatten the model",
                "E102",
            )
        self._open[-1].append(element)
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop().close = self._parser.CurrentByteIndex

    def _refuse_document_type(self, *declaration: object) -> None:
        line = self._parser.CurrentLineNumber
        raise ModelError(
            f"{self._path}: line {line}: a <!DOCTYPE> is not accepted; remove it and write "
            "entities out",
            "E103",
        )


class XmlEditor:
    """Changes attributes and inserts elements; every other byte of the file stays.

    The file must use an encoding that contains ASCII, see :func:`is_editable`.

    Parameters
    ----------
    path : Path
        The file that :func:`read_xml` has read.
    """

    def __init__(self, path: Path) -> None:
        self._content = read_bytes(path, MAX_BYTES)
        self._edits: list[tuple[int, int, bytes]] = []

    def set(self, element: Element, key: str, value: str) -> None:
        """Replace the value of an attribute in place, or append the attribute."""
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

        A missing attribute means zeros.
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
        """Remove an attribute if the element has it."""
        attribute = self._attribute(element, key)
        if attribute is not None:
            self._edits.append((*attribute.span(), b""))

    def insert(self, parent: Element, *markup: str, last: bool = False) -> None:
        """Insert an element, one line of markup per argument, as the first or last child.

        It is indented like the child that it precedes or follows. A parent written as ``<a/>``
        accepts one insertion only.
        """
        head = self._head(parent)
        newline = b"\r\n" if b"\r\n" in self._content else b"\n"
        margin = newline + self._indentation(parent.start)
        if head[2].endswith(b"/>"):
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

        Bytes that are not UTF-8, such as a comment in Latin-1, become surrogates;
        :func:`symbid_ros.atomic_write.write_text` turns them back into the same bytes.
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


def with_comment(path: Path, text: str, mark: str, comment: str) -> str:
    """Return a file's text with a comment as the first child of its root.

    Parameters
    ----------
    path : Path
        For messages.
    text : str
        As :meth:`XmlEditor.text` returns it.
    mark : str
        First word of the comment. An earlier comment that begins with it is replaced.
    comment : str
        Its other words. Characters that are not ASCII are written as references.
    """
    content = text.encode(errors="surrogateescape")
    words = f"{mark} {comment}".replace("--", "- -").encode("ascii", "xmlcharrefreplace")
    markup = b"<!-- " + words + b" -->"
    earlier = re.search(rb"<!-- " + re.escape(mark.encode()) + rb"\s[^<>]*-->", content)
    if earlier is not None:
        start, stop = earlier.span()
    else:
        root = _Builder(path).root(content)
        head = _HEAD.match(content, root.start)
        if head is None or head[2].endswith(b"/>"):
            return text  # an empty robot
        start = stop = head.end()
        blank = re.match(rb"\s*\n([ \t]*)", content[start:])
        newline = b"\r\n" if b"\r\n" in content else b"\n"
        markup = newline + (b"  " if blank is None else blank[1]) + markup
    return (content[:start] + markup + content[stop:]).decode("utf-8", "surrogateescape")


def is_editable(path: Path) -> bool:
    """Return whether the file's encoding contains ASCII, as every one except UTF-16 does."""
    return not read_bytes(path, MAX_BYTES).startswith(_UTF16)


def _joined(markup: tuple[str, ...], indentation: bytes) -> bytes:
    separator = indentation if b"\n" in indentation else b""
    return separator.join(line.encode("ascii", "xmlcharrefreplace") for line in markup)
