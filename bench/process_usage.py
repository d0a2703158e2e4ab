"""Memory and processor time of processes, from Linux's /proc."""

import os
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

TICKS = os.sysconf("SC_CLK_TCK")


def peak_memory() -> float:
    """Return the peak memory of this process, MB; getrusage may return that of its parent."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024e-6


def processor_seconds(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


class SessionMemory:
    """Largest memory of all processes of a session together, watched while the context lasts.

    Pages that processes share are counted once (proportional set size). The memory is read every
    ``PERIOD``, so a shorter peak may be missed.
    """

    PERIOD = 0.25  # s; reading takes time that the processes lose

    def __init__(self, session: int) -> None:
        self.peak = 0.0  # MB
        self._session = session
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._measure, daemon=True)

    def __enter__(self) -> Self:
        self._watch.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._watch.join()

    def _measure(self) -> None:
        while not self._ended.wait(self.PERIOD):
            self.peak = max(self.peak, sum(map(_memory, _processes(self._session))))


def _processes(session: int) -> list[Path]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
        except OSError:  # it has ended
            continue
        if int(fields[3]) == session:
            found.append(folder)
    return found


def _memory(process: Path) -> float:
    """Return the proportional set size, MB; 0 of a process that has ended."""
    try:
        lines = (process / "smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(x.split()[1]) * 1024e-6 for x in lines if x.startswith("Pss:")), 0.0)
