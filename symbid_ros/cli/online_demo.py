"""The online demo: identify the robot while it moves, and report on what was known at the end."""

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from symbid_ros.cli.demo_setting import (
    MOTION_SEED,
    progress_bars,
    recording_facts,
    simulate_validation,
)

POLL = 0.2  # s
SAVING_TIME = 120.0  # s; on a slow machine the identifier may be behind


def demonstrate_online(out: Path, model: Path, moves: int, seed: int, console: Console) -> None:
    """Identify live and report into the demo's folder, which holds a prior already."""
    facts = _identify(out, model, moves, seed, console)
    with progress_bars(console) as progress:
        simulate_validation(out / "validation", moves, progress)
        _report(out, model, facts, progress, console)


def _identify(out: Path, model: Path, moves: int, seed: int, console: Console) -> dict[str, str]:
    """Let the nodes run until the motion has ended and the estimate is saved."""
    from symbid_ros.cli.processes import NodeProcess, private_graph
    from symbid_ros.simulation.simulator import Simulator

    motion = {"scenario": "smooth", "moves": moves, "motion_seed": MOTION_SEED, "noise_seed": seed}
    simulator = Simulator("smooth", moves=moves, motion_seed=MOTION_SEED, noise_seed=seed)
    seconds = simulator.steps * simulator.period_ns * 1e-9
    console.print(f"The robot moves for {seconds:.0f} s; Ctrl-C ends it all.\n")
    logs = out / "log"
    logs.mkdir()
    identifier_parameters = {
        "mode": "online",
        "model": str(model),
        "prior": str(out / "prior.json"),
        "out": str(out / "online"),
    }

    with private_graph() as graph:

        def node(
            name: str,
            parameters: Mapping[str, object],
            file: str | None = None,
            *,
            is_shown: bool = False,
        ) -> NodeProcess:
            log = logs / f"{name}.log"
            return NodeProcess(name, parameters, graph, log, file=file, is_shown=is_shown)

        # The robot waits for recorder and identifier, so that both get everything.
        awaited = {"wait_for_subscribers": True, "subscribers": 2}
        with (
            node("identifier", identifier_parameters, "identifier.yaml") as identifier,
            node("recorder", {"bag": str(out / "bag")}, "recorder.yaml") as recorder,
            node("monitor", {"truth": str(model)}, is_shown=True) as monitor,
            node("mujoco_bridge", motion | awaited, "bridge.yaml") as bridge,
        ):
            while not bridge.wait(POLL):
                for other in (identifier, recorder, monitor):
                    other.require_running()
            played = bridge.finish()
            # Asked to end, it works on what is left and saves; the monitor sees that too.
            identified = identifier.finish(stop=True, patience=SAVING_TIME)
            monitor.stop()
            recorded = recorder.finish(stop=True)
    received, missing = (sum(identified[key].values()) for key in ("received", "missing"))
    return recording_facts(played, recorded) | {
        "Identified live": f"{identified['solves']} estimates, the last of {received} messages, "
        f"{missing} missing by stamp",
    }


def _report(
    out: Path, model: Path, facts: dict[str, str], progress: Progress, console: Console
) -> None:
    """Judge the saved estimate by the truth and write the page."""
    from symbid_ros.errors import EstimateError
    from symbid_ros.identification.loaded_model import load_subject
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.truth import read_realistic_motion, read_true_motion
    from symbid_ros.report.compose import TITLES, Reference, bag_facts, compose, estimate_facts
    from symbid_ros.report.page import write_report
    from symbid_ros.report.table import metrics_table

    task = progress.add_task("a report", total=2)
    robot = load_model(model)
    subject = load_subject(out / "online", robot)
    estimate = subject.estimate
    if estimate is None:
        raise EstimateError(f"{out / 'online'}: holds no estimate; see {out / 'log'}")
    reference = Reference(
        read_true_motion([out / "validation"], robot),
        subject.parameters.values,
        read_realistic_motion([out / "bag"], robot),
    )
    progress.advance(task)
    title = f"{TITLES[estimate.method]}, online"
    described = bag_facts([out / "bag"]) | facts | estimate_facts(estimate)
    content = compose(
        {title: estimate},
        subject.parameters,
        chosen=title,
        facts=described | {"Judged on": f"{out / 'validation'}, ideal, other moves"},
        reference=reference,
        deviation_factor=subject.deviation_factor,
    )
    write_report(content, out / "report.html")
    progress.advance(task)
    console.print(metrics_table(content.methods))
