"""``symbid demo``: simulate, record, identify and report on one machine."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from symbid_ros.atomic_write import check_replaceable, check_writable, kept_until_replaced
from symbid_ros.cli.learning_demo import SEED as LEARNING_SEED
from symbid_ros.cli.learning_demo import demonstrate_learning
from symbid_ros.cli.live import SAVE_TIME, SAVING_TIME, WebPort, start_page
from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.simulation.options import SimulateOptions

if TYPE_CHECKING:
    from symbid_ros.estimation.estimate import Estimate
    from symbid_ros.identification.identification import Identification
    from symbid_ros.identification.loaded_problem import LoadedProblem


def demo(
    out: Annotated[Path, typer.Option(help="Folder for all outputs.")] = Path("demo"),
    moves: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of moves of the centre of mass.")
    ] = 20,
    percent: Annotated[
        float, typer.Option(min=1, max=99, help="Half-width of the prior, %.")
    ] = 25.0,
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Seed of the prior and the noise. Default: 0; with --learn 2, whose prior makes "
            "the robot fall.",
            show_default=False,
        ),
    ] = None,
    online: Annotated[
        bool,
        typer.Option("--online", help="Identify while the robot moves and show the estimate."),
    ] = False,
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="With --online: show a page in the browser, with the robot in 3D, and attach a "
            "payload to a thigh during the motion.",
        ),
    ] = False,
    learn: Annotated[
        bool,
        typer.Option(
            "--learn",
            help="Two robots balance with the same wrong model, and one of them identifies its "
            "own: in simulated time, without ROS.",
        ),
    ] = False,
    payload: Annotated[
        bool,
        typer.Option(
            "--payload",
            help="With --learn: attach 5 kg to a thigh during the motion, and remove them later.",
        ),
    ] = False,
    port: WebPort = 8377,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the folder of an earlier demo.")
    ] = False,
) -> None:
    """Simulate, publish, record and identify the Symbitron, and write a report."""
    from symbid_ros.package_paths import config_file

    if learn and (online or web):
        raise typer.BadParameter(
            "with --online or --web it cannot be combined", param_hint="--learn"
        )
    if payload and not learn:
        raise typer.BadParameter("needs --learn", param_hint="--payload")
    console = Console()
    if seed is None:
        seed = LEARNING_SEED if learn else 0
    model = config_file("symbitron.xml")
    with prepared_folder(out, overwrite=overwrite):
        draw_demo_prior(out, model, percent, seed)
        if learn:
            demonstrate_learning(out, model, moves, percent, seed, console, with_payload=payload)
        elif web:
            demonstrate_payload(out, model, moves, seed, port, console)
        elif online:
            demonstrate_online(out, model, moves, seed, console)
        else:
            demonstrate_offline(out, model, moves, seed, console)
    if not web:
        print_report(out, console)


def print_report(out: Path, console: Console) -> None:
    """Print where the report is."""
    console.print(f"\nThe report is [bold]{out}/report.html[/bold]; its inputs are in {out}/.")


MOTION_SEED, VALIDATION_SEED = 1, 2


def progress_bars(console: Console) -> Progress:
    """Return the progress bars of a demo."""
    return Progress(
        TextColumn("{task.description:<34}"),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
        console=console,
    )


@contextmanager
def prepared_folder(out: Path, *, overwrite: bool) -> Iterator[None]:
    """Create an empty folder; with ``overwrite`` it replaces an earlier demo's at the end."""
    check_writable(out)
    check_replaceable(
        out,
        lambda folder: (folder / "prior.json").is_file(),
        "the folder of a demo",
        overwrite=overwrite,
    )
    with kept_until_replaced(out):
        out.mkdir(parents=True)
        yield


def draw_demo_prior(out: Path, model: Path, percent: float, seed: int) -> None:
    """Write ``prior.json``, with each parameter drawn within ``percent`` of the truth.

    It is written first, as it marks the folder as that of a demo. Then --overwrite also accepts the
    folder of an interrupted demo.
    """
    from symbid_ros.estimation.prior import draw_prior
    from symbid_ros.estimation.prior_file import write_prior
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    write_prior(
        out / "prior.json", draw_prior(ParameterSet(load_model(model)), "percent", percent, seed)
    )


