"""Standing with a wrong model, and with models that an identifier finds meanwhile.

    .venv/bin/python bench/learning.py [--seeds 2 3 5 6] [--seconds 16] [--percent 25]

Bridge, balance controller and identifier run as processes in real time. Every number of the model
file is wrong by up to a percentage; the simulated Symbitron is not. The table says how often it
fell with the file's inertias alone, and with identified ones, and how many of these were used.
"""

import argparse
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file

TRUE = config_file("symbitron.xml")
START = 3.0  # s until controller and identifier have started


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
    with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
        for seed in given.seeds:
            wrong = parameters.apply(draw_prior(parameters, "percent", given.percent, seed).mean)
            model = Path(folder) / "wrong.xml"
            model.write_text(mjcf_text(wrong, TRUE))
            alone, learning = (run(model, graph, given.seconds, learns) for learns in (False, True))
            print(
                f"| {seed} | {alone.falls} | {learning.falls} | {learning.accepted} |", flush=True
            )


def run(model: Path, graph: dict[str, str], seconds: float, learns: bool) -> Run:
    """Let the robot stand and move, and the controller learn or not."""
    environment = graph | {"OMP_NUM_THREADS": "1"}
    logs = model.parent
    with ExitStack() as stack:

        def started(name: str, **parameters: object) -> NodeProcess:
            node = NodeProcess(name, parameters, environment, logs / f"{name}.log")
            return stack.enter_context(node)

        source = "identifier" if learns else "file"
        controller = started("balance_controller", model=str(model), model_source=source)
        if learns:
            started("identifier", model=str(model))
        time.sleep(START)
        bridge = started("mujoco_bridge", command_source="topic")
        time.sleep(seconds)
        falls = bridge.finish(stop=True)["commands"]["falls"]
        controller.finish(stop=True)
    return Run(falls, controller.log.read_text().count("replaces the present one"))


if __name__ == "__main__":
    main()
