"""XML from anybody, read within limits; every element knows the line it comes from."""

import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from symbid_ros.errors import ModelError
from symbid_ros.user_files import read_regular

MAX_BYTES = 4 << 20
MAX_ELEMENTS = 10_000
# Several times those of any element of either format; MuJoCo's parser takes time with the square.
MAX_ATTRIBUTES = 200
MAX_DEPTH = 200
LARGEST = 1e9  # SI units; no mass, length or inertia of a robot is as large


class Element(ET.Element):
    """An element of a file.

    Attributes
    ----------
    file : Path
        The file.
    line : int
        Line of its start tag.
    start, close : int
        Byte offsets of its start tag and of its end tag in the file; equal for ``<a/>``.
    """

    file: Path = Path()
    line: int = 0
    start: int = 0
    close: int = 0

    @property
    def place(self) -> str:
        """File and line of its start tag, for messages."""
        return f"{self.file}: line {self.line}"


def read_xml(path: Path) -> Element:
    """Return the root element of a file, without text and comments.

    Raises
    ------
    ModelError
        When the file cannot be read, is not XML, declares a document type (and with it
        entities, which may expand without end or read other files), is larger than
        ``MAX_BYTES``, or has more than ``MAX_ELEMENTS`` elements, ``MAX_DEPTH`` levels or
        ``MAX_ATTRIBUTES`` attributes of an element.
    """
    return _Builder(path).root(read_bytes(path, MAX_BYTES))


def as_element(element: ET.Element | None) -> Element:
    """Return an element that :func:`read_xml` has read, as what it is."""
    assert isinstance(element, Element)
    return element


def place(element: ET.Element) -> str:
    """Return the file and line that an element of :func:`read_xml` comes from."""
    return as_element(element).place


def read_bytes(path: Path, limit: int) -> bytes:
    """Return what a regular file holds.

    Raises
    ------
    ModelError
        When there is no such file, or it is larger than ``limit`` bytes.
    """
    try:
        return read_regular(path, limit)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read the model ({error.strerror}); check the path"
        ) from None
    except ValueError as error:
        raise ModelError(f"{path}: {error}; reduce it") from None


class _Builder:
    """One file while expat reads it."""

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
            # Unknown encodings come as ValueError or LookupError.
            raise ModelError(
                f"{self._path}: not well-formed XML ({error}); correct the file"
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
            raise ModelError(f"{element.place}: more than {MAX_ELEMENTS} elements; split the model")
        if len(attributes) > MAX_ATTRIBUTES:
            raise ModelError(
                f"{element.place}: <{tag}> has more than {MAX_ATTRIBUTES} attributes; remove those "
                "that its format does not know"
            )
        if len(self._open) > MAX_DEPTH:
            raise ModelError(
                f"{element.place}: <{tag}> is more than {MAX_DEPTH} levels deep; flatten the model"
            )
        self._open[-1].append(element)
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop().close = self._parser.CurrentByteIndex

    def _refuse_document_type(self, *declaration: object) -> None:
        line = self._parser.CurrentLineNumber
        raise ModelError(
            f"{self._path}: line {line}: a <!DOCTYPE> is not accepted; remove it and write "
            "entities out"
        )
