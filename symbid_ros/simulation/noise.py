"""How noisy the simulated sensors are: the contents of config/noise.yaml."""

import math
from dataclasses import dataclass, fields
from pathlib import Path

import yaml

from symbid_ros.errors import SimulationError


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of white Gaussian noise, per channel and period.

    Attributes
    ----------
    joint_position, joint_velocity : float
        rad, rad/s.
    joint_effort : float
        Nm, of joints with a drive.
    angular_velocity, linear_acceleration : float
        Of the IMU: rad/s, m/s².
    force, moment : float
        Of every wrench sensor: N, Nm.
    """

    joint_position: float
    joint_velocity: float
    joint_effort: float
    angular_velocity: float
    linear_acceleration: float
    force: float
    moment: float


def load_noise(path: Path) -> SensorNoise:
    """Read and check a noise file.

    Parameters
    ----------
    path : Path
        YAML mapping of every field of `SensorNoise` to a number, and nothing else.

    Raises
    ------
    SimulationError
        When the file is missing, is not such a mapping, or a value is no standard deviation.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SimulationError(f"{path}: cannot be read ({error}); name an existing file") from error
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise SimulationError(f"{path}: not valid YAML ({reason}); mend that line") from error
    names = [field.name for field in fields(SensorNoise)]
    if not isinstance(content, dict):
        raise SimulationError(
            f"{path}: not a mapping; give one line for each of {', '.join(names)}"
        )
    missing = [name for name in names if name not in content]
    if missing:
        raise SimulationError(f"{path}: {', '.join(missing)} missing; 0 stands for an ideal sensor")
    unknown = [str(name) for name in content if name not in names]
    if unknown:
        raise SimulationError(f"{path}: unknown entry {', '.join(unknown)}; remove it")
    return SensorNoise(**{name: _standard_deviation(path, name, content[name]) for name in names})


def _standard_deviation(path: Path, name: str, value: object) -> float:
    # YAML reads "yes" as a boolean, which Python would take for the number 1.
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < 0:  # type: ignore[arg-type,operator]
        raise SimulationError(
            f"{path}: {name} is {value!r}; a standard deviation is a finite number, 0 or more"
        )
    return float(value)  # type: ignore[arg-type]
