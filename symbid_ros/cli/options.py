"""Options that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

import typer

Base = Literal["auto", "floating", "fixed"]

Model = Annotated[Path, typer.Option(help="Robot model, URDF or MJCF.")]
BaseKind = Annotated[
    Base, typer.Option(help="Whether a URDF's base may move; auto: it floats unless on 'world'.")
]
JointTopic = Annotated[
    list[str] | None,
    typer.Option(
        help="JointState topic, repeatable: joints of all are merged by stamp; default: the one "
        "named joint_states."
    ),
]
ImuTopic = Annotated[
    list[str] | None, typer.Option(help="Imu topic, repeatable; default: all of that type.")
]
WrenchTopic = Annotated[
    list[str] | None,
    typer.Option(help="WrenchStamped topic, repeatable; default: all named wrench."),
]
FramePrefix = Annotated[
    str,
    typer.Option(
        help="What the sensors' frames begin with and the model's do not, such as robot1/.",
        show_default=False,
    ),
]
Start = Annotated[
    float, typer.Option(help="Leave out what comes earlier, s after the first joint state.")
]
Stop = Annotated[
    float, typer.Option(help="Leave out what comes later, likewise.", show_default=False)
]
