"""``symbid identify``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from symbid_ros.cli.options import BaseKind, ImuTopic, JointTopic, Model, WrenchTopic

Method = Literal["ols", "wls_r", "wls_c", "wls_rc"]
Criterion = Literal["gen_force", "torque", "com"]
Channels = Literal["all", "thesis"]


def identify(
    bags: Annotated[list[Path], typer.Argument(help="Bags, in sequence.", show_default=False)],
    model: Model,
    out: Annotated[Path, typer.Option(help="Folder for estimate.json, model.urdf and model.xml.")],
    prior: Annotated[
        Path | None, typer.Option(help="prior.json; default: the model's own inertias.")
    ] = None,
    method: Annotated[
        Method, typer.Option(help="Scale rows (R) and columns (C) of the least squares.")
    ] = "wls_rc",
    cutoff: Annotated[
        float, typer.Option(min=0, help="Low-pass cutoff in Hz; 0 filters nothing.")
    ] = 30.0,
    channels: Annotated[
        Channels, typer.Option(help="Filter all channels, or the thesis's choice of them.")
    ] = "all",
    rank: Annotated[
        int | None, typer.Option(min=1, help="Number of singular values to use.")
    ] = None,
    validate: Annotated[
        Path | None, typer.Option(help="Bag on which to choose the number of singular values.")
    ] = None,
    select_by: Annotated[
        Criterion, typer.Option(help="Prediction error that chooses it.")
    ] = "gen_force",
    friction: Annotated[
        bool, typer.Option("--friction", help="Identify viscous and Coulomb friction as well.")
    ] = False,
    armature: Annotated[
        bool, typer.Option("--armature", help="Identify the drives' reflected inertias as well.")
    ] = False,
    offset: Annotated[
        bool, typer.Option("--offset", help="Identify a constant effort per joint as well.")
    ] = False,
    sensor_std: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            metavar="EFFORT FORCE MOMENT",
            help="Weigh rows by these sensor deviations instead of by residuals.",
        ),
    ] = None,
    joint_topic: JointTopic = None,
    imu_topic: ImuTopic = None,
    wrench_topic: WrenchTopic = None,
    base: BaseKind = "auto",
) -> None:
    """Identify a robot's parameters from bags."""
    from symbid_ros.bags.selection import TopicSelection
    from symbid_ros.cli.summary import print_estimate
    from symbid_ros.estimation.row_weights import SensorDeviation
    from symbid_ros.model.parameters import joint_terms
    from symbid_ros.offline.identification import write_identification
    from symbid_ros.offline.job import Job, prepare
    from symbid_ros.offline.record import Processing
    from symbid_ros.signals.filters import LowPass

    topics = TopicSelection(
        joints=joint_topic,
        imus=tuple(imu_topic) if imu_topic else None,
        wrenches=tuple(wrench_topic) if wrench_topic else None,
    )
    job = Job(
        bags=tuple(bags),
        model=model,
        base=base,
        prior=prior,
        method=method,
        terms=joint_terms(friction, armature, offset),
        processing=Processing(LowPass(cutoff, channels), topics),
        rank=rank,
        validation=validate,
        criterion=select_by,
        sensors=SensorDeviation(*sensor_std) if sensor_std else None,
    )
    prepared = prepare(job)
    estimate = prepared.solve(method)
    write_identification(estimate, prepared.parameters, out)
    print_estimate(estimate, out)
