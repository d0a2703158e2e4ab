"""Motion without physics: random numbers in the shape of a simulated robot."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from symbid_ros.simulation.recording import record
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.systematic_errors import SampleRates


@dataclass(frozen=True)
class Plate:
    topic: str
    frame_id: str


@dataclass
class RandomRobot:
    """Reports different numbers at each step, which need not be physically possible."""

    steps: int = 300
    seed: int = 0
    joint_names: tuple[str, ...] = ("hip", "knee", "ankle")
    imu_frame: str = "imu_link"
    base_frame: str = "base_link"
    sample_rates: ClassVar[SampleRates] = SampleRates()
    wrench_sensors: tuple[Plate, ...] = (
        Plate("left_foot/wrench", "left_sole"),
        Plate("right_foot/wrench", "right_sole"),
    )
    instants: list[Instant] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._draw = np.random.default_rng(self.seed)

    def step(self) -> Instant:
        draw, joints = self._draw.standard_normal, len(self.joint_names)
        self.instants.append(
            Instant(
                stamp=(len(self.instants) + 1) * 1_000_000,
                joint_position=draw(joints),
                joint_velocity=draw(joints),
                joint_effort=draw(joints),
                imu_orientation=draw(4),
                imu_angular_velocity=draw(3),
                imu_linear_acceleration=draw(3),
                wrenches=draw((len(self.wrench_sensors), 6)),
                true_position=draw(joints),
                true_velocity=draw(joints),
                true_acceleration=draw(joints),
                true_effort=draw(joints),
                base_position=draw(3),
                base_orientation=draw(4),
                base_linear_velocity=draw(3),
                base_angular_velocity=draw(3),
                base_linear_acceleration=draw(3),
                base_angular_acceleration=draw(3),
            )
        )
        return self.instants[-1]

    def all(self, name: str) -> np.ndarray:
        """One field of all instants so far, one row each."""
        return np.array([getattr(instant, name) for instant in self.instants])


@pytest.fixture
def robot() -> RandomRobot:
    return RandomRobot()


@pytest.fixture
def make_robot() -> type[RandomRobot]:
    return RandomRobot


@pytest.fixture
def log(robot, tmp_path: Path) -> Path:
    record(robot, tmp_path / "log")
    return tmp_path / "log"
