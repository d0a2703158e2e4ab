"""Progress line and status of a recording."""

import time
from io import StringIO

import pytest
from rich.console import Console

from symbid_ros.bags import WriterState
from symbid_ros.errors import BagError
from symbid_ros.ros.recorder import LATE_SYNC, REFRESH, RecordingProgress
from symbid_ros.ros.reporting import ERROR, OK, WARN

STATE = WriterState(messages=12_345, size=67_800_000, queued=4321, dropped={}, sync_age=0.2)
LOSING = WriterState(
    messages=12_345, size=67_800_000, queued=4321, dropped={"/camera": 16, "/imu": 1}, sync_age=0.2
)


def shown(state: WriterState, width: int, *, is_terminal: bool = True) -> str:
    """Return the last line on the terminal after an update."""
    file = StringIO()
    console = Console(file=file, width=width, force_terminal=is_terminal, color_system=None)
    progress = RecordingProgress("/data/walk", console)
    with progress.display:
        time.sleep(REFRESH)  # the shortest time between two updates
        progress.show(state)
        text = file.getvalue()
    lines = text.replace("\x1b[?25l", "").replace("\r\x1b[2K", "\n").splitlines()
    return lines[-1] if lines else ""


def test_terminal_shows_size_rate_and_number() -> None:
    line = shown(STATE, 100)
    assert "67.8 MB" in line
    assert "12345 messages  /data/walk" in line
    assert "messages/s" in line
    assert "dropped" not in line


@pytest.mark.parametrize("width", [10, 20, 40])
def test_narrow_terminal_shows_the_most_important_values_in_one_line(width: int) -> None:
    line = shown(LOSING, width)
    assert len(line.rstrip()) <= width
    assert "recording".startswith(line[:9])
    if width >= 40:
        assert line.startswith("recording  17 dropped")


def test_nothing_is_shown_without_a_terminal() -> None:
    assert shown(STATE, 100, is_terminal=False) == ""


def test_status_holds_the_counts_and_the_fault() -> None:
    progress = RecordingProgress("/data/walk", Console(file=StringIO()))
    status = progress.status(STATE, None)
    assert (status.level, status.message) == (OK, "recording")
    assert status.values == {
        "bag": "/data/walk",
        "messages": 12_345,
        "bytes": 67_800_000,
        "rate": "0.0",
        "queued": 4321,
        "dropped": 0,
        "sync_age": "0.20",
    }
    late = WriterState(1, 1, 0, {}, LATE_SYNC + 1.0)
    assert progress.status(WriterState(0, 1, 0, {}, 0.0), None).message == "waiting for messages"
    assert progress.status(late, None).level == WARN
    assert progress.status(LOSING, None).level == WARN
    failed = progress.status(LOSING, BagError("the disk is full", "E201"))
    assert (failed.level, failed.message) == (ERROR, "the disk is full")
