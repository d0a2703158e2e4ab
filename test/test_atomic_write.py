"""Outputs appear completely or not at all, and paths are checked before a computation."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from symbid_ros.atomic_write import (
    check_output_file,
    check_output_folder,
    check_writable,
    kept_until_replaced,
    require_distinct,
    staged,
)
from symbid_ros.errors import OptionError, SymbidError

KILLED = """
import os, signal, sys
from pathlib import Path
from symbid_ros.atomic_write import staged
with staged(Path(sys.argv[1])) as stage:
    (stage / "estimate").write_text("new")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}


def write(folder: Path, text: str) -> None:
    with staged(folder) as stage:
        for name in ("estimate", "model"):
            (stage / name).write_text(text)


def test_a_new_folder_appears_with_all_its_files(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    write(out, "first")
    assert contents(out) == {"estimate": "first", "model": "first"}
    assert list(out.parent.iterdir()) == [out]
    umask = os.umask(0)
    os.umask(umask)
    assert out.stat().st_mode & 0o777 == 0o777 & ~umask


def test_in_a_folder_that_exists_only_the_files_written_are_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes").write_text("mine")
    (out / "model").write_text("old")
    write(out, "new")
    assert contents(out) == {"notes": "mine", "estimate": "new", "model": "new"}
    assert len(list(out.iterdir())) == 3


@pytest.mark.parametrize("exists", [False, True])
def test_an_error_leaves_everything_unchanged(tmp_path: Path, exists: bool) -> None:
    out = tmp_path / "out"
    if exists:
        write(out, "old")

    def fail() -> None:
        with staged(out) as stage:
            (stage / "estimate").write_text("new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert out.exists() is exists
    if exists:
        assert contents(out) == {"estimate": "old", "model": "old"}
    assert len(list(tmp_path.rglob("*"))) == 3 * exists


@pytest.mark.parametrize("exists", [False, True])
def test_a_kill_leaves_everything_unchanged(tmp_path: Path, exists: bool) -> None:
    out = tmp_path / "out"
    if exists:
        write(out, "old")
    done = subprocess.run([sys.executable, "-c", KILLED, out], check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    assert out.exists() is exists
    if exists:
        assert contents(out) == {"estimate": "old", "model": "old"}


def test_an_unwritable_path_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SymbidError, match="out: cannot write"):
        write(tmp_path / "file" / "out", "new")


def test_a_check_leaves_no_files(tmp_path: Path) -> None:
    check_writable(tmp_path / "deep" / "down")
    check_writable(tmp_path)
    check_output_file(tmp_path / "deep" / "page.html", lambda _: False)
    (tmp_path / "page.html").write_text("old")
    check_output_file(tmp_path / "page.html", lambda path: path.read_text() == "old")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "old"


def test_unwritable_paths_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SymbidError, match="name a file in it"):
        check_output_file(tmp_path, lambda _: True)
    for folder in ("file", "file/below", "deep/" + 300 * "x"):
        with pytest.raises(SymbidError, match="cannot write"):
            check_writable(tmp_path / folder)
    with pytest.raises(SymbidError, match=r"page\.html: cannot write"):
        check_output_file(tmp_path / "file" / "page.html", lambda _: True)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_files_that_may_not_be_replaced_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "file").write_text("mine")
    for name in ("file", "link"):
        with pytest.raises(SymbidError, match=f"{name}: exists") as refused:
            check_output_file(tmp_path / name, lambda _: False)
        assert refused.value.code == "E551"


def test_one_file_under_two_names_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    one = tmp_path / "folder" / "file"
    for other in (one, tmp_path / "link" / "file", tmp_path / "folder" / ".." / "link" / "file"):
        with pytest.raises(OptionError, match="`a` and `b` are the same file"):
            require_distinct({"`a`": one, "`none`": None, "`b`": other})
    require_distinct({"`a`": one, "`b`": tmp_path / "file", "`c`": None, "`d`": None})


@pytest.mark.parametrize("name", ["metadata.yaml", "log_0.mcap", "log_0.db3"])
def test_the_folder_of_a_bag_is_no_output_folder(tmp_path: Path, name: str) -> None:
    check_output_folder(tmp_path)
    (tmp_path / name).write_text("")
    with pytest.raises(SymbidError, match="is the folder of a bag") as refused:
        check_output_folder(tmp_path)
    assert refused.value.code == "E551"


@pytest.mark.parametrize("fails", [None, KeyboardInterrupt, OSError])
def test_a_folder_is_kept_until_its_replacement_is_complete(tmp_path, fails):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "earlier").touch()
    with contextlib.suppress(KeyboardInterrupt, OSError), kept_until_replaced(folder):
        assert not folder.exists()
        folder.mkdir()
        (folder / "new").touch()
        if fails is not None:
            raise fails
    assert [path.name for path in folder.iterdir()] == ["new" if fails is None else "earlier"]
    assert list(tmp_path.iterdir()) == [folder]
