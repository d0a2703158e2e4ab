"""Limits of joints for a trajectory: from the model file, a limits file, and stated defaults."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import OptionError
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.user_files import load_yaml

# What applies where neither the model nor a limits file states a limit: revolute joints in rad, and
# prismatic ones in m.
RANGE = np.pi / 2, 0.1  # to both sides of the posture
SPEED = 1.0, 0.1
SECONDS_TO_SPEED = 0.5  # in which a joint may reach its largest speed, which limits acceleration
ROOT = "joint_limits"
KEYS = {
    "min_position": "lower",
    "max_position": "upper",
    "max_velocity": "speed",
    "max_acceleration": "acceleration",
    "max_effort": "effort",
}
SWITCHES = {f"has_{kind}_limits" for kind in ("position", "velocity", "acceleration", "effort")}
# MoveIt's files contain these as well; they limit no trajectory of this package.
IGNORED = {"has_jerk_limits", "max_jerk", "min_velocity", "min_acceleration", "min_effort"}


@dataclass(frozen=True)
class JointLimits:
    """Limits of D joints that a trajectory keeps.

    Attributes
    ----------
    names : tuple of str
    lower, upper : (D,) float64
        Positions, rad or m.
    speed, acceleration : (D,) float64
        Magnitudes, per second and per second squared.
    effort : (D,) float64
        Magnitude, Nm or N; infinite where unknown.
    assumed : tuple of str
        Limits that neither model nor limits file states, as ``joint: kind`` with the default.
    """

    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    assumed: tuple[str, ...] = ()

    @property
    def centre(self) -> FloatArray:
        """(D,) middles of the ranges, rad or m."""
        return np.asarray((self.lower + self.upper) / 2)

    @property
    def half_width(self) -> FloatArray:
        """(D,) half widths of the ranges, rad or m."""
        return np.asarray((self.upper - self.lower) / 2)

    def scaled(self, position: float, speed: float, effort: float) -> "JointLimits":
        """Return shares of the limits; those of speed hold for acceleration as well."""
        half = position * self.half_width
        return replace(
            self,
            lower=self.centre - half,
            upper=self.centre + half,
            speed=speed * self.speed,
            acceleration=speed * self.acceleration,
            effort=effort * self.effort,
        )

    def usage(self, motion: FloatArray, torque: FloatArray | None = None) -> dict[str, FloatArray]:
        """Return the largest share (D,) of each limit that a motion and its torques use.

        Parameters
        ----------
        motion : (3, N, D) float64
            Position, velocity and acceleration.
        torque : (N, D) float64, optional
        """
        shares = {
            "position": np.abs((motion[0] - self.centre) / self.half_width).max(axis=0),
            "velocity": (np.abs(motion[1]) / self.speed).max(axis=0),
            "acceleration": (np.abs(motion[2]) / self.acceleration).max(axis=0),
        }
        if torque is not None:
            shares["effort"] = (np.abs(torque) / self.effort).max(axis=0)
        return shares


def joint_limits(
    joints: Mapping[str, Joint], posture: Mapping[str, float], file: Path | None = None
) -> JointLimits:
    """Return the limits of some joints.

    Parameters
    ----------
    joints : mapping of str to Joint
        The joints that move, by name.
    posture : mapping of str to float
        Position about which a joint without position limits moves.
    file : Path, optional
        YAML in the format of MoveIt's ``joint_limits.yaml``. Its limits replace those of the
        model, except that a position stays within the model's range, if that has a width.

    Raises
    ------
    OptionError
        When the file is invalid.
    """
    stated = {} if file is None else read_limits(file, joints)
    rows: list[list[float]] = []
    assumed: list[str] = []
    for name, joint in joints.items():
        given, slides = stated.get(name, {}), joint.kind == "prismatic"
        unit = "m" if slides else "rad"
        low = max(given.get("lower", -np.inf), joint.lower)
        high = min(given.get("upper", np.inf), joint.upper)
        if not np.isfinite([low, high]).all():
            middle = posture.get(name, 0.0)
            low, high = max(low, middle - RANGE[slides]), min(high, middle + RANGE[slides])
            assumed.append(f"{name}: position from {low:.3g} to {high:.3g} {unit}")
        fastest = given.get("speed", joint.speed)
        if not 0 < fastest < np.inf:
            fastest = SPEED[slides]
            assumed.append(f"{name}: velocity {fastest:g} {unit}/s")
        quickest = given.get("acceleration", np.inf)
        if not 0 < quickest < np.inf:
            quickest = fastest / SECONDS_TO_SPEED
            assumed.append(f"{name}: acceleration {quickest:.3g} {unit}/s²")
        strongest = given.get("effort", joint.effort)
        if not np.isfinite(strongest):
            assumed.append(f"{name}: effort unlimited")
        rows.append([low, high, fastest, quickest, strongest])
    columns = np.array(rows).reshape(len(rows), 5).T
    lower, upper, speed, acceleration, effort = columns
    return JointLimits(tuple(joints), lower, upper, speed, acceleration, effort, tuple(assumed))


def with_stated_limits(robot: RobotModel, file: Path) -> RobotModel:
    """Return a robot with a file's ranges and efforts for joints to which its model gives none.

    Raises
    ------
    OptionError
        When the file is invalid.
    """
    moving = {
        name: robot.joints[robot.joint_names.index(name)] for name in robot.measured_joint_names
    }
    stated = read_limits(file, moving)

    def completed(joint: Joint) -> Joint:
        given = stated.get(joint.name, {})
        if joint.effort == 0:
            joint = replace(joint, effort=given.get("effort", 0.0))
        if joint.lower >= joint.upper and {"lower", "upper"} <= given.keys():
            joint = replace(joint, lower=given["lower"], upper=given["upper"])
        return joint

    return replace(robot, joints=tuple(map(completed, robot.joints)))


def read_limits(file: Path, joints: Mapping[str, Joint]) -> dict[str, dict[str, float]]:
    """Return the limits in a file by joint and field of :class:`JointLimits`.

    Raises
    ------
    OptionError
        When the file cannot be read, names an unknown joint or limit, or has a range without width.
    """
    try:
        content = load_yaml(file)
    except OSError as error:
        raise OptionError(
            f"{file}: {error.strerror}; give an existing `limits` file", "E580"
        ) from (None)
    except ValueError as error:
        raise OptionError(f"{file}: {error}", "E580") from None
    entries = content.get(ROOT) if isinstance(content, dict) else None
    if not isinstance(entries, dict):
        raise OptionError(
            f"{file}: has no mapping '{ROOT}'; write it as MoveIt's joint_limits.yaml", "E580"
        )
    return {
        str(name): _stated(file, str(name), entry)
        for name, entry in entries.items()
        if _is_known(file, str(name), joints)
    }


def _is_known(file: Path, name: str, joints: Mapping[str, Joint]) -> bool:
    if name in joints:
        return True
    raise OptionError(
        f"{file}: {name!r} is not a joint that moves; name one of {', '.join(joints)}", "E580"
    )


def _stated(file: Path, joint: str, entry: Any) -> dict[str, float]:
    if not isinstance(entry, dict):
        raise OptionError(f"{file}: joint {joint} is not a mapping of limits", "E580")
    found = {}
    for key, value in entry.items():
        if key in SWITCHES | IGNORED:
            continue
        switch = f"has_{str(key).partition('_')[2]}_limits"
        if key not in KEYS:
            raise OptionError(
                f"{file}: joint {joint} has an unknown limit {key!r}; use {', '.join(KEYS)}", "E580"
            )
        if not isinstance(value, int | float) or isinstance(value, bool) or not np.isfinite(value):
            raise OptionError(
                f"{file}: {key} of joint {joint} is {value!r}; give a finite number", "E580"
            )
        if not entry.get(switch, True):
            continue
        if "position" not in key and value <= 0:
            raise OptionError(
                f"{file}: {key} of joint {joint} is {value!r}; give a number above 0", "E580"
            )
        found[KEYS[key]] = float(value)
    if found.get("lower", -np.inf) >= found.get("upper", np.inf):
        raise OptionError(
            f"{file}: min_position of joint {joint} is not below max_position; correct them", "E580"
        )
    return found
