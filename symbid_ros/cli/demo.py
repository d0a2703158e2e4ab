"""``symbid demo``: the whole loop on one machine, from a standing robot to a report."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from symbid_ros.errors import SymbidError

if TYPE_CHECKING:
    from symbid_ros.estimation.estimate import Estimate
    from symbid_ros.offline.identification import Identification
    from symbid_ros.offline.job import Prepared

MOTION_SEED, VALIDATION_SEED = 1, 2


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the demo makes.")] = Path("demo"),
    moves: Annotated[int, typer.Option(min=1, max=1000, help="Moves of the centre of mass.")] = 20,
    percent: Annotated[float, typer.Option(min=1, max=99, help="Prior's half-width in %.")] = 25.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the prior and the noise.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the folder of an earlier demo.")
    ] = False,
) -> None:
    """Simulate, publish, record and identify the Symbitron, and report on it."""
    from symbid_ros.share import config_file

    console = Console()
    _prepare_folder(out, overwrite=overwrite)
    model = config_file("symbitron.xml")
    _draw_prior(out, model, percent, seed)
    with _progress(console) as progress:
        facts = _record(out, moves, seed, progress)
        _simulate_validation(out / "validation", moves, progress)
        _identify(out, model, facts, progress, console)
    console.print(f"\n[bold]{out}/report.html[/bold] shows it all; the rest of {out}/ made it.")


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
        console=console,
    )


def _prepare_folder(out: Path, *, overwrite: bool) -> None:
    if out.exists():
        if not overwrite:
            raise SymbidError(f"{out}: exists; remove it, choose another --out or pass --overwrite")
        if not (out / "prior.json").is_file():
            raise SymbidError(f"{out}: exists and is no demo's folder; choose another --out")
        shutil.rmtree(out)
    out.mkdir(parents=True)


def _draw_prior(out: Path, model: Path, percent: float, seed: int) -> None:
    # First of all, as it marks the folder as a demo's: one that was interrupted can be replaced.
    from symbid_ros.estimation.prior import draw_prior
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    draw_prior(ParameterSet(load_model(model)), "percent", percent, seed).write(out / "prior.json")


def _record(out: Path, moves: int, seed: int, progress: Progress) -> dict[str, str]:
    """Let bridge and recorder run as processes, and return what they say."""
    from symbid_ros.cli.processes import NodeProcess, private_domain
    from symbid_ros.simulation.simulator import Simulator

    motion = {"scenario": "smooth", "moves": moves, "motion_seed": MOTION_SEED, "noise_seed": seed}
    simulator = Simulator("smooth", moves=moves, motion_seed=MOTION_SEED, noise_seed=seed)
    seconds = simulator.steps * simulator.period_ns * 1e-9
    task = progress.add_task("robot moves, topics are recorded", total=seconds)
    graph = private_domain()
    logs = out / "log"
    logs.mkdir()
    bag = str(out / "bag")
    bridge_parameters = motion | {"wait_for_subscribers": True}
    with (
        NodeProcess("recorder", {"bag": bag}, graph, logs / "recorder.log") as recorder,
        NodeProcess("mujoco_bridge", bridge_parameters, graph, logs / "bridge.log") as bridge,
    ):
        while not bridge.wait(0.2):
            if not recorder.running:
                recorder.finish()
            progress.update(task, completed=min(progress.tasks[task].elapsed or 0, seconds))
        played = bridge.finish()
        recorded = recorder.finish(stop=True)
    progress.update(task, completed=seconds)
    return _recording_facts(played, recorded)


def _recording_facts(played: dict[str, Any], recorded: dict[str, Any]) -> dict[str, str]:
    kept = sum(recorded["recorded"].values())
    # The clock is published too, but not recorded: only topics of both count.
    published = sum(played["published"].get(topic, 0) for topic in recorded["recorded"])
    missing = sum(gap["missing"] for gap in recorded["gaps"].values())
    return {
        "Real-time factor": f"{played['real_time_factor']:.3f}, {played['late_steps']} late steps",
        "Messages": f"{kept} recorded of {published} published, {missing} missing by stamp",
    }


def _simulate_validation(bag: Path, moves: int, progress: Progress) -> None:
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import Simulator

    simulator = Simulator("smooth", moves=moves, motion_seed=VALIDATION_SEED, ideal=True)
    task = progress.add_task("ideal validation bag", total=simulator.steps)
    record(simulator, bag, progress=lambda done, _: progress.update(task, completed=done))


def _identify(
    out: Path, model: Path, facts: dict[str, str], progress: Progress, console: Console
) -> None:
    """Identify with every method, write what each found, and report on all of them."""
    from symbid_ros.estimation.thesis import METHODS
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet
    from symbid_ros.offline.evaluation import read_true_motion
    from symbid_ros.offline.export import write_identification
    from symbid_ros.offline.facts import PriorChoice
    from symbid_ros.offline.job import Job, prepare
    from symbid_ros.offline.prediction import read_realistic_motion
    from symbid_ros.offline.record import Processing
    from symbid_ros.report.compose import OWN_Z, TITLES, Reference, compose
    from symbid_ros.report.facts import bag_facts
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
    for name, identified in found.values():
        write_identification(identified, by_windows.parameters, out / name)
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
    from symbid_ros.estimation.thesis import METHODS
    from symbid_ros.offline.record import Processing, read_record
    from symbid_ros.report.compose import TITLES

    # The other windows' rows of an ideal bag would be built for nothing.
    only = Processing(windows=(prepared.solver.chosen.window,))
    judge = replace(prepared, validation=read_record([validation], prepared.parameters, only))
    return {
        (TITLES[method], chosen_by): source.solve(method).estimate
        for method in METHODS
        for chosen_by, source in (("the log itself", prepared), ("the ideal bag", judge))
    }
