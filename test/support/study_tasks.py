"""Tasks for worker processes, at the top level of a module so that they can be pickled."""

import os
import signal
import threading
from pathlib import Path

from symbid_ros.errors import StudyError


def write(place: Path, text: str) -> None:
    place.write_text(text, encoding="utf-8")


def tell_blocked_signals(place: Path) -> None:
    place.write_text(" ".join(map(str, map(int, signal.pthread_sigmask(signal.SIG_BLOCK, ())))))


def refuse(place: Path) -> None:
    raise StudyError(f"{place}: refused; ask for something else", "E701")


def die(place: Path) -> None:
    del place
    os.kill(os.getpid(), signal.SIGKILL)


def tell(place: Path) -> None:
    part = place.with_suffix(".part")
    part.write_text(str(os.getpid()), encoding="utf-8")
    part.rename(place)


def stay(place: Path) -> None:
    tell(place)
    threading.Event().wait()
