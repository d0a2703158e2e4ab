"""Edits of an XML file: insertions are indented like their neighbours."""

import pytest

from symbid_ros.model.xml_file import XmlEditor, as_element, read_xml


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        # A blank line before the first child is not repeated.
        (
            "<a>\n\n  <b/>\n</a>",
            "<a>\n  <new/>\n\n  <b/>\n</a>",
            "<a>\n\n  <b/>\n  <new/>\n</a>",
        ),
        # A file on one line stays on one line.
        ("<a><b/></a>", "<a><new/><b/></a>", "<a><b/><new/></a>"),
        ("<a> <b/></a>", "<a> <new/> <b/></a>", "<a> <b/> <new/></a>"),
        ("<r>\n <a/>\n</r>", *2 * ["<r>\n <a>\n   <new/>\n </a>\n</r>"]),
    ],
)
def test_an_insertion_is_indented_like_its_neighbours(tmp_path, text, first, last):
    path = tmp_path / "model.xml"
    path.write_text(text)
    for expected, at_end in ((first, False), (last, True)):
        editor = XmlEditor(path)
        editor.insert(as_element(next(read_xml(path).iter("a"))), "<new/>", last=at_end)
        assert editor.changed
        assert editor.text() == expected
