"""YAML and JSON files from any source give plain data within limits, or a one-line error."""

import os

import pytest

from symbid_ros import user_files
from symbid_ros.user_files import load_json, load_yaml


def written(folder, content):
    path = folder / "document"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def reason(load, path):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the message is what is looked at
        load(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


BOMB = "a: &a [x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n"
    for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


CHAIN = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 60))


def test_plain_data_are_read(tmp_path):
    yaml = "rate: 1.5\nnames: [a, b]\nnested:\n  on: {x: 1, y: {x: 2}}\n"
    assert load_yaml(written(tmp_path, yaml)) == {
        "rate": 1.5,
        "names": ["a", "b"],
        "nested": {True: {"x": 1, "y": {"x": 2}}},
    }
    assert load_yaml(written(tmp_path, "a: &one {x: 1}\nb: *one\n")) == {
        "a": {"x": 1},
        "b": {"x": 1},
    }
    assert load_yaml(written(tmp_path, "")) is None
    assert load_json(written(tmp_path, '{"a": [1.5, null]}')) == {"a": [1.5, None]}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("- \n" * 200_000, "more than 100000 parts"),
        (BOMB, "more than 100000 parts"),
        (CHAIN, "more than 100000 parts or 50 levels"),
        ("a: &a [*a]\n", "line 1: more than 50 levels deep"),
        ("a: &a {x: *a}\n", "line 1: more than 50 levels deep"),
        ("a: 1\nb: 2\na: 3\n", "line 3: a is given twice"),
        ("a:\n  b: 1\n  b: 1\n", "line 3: b is given twice"),
        ("[" * 60 + "]" * 60, "line 1: more than 50 levels deep"),
        ("[" * 100_000, "line 1: more than 50 levels deep"),
        ("a: !!python/object/apply:os.system [id]\n", "not valid YAML"),
        ("b: 2\na: [1\n", "line 3: not valid YAML"),
        ("a: 1\n---\nb: 2\n", "not valid YAML"),
        ("? [a]\n: 1\n", "not valid YAML"),
        (
            "a: " + "9" * 5000,
            "line 1: '" + "9" * 40 + "' is not a valid int",
        ),
        ("b: 1\na: 9223372036854775808", "line 2: '9223372036854775808' has more than 64 bits"),
        ("a: 0x" + "f" * 5000, "more than 64 bits"),
        ("a: 59:59:59", "line 1: '59:59:59' is a number in base 60; write it with decimals"),
        ("a: " + ":".join(["59"] * 5000), "base 60"),
        ("a: 1:30.5", "base 60"),
        ("a: 2001-13-45", "'2001-13-45' is not a valid timestamp"),
        ("a: !!int x", "'x' is not a valid int"),
        ("a: !!int ''", "'' is not a valid int"),
        ("a: !!float ''", "'' is not a valid float"),
        ("a: !!bool maybe", "'maybe' is not a valid bool"),
        ("a: !!timestamp never", "'never' is not a valid timestamp"),
        ("a: !!binary \xe9", "not valid YAML"),
        ("a: \x00", "not valid YAML"),
        (b"b: 1\na: \xff", "line 2: not UTF-8 text; save the file in UTF-8"),
        (b" " * (user_files.MAX_YAML_BYTES + 1), "larger than 1 MiB"),
    ],
)
def test_invalid_yaml_is_rejected(content, expected, tmp_path):
    assert expected in reason(load_yaml, written(tmp_path, content))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("{", "line 1"),
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "key 'c' is given twice"),
        ("9" * 5000, ""),
        (b"\xff", "line 1: not UTF-8 text"),
        (b" " * (user_files.MAX_JSON_BYTES + 1), "larger than 64 MiB"),
    ],
)
def test_invalid_json_is_rejected(content, expected, tmp_path):
    assert expected in reason(load_json, written(tmp_path, content))


@pytest.mark.parametrize("load", [load_yaml, load_json])
def test_special_files_are_rejected(load, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name, message in {
        "pipe": "not a regular file",
        "link": "not a regular file",
        "": "a folder, not a file",
        "nothing": "No such file",
        "x" * 300: "File name too long",
        "a\0b": "null byte",
    }.items():
        with pytest.raises(OSError, match=message):
            load(tmp_path / name)
