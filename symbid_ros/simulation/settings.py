"""Sensor noise and joint friction: YAML files of numbers, checked entry by entry."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.user_files import load_yaml


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises
    ------
    SimulationError
        When the file cannot be read or does not contain a mapping.
    """
    try:
        content = load_yaml(path)
    except OSError as error:
        raise SimulationError(
            f"{path}: cannot be read ({error.strerror}); name an existing file", "E603"
        ) from None
    except ValueError as error:
        raise SimulationError(f"{path}: {error}", "E603") from None
    if not isinstance(content, dict):
        raise SimulationError(
            f"{path}: not a mapping; write one line 'name: value' for each entry", "E604"
        )
    return {str(name): value for name, value in content.items()}


def require_numbers(content: object, names: Sequence[str], where: str) -> dict[str, float]:
    """Return the named entries of a mapping and check that each is a finite number, 0 or more.

    Raises
    ------
    SimulationError
        When an entry is missing, unknown or not such a number; the message starts with ``where``.
    """
    if not isinstance(content, dict):
        raise SimulationError(f"{where}: not a mapping; give {', '.join(names)}", "E604")
    missing = [name for name in names if name not in content]
    if missing:
        raise SimulationError(f"{where}: {', '.join(missing)} missing; give 0 for none", "E604")
    unknown = [str(name) for name in content if name not in names]
    if unknown:
        raise SimulationError(f"{where}: unknown entry {', '.join(unknown)}; remove it", "E604")
    return {name: _number(content[name], name, where) for name in names}


def _number(value: object, name: str, where: str) -> float:
    # YAML parses "yes" as a boolean, which Python would accept as the number 1.
    if isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and number >= 0.0:
            return number
    raise SimulationError(f"{where}: {name} is {value!r}; give a finite number, 0 or more", "E604")


@dataclass(frozen=True)
class ChannelValues:
    """A standard deviation of noise, or a quantisation step, for each kind of sensor channel.

    Attributes
    ----------
    joint_position, joint_velocity : float
        rad, rad/s.
    joint_effort : float
        Torque of each driven joint, Nm.
    angular_velocity, linear_acceleration : float
        IMU: rad/s, m/s².
    force, moment : float
        Every wrench sensor: N, Nm.
    """

    joint_position: float
    joint_velocity: float
    joint_effort: float
    angular_velocity: float
    linear_acceleration: float
    force: float
    moment: float

    def by_channel(self, joints: int, wrenches: int) -> FloatArray:
        """Return the value of each channel, in the order of the fields.

        The channels are those of J joints, one IMU and F wrench sensors, (3 J + 6 + 6 F,).
        """
        wrench = np.repeat([self.force, self.moment], 3)
        joint = np.repeat([self.joint_position, self.joint_velocity, self.joint_effort], joints)
        imu = np.repeat([self.angular_velocity, self.linear_acceleration], 3)
        return np.concatenate([joint, imu, np.tile(wrench, wrenches)])

    def scaled(self, factor: float) -> "ChannelValues":
        """Return every value multiplied by ``factor``.

        Raises
        ------
        SimulationError
            When the factor is negative or not finite.
        """
        if not (math.isfinite(factor) and factor >= 0.0):
            raise SimulationError(
                f"noise factor {factor:g}; give a finite number, 0 or more", "E605"
            )
        return ChannelValues(**{name: factor * value for name, value in asdict(self).items()})


def load_noise(path: Path) -> ChannelValues:
    """Read the standard deviations in a noise file.

    Parameters
    ----------
    path : Path
        YAML mapping of every field of `ChannelValues` to a number, and nothing else.

    Raises
    ------
    SimulationError
        When the file cannot be read or is not such a mapping, or when a value is negative or not
        finite.
    """
    names = [field.name for field in fields(ChannelValues)]
    return ChannelValues(**require_numbers(read_mapping(path), names, str(path)))


@dataclass(frozen=True)
class JointFriction:
    """Friction and reflected inertia of one joint, named as MJCF names them.

    Attributes
    ----------
    damping : float
        Viscous friction, Nm s/rad or N s/m.
    frictionloss : float
        Coulomb friction, Nm or N.
    armature : float
        Rotor inertia reflected to the joint, kg m² or kg.
    """

    damping: float
    frictionloss: float
    armature: float


def load_friction(path: Path) -> dict[str, JointFriction]:
    """Read and check a friction file.

    Parameters
    ----------
    path : Path
        YAML mapping of joint names to mappings of every field of `JointFriction` to a number.
        Joints that it does not name keep the friction in the robot's model file.

    Raises
    ------
    SimulationError
        When the file cannot be read or does not have that form.
    """
    names = [field.name for field in fields(JointFriction)]
    return {
        joint: JointFriction(**require_numbers(content, names, f"{path}, joint {joint}"))
        for joint, content in read_mapping(path).items()
    }
