"""The commands ``simulate`` and ``udp-client``."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import Progress

from symbid_ros.cli.flags import with_flags
from symbid_ros.shutdown import stop_on_signals
from symbid_ros.simulation.options import SimulateOptions


@with_flags
def simulate(
    out: Annotated[Path, typer.Option(help="Folder of the new bag.")],
    options: SimulateOptions,
    true_model: Annotated[
        Path | None,
        typer.Option(
            help="MJCF file to write: the simulated robot without payload, for `symbid evaluate`."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the bag of an earlier run.")
    ] = False,
) -> None:
    """Simulate the Symbitron in MuJoCo and record sensor data and ground truth to a bag.

    Scenarios: in [b]smooth[/b] and [b]vibrating[/b] the robot stands and moves its centre of mass,
    in [b]squat[/b] mostly vertically. In [b]suspended[/b] it hangs from a hoist that moves. In
    [b]tare[/b] it hangs still for 5 s without touching the force plates; --moves and --motion-seed
    have no effect.

    [b]Systematic errors[/b] (--errors), each drawn from --error-seed and its own name:
    [b]plate_gain[/b] .25-.75 % of each channel, [b]plate_offset[/b] 1-2 N and .1-.2 Nm of each
    channel, [b]plate_pose[/b] 1-3 mm, [b]torque_gain[/b] 1-2 % of each drive, [b]imu_mounting[/b]
    .1-.3 degrees, [b]encoder_offset[/b] .05-.15 degrees of each joint ([b]typical[/b] means these
    six), [b]link_length[/b] 1-2 mm between joints, [b]sample_rates[/b] joints 1000 Hz, IMU 500 Hz,
    plates 333 Hz, [b]delays[/b] 1-5 ms, different for each sensor, [b]quantisation[/b] 16 to 18
    bits.
    """
    from symbid_ros.atomic_write import clear_folder, write_text
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import PayloadFactory, simulator_of

    payload = PayloadFactory().payload(
        options.payload_link, options.payload_mass, options.payload_position
    )
    simulator = simulator_of(options, payload=payload)
    clear_folder(out, _is_simulated_bag, "a bag", overwrite=overwrite)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"simulating {options.scenario}", total=simulator.steps)
        counts = record(
            simulator, out, progress=lambda done, _: progress.update(task, completed=done)
        )
    if true_model is not None:
        write_text(true_model, simulator.robot)
    seconds = simulator.steps * simulator.period_ns * 1e-9
    typer.echo(f"{out}: {seconds:.1f} s, {sum(counts.values())} messages on {len(counts)} topics")


def _is_simulated_bag(folder: Path) -> bool:
    """Return whether a folder holds MCAP files, their metadata and nothing else."""
    suffixes = {file.suffix for file in folder.iterdir()}
    return {".mcap"} <= suffixes <= {".mcap", ".yaml"}


StandingScenario = Literal["smooth", "squat"]


def udp_client(
    host: Annotated[str, typer.Option(help="Host of the simulator.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="UDP port of the simulator.")] = 5005,
    scenario: Annotated[StandingScenario, typer.Option(help="Motion of the robot.")] = "smooth",
    moves: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 20,
    motion_seed: Annotated[int, typer.Option(min=0, help="Random seed of the moves.")] = 0,
    model: Annotated[
        Path | None,
        typer.Option(help="MJCF model of the controller. Default: the package's Symbitron."),
    ] = None,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds without a measurement after which it stops.")
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
        scenario, moves=moves, motion_seed=motion_seed, model_path=model
    )
    with UdpClient(host, port, controller) as client:
        client.run(stop, timeout)
        counts = client.counts
    typer.echo(
        f"{host}:{port}: answered {counts.answered} measurements, {counts.repeated} of them again; "
        f"{counts.ignored} datagrams ignored, {counts.unanswered} left unanswered"
    )
