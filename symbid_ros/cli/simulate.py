"""``symbid simulate``."""

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
    out: Annotated[Path, typer.Option(help="Bag folder to write.")],
    options: SimulateOptions,
    true_model: Annotated[
        Path | None,
        typer.Option(
            help="MJCF to write of the robot as simulated, without payload, for symbid evaluate."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the bag of an earlier run.")
    ] = False,
) -> None:
    """Simulate the Symbitron in MuJoCo and record its sensors and the truth to a bag.

    In [b]smooth[/b] and [b]vibrating[/b] it stands and moves its centre of mass, in
    [b]squat[/b] mostly up and down, in [b]suspended[/b] it is rocked in a hoist, in [b]tare[/b]
    it hangs still for 5 s with nothing touching the force plates, whatever --moves and
    --motion-seed say.

    [b]Systematic errors[/b], each drawn from --error-seed and its own name alone:
    [b]plate_gain[/b] .25-.75 % a channel, [b]plate_offset[/b] 1-2 N and .1-.2 Nm a channel,
    [b]plate_pose[/b] 1-3 mm, [b]torque_gain[/b] 1-2 % a drive, [b]imu_mounting[/b] .1-.3
    degrees, [b]encoder_offset[/b] .05-.15 degrees a joint ([b]typical[/b] is these six);
    [b]link_length[/b] 1-2 mm between joints, [b]sample_rates[/b] joints 1000, IMU 500, plates
    333 Hz, [b]delays[/b] 1-5 ms, each sensor its own, [b]quantisation[/b] 16 to 18 bits.
    """
    from symbid_ros.atomic_write import write_text
    from symbid_ros.cli.overwriting import clear_folder, is_simulated_bag
    from symbid_ros.simulation.recording import record
    from symbid_ros.simulation.simulator import PayloadFactory, simulator_of

    payload = PayloadFactory().payload(
        options.payload_link, options.payload_mass, options.payload_position
    )
    simulator = simulator_of(options, payload=payload)
    clear_folder(out, is_simulated_bag, "a bag", overwrite=overwrite)
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


StandingScenario = Literal["smooth", "squat"]


def udp_client(
    host: Annotated[str, typer.Option(help="Where the plant listens.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Its UDP port.")] = 5005,
    scenario: Annotated[StandingScenario, typer.Option(help="What the robot is to do.")] = "smooth",
    moves: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 20,
    motion_seed: Annotated[int, typer.Option(min=0, help="Seed of the motion.")] = 0,
    model: Annotated[
        Path | None,
        typer.Option(help="MJCF it believes the robot to be; default: the package's Symbitron."),
    ] = None,
    timeout: Annotated[
        float, typer.Option(min=0.1, help="Seconds of silence after which it gives up.")
    ] = 10.0,
) -> None:
    """Balance a robot over UDP, by its sensors alone, until Ctrl-C.

    The plant is [b]mujoco_bridge[/b] with command_source:=udp, or whatever speaks the packets of
    docs/udp.md. Nothing is shared with it but the model file and what --scenario, --moves and
    --motion-seed draw.
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
