"""Standing with a wrong model, and with models that are identified meanwhile.

    .venv/bin/python bench/learning.py [--seeds 200 201 ...] [--percent 25] [--seconds 70]
    .venv/bin/python bench/learning.py --payload [--seeds 300 301 ...]
    .venv/bin/python bench/learning.py --quiet 10
    .venv/bin/python bench/learning.py --processes --seeds 2 3 5 6 --seconds 16

Every number of the model file is wrong by up to a percentage; the simulated Symbitron is not. The
table says when it fell with the file's inertias alone and with identified ones, how many of these
were used, and how far its centre of mass was from the reference in the last 10 s (rms), relative to
a controller with the true model. All of them make the same moves; the robot that learns begins with
small ones.

With --payload, 5 kg are attached to the body or a thigh of a robot that has learned its model,
and removed again, while the moves are those of the scenario smooth. The table says which link was
named and when, and the error from 15 s after each of both on, relative to that of a controller that
knows robot and payload.

With --quiet, a robot of which nothing changes moves for some minutes, and the models that it takes
over after the first one are counted.

Robot, controller and identifier run in simulated time in one process. With --processes, bridge,
balance controller, identifier and recorder run as processes in real time. The table counts falls,
and states the processor seconds of each process in a simulated second.
"""

import argparse
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from process_usage import processor_seconds
from threadpoolctl import threadpool_limits

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.learning.lockstep import (
    CHANGED,
    SMOOTH,
    WIDE,
    LearningRecord,
    LearningRun,
    LearningTask,
)
from symbid_ros.learning.model_update import ACCEPTED
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload

