"""Standing with a wrong model, and with models that an identifier finds meanwhile.

    .venv/bin/python bench/learning.py [--seeds 2 3 5 6] [--seconds 16] [--percent 25]

Bridge, balance controller and identifier run as processes in real time. Every number of the model
file is wrong by up to a percentage; the simulated Symbitron is not. The table says how often it
fell with the file's inertias alone, and with identified ones, and how many of these were used.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file

TRUE = config_file("symbitron.xml")
DOMAIN = 87  # of ROS, in which nothing else should run
START = 3.0  # s until controller and identifier have started
END = 30.0  # s until they have ended


@dataclass(frozen=True)
class Run:
    """How often the robot fell, and how many models the controller took over."""

    falls: int
    accepted: int


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[2, 3, 5, 6])
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--percent", type=float, default=25.0)
    given = parser.parse_args()
    parameters = ParameterSet(load_model(TRUE))
    print("| prior | falls, file alone | falls, learning | models |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for seed in given.seeds:
            wrong = parameters.apply(draw_prior(parameters, "percent", given.percent, seed).mean)
            model = Path(folder) / "wrong.xml"
            model.write_text(mjcf_text(wrong, TRUE))
            alone, learning = (run(model, given.seconds, learns) for learns in (False, True))
            print(
                f"| {seed} | {alone.falls} | {learning.falls} | {learning.accepted} |", flush=True
            )


def run(model: Path, seconds: float, learns: bool) -> Run:
    """Let the robot stand and move."""
    source = "identifier" if learns else "file"
    controller = started("balance_controller", model=model, model_source=source)
    identifier = started("identifier", model=model) if learns else None
    time.sleep(START)
    bridge = started("mujoco_bridge", command_source="topic")
    time.sleep(seconds)
    counts = json.loads(ended(bridge)[0])
    report = ended(controller)[1]
    if identifier is not None:
        ended(identifier)
    return Run(counts["commands"]["falls"], report.count("replaces the present one"))


def ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    """End a node and return what it printed."""
    process.send_signal(signal.SIGINT)
    return process.communicate(timeout=END)


def started(node: str, **parameters: object) -> subprocess.Popen[str]:
    """Start a node in a domain of its own."""
    words = [str(Path(sys.executable).parent / node), "--ros-args"]
    for name, value in parameters.items():
        words += ["-p", f"{name}:={value}"]
    environment = os.environ | {"ROS_DOMAIN_ID": str(DOMAIN), "OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    return subprocess.Popen(words, env=environment, stdout=pipe, stderr=pipe, text=True)


if __name__ == "__main__":
    main()
