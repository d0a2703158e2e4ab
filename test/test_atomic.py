"""Whether a result can be written is known before the work, and asking leaves nothing."""

from pathlib import Path

import pytest

from symbid_ros.atomic import check_output_file, check_writable
from symbid_ros.errors import SymbidError


def test_asking_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "deep" / "down")
    check_writable(tmp_path)
    check_output_file(tmp_path / "deep" / "page.html")
    (tmp_path / "page.html").write_text("old")
    check_output_file(tmp_path / "page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "old"


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SymbidError, match="name a file in it"):
        check_output_file(tmp_path)
    for folder in ("file", "file/below", "deep/" + 300 * "x"):
        with pytest.raises(SymbidError, match="cannot write"):
            check_writable(tmp_path / folder)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
