"""Options of a simulation, the same for the command and the bridge node."""

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from symbid_ros.choices import Scenario
from symbid_ros.options import check_values, option

PAYLOAD = "Payload"


@dataclass(frozen=True)
class SimulateOptions:
    """What to simulate.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    scenario: Scenario = option(
        "smooth",
        f"Motion of the robot, one of {', '.join(get_args(Scenario))}; with an external "
        "controller, its initial posture.",
        metavar="SCENARIO",
    )
    moves: int = option(
        20,
        "Number of moves (of the centre of mass, the hook or each lifted foot) or steps; no "
        "effect in tare.",
        minimum=1,
        maximum=100_000,
    )
    motion_seed: int = option(0, "Random seed of the moves.", minimum=0)
    noise_seed: int = option(0, "Random seed of the sensor noise.", minimum=0)
    ideal: bool = option(False, "Noise-free sensor data of the same motion.")
    friction: bool = option(False, "Add the friction and armature of friction.yaml to the joints.")
    friction_file: Path | None = option(
        None, "YAML file to use instead of friction.yaml; implies `friction`."
    )
    errors: str = option("", "Systematic errors: typical, or a comma-separated list; empty: none.")
    error_seed: int = option(
        0, "Random seed of the systematic errors; equal seeds give the same robot.", minimum=0
    )
    noise: Path | None = option(
        None, "YAML file of sensor noise.", unset="the package's noise.yaml"
    )
    payload_link: str = option(
        "", "Link that carries the payload; empty: the base.", group=PAYLOAD, live=True
    )
    payload_mass: float = option(
        0.0,
        "Mass of the payload; 0: none.",
        unit="kg",
        minimum=0.0,
        maximum=100.0,
        group=PAYLOAD,
        live=True,
    )
    payload_position: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "Centre of the payload in the link's frame.",
        unit="m",
        minimum=-2.0,
        maximum=2.0,
        group=PAYLOAD,
        live=True,
    )
    payload_time: float = option(
        0.0,
        "Time in the motion at which a payload given at the start is attached.",
        unit="s",
        minimum=0.0,
        group=PAYLOAD,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)


TRUTH = "True robot, with --trajectory"


@dataclass(frozen=True)
class TruthOptions:
    """How the true robot of a rehearsal differs from its model file.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    truth_percent: float = option(
        25.0,
        "How far mass, first moments and inertia of each true link may differ from the model's, ± "
        "percent (uniform); 0: not at all.",
        unit="%",
        minimum=0.0,
        maximum=95.0,
        group=TRUTH,
    )
    truth_seed: int = option(
        0, "Random seed of the true links, friction and armature.", minimum=0, group=TRUTH
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