TRUE = config_file("symbitron.xml")
START = 3.0  # s until controller and identifier have started
WINDOW = 10.0  # s, over which the error is taken
# Payloads: time of the first change, which varies with the seed by a move, duration, and time to
# recover, s.
ATTACHED, VARIES, CARRIED, RECOVERY = 12.0, 4.0, 22.0, 15.0
MASS, MEMORY = 5.0, 10.0  # kg, s
PLACES = {
    "base_link": (0.0, 0.0, 0.2),
    "L_thigh": (0.2, 0.0, 0.05),
    "R_thigh": (0.2, 0.0, 0.05),
}
RESTORED = 1.2  # of the true model's error
FIRST_MINUTE, QUIET_SEED = 60.0, 320  # s
NODES = ("mujoco_bridge", "balance_controller", "identifier", "recorder")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(200, 220)))
    parser.add_argument("--seconds", type=float, default=70.0)
    parser.add_argument("--percent", type=float, default=25.0)
    parser.add_argument("--scenario", choices=(SMOOTH, WIDE), default=WIDE)
    parser.add_argument("--learning-only", action="store_true", help="without the file alone")
    parser.add_argument("--payload", action="store_true")
    parser.add_argument("--quiet", type=float, metavar="MINUTES")
    parser.add_argument("--processes", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.processes:
            by_processes(folder, given.seeds, given.percent, given.seconds, given.scenario)
        elif given.payload:
            with_payload(folder, given.seeds, given.percent)
        elif given.quiet:
            without_change(folder, given.percent, given.quiet)
        else:
            in_lockstep(
                folder,
                given.seeds,
                given.percent,
                LearningTask(TRUE, given.seconds, scenario=given.scenario),
                learning_only=given.learning_only,
            )


def wrong_model(folder: Path, percent: float, seed: int) -> Path:
    """Write the Symbitron with all its numbers wrong by up to a percentage."""
    parameters = ParameterSet(load_model(TRUE))
    wrong = parameters.apply(draw_prior(parameters, "percent", percent, seed).mean)
    model = folder / "wrong.xml"
    model.write_text(mjcf_text(wrong, TRUE))
    return model


def in_lockstep(
    folder: Path, seeds: list[int], percent: float, known: LearningTask, *, learning_only: bool
) -> None:
    """Compare the file alone, learning and the true model in simulated time."""
    threadpool_limits(1)
    truth = LearningRun(known, learns=False).run()
    seconds = float(known.seconds or 0.0)
    last = seconds - WINDOW, seconds
    best = truth.com_error(*last)
    print(f"With the true model: {1e3 * best:.2f} mm.\n")
    print("| prior | file alone | learning | models | full size after | error | relative |")
    print("|---|---|---|---|---|---|---|", flush=True)
    alone_stands = learning_stands = 0
    for seed in seeds:
        task = replace(known, model=wrong_model(folder, percent, seed), noise_seed=seed)
        alone = None if learning_only else LearningRun(task, learns=False).run()
        learning = LearningRun(task, learns=True).run()
        alone_stands += alone is not None and alone.fall is None
        learning_stands += learning.fall is None
        error = learning.com_error(*last)
        models = sum(event.kind == ACCEPTED for event in learning.events)
        widened = learning.time[learning.reach >= 0.99]
        full = f"{widened[0]:.0f} s" if len(widened) else "–"
        print(
            f"| {seed} | {outcome(alone) if alone else ''} | {outcome(learning)} | {models} | "
            f"{full} | {1e3 * error:.2f} mm | {error / best:.2f} |",
            flush=True,
        )
    by_file = "" if learning_only else f"{alone_stands} stand with the file alone, "
    print(f"\nOf {len(seeds)}: {by_file}{learning_stands} stand learning.")


def outcome(record: LearningRecord) -> str:
    """Return when the robot fell, or that it stands."""
    return "stands" if record.fall is None else f"falls at {record.fall.time:.1f} s"


def with_payload(folder: Path, seeds: list[int], percent: float) -> None:
    """Attach a payload to robots that have learned their models, and remove it."""
    threadpool_limits(1)
    seconds = ATTACHED + VARIES + 2 * CARRIED
    unloaded = LearningRun(LearningTask(TRUE, seconds, scenario=SMOOTH), learns=False).run()
    loaded: dict[str, LearningRecord] = {}
    change = "{} | named after | models | size | error, relative"
    print(f"| prior | link | {change.format('attached')} | {change.format('removed')} | outcome |")
    print("|" + "---|" * 13, flush=True)
    stands = named = restored = 0
    for seed in seeds:
        link = list(PLACES)[seed % len(PLACES)]
        attached = ATTACHED + VARIES * float(np.random.default_rng(seed).uniform())
        removed = attached + CARRIED
        payload = Payload(link, MASS, PLACES[link])
        if link not in loaded:
            loaded[link] = carrying_from_the_start(folder, payload, seconds)
        task = LearningTask(
            wrong_model(folder, percent, seed),
            seconds,
            noise_seed=seed,
            scenario=SMOOTH,
            payload=payload,
            attached=attached,
            removed=removed,
            memory=MEMORY,
        )
        record = LearningRun(task, learns=True).run()
        cells, ratios = [], []
        for change, end, truth in (
            (attached, removed, loaded[link]),
            (removed, seconds, unloaded),
        ):
            found = [event for event in record.between(change, end) if event.kind == CHANGED]
            names = [event.text.partition(" has changed")[0] for event in found]
            after = f"{found[0].time - change:.1f} s, {names[0]}" if found else "–"
            named += names[:1] == [link]
            models = sum(event.kind == ACCEPTED for event in record.between(change, end))
            start, stop = change + RECOVERY, min(change + RECOVERY + WINDOW, end)
            ratios.append(record.com_error(start, stop) / truth.com_error(start, stop))
            size = record.reach[(record.time >= start) & (record.time < stop)]
            size_text = f"{100 * size.min():.0f} %" if len(size) else "–"
            cells.append(f"{change:.1f} s | {after} | {models} | {size_text} | {ratios[-1]:.2f}")
        stands += record.fall is None
        restored += max(ratios) < RESTORED
        print(f"| {seed} | {link} | {' | '.join(cells)} | {outcome(record)} |", flush=True)
    count = len(seeds)
    print(
        f"\nOf {count}: {stands} stand, {restored} track within {RESTORED:g} x after {RECOVERY:g} "
        f"s both times; {named} of {2 * count} changes are attributed to the link at once."
    )


def carrying_from_the_start(folder: Path, payload: Payload, seconds: float) -> LearningRecord:
    """Return the run of a controller that knows the robot with its payload."""
    parameters = ParameterSet(load_model(TRUE))
    values = parameters.values.copy()
    place = 10 * parameters.link_names.index(payload.link)
    values[place : place + 10] += payload.phi
    model = folder / f"with_{payload.link}.xml"
    model.write_text(mjcf_text(parameters.apply(values), TRUE))
    task = LearningTask(model, seconds, scenario=SMOOTH, payload=payload, attached=0.0)
    return LearningRun(task, learns=False).run()


def without_change(folder: Path, percent: float, minutes: float) -> None:
    """Count the models that a robot takes over of which nothing changes."""
    threadpool_limits(1)
    task = LearningTask(
        wrong_model(folder, percent, QUIET_SEED),
        FIRST_MINUTE + 60.0 * minutes,
        moves=round(30 * (minutes + 1)),
        noise_seed=QUIET_SEED,
        scenario=SMOOTH,
        memory=MEMORY,
    )
    record = LearningRun(task, learns=True).run()
    kinds = [event.kind for event in record.between(FIRST_MINUTE, np.inf)]
    print(
        f"{minutes:g} minutes after the first: {kinds.count(ACCEPTED)} models taken over, "
        f"{kinds.count(CHANGED)} changes found; {outcome(record)}"
    )


def by_processes(
    folder: Path, seeds: list[int], percent: float, seconds: float, scenario: str
) -> None:
    """Count falls of bridge, balance controller, identifier and recorder in real time."""
    print(
        "| prior | falls, file alone | falls, learning | models | real-time factor | "
        f"{' | '.join(NODES)} | sum |"
    )
    print("|" + "---|" * (6 + len(NODES)), flush=True)
    with private_graph() as graph:
        for seed in seeds:
            model = wrong_model(folder, percent, seed)
            alone, learning = (
                run_processes(model, graph, seconds, scenario, learns=learns)
                for learns in (False, True)
            )
            used = [f"{learning.usage[name]:.2f}" for name in NODES]
            print(
                f"| {seed} | {alone.falls} | {learning.falls} | {learning.models} | "
                f"{learning.factor:.2f} | {' | '.join(used)} | "
                f"{sum(learning.usage.values()):.2f} |",
                flush=True,
            )


@dataclass(frozen=True)
class ProcessRun:
    """Falls, models taken over, simulated seconds per second, and processor seconds of each node.

    The processor seconds are those of a simulated second.
    """

    falls: int
    models: int
    factor: float
    usage: dict[str, float]


def run_processes(
    model: Path, graph: dict[str, str], seconds: float, scenario: str, *, learns: bool
) -> ProcessRun:
    """Let the nodes run in real time; without learning, without an identifier."""
    environment = graph | {"OMP_NUM_THREADS": "1"}
    logs = model.parent
    with ExitStack() as stack:
        nodes: dict[str, NodeProcess] = {}

        def start(name: str, **parameters: object) -> None:
            node = NodeProcess(name, parameters, environment, logs / f"{name}.log")
            nodes[name] = stack.enter_context(node)

        source = "identifier" if learns else "file"
        start("balance_controller", model=str(model), model_source=source, scenario=scenario)
        if learns:
            start("identifier", model=str(model))
            start("recorder", bag=str(model.parent / f"bag_{time.time_ns()}"))
        time.sleep(START)
        start("mujoco_bridge", command_source="topic")
        bridge = nodes["mujoco_bridge"]
        while "waiting for a controller" not in bridge.log.read_text():
            bridge.require_running()
            time.sleep(0.1)
        time.sleep(START)
        before = {name: processor_seconds(node.pid) for name, node in nodes.items()}
        time.sleep(seconds)
        used = {name: processor_seconds(node.pid) - before[name] for name, node in nodes.items()}
        summary = bridge.finish(stop=True)
        nodes["balance_controller"].finish(stop=True)
    factor = summary["real_time_factor"]
    usage = {name: spent / (factor * seconds) for name, spent in used.items()}
    log = nodes["balance_controller"].log.read_text()
    return ProcessRun(
        summary["commands"]["falls"], log.count("replaces the present one"), factor, usage
    )


if __name__ == "__main__":
    main()
