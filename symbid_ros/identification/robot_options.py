"""Options that say how the robot is mounted, what touches it, and which sensors feel that."""

from dataclasses import dataclass
from functools import cached_property

from symbid_ros.errors import OptionError
from symbid_ros.model.mounting_options import MountingOptions
from symbid_ros.options import option

GROUP = "Contacts and wrench sensors"
LARGEST_RADIUS = 1.0  # m, of a ball that is a foot


@dataclass(frozen=True, kw_only=True)
class RobotOptions(MountingOptions):
    """Mounting of a fixed base, wrist sensors, and contacts without a sensor.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    wrist_sensor: tuple[str, ...] = option(
        (),
        "Frames of the wrist force/torque sensors, comma-separated. Everything beyond a sensor is "
        "identified as a separate link, together with the sensor's offset. Write FRAME:LINK if "
        "the first link beyond the sensor is not FRAME, and -FRAME if the sensor reads the "
        "wrench of the robot on the payload.",
        group=GROUP,
    )
    contact: tuple[str, ...] = option(
        (),
        "Frames at which something touches the robot without a wrench sensor, comma-separated. "
        "FRAME transmits force and moment, as a flat foot does. FRAME:point transmits a force "
        "alone, as the feet of most quadrupeds do. It acts at the lowest point of the ball that "
        "the model has around the frame's origin, or at the origin if there is none. FRAME:RADIUS "
        "gives the radius of that ball, m; with FRAME:0 the force acts at the origin. The unknown "
        "wrenches are eliminated from the equations.",
        group=GROUP,
    )

    force_only: tuple[str, ...] = option(
        (),
        "Frames of foot sensors that measure forces alone, comma-separated. The force is assumed "
        "to act at the lowest point of the model's ball about the frame. FRAME:RADIUS gives the "
        "ball's radius, m. none: use moments of zero as measured.",
        group=GROUP,
        unset="sensors of ball feet with moments of zero in the log, if the log shows the radius",
    )

    end_stops: tuple[str, ...] = option(
        (),
        "Joints that rest against the ends of their ranges in the model, comma-separated. Rows in "
        "which they do so are left out, because no sensor measures the force of an end stop. "
        "none: no joint.",
        group=GROUP,
        unset="joints for which the log shows such a force",
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        super().__post_init__()
        for name in self.force_only_sensors:
            if ":" in name and not is_radius(name.partition(":")[2]):
                raise OptionError(
                    f"`force_only`: {name!r} is not a sensor; give FRAME or FRAME:RADIUS", "E501"
                )
        for name in self.contacts:
            if not is_contact_kind(name.partition(":")[2]):
                raise OptionError(
                    f"`contact`: {name!r} is not a contact; give FRAME, FRAME:point or "
                    "FRAME:RADIUS",
                    "E501",
                )

    @cached_property
    def wrist_sensors(self) -> tuple[str, ...]:
        """The wrist sensors, as FRAME or FRAME:LINK."""
        return tuple(names(self.wrist_sensor))

    @cached_property
    def contacts(self) -> tuple[str, ...]:
        """The contacts without a sensor, as FRAME, FRAME:point or FRAME:RADIUS."""
        return tuple(names(self.contact))

    @cached_property
    def force_only_sensors(self) -> tuple[str, ...]:
        """The sensors that measure forces alone, as FRAME or FRAME:RADIUS."""
        found = tuple(names(self.force_only))
        return () if found == ("none",) else found

    @cached_property
    def end_stop_joints(self) -> tuple[str, ...]:
        """The joints that lean on the ends of their ranges."""
        found = tuple(names(self.end_stops))
        return () if found == ("none",) else found


def is_contact_kind(text: str) -> bool:
    """Return whether a text is ``point``, ``surface``, a radius in m or empty."""
    return text in ("", "point", "surface") or is_radius(text)


def is_radius(text: str) -> bool:
    """Return whether a text is a radius in m."""
    try:
        return 0.0 <= float(text) < LARGEST_RADIUS
    except ValueError:
        return False


def names(values: tuple[str, ...]) -> list[str]:
    """Return the names in comma-separated lists."""
    return [name for part in ",".join(values).split(",") if (name := part.strip())]