def simulate_validation(bag: Path, moves: int, progress: Progress) -> None:
    """Simulate another motion with ideal sensors, and write its bag."""
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import Simulator

    simulator = Simulator(
        SimulateOptions("smooth", moves=moves, motion_seed=VALIDATION_SEED, ideal=True)
    )
    task = progress.add_task("simulating a validation bag", total=simulator.steps)
    record(simulator, bag, progress=lambda done, _: progress.update(task, completed=done))


def recording_facts(played: Mapping[str, Any], recorded: Mapping[str, Any]) -> dict[str, str]:
    """Return the report's facts on the recording, from the summaries of bridge and recorder."""
    kept = sum(recorded["recorded"].values())
    # Only topics in both summaries count: the clock is published but not recorded.
    published = sum(played["published"].get(topic, 0) for topic in recorded["recorded"])
    missing = sum(gap["missing"] for gap in recorded["gaps"].values())
    return {
        "Real-time factor": f"{played['real_time_factor']:.3f}, {played['late_steps']} late steps",
        "Messages": f"{kept} recorded of {published} published, {missing} missing by stamp",
    }


def demonstrate_offline(out: Path, model: Path, moves: int, seed: int, console: Console) -> None:
    """Record, identify and report, with the prior in the folder."""
    with progress_bars(console) as progress:
        facts = _record(out, moves, seed, progress)
        simulate_validation(out / "validation", moves, progress)
        _identify_offline(out, model, facts, progress, console)


def _record(out: Path, moves: int, seed: int, progress: Progress) -> dict[str, str]:
    """Run bridge and recorder as processes, and return the report's facts on the recording."""
    from symbid_ros.simulation.simulator import Simulator

    motion = {
        "scenario": "smooth",
        "moves": moves,
        "motion_seed": MOTION_SEED,
        "noise_seed": seed,
        "wait_for_subscribers": True,
    }
    simulator = Simulator(
        SimulateOptions("smooth", moves=moves, motion_seed=MOTION_SEED, noise_seed=seed)
    )
    seconds = simulator.steps * simulator.period_ns * 1e-9
    task = progress.add_task("moving the robot and recording", total=seconds)
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


