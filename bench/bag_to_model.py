"""From bag to model: `symbid identify` compared with the script in bench/peer_script.py.

A simulated log of the Symbitron at 1 kHz (ten joints, an IMU, two force plates) is identified by
each program in turn, in processes of their own, and the round is repeated; the tables show medians.
Where other programs use the machine, the ratio of processor time says more than that of seconds.
The peer sums normal equations and solves with a plain prior; `symbid identify` also diagnoses the
log, chooses joint terms and windows, weights by a noise model, solves `map_lmi`, predicts data held
out and writes model files.

    python bench/bag_to_model.py [--seconds 47 600] [--repeats 5] [--jobs 1 2]
    python bench/bag_to_model.py --growth 1 10 60      # minutes; time and memory against length

`--checkout FOLDER` times `symbid identify` of another checkout as well, such as that of commit
17d344f, which was 1.5 to 1.8 times as fast as the peer on a machine with 16 cores. Logs are kept in
`--data FOLDER` when it is given, and used again.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from development import require_packages
from process_usage import SessionMemory
from tables import markdown, save_plot

HERE = Path(__file__).resolve().parent
MODEL = HERE.parent / "config" / "symbitron.urdf"
SECONDS_PER_MOVE = 2.5
ENTRY = "from symbid_ros.cli.main import main; main()"


@dataclass(frozen=True)
class Usage:
    """What a process took: s on the clock, s of processor time, MB at most."""

    wall: float
    processor: float
    memory: float


def main() -> None:
    """Write the logs, time the programs and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, nargs="+", default=[47.0, 600.0])
    parser.add_argument("--growth", type=float, nargs="+", metavar="MINUTES")
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--checkout", type=Path)
    parser.add_argument("--plot", type=Path, metavar="SVG", help="of time against length")
    given = parser.parse_args()
    require_packages("pin")
    with kept_or_temporary(given.data) as folder:
        if given.growth:
            growth(folder, given.growth, max(given.jobs), given.repeats, given.plot)
        else:
            compare(folder, given.seconds, given.jobs, given.repeats, given.checkout)


@contextlib.contextmanager
def kept_or_temporary(folder: Path | None) -> Iterator[Path]:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder.resolve()
    else:
        with tempfile.TemporaryDirectory() as temporary:
            yield Path(temporary)


def compare(
    folder: Path,
    lengths: Sequence[float],
    jobs: Sequence[int],
    repeats: int,
    checkout: Path | None,
) -> None:
    """Print the time and the memory of every program for logs of several lengths."""
    rows = []
    for seconds in lengths:
        bag = simulated(folder, seconds)
        programs = {"peer script": peer(bag)}
        for count in jobs:
            programs[f"symbid identify --jobs {count}"] = identify(bag, folder, count)
        if checkout is not None:
            command = identify(bag, folder / "other", None)
            programs["other checkout"] = [one for one in command if one != "--overwrite"]
        environments = {"other checkout": {"PYTHONPATH": str(checkout and checkout.resolve())}}
        measured = in_turn(programs, environments, repeats)
        peers = medians(measured["peer script"])
        for name, usages in measured.items():
            wall, processor, memory = medians(usages)
            ratios = peers[0] / wall, peers[1] / processor
            rows.append([seconds, name, wall, processor, memory, *ratios])
    head = ["log, s", "program", "s", "processor s", "peak MB", "× faster", "× less processor time"]
    print(markdown(head, rows, digits=3))


def growth(
    folder: Path, minutes: Sequence[float], jobs: int, repeats: int, plot: Path | None
) -> None:
    """Print time and memory of logs whose lengths differ by much."""
    rows = []
    for length in minutes:
        command = identify(simulated(folder, 60 * length), folder, jobs)
        wall, processor, memory = medians([run(command, {}) for _ in range(repeats)])
        rows.append([length, wall, processor, memory, processor / length])
    head = ["log, min", "s", "processor s", "peak MB", "processor s per minute of log"]
    print(markdown(head, rows, digits=3))
    if plot is not None:
        lines = {"processor s": [row[2] for row in rows], "peak MB": [row[3] for row in rows]}
        save_plot(plot, "minutes of log at 1 kHz", minutes, lines)


def simulated(folder: Path, seconds: float) -> Path:
    """Return a bag of about this length; a simulated one is as long as its moves take."""
    bag = folder / f"log_{seconds:g}_s"
    if not bag.exists():
        moves = max(1, round(seconds / SECONDS_PER_MOVE))
        options = ["--moves", moves, "--motion-seed", 1, "--noise-seed", 2, "--out", bag]
        subprocess.run(
            [sys.executable, "-c", ENTRY, "simulate", *map(str, options)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return bag


def peer(bag: Path) -> list[str]:
    return [sys.executable, str(HERE / "peer_script.py"), str(bag), str(MODEL)]


def identify(bag: Path, folder: Path, jobs: int | None) -> list[str]:
    """Return the command; without ``jobs``, as versions that lack the option take it."""
    command = [sys.executable, "-c", ENTRY, "identify", str(bag), "--model", str(MODEL)]
    command += ["--method", "map_lmi", "--overwrite", "--out", str(folder / "result")]
    return command + ([] if jobs is None else ["--jobs", str(jobs)])


def in_turn(
    programs: dict[str, list[str]], environments: dict[str, dict[str, str]], repeats: int
) -> dict[str, list[Usage]]:
    """Run every program once to warm caches, then ``repeats`` rounds of all."""
    measured: dict[str, list[Usage]] = {name: [] for name in programs}
    for number in range(repeats + 1):
        for name, command in programs.items():
            usage = run(command, environments.get(name, {}))
            if number > 0:
                measured[name].append(usage)
                print(json.dumps({name: vars(usage)}), file=sys.stderr, flush=True)
    return measured


def run(command: list[str], environment: dict[str, str]) -> Usage:
    """Run a command; its memory is that of all its processes together."""
    start = time.perf_counter()
    process = subprocess.Popen(
        command,
        env=os.environ | environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=environment.get("PYTHONPATH"),  # Python looks for packages there first
        start_new_session=True,
    )
    with SessionMemory(process.pid) as memory:
        assert process.stderr is not None
        complaint = process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(command)}\n{complaint.decode()}")
    peak = max(memory.peak, usage.ru_maxrss * 1024e-6)
    return Usage(wall, usage.ru_utime + usage.ru_stime, peak)


def medians(usages: Sequence[Usage]) -> tuple[float, float, float]:
    values = np.median([[usage.wall, usage.processor, usage.memory] for usage in usages], axis=0)
    wall, processor, memory = values.tolist()
    return wall, processor, memory


if __name__ == "__main__":
    main()
