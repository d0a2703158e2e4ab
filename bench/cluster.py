"""Seconds of `symbid identify --dask` with 1, 2 and 4 workers on this machine.

A simulated log of the Symbitron at 1 kHz is identified by a scheduler and workers on loopback, with
one thread each. They are started before, so that their imports do not count. Speed cannot grow
beyond the machine's cores.

    .venv/bin/python bench/cluster.py [--seconds 600] [--repeats 3] [--workers 1 2 4]
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from bag_to_model import identify, kept_or_temporary, run, simulated
from development import require_packages
from tables import markdown, save_plot

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from dask_cluster import local_cluster


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--plot", type=Path, metavar="SVG")
    given = parser.parse_args()
    require_packages("distributed")
    with kept_or_temporary(given.data) as folder:
        bag = simulated(folder, given.seconds)
        command = identify(bag, folder, 1)
        alone = seconds(command, given.repeats)
        rows: list[list[object]] = []
        times = []
        for count in given.workers:
            with tempfile.TemporaryDirectory() as own, local_cluster(Path(own), count) as cluster:
                command = [*identify(bag, folder, None), "--dask", cluster.address]
                times.append(seconds(command, given.repeats))
            rows.append([count, times[-1], times[0] / times[-1]])
        rows.append(["no cluster, --jobs 1", alone, times[0] / alone])
    print(markdown(["workers", "s", "× faster than one worker"], rows, digits=3))
    if given.plot:
        save_plot(given.plot, "workers", given.workers, {"s": times})


def seconds(command: list[str], repeats: int) -> float:
    """Return the median time of a command, s, after a run that warms caches."""
    return float(np.median([run(command, {}).wall for _ in range(repeats + 1)][1:]))


if __name__ == "__main__":
    main()
