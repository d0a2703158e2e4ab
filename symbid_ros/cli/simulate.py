"""The commands ``simulate`` and ``udp-client``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.progress import Progress

from symbid_ros.cli.flags import BaseKind, ModelOrRobot, Robot, require_model, with_flags
from symbid_ros.cli.verbosity import shows_progress
from symbid_ros.errors import OptionError
from symbid_ros.options import options_of, refuse_unused
from symbid_ros.shutdown import stop_on_signals
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.options import SimulateOptions, TruthOptions

if TYPE_CHECKING:
    from symbid_ros.model.tree import RobotModel
    from symbid_ros.simulation.simulator import Simulator
    from symbid_ros.simulation.standing_robot import StandingSimulator
    from symbid_ros.simulation.tracking import TrackingSimulator

# First line of the file of --true-model.
TRUE_MODEL = "<!-- The robot of symbid simulate, without payload. -->"


@with_flags
def simulate(
    *,
    out: Annotated[Path, typer.Option(help="Folder of the new bag.")],
    trajectory: Annotated[
        Path | None,
        typer.Option(
            help="Folder of `symbid excite`, or CSV file in it, for a robot to follow; for one on "
            "a fixed base any CSV file with positions of joints. Needs --model. --noise-seed, "
            "--ideal and --friction apply as well; other options of scenarios do not."
        ),
    ] = None,
    model: ModelOrRobot = None,
    robot: Robot = None,
    base: BaseKind = "auto",
    options: SimulateOptions,
    truth: TruthOptions,
    sensors: JointSensorOptions,
    base_sensors: BaseSensorOptions,
    true_model: Annotated[
        Path | None,
        typer.Option(
            help="MJCF file to write: the simulated robot without payload, for `symbid evaluate`. "
            "Default with --trajectory: the bag's name with _truth.xml."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the bag of an earlier run.")
    ] = False,
) -> None:
    """Simulate a robot in MuJoCo and record its sensors and the ground truth to a bag.

    With --trajectory, the robot of --model follows a trajectory of its joints. Its true links
    differ from the model by up to --truth-percent, so that an identification can be rehearsed.
    Without, the Symbitron carries out a scenario.

    [b]Scenarios[/b]: in [b]smooth[/b] and [b]vibrating[/b] the robot stands and moves its centre
    of mass. In [b]wide[/b] it moves as far as it can without falling if its model is good. In
    [b]squat[/b] it moves mostly up and down. In [b]one_leg[/b] it stands on each leg
    in turn while the other foot makes --moves moves in the air, 1.3 s each. In [b]stepping[/b] it
    makes --moves steps, forward and back, 2 s each. In [b]suspended[/b] it hangs from an overhead
    support that rocks it. In [b]tare[/b] it hangs at rest for 5 s and the force plates
    carry no load; --moves and --motion-seed have no effect.

    [b]Systematic errors[/b]: each one depends only on its name and --error-seed.
    [b]typical[/b] stands for [b]wrench_gain[/b] 0.25-0.75 % per channel, [b]wrench_offset[/b] 1-2 N
    and 0.1-0.2 Nm per channel, [b]wrench_position[/b] 1-3 mm, [b]torque_gain[/b] 1-2 % per drive,
    [b]imu_mounting[/b] 0.1-0.3 degrees and [b]encoder_offset[/b] 0.05-0.15 degrees per joint.
    Others: [b]link_length[/b] 1-2 mm between joints, [b]sample_rates[/b] 1000 Hz for joints, 500 Hz
    for the IMU and 333 Hz for plates, [b]delays[/b] 1-5 ms, different for each sensor,
    [b]quantisation[/b] 16 to 18 bits, [b]drift[/b] slow random walks of plate offsets (0.5 N
    and 0.05 Nm in a minute) and IMU biases (0.0002 rad/s and 0.002 m/s²).
    """
    from symbid_ros.atomic_write import (
        check_output_file,
        check_replaceable,
        require_distinct,
        write_text,
    )
    from symbid_ros.model.load import load_model
    from symbid_ros.simulation.recording import record
    from symbid_ros.user_files import begins_with_mark

    simulator: Simulator | TrackingSimulator | StandingSimulator
    if trajectory is None:
        _require_scenario(model, truth, sensors, base_sensors)
        simulator = _scenario_simulator(options)
    else:
        _require_tracking(options)
        simulator = _tracking_simulator(
            load_model(require_model(model), base),
            trajectory,
            options,
            truth,
            (sensors, base_sensors),
        )
        true_model = true_model or out.with_name(f"{out.name}_truth.xml")
    check_replaceable(out, _is_simulated_bag, "a bag", overwrite=overwrite)
    if true_model is not None:
        require_distinct({"`out`": out, "`true_model`": true_model})
        check_output_file(true_model, lambda path: begins_with_mark(path, TRUE_MODEL))
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not shows_progress(console)) as progress:
        what = options.scenario if trajectory is None else trajectory
        task = progress.add_task(f"simulating {what}", total=simulator.steps)
        counts = record(
            simulator,
            out,
            progress=lambda done, _: progress.update(task, completed=done),
            replace=overwrite,
        )
    if true_model is not None:
        write_text(true_model, f"{TRUE_MODEL}\n{simulator.robot}")
    seconds = simulator.steps * simulator.period_ns * 1e-9
    typer.echo(f"{out}: {seconds:.1f} s, {sum(counts.values())} messages on {len(counts)} topics")
    if trajectory is not None:
        typer.echo(f"{true_model}: the true robot, for `symbid evaluate`")


def _require_scenario(model: Path | None, *others: object) -> None:
    """Refuse options that have no effect on the robot of a scenario."""
    if model is not None:
        raise OptionError(
            "`model` has no effect without `trajectory`: scenarios are those of the Symbitron; "
            "give both",
            "E503",
        )
    for options in others:
        refuse_unused(options, "without `trajectory`; leave it out")


def _require_tracking(options: SimulateOptions) -> None:
    """Refuse options of scenarios that have no effect on a robot that follows a trajectory."""
    used = {"noise_seed", "ideal", "friction"}
    unused = {each.name for each in options_of(SimulateOptions)} - used
    refuse_unused(options, "with `trajectory`; leave it out", unused)


def _scenario_simulator(options: SimulateOptions) -> "Simulator":
    from symbid_ros.simulation.simulator import PayloadFactory, Simulator

    if not options.payload_mass:
        of_payload = "payload_link", "payload_position", "payload_time"
        refuse_unused(options, "without `payload_mass`; give both", of_payload)
    payload = PayloadFactory().payload(
        options.payload_link, options.payload_mass, options.payload_position
    )
    simulator = Simulator(options, payload=payload)
    seconds = simulator.steps * simulator.period_ns * 1e-9
    if options.payload_time >= seconds:
        raise OptionError(
            f"`payload_time` {options.payload_time:g} s is after the end of the motion at "
            f"{seconds:.1f} s; give an earlier one, or more `moves`",
            "E503",
        )
    return simulator


def _tracking_simulator(
    robot: "RobotModel",
    trajectory: Path,
    options: SimulateOptions,
    truth: TruthOptions,
    both: tuple[JointSensorOptions, BaseSensorOptions],
) -> "TrackingSimulator | StandingSimulator":
    from symbid_ros.excitation.rehearsal import draw_truth, standing_simulator
    from symbid_ros.simulation.joint_trajectory import read_trajectory
    from symbid_ros.simulation.tracking import TrackingSimulator, effort_capacity

    seed = None if options.ideal else options.noise_seed
    sensors, base_sensors = both
    if not robot.floating:
        refuse_unused(base_sensors, "on a robot with a fixed base; leave it out")
    if robot.floating:
        return standing_simulator(
            robot,
            trajectory,
            truth=truth,
            has_friction=options.friction,
            sensors=sensors,
            base_sensors=base_sensors,
            seed=seed,
        )
    motion = read_trajectory(trajectory, robot.measured_joint_names)
    return TrackingSimulator(
        draw_truth(
            robot,
            percent=truth.truth_percent,
            seed=truth.truth_seed,
            has_friction=options.friction,
        ),
        robot,
        motion,
        sensors=sensors,
        capacity=effort_capacity(robot),
        seed=seed,
    )


def _is_simulated_bag(folder: Path) -> bool:
    """Return whether a folder holds MCAP files, their metadata and nothing else."""
    suffixes = {file.suffix for file in folder.iterdir()}
    return {".mcap"} <= suffixes <= {".mcap", ".yaml"}


StandingScenario = Literal["smooth", "wide", "squat"]


def udp_client(
    host: Annotated[str, typer.Option(help="Host of the simulator.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="UDP port of the simulator.")] = 5005,
    scenario: Annotated[
        StandingScenario,
        typer.Option(help="Motion of the robot: smooth, wide or squat.", metavar="SCENARIO"),
    ] = "smooth",
    moves: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 20,
    motion_seed: Annotated[int, typer.Option(min=0, help="Random seed of the moves.")] = 0,
    model: Annotated[
        Path | None,
        typer.Option(help="MJCF model of the controller. Default: the package's Symbitron."),
    ] = None,
    model_source: Annotated[
        Path | None,
        typer.Option(
            help="File to which a running identifier writes its estimates (its parameter "
            "live_model). They replace the model's inertias once they are accurate enough; moves "
            "begin small and grow as the standard deviations of mass and centre of mass "
            "decrease."
        ),
    ] = None,
    largest_change: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=1.0,
            help="Largest change of a torque by a new model, as a share of the drive's limit.",
        ),
    ] = 0.25,
    timeout: Annotated[
        float,
        typer.Option(
            min=0.1, metavar="<s>", help="Seconds without a measurement after which it stops."
        ),
    ] = 10.0,
) -> None:
    """Balance a robot over UDP, from its sensor data, until Ctrl-C.

    The simulator is [b]mujoco_bridge[/b] with command_source:=udp, or any program that follows the
    protocol in docs/udp.md. The controller knows only the measurements, its model file, and the
    motion that --scenario, --moves and --motion-seed define.
    """
    stop = stop_on_signals()

    from symbid_ros.simulation.standing_controller import StandingController
    from symbid_ros.simulation.udp_client import UdpClient

    controller = StandingController(
        scenario,
        moves=moves,
        motion_seed=motion_seed,
        model_path=model,
        is_cautious=model_source is not None,
    )
    models = None
    if model_source is not None:
        from symbid_ros.learning.model_file import ModelFile

        models = ModelFile(
            model_source, controller, largest_change, lambda line: typer.echo(line, err=True)
        )
    with UdpClient(host, port, controller, models.update if models else None) as client:
        typer.echo(f"waiting for measurements of a simulator at {host}:{port}", err=True)
        client.run(stop, timeout)
        counts = client.counts
    summary = (
        f"{host}:{port}: answered {counts.answered} measurements, repeated "
        f"{counts.repeated} answers; {counts.ignored} datagrams ignored, "
        f"{counts.unanswered} measurements without torques"
    )
    if models is not None:
        decisions = ", ".join(f"{count} {kind}" for kind, count in models.counts.items())
        summary += f"; models: {decisions}"
    typer.echo(summary)