def _identify_offline(
    out: Path, model: Path, facts: dict[str, str], progress: Progress, console: Console
) -> None:
    """Identify with every method, and write the results and the report."""
    from symbid_ros.cli.tables import print_metrics
    from symbid_ros.estimation.provenance import command_line
    from symbid_ros.estimation.truncated_svd import METHODS
    from symbid_ros.identification.options import IdentifyOptions
    from symbid_ros.identification.pipeline import identify_problem
    from symbid_ros.identification.result_files import write_identification
    from symbid_ros.identification.rows.dataset import Processing
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import (
        BagRequest,
        load_bag,
        read_realistic_motion,
        read_true_motion,
    )
    from symbid_ros.report.compose import OWN_Z, GroundTruth, compose, describe_log
    from symbid_ros.report.page import write_report
    from symbid_ros.report.saved_results import METHOD_TITLES, ReportedResult

    task = progress.add_task("identifying and reporting", total=6)
    validation = out / "validation"
    # The methods are compared on the same parameters.
    options = IdentifyOptions(prior=out / "prior.json", joint_terms=("none",))
    for_thesis = replace(
        options, method="wls_rc", filter="butterworth", choose_truncation=validation
    )
    by_thesis = BagRequest((out / "bag",), model, for_thesis).load()
    progress.advance(task)
    by_windows = BagRequest((out / "bag",), model, options).load()
    progress.advance(task)
    _, chosen = identify_problem(by_windows)
    found: dict[str, tuple[str, Identification]] = {
        METHOD_TITLES[method]: (method, by_thesis.solve(method)) for method in METHODS
    }
    found[OWN_Z] = ("wls_rc_own_z", by_windows.solve("wls_rc"))
    found[METHOD_TITLES["map"]] = ("map", by_windows.solve("map"))
    found[METHOD_TITLES["map_lmi"]] = ("map_lmi", chosen)
    exports = logging.getLogger(write_identification.__module__)
    exports.setLevel(logging.ERROR)  # the report shows which methods give impossible links
    try:
        for name, identified in found.values():
            problem = by_thesis if name in METHODS else by_windows
            named = problem.with_provenance(identified, command_line())
            write_identification(named, by_windows.parameters, out / name)
    finally:
        exports.setLevel(logging.NOTSET)
    progress.advance(task)
    truncations = _truncations(by_windows, validation)
    progress.advance(task)
    robot = load_model(model)
    ground_truth = GroundTruth(
        read_true_motion([validation], robot),
        robot,
        read_realistic_motion([out / "bag"], robot),
    )
    progress.advance(task)
    described = describe_log(load_bag(out / "bag")) | facts
    described |= {
        "Prior": f"{by_windows.prior.kind}, seed {by_windows.prior.seed}",
        "MAP, MAP-LMI": f"{Processing.of(options)}, no validation data",
        OWN_Z: "the same rows, no validation data",
        "OLS to WLS-RC": f"{Processing.of(for_thesis)}; z chosen on {validation}",
        "Evaluated on": f"{validation}, ideal, another motion",
        "Software": chosen.estimate.software,
    }
    content = compose(
        {
            title: ReportedResult(
                identified.estimate,
                by_windows.parameters,
                identified.deviation_factor,
                identified.report,
            )
            for title, (_, identified) in found.items()
        },
        chosen=METHOD_TITLES["map_lmi"],
        metadata=described,
        ground_truth=ground_truth,
        truncations=truncations,
    )
    write_report(content, out / "report.html")
    progress.advance(task)
    print_metrics(console, content.methods)


def _truncations(prepared: "LoadedProblem", validation: Path) -> "dict[tuple[str, str], Estimate]":
    """Return the thesis's estimates from equal rows, with z chosen without and with validation."""
    from symbid_ros.bags import bag_log
    from symbid_ros.estimation.truncated_svd import METHODS
    from symbid_ros.identification.rows.dataset import Processing, read_dataset
    from symbid_ros.report.saved_results import METHOD_TITLES

    # Only rows of the chosen window are needed.
    log = bag_log([validation], prepared.parameters.model)
    only = Processing(windows=(prepared.solved.chosen.window,))
    validated = replace(prepared, validation=read_dataset(log, prepared.parameters, only))
    return {
        (METHOD_TITLES[method], chosen_by): source.solve(method).estimate
        for method in METHODS
        for chosen_by, source in (("the log itself", prepared), ("the ideal bag", validated))
    }


POLL = 0.2  # s


def demonstrate_online(out: Path, model: Path, moves: int, seed: int, console: Console) -> None:
    """Identify online and report, with the prior in the folder."""
    facts = _identify_online(out, model, moves, seed, console)
    with progress_bars(console) as progress:
        simulate_validation(out / "validation", moves, progress)
        _report(out, model, facts, progress, console)


