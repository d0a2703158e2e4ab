"""The commands ``prior``, ``identify``, ``evaluate`` and ``report``."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from symbid_ros.cli.cluster import Dask, bag_location, print_dashboard, require_no_urls
from symbid_ros.cli.flags import (
    BaseKind,
    LogBaseKind,
    Model,
    ModelOrRobot,
    Robot,
    require_model,
    with_flags,
)
from symbid_ros.cli.validate import as_identified
from symbid_ros.cli.verbosity import progress_shown
from symbid_ros.errors import EstimateError, PriorError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import options_of, refuse_unused


def prior(
    model: Model,
    out: Annotated[Path, typer.Option(help="File to write, such as prior.json.")],
    percent: Annotated[
        float | None,
        typer.Option(help="Each parameter is uniform within ± this percentage of its value."),
    ] = None,
    absolute: Annotated[
        float | None,
        typer.Option(help="Each parameter is uniform within ± this number in its SI unit."),
    ] = None,
    consistent: Annotated[
        float | None,
        typer.Option(
            help="Each link is physically possible, and its mass moments are within ± this "
            "percentage of their values."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the draw.")] = 0,
    base: BaseKind = "auto",
) -> None:
    """Draw a random prior around the inertias of a model, to test an identification."""
    from symbid_ros.atomic_write import check_output_file
    from symbid_ros.estimation.prior import Kind, draw_prior
    from symbid_ros.estimation.prior_file import write_prior
    from symbid_ros.json_documents import is_document
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    amounts: dict[Kind, float | None] = {
        "percent": percent,
        "absolute": absolute,
        "consistent": consistent,
    }
    chosen = [(kind, amount) for kind, amount in amounts.items() if amount is not None]
    if len(chosen) != 1:
        raise PriorError("give exactly one of --percent, --absolute and --consistent", "E555")
    kind, amount = chosen[0]
    check_output_file(out, lambda path: is_document(path, "prior"))
    drawn = draw_prior(ParameterSet(load_model(model, base)), kind, amount, seed)
    write_prior(out, drawn)
    typer.echo(f"{out}: {len(drawn.names)} parameters of {drawn.model}, {drawn.kind}, seed {seed}")


@with_flags
def identify(
    *,
    bags: Annotated[
        list[Path],
        typer.Argument(help="Bags of one robot; with --dask also URLs.", show_default=False),
    ],
    model: ModelOrRobot = None,
    out: Annotated[Path, typer.Option(help="Folder for the estimate and the identified models.")],
    robot: Robot = None,
    base: LogBaseKind = "auto",
    options: IdentifyOptions,
    log: LogOptions,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the result of an earlier run in --out.")
    ] = False,
    dask: Dask = None,
) -> None:
    """Identify a robot's parameters from bags.

    All identified links are physically possible, and each number has a standard deviation.

    The log is checked first, as by `symbid bag doctor`. The output lists alarms first, and ends
    with what the data determined.

    Exit status: 0 written, 1 written with alarms (do not trust the numbers yet), 2 nothing written.
    """
    from symbid_ros.atomic_write import require_no_files
    from symbid_ros.cli.tables import print_estimate
    from symbid_ros.estimation.provenance import command_line
    from symbid_ros.identification.pipeline import identify_problem
    from symbid_ros.identification.result_files import (
        CALIBRATED,
        RESULT_FILES,
        write_identification,
    )
    from symbid_ros.identification.rows.reading_process import reading_processes
    from symbid_ros.offline.bags import BagRequest

    require_no_files(out, (*RESULT_FILES, *CALIBRATED), overwrite=overwrite)
    request = BagRequest(tuple(bags), require_model(model), options, log, base)
    if dask is None:
        require_no_urls(bags)
        request = request.completed()
        with progress_shown(), reading_processes():
            problem = request.load(out)
            problem, found = identify_problem(problem)
    else:
        from symbid_ros.cluster.connection import connected
        from symbid_ros.cluster.log_job import ClusterRequest

        with connected(dask) as cluster:
            print_dashboard(cluster.dashboard)
            distributed = ClusterRequest(tuple(map(bag_location, bags)), request)
            with progress_shown():
                problem = distributed.load(cluster, out)
                problem, found = identify_problem(problem)
                found = distributed.attributed(cluster, found)
    found = request.attributed(found, command_line(), () if robot is None else (robot,))
    kinematics = problem.options.export_kinematics
    files = write_identification(found, problem.parameters, out, kinematics=kinematics)
    print_estimate(found.estimate, out, files)
    verdict = found.estimate.verdict
    if verdict is not None and verdict.alarms:
        raise typer.Exit(1)


def evaluate(
    estimate: Annotated[Path, typer.Argument(help="Folder of an identification, or a prior.json.")],
    truth: Annotated[
        Path,
        typer.Option(
            help="Model with the true parameters, URDF or MJCF, as of `symbid simulate "
            "--true-model`."
        ),
    ],
    bag: Annotated[list[Path], typer.Option(help="Ideal bag with ground truth. Repeatable.")],
    realistic: Annotated[
        list[Path] | None,
        typer.Option(
            help="Noisy bag with ground truth. Predictions then also use the robot's own sensors: "
            "velocities filtered in real time, and contact forces from Eq. 4.1 of the thesis. "
            "Repeatable."
        ),
    ] = None,
    velocity_cutoff: Annotated[
        float,
        typer.Option(help="Cutoff of the velocity filter for --realistic, Hz; 0 for no filter."),
    ] = 50.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of tables.")
    ] = False,
    base: BaseKind = "auto",
) -> None:
    """Compute the errors of an estimate or a prior from the ground truth of a simulated bag.

    Errors of forces exclude joints with Coulomb friction while they may stick.
    """
    from symbid_ros.cli.tables import errors_table
    from symbid_ros.identification.calibration.rigid_sensors import RigidSensors
    from symbid_ros.identification.predictions.evaluation import check_true_robot, sticking_share
    from symbid_ros.identification.predictions.evaluation import evaluate as evaluate_ideal
    from symbid_ros.identification.predictions.intervals import LEVEL, summarise_intervals
    from symbid_ros.identification.predictions.realistic_prediction import evaluate_realistic
    from symbid_ros.identification.result_files import load_estimated_model
    from symbid_ros.json_documents import versioned
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
    from symbid_ros.signals.filters import CausalLowPass

    low_pass = CausalLowPass(velocity_cutoff)
    robot = load_model(truth, base)
    robot.require_mass()
    estimated = load_estimated_model(estimate, robot)
    rigid = RigidSensors.of(estimated.parameters)
    parameters, values = rigid.parameters, rigid.matrix @ estimated.values
    true_values = rigid.matrix @ estimated.parameters.values
    internal = estimated.parameters.model.wrist_sensors
    motion = read_true_motion(bag, robot, internal)
    check_true_robot(robot, motion)
    noisy = read_realistic_motion(realistic, robot, low_pass, internal) if realistic else None
    ideal = asdict(evaluate_ideal(parameters, {"": values}, true_values, motion)[""])
    sticking = 100 * sticking_share(parameters, true_values, motion)
    errors: dict[str, object] = {**ideal, "sticking_pct": sticking}
    tables = [errors_table("", ideal)]
    if estimated.deviation_factor is not None:
        summary = asdict(
            summarise_intervals(
                parameters, values, rigid.matrix @ estimated.deviation_factor, true_values, motion
            )
        )
        errors["intervals"] = summary
        tables.append(errors_table(f"{100 * LEVEL:g} % intervals", summary))
    if noisy is not None:
        predicted = asdict(evaluate_realistic(parameters, {"": values}, true_values, noisy)[""])
        errors["realistic"] = predicted
        tables.append(errors_table("from noisy sensors", predicted))
    if as_json:
        typer.echo(json.dumps(versioned("evaluation", errors), indent=1))
        return
    Console().print(*tables, sep="\n")
    if sticking:
        typer.echo(
            f"{sticking:.2g} % of the joints' instants are left out of errors of forces: a joint "
            "with Coulomb friction may stick there, and no model predicts its effort"
        )


@with_flags
def report(
    *,
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of identifications; the last is shown in full.")
    ],
    model: Annotated[
        Path | None,
        typer.Option(
            help="Robot model, if not the one in the result's folder.", show_default=False
        ),
    ] = None,
    robot: Robot = None,
    bag: Annotated[
        list[Path] | None,
        typer.Option(
            help="Bag whose forces are shown instead of those of the identified log; with --truth, "
            "bag with ground truth to predict. Repeatable."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="HTML file to write; by default report.html in the last folder.",
            show_default=False,
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Model with the true parameters, for errors of the estimates."),
    ] = None,
    realistic: Annotated[
        list[Path] | None,
        typer.Option(
            help="Noisy bag with ground truth, for predictions from its sensors; needs --truth. "
            "Repeatable."
        ),
    ] = None,
    base: BaseKind = "auto",
    log: LogOptions,
) -> None:
    """Write a report on one or several identifications as a self-contained page.

    Results of one robot may differ in method, log and joint terms. Without --truth, the bag is read
    like those of the identifications, as far as these agree.
    """
    from symbid_ros.atomic_write import check_output_file
    from symbid_ros.identification.predictions.evaluation import check_true_robot
    from symbid_ros.model.load import load_model
    from symbid_ros.offline.bags import load_bag, read_realistic_motion, read_true_motion
    from symbid_ros.progress import report as step
    from symbid_ros.report.compose import GroundTruth, compose, describe_estimate, describe_given
    from symbid_ros.report.page import write_report
    from symbid_ros.report.saved_results import labels, load_result, with_forces_of
    from symbid_ros.report.templates import is_page

    if truth is not None and not bag:
        raise EstimateError("--truth needs a bag with ground truth to predict; add --bag", "E556")
    if realistic and truth is None:
        raise EstimateError("--realistic needs the true model to compare with; add --truth", "E556")
    if not bag:
        given = {one.name for one in options_of(LogOptions)} - {*log.of_robot}
        refuse_unused(log, "without --bag; give both", given)
    folders = list(dict.fromkeys(folders))
    if out is not None:
        check_output_file(out, is_page)
    with progress_shown():
        loaded = None if model is None else load_model(model, base)
        found = [load_result(folder, loaded) for folder in folders]
        if out is None:
            out = folders[-1] / "report.html"
            check_output_file(out, is_page)
        shown = found[-1]
        if bag and truth is None:
            log = as_identified(log, folders)
        recording = load_bag(bag, shown.parameters.model, log) if bag else None
        ground_truth = None
        if recording is not None and truth is None:
            found = [
                with_forces_of(one, folder, recording)
                for folder, one in zip(folders, found, strict=True)
            ]
        elif bag and truth is not None:
            true_robot = load_model(truth, base)
            true_robot.require_mass()
            internal = shown.parameters.model.wrist_sensors
            noisy = (
                read_realistic_motion(realistic, true_robot, internal=internal)
                if realistic
                else None
            )
            motion = read_true_motion(bag, true_robot, internal)
            check_true_robot(true_robot, motion)
            ground_truth = GroundTruth(motion, true_robot, noisy)
        names = labels(folders, [one.estimate for one in found])
        metadata = {} if recording is None else describe_given(recording)
        step("drawing the report")
        content = compose(
            dict(zip(names, found, strict=True)),
            chosen=names[-1],
            metadata=describe_estimate(shown.estimate) | metadata,
            ground_truth=ground_truth,
        )
        write_report(content, out)
    typer.echo(f"wrote {out}")
