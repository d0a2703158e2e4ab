"""Standing with a wrong model, and with models that are identified meanwhile.

    .venv/bin/python bench/learning.py [--seeds 200 201 ...] [--percent 25] [--seconds 70]
    .venv/bin/python bench/learning.py --processes --seeds 2 3 5 6 --seconds 16

Every number of the model file is wrong by up to a percentage; the simulated Symbitron is not. The
table says when it fell with the file's inertias alone and with identified ones, how many of these
were used, and how far its centre of mass was from the reference in the last 10 s (rms), relative to
a controller with the true model.

Robot, controller and identifier run in simulated time in one process. With --processes, bridge,
balance controller and identifier run as processes in real time, and the table counts falls.
"""

import argparse
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.learning.lockstep import LearningRecord, LearningRun, LearningTask
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file

TRUE = config_file("symbitron.xml")
START = 3.0  # s until controller and identifier have started
WINDOW = 10.0  # s at the end, over which the error is taken


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(200, 220)))
    parser.add_argument("--seconds", type=float, default=70.0)
    parser.add_argument("--percent", type=float, default=25.0)
    parser.add_argument("--processes", action="store_true")
    given = parser.parse_args()
    compare = by_processes if given.processes else in_lockstep
    with tempfile.TemporaryDirectory() as folder:
        compare(Path(folder), given.seeds, given.percent, given.seconds)


def wrong_model(folder: Path, percent: float, seed: int) -> Path:
    """Write the Symbitron with all its numbers wrong by up to a percentage."""
    parameters = ParameterSet(load_model(TRUE))
    wrong = parameters.apply(draw_prior(parameters, "percent", percent, seed).mean)
    model = folder / "wrong.xml"
    model.write_text(mjcf_text(wrong, TRUE))
    return model


def in_lockstep(folder: Path, seeds: list[int], percent: float, seconds: float) -> None:
    """Compare the file alone, learning and the true model in simulated time."""
    threadpool_limits(1)
    truth = LearningRun(LearningTask(TRUE, seconds), learns=False).run()
    last = seconds - WINDOW, seconds
    best = truth.com_error(*last)
    print(f"With the true model: {1e3 * best:.2f} mm.\n")
    print("| prior | file alone | learning | models | full size after | error | relative |")
    print("|---|---|---|---|---|---|---|", flush=True)
    alone_stands = learning_stands = 0
    for seed in seeds:
        task = replace(LearningTask(wrong_model(folder, percent, seed), seconds), noise_seed=seed)
        alone, learning = (LearningRun(task, learns=learns).run() for learns in (False, True))
        alone_stands += alone.fall is None
        learning_stands += learning.fall is None
        error = learning.com_error(*last)
        models = sum(event.kind == "accepted" for event in learning.events)
        widened = learning.time[learning.reach >= 0.99]
        full = f"{widened[0]:.0f} s" if len(widened) else "–"
        print(
            f"| {seed} | {outcome(alone)} | {outcome(learning)} | {models} | {full} | "
            f"{1e3 * error:.2f} mm | {error / best:.2f} |",
            flush=True,
        )
    print(
        f"\nOf {len(seeds)}: {alone_stands} stand with the file alone, {learning_stands} learning."
    )


def outcome(record: LearningRecord) -> str:
    """Return when the robot fell, or that it stands."""
    return "stands" if record.fall is None else f"falls at {record.fall.time:.1f} s"


def by_processes(folder: Path, seeds: list[int], percent: float, seconds: float) -> None:
    """Count falls of bridge, balance controller and identifier in real time."""
    print("| prior | falls, file alone | falls, learning | models |\n|---|---|---|---|", flush=True)
    with private_graph() as graph:
        for seed in seeds:
            model = wrong_model(folder, percent, seed)
            (alone, _), (learning, models) = (
                run_processes(model, graph, seconds, learns) for learns in (False, True)
            )
            print(f"| {seed} | {alone} | {learning} | {models} |", flush=True)


def run_processes(
    model: Path, graph: dict[str, str], seconds: float, learns: bool
) -> tuple[int, int]:
    """Return the number of falls and of models that the controller took over."""
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
    return falls, controller.log.read_text().count("replaces the present one")


if __name__ == "__main__":
    main()
