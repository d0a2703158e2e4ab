"""Systematic errors of the simulated robot, of the size that remains after calibration."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.settings import ChannelValues

# Minimum and maximum of uniformly distributed magnitudes; signs and directions are random. The
# minimum keeps every drawn error significant.
PLATE_GAIN = 0.0025, 0.0075  # per channel
PLATE_FORCE_OFFSET = 1.0, 2.0  # N, per axis
PLATE_MOMENT_OFFSET = 0.1, 0.2  # Nm, per axis
PLATE_DISPLACEMENT = 1e-3, 3e-3  # m
TORQUE_GAIN = 0.01, 0.02
IMU_MOUNTING = np.radians(0.1), np.radians(0.3)
ENCODER_OFFSET = np.radians(0.05), np.radians(0.15)
LINK_LENGTH = 1e-3, 2e-3  # m
DELAY = 1.0, 5.0  # periods
# Standard deviations of the change in a minute, of random walks from minute to minute. Sensors do
# not drift after the last one.
PLATE_DRIFT = (0.5,) * 3 + (0.05,) * 3  # N, Nm
IMU_DRIFT = (2e-4,) * 3 + (2e-3,) * 3  # rad/s, m/s²
DRIFT_MINUTES = 120

# Quantisation steps: 18 bits per turn of an encoder; 16 bits for ±100 Nm, ±250 degrees per second,
# ±4 g, ±2 kN and ±400 Nm.
RESOLUTION = ChannelValues(
    joint_position=2.0 * np.pi / 2**18,
    joint_velocity=1e-3,  # resolution of the drives' messages
    joint_effort=200.0 / 2**16,
    angular_velocity=np.radians(500.0) / 2**16,
    linear_acceleration=8.0 * 9.81 / 2**16,
    force=4e3 / 2**16,
    moment=800.0 / 2**16,
)


@dataclass(frozen=True)
class SampleRates:
    """Sample intervals of the sensors, each starting at the first instant.

    Attributes
    ----------
    joints, imu, plates : int
        Periods from one sample to the next.
    """

    joints: int = 1
    imu: int = 1
    plates: int = 1


# An IMU at half the rate of the joints, and plates at a third.
SAMPLE_RATES = SampleRates(joints=1, imu=2, plates=3)


@dataclass(frozen=True)
class SystematicErrors:
    """Systematic errors of J joints, their sensors, the IMU and F force plates.

    Attributes
    ----------
    wrench_gain : (F, 6) float64
        Relative error of each channel of each plate, (force; moment).
    wrench_offset : (F, 6) float64
        Reading of an unloaded plate, N and Nm.
    wrench_position : (F, 3) float64
        Vector from the frame's origin to the point about which the plate reports its moment,
        in the frame's axes, m.
    torque_gain : (J,) float64
        Relative error of the torque sensors.
    imu_mounting : (3,) float64
        Rotation vector from the frame's axes to the axes in which the IMU reports, rad.
    encoder_offset : (J,) float64
        Encoder readings at true zero, rad (m for a slide).
    link_length : (J,) float64
        Additional distance of a joint's body from its parent compared with the model file, m.
        This is an error of the robot, not of its sensors.
    sample_rates : SampleRates
        Sample interval of each kind of sensor.
    delays : (2 + F,) float64
        Delays of joint states, IMU and plates in periods: a message stamped t contains the
        readings of that many periods earlier, interpolated between two instants.
    quantisation : ChannelValues or None
        Quantisation steps of the readings.
    drift : (K, 6 F + 6) float64
        Change of the plates' offsets (force; moment) and of the IMU's biases (gyroscope;
        accelerometer) since the start of the motion, once a second, N, Nm, rad/s and m/s².
    """

    wrench_gain: FloatArray
    wrench_offset: FloatArray
    wrench_position: FloatArray
    torque_gain: FloatArray
    imu_mounting: FloatArray
    encoder_offset: FloatArray
    link_length: FloatArray
    sample_rates: SampleRates
    delays: FloatArray
    quantisation: ChannelValues | None
    drift: FloatArray

    @classmethod
    def none(cls, joints: int, plates: int) -> "SystematicErrors":
        """Return zero errors."""
        return cls(
            wrench_gain=np.zeros((plates, 6)),
            wrench_offset=np.zeros((plates, 6)),
            wrench_position=np.zeros((plates, 3)),
            torque_gain=np.zeros(joints),
            imu_mounting=np.zeros(3),
            encoder_offset=np.zeros(joints),
            link_length=np.zeros(joints),
            sample_rates=SampleRates(),
            delays=np.zeros(2 + plates),
            quantisation=None,
            drift=np.zeros((1, 6 * plates + 6)),
        )


def draw_errors(names: tuple[str, ...], seed: int, *, joints: int, plates: int) -> SystematicErrors:
    """Draw the named errors at random; all others are zero.

    Each error depends only on the seed and its name: plate offsets, for example, do not change
    with the other errors or with the motion.

    Parameters
    ----------
    names : tuple of str
        Keys of `ERRORS`.
    seed : int
        Seed of all errors.
    joints, plates : int
        Numbers of joints and plates.
    """
    drawn = {
        name: ERRORS[name](
            np.random.default_rng([seed, *STREAMS.get(name, name).encode()]), joints, plates
        )
        for name in names
    }
    return replace(SystematicErrors.none(joints, plates), **drawn)


def parse_errors(text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated list; ``typical`` stands for `TYPICAL`.

    Raises
    ------
    SimulationError
        When a name is unknown.
    """
    names = {name for part in text.split(",") if (name := part.strip())}
    unknown = sorted(names - {"typical", *ERRORS})
    if unknown:
        raise SimulationError(
            f"no systematic error {unknown[0]!r}; give typical or any of {', '.join(ERRORS)}",
            "E607",
        )
    if "typical" in names:
        names |= set(TYPICAL)
    return tuple(name for name in ERRORS if name in names)


