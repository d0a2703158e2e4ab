"""The offline demo: record a bag over topics, identify it with every method, report on all."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import Progress

from symbid_ros.cli.demo_setting import (
    MOTION_SEED,
    progress_bars,
    recording_facts,
    simulate_validation,
)

if TYPE_CHECKING:
    from symbid_ros.estimation.estimate import Estimate
    from symbid_ros.identification.solver import Identification
    from symbid_ros.offline.identify import Prepared


def demonstrate_offline(out: Path, model: Path, moves: int, seed: int, console: Console) -> None:
    """Record, identify and report into the demo's folder, which holds a prior already."""
    with progress_bars(console) as progress:
        facts = _record(out, moves, seed, progress)
        simulate_validation(out / "validation", moves, progress)
        _identify(out, model, facts, progress, console)


def _record(out: Path, moves: int, seed: int, progress: Progress) -> dict[str, str]:
    """Let bridge and recorder run as processes, and return what they say."""
    from symbid_ros.cli.processes import NodeProcess, private_graph
    from symbid_ros.simulation.simulator import Simulator

    motion = {
        "scenario": "smooth",
        "moves": moves,
        "motion_seed": MOTION_SEED,
        "noise_seed": seed,
        "wait_for_subscribers": True,
    }
    simulator = Simulator("smooth", moves=moves, motion_seed=MOTION_SEED, noise_seed=seed)
    seconds = simulator.steps * simulator.period_ns * 1e-9
    task = progress.add_task("robot moves, topics are recorded", total=seconds)
    logs = out / "log"
    logs.mkdir()
    bag = {"bag": str(out / "bag")}
    with (
        private_graph() as graph,
        NodeProcess(
            "recorder", bag, graph, logs / "recorder.log", file="recorder.yaml"
        ) as recorder,
        NodeProcess(
            "mujoco_bridge", motion, graph, logs / "bridge.log", file="bridge.yaml"
        ) as bridge,
    ):
        while not bridge.wait(0.2):
            recorder.require_running()
            progress.update(task, completed=min(progress.tasks[task].elapsed or 0, seconds))
        played = bridge.finish()
        recorded = recorder.finish(stop=True)
    progress.update(task, completed=seconds)
    return recording_facts(played, recorded)


def _identify(
    out: Path, model: Path, facts: dict[str, str], progress: Progress, console: Console
) -> None:
    """Identify with every method, write what each found, and report on all of them."""
    from symbid_ros.estimation.truncated_svd import METHODS
    from symbid_ros.identification.dataset import Processing
    from symbid_ros.identification.export import write_identification
    from symbid_ros.identification.prior_information import PriorChoice
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet
    from symbid_ros.offline.identify import prepare
    from symbid_ros.offline.job import Job
    from symbid_ros.offline.truth import read_realistic_motion, read_true_motion
    from symbid_ros.report.compose import OWN_Z, TITLES, Reference, bag_facts, compose
    from symbid_ros.report.page import write_report
    from symbid_ros.report.table import metrics_table
    from symbid_ros.signals.filters import LowPass

    task = progress.add_task("identification and a report", total=6)
    validation = out / "validation"
    job = Job((out / "bag",), model, prior=PriorChoice(out / "prior.json"))
    by_thesis = prepare(
        replace(job, method="wls_rc", processing=Processing(LowPass()), validation=validation)
    )
    progress.advance(task)
    by_windows = prepare(job)
    progress.advance(task)
    chosen = by_windows.solve("map_lmi")
    found: dict[str, tuple[str, Identification]] = {
        TITLES[method]: (method, by_thesis.solve(method)) for method in METHODS
    }
    found[OWN_Z] = ("wls_rc_own_z", by_windows.solve("wls_rc"))
    found[TITLES["map"]] = ("map", by_windows.solve("map"))
    found[TITLES["map_lmi"]] = ("map_lmi", chosen)
    exports = logging.getLogger(write_identification.__module__)
    exports.setLevel(logging.ERROR)  # impossible links of most methods are what the report shows
    try:
        for name, identified in found.values():
            write_identification(identified, by_windows.parameters, out / name)
    finally:
        exports.setLevel(logging.NOTSET)
    progress.advance(task)
    truncations = _truncations(by_windows, validation)
    progress.advance(task)
    robot = load_model(model)
    reference = Reference(
        read_true_motion([validation], robot),
        ParameterSet(robot).values,
        read_realistic_motion([out / "bag"], robot),
    )
    progress.advance(task)
    described = bag_facts([out / "bag"]) | facts
    described |= {
        "Prior": f"{by_windows.prior.kind}, seed {by_windows.prior.seed}",
        "MAP, MAP-LMI": f"{by_windows.job.processing}, no validation data",
        OWN_Z: "the same rows, no validation data",
        "OLS to WLS-RC": f"{by_thesis.job.processing}; z chosen on {validation}",
        "Judged on": f"{validation}, ideal, other moves",
        "Software": chosen.estimate.software,
    }
    content = compose(
        {title: identified.estimate for title, (_, identified) in found.items()},
        by_windows.parameters,
        chosen=TITLES["map_lmi"],
        facts=described,
        reference=reference,
        deviation_factor=chosen.deviation_factor,
        truncations=truncations,
    )
    write_report(content, out / "report.html")
    progress.advance(task)
    console.print(metrics_table(content.methods))


def _truncations(prepared: "Prepared", validation: Path) -> "dict[tuple[str, str], Estimate]":
    """Return the thesis's methods on the prepared rows, z chosen without and with validation."""
    from symbid_ros.bags.streams.reader import bag_log
    from symbid_ros.estimation.truncated_svd import METHODS
    from symbid_ros.identification.dataset import Processing, read_record
    from symbid_ros.report.compose import TITLES

    # The other windows' rows of an ideal bag would be built for nothing.
    log = bag_log([validation], prepared.parameters.model)
    only = Processing(windows=(prepared.solver.chosen.window,))
    judge = replace(prepared, validation=read_record(log, prepared.parameters, only))
    return {
        (TITLES[method], chosen_by): source.solve(method).estimate
        for method in METHODS
        for chosen_by, source in (("the log itself", prepared), ("the ideal bag", judge))
    }
