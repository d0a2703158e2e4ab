"""Identifies random robots from hundreds of random logs: no traceback, whatever the log.

    python test/support/log_fuzz.py [--cases 300] [--first 0] [--processes 2]

Every case follows from its number. A failure is printed with the command that repeats it.
"""

import contextlib
import io
import json
import logging
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from random import Random
from unittest.mock import patch

import numpy as np
from bag_fuzz import TooSlow, time_limit
from fuzz_runner import run_cases
from random_logs import FAULTS, SECOND, LogPlan, random_streams, small_robot, write_bag

from symbid_ros.cli.main import main as symbid
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.weak_form import block_length

BATCH = 10
MAX_SECONDS = 300  # a busy machine is slow
LONGEST, LONGEST_BLOCK = 2500, 4002  # joint states
RATES = (20.0, 25.0, 30.0, 50.0, 60.0, 100.0, 125.0, 200.0, 250.0, 500.0, 1000.0, 4000.0)
OPTIONS: tuple[tuple[str, ...], ...] = (
    (),
    (),
    (),
    ("--method", "map", "--friction"),
    ("--method", "wls_rc"),
    ("--method", "ols", "--rank", "5"),
    ("--prior-percent", "25", "--armature", "--offset"),
    ("--filter", "butterworth"),
    ("--filter", "butterworth", "--cutoff", "4", "--method", "map"),
    ("--filter", "savitzky_golay"),
    ("--window", "0.1"),
    ("--sensor-errors", "typical"),
    ("--unchecked", "--start", "0.5"),
    ("--unchecked", "--stop", "2.001"),
)


def draw_plan(draw: Random) -> LogPlan:
    """Return a random log's outline; half of them have nothing odd but length and rate."""
    rate = draw.choice(RATES) if draw.random() < 0.5 else 20 * 200 ** draw.random()
    block = block_length(rate)
    in_block = round(block * rate * 1e-9)
    count = draw.choice(
        [
            draw.randint(0, 60),
            draw.randint(50, 400),
            min(in_block + draw.randint(-2, 2), LONGEST_BLOCK),
            draw.randint(0, LONGEST),
            min(round(rate * draw.uniform(0.1, 65)), LONGEST),
        ]
    )
    start = draw.choice(
        [0, block * 40, block * 40 - round(0.03 * SECOND), draw.randrange(2 * 10**18)]
    )
    plan = LogPlan(rate, count, start)
    if draw.random() < 0.5:
        return plan
    gaps = [(draw.random(), 3 ** draw.uniform(0, 6)) for _ in range(draw.randint(0, 6))]
    ratios = tuple(draw.choice([1.0, 1.0, 0.5, 1 / 3, 2.0, 0.1]) for _ in range(2))
    return LogPlan(
        rate,
        count,
        start,
        tuple(gaps),
        (ratios[0], ratios[1]),
        jitter=draw.choice([0.0, 0.1, 0.5]),
        noise=draw.choice([0.0, 1.0, 10.0]),
        fault=draw.choice(["", "", *FAULTS]),
    )


def write_robot(draw: Random, folder: Path) -> tuple[Path, RobotModel]:
    """Write a random robot in one of the formats and return it as it is loaded."""
    floating = draw.random() < 0.5
    robot = small_robot(draw.randrange(50), floating=floating, links=draw.randint(2, 4))
    if draw.random() < 0.5:
        path, text = folder / "robot.urdf", urdf_text(robot)
    else:
        path, text = folder / "robot.xml", mjcf_text(robot)
    path.write_text(text)
    return path, load_model(path, "auto" if floating or path.suffix == ".xml" else "fixed")


def faults(number: int, folder: Path) -> list[str]:
    """Everything that went wrong with one case."""
    draw = Random(number)
    plan, options = draw_plan(draw), draw.choice(OPTIONS)
    path, model = write_robot(draw, folder)
    shutil.rmtree(folder / "log", ignore_errors=True)
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    bag = write_bag(random_streams(model, plan, number), folder / "log")
    base = () if model.floating or path.suffix == ".xml" else ("--base", "fixed")
    arguments = ["symbid", "identify", bag, "--model", path, "--out", out, *base, *options]
    try:
        with time_limit(MAX_SECONDS):
            found = _run([str(each) for each in arguments], out)
    except TooSlow:
        found = ["took too long"]
    outline = f"{'floating' if model.floating else 'fixed'} {plan} {' '.join(options)}"
    return [f"case {number}: {outline}: {text}" for text in found]


def _run(arguments: list[str], out: Path) -> list[str]:
    """Run the command in this process and return what is wrong with how it ended."""
    told, status = io.StringIO(), None
    root = logging.getLogger()
    root.handlers.clear()
    with (
        patch.object(sys, "argv", arguments),
        contextlib.redirect_stderr(told),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error", RuntimeWarning)
        try:
            symbid()
        except SystemExit as ended:
            status = ended.code or 0
        except Exception:
            return [traceback.format_exc(limit=-4)]
    lines = told.getvalue().splitlines()
    if status == 2:
        errors = [line for line in lines if line.startswith("symbid: ")]
        if len(errors) != 1 or lines[-1] != errors[0]:
            return [f"does not end with one line of error: {lines}"]
        return ["left a folder behind"] if out.exists() else []
    if status not in (0, 1):
        return [f"status {status}: {lines}"]
    estimate = json.loads((out / "estimate.json").read_text())
    values = [one["value"] for one in estimate["parameters"].values()]
    return [] if np.isfinite(values).all() else ["an estimate that is not finite"]


def run(cases: range) -> list[str]:
    """Run cases one after the other and return what went wrong."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number in cases:
            found += faults(number, Path(folder))
    return found


if __name__ == "__main__":
    sys.exit(run_cases(run, "random logs", cases=300, batch=BATCH))
