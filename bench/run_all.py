"""Run the benchmarks of speed and write their tables and plots to bench/README.md.

    .venv/bin/python bench/run_all.py [--only regressor reading] [--quick] [--data FOLDER]

Each benchmark is a script of its own in a process of its own. Ratios compare programs that ran in
turn on the same machine; seconds are of that machine. With ``--only``, the other sections of
bench/README.md stay as they are. With ``--quick``, logs are short and repetitions few, to see that
everything runs. Simulated logs are kept in ``--data`` when it is given, and used again.
"""

import argparse
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tables import versions

HERE = Path(__file__).resolve().parent
PAGE = HERE / "README.md"
SIMULATING = "bag_to_model.py", "cluster.py"
PACKAGES = "numpy", "scipy", "numba", "pin", "mujoco", "rosbags", "mcap"
HEADING = """# Speed

`make bench` writes this page in about an hour on two idle cores, and
`.venv/bin/python bench/run_all.py --only regressor` the sections of one script. Sections may be of
different runs: each begins with its machine and versions. Ratios compare programs that ran in turn
on the same machine. [Bags](../docs/bags.md) and [live identification](../docs/live.md) have
figures of their own.
"""


@dataclass(frozen=True)
class Section:
    """One script: what it shows, its options in full and when quick, and its plot."""

    title: str
    script: str
    text: str
    options: str = ""
    quick: str = ""
    plot: str = ""


SECTIONS = (
    Section(
        "Regressor",
        "regressor.py",
        "Rows of the equation of motion and Pinocchio in a Python loop, one thread.",
        quick="--repeats 3 --samples 128",
        plot="regressor.svg",
    ),
    Section(
        "Reading",
        "reading.py",
        "Bags into arrays, compared with the deserializing reader of rosbags.",
        quick="--seconds 20",
    ),
    Section(
        "From bag to model",
        "bag_to_model.py",
        "`symbid identify` compared with a plain script of rosbags, SciPy, Pinocchio and NumPy, "
        "whose linear algebra uses all cores. Simulated logs have whole moves: that of "
        '"10 s" lasts 17 s, that of "300 s" 283 s, and that of "600 s" 565 s.',
        options="--seconds 10 47 300 600 --repeats 3",
        quick="--seconds 10 --repeats 1",
    ),
    Section(
        "Growth with the length of the log",
        "bag_to_model.py",
        "One thread, one run of each length. Memory is that of all processes together.",
        options="--growth 0.78 5 10 --repeats 1 --jobs 1",
        quick="--growth 0.2 0.4 --repeats 1",
        plot="growth.svg",
    ),
    Section(
        "Growth with the number of joints",
        "many_joints.py",
        "`identify` with default options on chains of joints, 60 s at 250 Hz, one thread. Rows of "
        "4000 columns or more are used as they are: with moments of all pairs of their columns, "
        "40 joints took 8 GB.",
        quick="--joints 6 10 --seconds 20",
    ),
    Section(
        "Decimated rows",
        "row_rates.py",
        "Estimates by default, from rows at the full rate, and with the rows of NumPy.",
        options="--draws 3 --moves 6",
        quick="--draws 1 --moves 2",
    ),
    Section(
        "Growth with the number of workers",
        "cluster.py",
        "`symbid identify --dask` with a scheduler and workers on the same machine.",
        options="--repeats 1",
        quick="--seconds 10 --repeats 1 --workers 1",
        plot="cluster.svg",
    ),
    Section(
        "Live identification",
        "online.py",
        "Bridge, recorder and identifier at 1 kHz in real time.",
        quick="--minutes 0.2",
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=sorted({_stem(one) for one in SECTIONS}))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--data", type=Path)
    given = parser.parse_args()
    known = parts(PAGE.read_text(encoding="utf-8")) if PAGE.exists() else {}
    for section in SECTIONS:
        if given.only is None or _stem(section) in given.only:
            known[section.title] = measured(section, given.quick, given.data)
    text = [
        f"## {one.title}\n\n{known[one.title].strip()}\n" for one in SECTIONS if one.title in known
    ]
    whole = "\n".join([HEADING, *text])
    if given.quick:
        print(whole)
    else:
        PAGE.write_text(whole, encoding="utf-8")


def measured(section: Section, quick: bool, data: Path | None) -> str:
    """Run a script and return what the page says about it."""
    command = command_of(section, quick)
    print(" ".join(command), file=sys.stderr, flush=True)
    kept = ["--data", str(data.resolve())] if data and section.script in SIMULATING else []
    answer = subprocess.run(
        [sys.executable, *command, *kept],
        cwd=HERE.parent,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    lines = [section.text, "", f"    .venv/bin/python {' '.join(command)}", "", versions(*PACKAGES)]
    lines += ["", answer.stdout.strip(), ""]
    if section.plot and not quick:
        lines += [f"![{section.title}]({section.plot})", ""]
    return "\n".join(lines)


def command_of(section: Section, quick: bool = False) -> list[str]:
    """Return the script and its options."""
    options = (section.quick if quick else section.options).split()
    if section.plot and not quick:
        options += ["--plot", f"bench/{section.plot}"]
    return ["bench/" + section.script, *options]


def parts(text: str) -> dict[str, str]:
    """Return the sections of the page by title."""
    pieces = re.split(r"^## (.+)\n\n", text, flags=re.MULTILINE)
    return dict(zip(pieces[1::2], pieces[2::2], strict=True))


def _stem(section: Section) -> str:
    return section.script.removesuffix(".py")


if __name__ == "__main__":
    main()
