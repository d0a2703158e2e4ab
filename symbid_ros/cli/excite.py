"""``symbid excite``: a trajectory that tells the most about a robot, designed before it moves."""

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from symbid_ros.cli.flags import BaseKind, ModelOrRobot, Robot, require_model, with_flags
from symbid_ros.cli.verbosity import shows_progress
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions


@with_flags
def excite(
    *,
    model: ModelOrRobot = None,
    out: Annotated[Path, typer.Option(help="Folder for the trajectory and its plan.")],
    robot: Robot = None,
    base: BaseKind = "auto",
    options: ExciteOptions,
    sensors: JointSensorOptions,
    base_sensors: BaseSensorOptions,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier plan in --out.")
    ] = False,
) -> None:
    """Design a periodic trajectory that identifies a robot best, and predict the result.

    The trajectory keeps the limits of positions, velocities, accelerations and efforts. The output
    lists the standard deviation that each parameter will have after the recording.

    With --feet the robot stands: its base moves, its feet stay, and the forces of the ground remain
    inside friction cones and soles.

    Ctrl-C ends the search; the best trajectory so far is written.
    """
    from symbid_ros.atomic_write import check_output_folder, require_no_files
    from symbid_ros.cli.plan_tables import print_plan
    from symbid_ros.excitation.files import FILES, write_plan
    from symbid_ros.excitation.optimizer import Progress as State
    from symbid_ros.excitation.optimizer import TrajectoryOptimizer
    from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
    from symbid_ros.model.load import load_model

    require_no_files(out, FILES, overwrite=overwrite)
    check_output_folder(out)
    loaded = load_model(require_model(model), base)
    problem = excitation_problem(loaded, options, sensors, base_sensors)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    is_complete = True
    with Progress(
        *columns, console=console, transient=True, disable=not shows_progress(console)
    ) as bar:
        task = bar.add_task("searching", total=options.starts * options.iterations)

        def show(state: State) -> None:
            done = max(state.start - 1, 0) * options.iterations + state.iteration
            what = f"start {state.start} of {state.starts}" if state.start else "random motions"
            gain = max(state.gain, 0.0) / math.log(2)
            bar.update(task, completed=done, description=f"{what}, gain {gain:.1f} bit")

        optimizer = TrajectoryOptimizer(problem.design, options.seed, show)
        try:
            optimizer.run(options.starts, options.iterations)
        except KeyboardInterrupt:
            if optimizer.best is None or optimizer.random is None:
                raise
            is_complete = False
            console.print("interrupted: writing the best trajectory so far")
    assert optimizer.best is not None
    assert optimizer.random is not None
    plan = ExcitationPlan(problem, optimizer.best, optimizer.random, is_complete)
    write_plan(plan, out)
    print_plan(plan, out)