def _identify_online(
    out: Path, model: Path, moves: int, seed: int, console: Console
) -> dict[str, str]:
    """Run the nodes until the motion ends and the estimate is saved."""
    motion = {"scenario": "smooth", "moves": moves, "motion_seed": MOTION_SEED, "noise_seed": seed}
    seconds = _duration(moves, seed)
    console.print(f"The robot moves for {seconds:.0f} s. Ctrl-C stops the demo.\n")
    logs = out / "log"
    logs.mkdir()
    identifier_parameters = {
        "mode": "online",
        "model": str(model),
        "prior": str(out / "prior.json"),
        "out": str(out / "online"),
        "save_time": SAVE_TIME,
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

        # The robot waits for recorder and identifier, so that both receive all messages.
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
            # The stopped identifier processes its queue and saves, which the monitor still shows.
            identified = identifier.finish(stop=True, patience=SAVING_TIME)
            monitor.stop()
            recorded = recorder.finish(stop=True)
    received, missing = (sum(identified[key].values()) for key in ("received", "missing"))
    return recording_facts(played, recorded) | {
        "Identified live": f"{identified['solves']} estimates, the last of {received} messages, "
        f"{missing} missing by stamp",
    }


# What the robot carries in the demo with a page, from a share of the motion on.
PAYLOAD: dict[str, object] = {
    "payload_link": "L_thigh",
    "payload_mass": 3.0,
    "payload_position": [0.2, 0.0, 0.05],
}
PAYLOAD_SHARE = 0.4
MEMORY = 10.0  # s in which the weight of data falls to 1/e, so that the estimate follows


def demonstrate_payload(
    out: Path, model: Path, moves: int, seed: int, port: int, console: Console
) -> None:
    """Identify online with a page in the browser, while a payload is attached to the robot."""
    motion = {"scenario": "smooth", "moves": moves, "motion_seed": MOTION_SEED, "noise_seed": seed}
    seconds = _duration(moves, seed)
    fastened = round(PAYLOAD_SHARE * seconds, 1)
    logs = out / "log"
    logs.mkdir()
    common = {"model": str(model), "prior": str(out / "prior.json")}
    parameters = common | {"mode": "online", "out": str(out / "online"), "memory": MEMORY}
    parameters["save_time"] = SAVE_TIME
    load = PAYLOAD | {"payload_time": fastened}
    awaited = {"wait_for_subscribers": True, "subscribers": 1}
    console.print(
        f"The robot moves for {seconds:.0f} s. After {fastened:.0f} s a payload of 3 kg is "
        "attached to L_thigh. Ctrl-C stops the demo.\n"
    )
    with (
        private_graph() as graph,
        NodeProcess(
            "identifier", parameters, graph, logs / "identifier.log", file="identifier.yaml"
        ) as identifier,
        start_page(common | {"port": port}, graph, logs, console) as page,
        NodeProcess("monitor", {}, graph, logs / "monitor.log", is_shown=True) as monitor,
        NodeProcess(
            "mujoco_bridge", motion | awaited | load, graph, logs / "bridge.log", file="bridge.yaml"
        ) as bridge,
    ):
        while not bridge.wait(POLL):
            for other in (identifier, page, monitor):
                other.require_running()
        bridge.finish()
        summary = identifier.finish(stop=True, patience=SAVING_TIME)
        monitor.stop()
    console.print(f"\n{summary.get('saved', '')}", soft_wrap=True, markup=False)


def _duration(moves: int, seed: int) -> float:
    """Return the duration of the motion, s."""
    from symbid_ros.simulation.simulator import Simulator

    simulator = Simulator(
        SimulateOptions("smooth", moves=moves, motion_seed=MOTION_SEED, noise_seed=seed)
    )
    return simulator.steps * simulator.period_ns * 1e-9


def _report(
    out: Path, model: Path, facts: dict[str, str], progress: Progress, console: Console
) -> None:
    """Compare the saved estimate with the truth, and write the report."""
    from symbid_ros.cli.tables import print_metrics
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import load_bag, read_realistic_motion, read_true_motion
    from symbid_ros.report.compose import GroundTruth, compose, describe_estimate, describe_log
    from symbid_ros.report.page import write_report
    from symbid_ros.report.saved_results import METHOD_TITLES, load_result, with_forces_of

    task = progress.add_task("reporting", total=2)
    robot = load_model(model)
    log = load_bag(out / "bag", robot)
    result = with_forces_of(load_result(out / "online", robot), out / "online", log)
    estimate = result.estimate
    ground_truth = GroundTruth(
        read_true_motion([out / "validation"], robot),
        robot,
        read_realistic_motion([out / "bag"], robot),
    )
    progress.advance(task)
    title = f"{METHOD_TITLES[estimate.method]}, online"
    described = describe_log(log) | facts | describe_estimate(estimate)
    content = compose(
        {title: result},
        chosen=title,
        metadata=described | {"Evaluated on": f"{out / 'validation'}, ideal, another motion"},
        ground_truth=ground_truth,
    )
    write_report(content, out / "report.html")
    progress.advance(task)
    print_metrics(console, content.methods)
