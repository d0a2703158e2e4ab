"""Options of the joint sensors of an arm, for commands that start without NumPy."""

from dataclasses import dataclass

from symbid_ros.options import check_values, option

GROUP = "Joint sensors"


@dataclass(frozen=True)
class JointSensorOptions:
    """Joint sensors of an arm, for expected deviations and for simulations.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    rate: float = option(
        250.0,
        "Rate of the joint states; a simulation takes the nearest that divides 1000.",
        unit="Hz",
        minimum=20.0,
        maximum=1000.0,
        group=GROUP,
    )
    effort_noise: float = option(
        0.1,
        "Standard deviation of the noise of efforts, in percent of each joint's largest effort.",
        unit="%",
        minimum=1e-6,
        maximum=100.0,
        group=GROUP,
    )
    position_noise: float = option(
        2e-5,
        "Standard deviation of the noise of positions; a tenth of it in m for slides.",
        unit="rad",
        minimum=0.0,
        maximum=0.1,
        group=GROUP,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
