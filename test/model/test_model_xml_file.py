"""Edits of an XML file: insertions are indented like their neighbours."""

import pytest

from symbid_ros.model.xml_file import XmlEditor, as_element, is_editable, place, read_xml


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


def edited(tmp_path, text, edit):
    """Return the text after an edit of its first <a>."""
    path = tmp_path / "model.xml"
    path.write_bytes(text.encode())
    editor = XmlEditor(path)
    edit(editor, as_element(next(read_xml(path).iter("a"))))
    assert editor.changed is (editor.text() != text)
    return editor.text()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('<a x="1"/>', '<a x="9"/>'),
        ("<a y='2' x = '1' z='3'/>", "<a y='2' x = \"9\" z='3'/>"),
        ("<a/>", '<a x="9"/>'),
        ("<a />", '<a x="9" />'),
        ('<a\n  y="2"\n  ></a>', '<a\n  y="2" x="9"\n  ></a>'),
        ('<r><!-- <a x="1"/> --><a x="1"/></r>', '<r><!-- <a x="1"/> --><a x="9"/></r>'),
        ('<r><b x="1"/><a xx="1"/></r>', '<r><b x="1"/><a xx="1" x="9"/></r>'),
        ('<r>\u00e4<a x="1"/>\u00f6</r>', '<r>\u00e4<a x="9"/>\u00f6</r>'),
    ],
)
def test_an_attribute_is_replaced_or_appended(tmp_path, before, after):
    assert edited(tmp_path, before, lambda editor, a: editor.set(a, "x", "9")) == after


def test_values_are_quoted(tmp_path):
    found = edited(tmp_path, "<a/>", lambda editor, a: editor.set(a, "x", 'a<b & "\u00e9"'))
    assert found == "<a x='a&lt;b &amp; \"&#233;\"'/>"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('<a x="1" y="2"/>', '<a y="2"/>'),
        ('<a y="2"   x="1"/>', '<a y="2"/>'),
        ('<a y="2"/>', '<a y="2"/>'),
    ],
)
def test_an_attribute_is_removed_with_the_space_before_it(tmp_path, before, after):
    assert edited(tmp_path, before, lambda editor, a: editor.drop(a, "x")) == after


@pytest.mark.parametrize(
    ("before", "values", "after"),
    [
        ('<a x="1.0 2e0  3"/>', [1, 2, 3], '<a x="1.0 2e0  3"/>'),
        ('<a x=" 1.0 2e0  3"/>', [1, 2.5, 3], '<a x=" 1.0 2.5  3"/>'),
        ('<a x="1 2 3"/>', [-1, 2.05, 4], '<a x="-1.0 2 4.0"/>'),
        ('<a x="1 2 3"/>', [1.1, 1.9, 3.11], '<a x="1 2 3.11"/>'),
        ("<a/>", [0, 0.1, -0.1], "<a/>"),
        ("<a/>", [0, 0, -0.2], '<a x="0.0 0.0 -0.2"/>'),
        ('<a x="&#49; 2 3"/>', [1, 2, 4], '<a x="1.0 2.0 4.0"/>'),
    ],
)
def test_only_numbers_that_differ_are_replaced(tmp_path, before, values, after):
    """By more than a tenth, here."""
    found = edited(tmp_path, before, lambda editor, a: editor.set_numbers(a, "x", values, 0.1001))
    assert found == after


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<r>\n  <a>\n  </a>\n</r>", "<r>\n  <a>\n    <b/>\n    <c/>\n  </a>\n</r>"),
        ("<a></a>", "<a><b/><c/></a>"),
        ("<a/>", "<a>\n  <b/>\n  <c/>\n</a>"),
        ("<a>\r\n\t<d/>\r\n</a>", "<a>\r\n\t<b/>\r\n\t<c/>\r\n\t<d/>\r\n</a>"),
        ('<a x="/>">\n <d/></a>', '<a x="/>">\n <b/>\n <c/>\n <d/></a>'),
    ],
)
def test_lines_are_inserted_with_the_files_indentation(tmp_path, before, after):
    found = edited(tmp_path, before, lambda editor, a: editor.insert(a, "<b/>", "<c/>"))
    assert found == after


def test_edits_apply_in_the_order_of_the_file(tmp_path):
    def edit(editor, a):
        editor.insert(a, "<d/>", last=True)
        editor.set(as_element(a.find("c")), "x", "3")
        editor.set(a, "y", "2")
        editor.drop(a, "x")

    found = edited(tmp_path, '<a x="1"><b/><c x="2"/></a>', edit)
    assert found == '<a y="2"><b/><c x="3"/><d/></a>'


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-8-sig"])
def test_files_that_contain_ascii_are_editable(tmp_path, encoding):
    path = tmp_path / "model.xml"
    path.write_bytes("<a/>".encode(encoding))
    assert is_editable(path)
    path.write_bytes("<a/>".encode("utf-16"))
    assert not is_editable(path)


def test_elements_know_their_lines(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text("<r>\n<!-- note -->\n\n  <a/><b\n/>\n</r>")
    root = read_xml(path)
    assert [(one.tag, one.line) for one in root.iter()] == [("r", 1), ("a", 4), ("b", 4)]
    assert place(root[1]) == f"{path}: line 4"
