"""``symbid udp-client``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from symbid_ros.shutdown import stop_on_signals

Scenario = Literal["smooth", "squat"]


def udp_client(
    host: Annotated[str, typer.Option(help="Where the plant listens.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Its UDP port.")] = 5005,
    scenario: Annotated[Scenario, typer.Option(help="What the robot is to do.")] = "smooth",
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
        f"{counts.passed_over} datagrams passed over, {counts.unanswered} left unanswered"
    )
