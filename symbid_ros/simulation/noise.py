"""How noisy the simulated sensors are: the contents of config/noise.yaml."""

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.settings import numbers, read_mapping


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

    def scaled(self, factor: float) -> "SensorNoise":
        """Return the noise with every deviation times ``factor``.

        Raises
        ------
        SimulationError
            When the factor is negative or not finite.
        """
        if not (math.isfinite(factor) and factor >= 0.0):
            raise SimulationError(f"noise factor {factor:g}; give a finite number, 0 or more")
        return SensorNoise(**{name: factor * value for name, value in asdict(self).items()})


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
    names = [field.name for field in fields(SensorNoise)]
    return SensorNoise(**numbers(read_mapping(path), names, str(path)))
