"""``symbid identify``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from symbid_ros.cli.options import BaseKind, ImuTopic, JointTopic, Model, WrenchTopic

Method = Literal["map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"]
Filter = Literal["weak", "butterworth", "savitzky_golay"]
Criterion = Literal["gen_force", "torque", "com"]
Channels = Literal["all", "thesis"]

ROWS = "Rows of the equation of motion"
KNOWN = "What is known beforehand"
UNKNOWN = "What is identified beside the links"
TRUNCATED = "The truncated methods: ols, wls_r, wls_c, wls_rc"
TOPICS = "Topics"


def identify(
    bags: Annotated[list[Path], typer.Argument(help="Bags, in sequence.", show_default=False)],
    model: Model,
    out: Annotated[Path, typer.Option(help="Folder for the estimate and the identified models.")],
    method: Annotated[
        Method,
        typer.Option(
            help="map_lmi: most probable and physically possible; map: most probable; else "
            "truncated least squares with rows (r) and columns (c) scaled."
        ),
    ] = "map_lmi",
    prior: Annotated[
        Path | None,
        typer.Option(
            help="prior.json; default: the model's own inertias, how sure being left to the data.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    prior_percent: Annotated[
        float | None,
        typer.Option(help="Believe the model's values to ± this share, %.", rich_help_panel=KNOWN),
    ] = None,
    prior_absolute: Annotated[
        float | None,
        typer.Option(help="Believe the model's values to ± this, SI units.", rich_help_panel=KNOWN),
    ] = None,
    total_mass: Annotated[
        float | None,
        typer.Option(help="The whole robot, weighed, kg.", rich_help_panel=KNOWN),
    ] = None,
    total_mass_std: Annotated[
        float,
        typer.Option(help="Standard deviation of that, kg.", rich_help_panel=KNOWN),
    ] = 0.05,
    mirror: Annotated[
        float | None,
        typer.Option(
            help="Tie left and right links: their difference in deviations of the prior, such as "
            "0.1.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    tare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Bag with nothing touching the wrench sensors; identifies sensor errors too.",
            rich_help_panel=KNOWN,
        ),
    ] = None,
    information: Annotated[
        Path | None,
        typer.Option(
            help="information.npz of an earlier run to go on from.", rich_help_panel=KNOWN
        ),
    ] = None,
    friction: Annotated[
        bool,
        typer.Option("--friction", help="Viscous and Coulomb friction.", rich_help_panel=UNKNOWN),
    ] = False,
    armature: Annotated[
        bool,
        typer.Option(
            "--armature", help="Reflected inertia of every drive.", rich_help_panel=UNKNOWN
        ),
    ] = False,
    offset: Annotated[
        bool,
        typer.Option(
            "--offset", help="Constant torque offset of every joint.", rich_help_panel=UNKNOWN
        ),
    ] = False,
    sensor_errors: Annotated[
        str | None,
        typer.Option(
            help="typical, or some of plate_offset, plate_gain, plate_pose, torque_gain, "
            "imu_mounting, imu_bias, encoder_offset with commas between them.",
            rich_help_panel=UNKNOWN,
        ),
    ] = None,
    row_filter: Annotated[
        Filter,
        typer.Option(
            "--filter",
            help="weak: rows averaged over windows; else rows at instants, filtered before.",
            rich_help_panel=ROWS,
        ),
    ] = "weak",
    window: Annotated[
        float | None,
        typer.Option(
            help="Length of the windows, s; default: what the data tell most by (weak), 0.081.",
            rich_help_panel=ROWS,
        ),
    ] = None,
    cutoff: Annotated[
        float,
        typer.Option(min=0, help="Of the Butterworth filter, Hz; 0: none.", rich_help_panel=ROWS),
    ] = 30.0,
    channels: Annotated[
        Channels,
        typer.Option(
            help="Butterworth-filter all channels, or the thesis's choice.", rich_help_panel=ROWS
        ),
    ] = "all",
    rank: Annotated[
        int | None,
        typer.Option(min=1, help="Number of singular values to use.", rich_help_panel=TRUNCATED),
    ] = None,
    validate: Annotated[
        Path | None,
        typer.Option(
            help="Bag to choose it on; default: those of which the data say more than the prior.",
            rich_help_panel=TRUNCATED,
        ),
    ] = None,
    select_by: Annotated[
        Criterion,
        typer.Option(help="Prediction error that chooses it there.", rich_help_panel=TRUNCATED),
    ] = "gen_force",
    sensor_std: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="EFFORT FORCE MOMENT",
            help="Weigh rows by these sensor deviations instead of by residuals.",
            rich_help_panel=TRUNCATED,
        ),
    ] = None,
    joint_topic: JointTopic = None,
    imu_topic: ImuTopic = None,
    wrench_topic: WrenchTopic = None,
    base: BaseKind = "auto",
) -> None:
    """Identify a robot's parameters from bags.

    Without options beyond the required ones the links are identified, all of them physically
    possible, with an uncertainty for every parameter and a verdict on whether the data or the
    model's own values decide it.
    """
    from symbid_ros.bags.selection import TopicSelection
    from symbid_ros.cli.summary import print_estimate
    from symbid_ros.estimation.row_weights import SensorDeviation
    from symbid_ros.model.parameters import joint_terms
    from symbid_ros.offline.export import write_identification
    from symbid_ros.offline.job import Facts, Job, PriorChoice, prepare
    from symbid_ros.offline.record import processing
    from symbid_ros.signals.calibration import parse_kinds

    topics = TopicSelection(
        joints=joint_topic,
        imus=tuple(imu_topic) if imu_topic else None,
        wrenches=tuple(wrench_topic) if wrench_topic else None,
    )
    job = Job(
        bags=tuple(bags),
        model=model,
        base=base,
        prior=PriorChoice(prior, prior_percent, prior_absolute),
        method=method,
        terms=joint_terms(friction, armature, offset),
        processing=processing(row_filter, window, cutoff, channels, topics),
        facts=Facts(
            total_mass=None if total_mass is None else (total_mass, total_mass_std),
            mirror=mirror,
            tare=tuple(tare or ()),
            sensor_errors=parse_kinds(sensor_errors or ""),
        ),
        information=information,
        rank=rank,
        validation=validate,
        criterion=select_by,
        sensors=SensorDeviation(*sensor_std) if sensor_std else None,
    )
    prepared = prepare(job)
    found = prepared.solve(method)
    write_identification(found, prepared.parameters, out)
    print_estimate(found.estimate, out)