def _draw_scalars(
    random: np.random.Generator, size: tuple[float, float], shape: tuple[int, ...]
) -> FloatArray:
    return np.asarray(random.uniform(*size, shape) * random.choice([-1.0, 1.0], shape))


def _draw_vectors(random: np.random.Generator, size: tuple[float, float], count: int) -> FloatArray:
    direction = random.standard_normal((count, 3))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(random.uniform(*size, (count, 1)) * direction / length)


def _draw_walks(random: np.random.Generator, plates: int) -> FloatArray:
    in_a_minute = np.array(plates * PLATE_DRIFT + IMU_DRIFT)
    walks = np.zeros((DRIFT_MINUTES + 1, len(in_a_minute)))
    walks[1:] = np.cumsum(random.standard_normal(walks[1:].shape) * in_a_minute, axis=0)
    second = np.arange(60 * DRIFT_MINUTES + 1)
    smooth: FloatArray = PchipInterpolator(60 * np.arange(DRIFT_MINUTES + 1), walks)(second)
    return smooth


# Names of the random streams, where they differ from those of the errors: the numbers in published
# tables come from these.
STREAMS = {
    "wrench_gain": "plate_gain",
    "wrench_offset": "plate_offset",
    "wrench_position": "plate_pose",
}

Draw = Callable[[np.random.Generator, int, int], Any]

ERRORS: dict[str, Draw] = {
    "wrench_gain": lambda random, _, plates: _draw_scalars(random, PLATE_GAIN, (plates, 6)),
    "wrench_offset": lambda random, _, plates: np.hstack(
        [
            _draw_scalars(random, PLATE_FORCE_OFFSET, (plates, 3)),
            _draw_scalars(random, PLATE_MOMENT_OFFSET, (plates, 3)),
        ]
    ),
    "wrench_position": lambda random, _, plates: _draw_vectors(random, PLATE_DISPLACEMENT, plates),
    "torque_gain": lambda random, joints, _: _draw_scalars(random, TORQUE_GAIN, (joints,)),
    "imu_mounting": lambda random, *_: _draw_vectors(random, IMU_MOUNTING, 1)[0],
    "encoder_offset": lambda random, joints, _: _draw_scalars(random, ENCODER_OFFSET, (joints,)),
    "link_length": lambda random, joints, _: _draw_scalars(random, LINK_LENGTH, (joints,)),
    "sample_rates": lambda *_: SAMPLE_RATES,
    "delays": lambda random, _, plates: random.uniform(*DELAY, 2 + plates),
    "quantisation": lambda *_: RESOLUTION,
    "drift": lambda random, _, plates: _draw_walks(random, plates),
}
TYPICAL = (
    "wrench_gain",
    "wrench_offset",
    "wrench_position",
    "torque_gain",
    "imu_mounting",
    "encoder_offset",
)
