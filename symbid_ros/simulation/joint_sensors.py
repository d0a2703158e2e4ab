"""Options of the sensors of a robot, for commands that start without NumPy."""

from dataclasses import dataclass

from symbid_ros.options import check_values, option

GROUP = "Joint sensors"
BASE = "IMU and wrench sensors of a standing robot"
MOMENT_ARM = 0.1  # m, of the noise of moments


@dataclass(frozen=True)
class JointSensorOptions:
    """Joint sensors of a robot, for expected deviations and for simulations.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    rate: float = option(
        250.0,
        "Rate of the joint states; a simulation uses the nearest divisor of 1000.",
        unit="Hz",
        minimum=20.0,
        maximum=1000.0,
        group=GROUP,
    )
    effort_noise: float = option(
        0.1,
        "Standard deviation of the noise of efforts, in percent of each joint's effort limit, or "
        "of twice the largest gravity torque if the model has no limit.",
        unit="%",
        minimum=1e-6,
        maximum=100.0,
        group=GROUP,
    )
    position_noise: float = option(
        2e-5,
        "Standard deviation of the noise of positions; prismatic joints: a tenth of it, in m.",
        unit="rad",
        minimum=0.0,
        maximum=0.1,
        group=GROUP,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)


@dataclass(frozen=True)
class BaseSensorOptions:
    """IMU and wrench sensors of a standing robot, for expected deviations and for simulations.

    Raises
    ------
    OptionError
        When a value is invalid.
    """

    gyro_noise: float = option(
        2e-3,
        "Standard deviation of the noise of angular velocities, at the rate of the joint states.",
        unit="rad/s",
        minimum=0.0,
        maximum=1.0,
        group=BASE,
    )
    accelerometer_noise: float = option(
        2e-2,
        "Standard deviation of the noise of accelerations.",
        unit="m/s²",
        minimum=0.0,
        maximum=10.0,
        group=BASE,
    )
    wrench_noise: float = option(
        0.1,
        "Standard deviation of the noise of the feet's forces, in percent of the weight; that of "
        "moments is this force times 0.1 m.",
        unit="%",
        minimum=1e-6,
        maximum=100.0,
        group=BASE,
    )

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        check_values(self)

    def wrench_std(self, weight: float) -> tuple[float, ...]:
        """Return the deviations of (moment; force) for a robot of a weight in N."""
        force = self.wrench_noise / 100 * weight
        return (*3 * (MOMENT_ARM * force,), *3 * (force,))
