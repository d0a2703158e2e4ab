"""How a fixed base is mounted, which its model file may not say."""

from dataclasses import dataclass

from symbid_ros.errors import OptionError
from symbid_ros.options import check_values, option


@dataclass(frozen=True, kw_only=True)
class MountingOptions:
    """Direction of gravity on a fixed base.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    gravity: tuple[float, float, float] | None = option(
        None,
        "Direction of gravity in the axes of a fixed base, a vector of any length, such as 1 0 0 "
        "for an arm on a wall.",
        group="Mounting of the robot",
        metavar="X Y Z",
        unset="that of the model file; identifications estimate it from the log if the "
        "efforts clearly contradict the file",
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)
        if self.gravity is not None and not any(self.gravity):
            raise OptionError("`gravity` has no direction; give a vector such as 0 0 -1", "E501")
