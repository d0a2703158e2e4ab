"""``symbid identify``."""

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from symbid_ros.cli.options import (
    BaseKind,
    FramePrefix,
    ImuTopic,
    JointTopic,
    Model,
    Start,
    Stop,
    WrenchTopic,
)

Method = Literal["map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"]
Filter = Literal["weak", "butterworth", "savitzky_golay"]
Criterion = Literal["gen_force", "torque", "com"]
Channels = Literal["all", "thesis"]

ROWS = "Rows of the equation of motion"
KNOWN = "What is known beforehand"
UNKNOWN = "What is identified beside the links"
TRUNCATED = "For ols, wls_r, wls_c and wls_rc only"


def identify(
    bags: Annotated[list[Path], typer.Argument(help="Bags of one robot.", show_default=False)],
    model: Model,
    out: Annotated[Path, typer.Option(help="Folder for the estimate and the identified models.")],
    method: Annotated[
        Method,
        typer.Option(
            metavar="METHOD",
            help="map_lmi: the most probable of all physically possible robots; map: the most "
            "probable, possible or not; ols, wls_r, wls_c, wls_rc: least squares by the largest "
            "singular values, rows (r) or columns (c) scaled.",
        ),
    ] = "map_lmi",
    prior: Annotated[
        Path | None,
        typer.Option(
            help="prior.json. Default: the model's own values; the data say how far to trust them.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    prior_percent: Annotated[
        float | None,
        typer.Option(help="Trust the model's values to ± this many %.", rich_help_panel=KNOWN),
    ] = None,
    prior_absolute: Annotated[
        float | None,
        typer.Option(help="Trust the model's values to ± this, SI units.", rich_help_panel=KNOWN),
    ] = None,
    total_mass: Annotated[
        float | None,
        typer.Option(help="What the whole robot weighs, kg.", rich_help_panel=KNOWN),
    ] = None,
    total_mass_std: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of --total-mass, kg. Default: 0.05.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    mirror: Annotated[
        float | None,
        typer.Option(
            help="How far left and right links may differ, in standard deviations of the prior; "
            "such as 0.1. Default: as they like.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    tare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Bag recorded with nothing touching the wrench sensors, repeatable; sensor "
            "errors are then identified too.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    information: Annotated[
        Path | None,
        typer.Option(
            help="information.npz of an earlier run, to add its data.", rich_help_panel=KNOWN
        ),
    ] = None,
    friction: Annotated[
        bool,
        typer.Option(
            "--friction",
            help="Friction of every joint, viscous and Coulomb.",
            rich_help_panel=UNKNOWN,
        ),
    ] = False,
    armature: Annotated[
        bool,
        typer.Option(
            "--armature",
            help="Inertia of every drive, as the joint feels it.",
            rich_help_panel=UNKNOWN,
        ),
    ] = False,
    offset: Annotated[
        bool,
        typer.Option("--offset", help="Constant torque of every joint.", rich_help_panel=UNKNOWN),
    ] = False,
    sensor_errors: Annotated[
        str | None,
        typer.Option(
            help="Errors of the sensors: typical (all of these) or some, with commas between: "
            "plate_offset, plate_gain, plate_pose, torque_gain, imu_mounting, imu_bias, "
            "encoder_offset.",
            rich_help_panel=UNKNOWN,
        ),
    ] = None,
    row_filter: Annotated[
        Filter | None,
        typer.Option(
            "--filter",
            metavar="FILTER",
            help="weak: average the equation over short windows; butterworth, savitzky_golay: "
            "filter the signals and take single instants. Default: weak, or butterworth where ols, "
            "wls_r, wls_c or wls_rc is given --cutoff or --channels.",
            rich_help_panel=ROWS,
        ),
    ] = None,
    window: Annotated[
        float | None,
        typer.Option(
            help="Length of the windows, s. Default: 0.081, 0.161 or 0.321, whichever tells most, "
            "longer below 75 Hz (weak); 0.081 (savitzky_golay).",
            rich_help_panel=ROWS,
        ),
    ] = None,
    cutoff: Annotated[
        float | None,
        typer.Option(
            min=0, help="Of butterworth, Hz; 0: no filter. Default: 30.", rich_help_panel=ROWS
        ),
    ] = None,
    channels: Annotated[
        Channels | None,
        typer.Option(
            help="Signals that butterworth filters: all (default), or the thesis's choice.",
            rich_help_panel=ROWS,
        ),
    ] = None,
    rank: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of singular values to use. Default: as many as the data know better "
            "than the prior.",
            rich_help_panel=TRUNCATED,
        ),
    ] = None,
    validate: Annotated[
        Path | None,
        typer.Option(
            help="Bag on which to choose that number instead.",
            rich_help_panel=TRUNCATED,
        ),
    ] = None,
    select_by: Annotated[
        Criterion,
        typer.Option(help="Prediction error that decides there.", rich_help_panel=TRUNCATED),
    ] = "gen_force",
    sensor_std: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="EFFORT FORCE MOMENT",
            help="Standard deviations of the sensors (Nm, N, Nm) to weigh rows by. Default: the "
            "residuals'.",
            rich_help_panel=TRUNCATED,
        ),
    ] = None,
    start: Start = 0.0,
    stop: Stop = math.inf,
    joint_topic: JointTopic = None,
    imu_topic: ImuTopic = None,
    wrench_topic: WrenchTopic = None,
    frame_prefix: FramePrefix = "",
    base: BaseKind = "auto",
    unchecked: Annotated[
        bool,
        typer.Option("--unchecked", help="Do without the doctor's checks (docs/diagnosis.md)."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the result of an earlier run in --out.")
    ] = False,
) -> None:
    """Identify a robot's parameters from bags.

    All links come out physically possible, each number with a standard deviation.

    A verdict says what the data decided; alarms come first. Before that the log is checked as by
    `symbid bag doctor`.

    Exit status: 0 written, 1 written with alarms: do not trust the numbers yet, 2 nothing written.
    """
    from symbid_ros.cli.overwriting import require_no_files
    from symbid_ros.cli.tables import print_estimate
    from symbid_ros.estimation.truncated_svd import SensorNoise
    from symbid_ros.identification.dataset import processing
    from symbid_ros.identification.export import RESULT_FILES, write_identification
    from symbid_ros.identification.prior_information import Facts, PriorChoice, weighing
    from symbid_ros.messages.topics import TopicSelection
    from symbid_ros.model.parameters import joint_terms
    from symbid_ros.offline.identify import prepare
    from symbid_ros.offline.job import Job, chosen_filter
    from symbid_ros.signals.sensor_errors import parse_kinds
    from symbid_ros.signals.streams import TimeRange

    require_no_files(out, RESULT_FILES, overwrite=overwrite)
    topics = TopicSelection(
        joints=tuple(joint_topic) if joint_topic else None,
        imus=tuple(imu_topic) if imu_topic else None,
        wrenches=tuple(wrench_topic) if wrench_topic else None,
        frame_prefix=frame_prefix,
    )
    job = Job(
        bags=tuple(bags),
        model=model,
        base=base,
        prior=PriorChoice(prior, prior_percent, prior_absolute),
        method=method,
        terms=joint_terms(friction, armature, offset),
        processing=processing(
            chosen_filter(row_filter, method, cutoff, channels),
            window,
            cutoff,
            channels,
        ),
        topics=topics,
        part=TimeRange(start, stop),
        facts=Facts(
            total_mass=weighing(total_mass, total_mass_std),
            mirror=mirror,
            tare=tuple(tare or ()),
            sensor_errors=() if sensor_errors is None else parse_kinds(sensor_errors),
        ),
        information=information,
        rank=rank,
        validation=validate,
        criterion=select_by,
        sensors=SensorNoise(*sensor_std) if sensor_std else None,
        unchecked=unchecked,
    )
    prepared = prepare(job, out)
    found = prepared.solve(method)
    write_identification(found, prepared.parameters, out)
    print_estimate(found.estimate, out)
    verdict = found.estimate.verdict
    if verdict is not None and verdict.alarms:
        raise typer.Exit(1)
