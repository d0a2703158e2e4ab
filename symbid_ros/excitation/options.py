"""Options of the design of an excitation trajectory."""

from dataclasses import dataclass
from pathlib import Path

from symbid_ros.model.mounting_options import MountingOptions
from symbid_ros.options import option

LIMITS = "Limits"
STANDING = "Standing robots"
KNOWN = "Prior knowledge"


@dataclass(frozen=True, kw_only=True)
class ExciteOptions(MountingOptions):
    """How to design an excitation trajectory.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    seconds: float = option(
        40.0,
        "Length of the recording, rounded up to whole periods.",
        unit="s",
        minimum=1.0,
        maximum=3600.0,
    )
    period: float = option(
        10.0, "Period of the trajectory, which is repeated.", unit="s", minimum=0.5, maximum=600.0
    )
    harmonics: int = option(
        5, "Number of harmonics of the period in each joint.", minimum=2, maximum=50
    )
    joints: tuple[str, ...] = option(
        (), "Joint to move; all others stay in place.", unset="all joints"
    )
    starts: int = option(3, "Number of random starts of the search.", minimum=1, maximum=100)
    iterations: int = option(
        80, "Iterations of the search from each start.", minimum=1, maximum=10_000
    )
    seed: int = option(0, "Random seed of the starts.", minimum=0)
    prior_percent: float = option(
        25.0,
        "How far the model's mass, first moments and inertia of each link may be wrong, ± percent "
        "(half-width of a uniform prior).",
        unit="%",
        minimum=0.1,
        maximum=1000.0,
        group=KNOWN,
    )
    information: Path | None = option(
        None,
        "Folder of an identification, or its information.npz; the trajectory then improves what "
        "this left uncertain.",
        group=KNOWN,
    )
    joint_terms: tuple[str, ...] = option(
        (),
        "Joint terms that will be identified: none, or a comma-separated list of viscous, coulomb, "
        "armature, offset.",
        unset="viscous,coulomb,armature",
        group=KNOWN,
    )
    limits: Path | None = option(
        None,
        "YAML in the format of MoveIt's joint_limits.yaml; its limits replace those of the model.",
        group=LIMITS,
    )
    position_share: float = option(
        0.95,
        "Share of each joint's range to use.",
        minimum=0.01,
        maximum=1.0,
        group=LIMITS,
    )
    speed_share: float = option(
        0.8,
        "Share of each joint's velocity and acceleration limits to use.",
        minimum=0.01,
        maximum=1.0,
        group=LIMITS,
    )
    effort_share: float = option(
        0.7,
        "Share of each joint's effort limit to use, computed with the model's inertias.",
        minimum=0.01,
        maximum=1.0,
        group=LIMITS,
    )

    clearance: float = option(
        0.03,
        "Smallest distance between links that are not neighbours, and from links to the floor.",
        unit="m",
        minimum=0.0,
        maximum=1.0,
        group=LIMITS,
    )
    floor: float | None = option(
        None,
        "Height of a floor or table above the base's origin; negative below it.",
        unit="m",
        minimum=-100.0,
        maximum=100.0,
        group=LIMITS,
        unset="no floor",
    )
    no_collision: bool = option(
        False, "Ignore collisions of links with each other and the floor.", group=LIMITS
    )
    feet: tuple[str, ...] = option(
        (),
        "Frames on which a robot with a floating base stands, comma-separated. FRAME is a flat "
        "sole. FRAME:point transmits a force alone, at the lowest point of the ball that the model "
        "has around the frame's origin, which rolls, or at the origin if there is none. "
        "FRAME:RADIUS gives the radius of that ball, m; with FRAME:0 the force acts at the origin. "
        "The base moves, and the feet stay in place.",
        unset="the base is fixed",
        group=STANDING,
    )
    contact: tuple[str, ...] = option(
        (),
        "The feet without a wrench sensor, written as in `feet`.",
        unset="all feet have a sensor",
        group=STANDING,
    )
    posture: tuple[str, ...] = option(
        (),
        "Joint positions of the standing robot, as JOINT=VALUE, comma-separated; others are 0.",
        unset="the keyframe standing of an MJCF, or the crouch of a quadruped",
        group=STANDING,
    )
    ground_friction: float = option(
        0.4,
        "Largest ratio of tangential to normal force at the feet.",
        minimum=0.01,
        maximum=2.0,
        group=STANDING,
    )
    sole_margin: float = option(
        0.03,
        "Smallest distance of the centre of pressure from the edges of a sole.",
        unit="m",
        minimum=0.0,
        maximum=0.2,
        group=STANDING,
    )
    base_speed: float = option(
        0.3, "Largest speed of the base.", unit="m/s", minimum=0.001, maximum=10.0, group=STANDING
    )
    turn_speed: float = option(
        1.0,
        "Largest angular velocity of the base.",
        unit="rad/s",
        minimum=0.001,
        maximum=20.0,
        group=STANDING,
    )
