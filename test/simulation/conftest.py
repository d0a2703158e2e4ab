"""Simulated runs with ideal sensors, shared by several tests."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator, WrenchSensor


@dataclass(frozen=True)
class Run:
    sensors: tuple[WrenchSensor, ...]
    instants: list[Instant]

    def array(self, name: str) -> np.ndarray:
        return np.array([getattr(instant, name) for instant in self.instants])


def simulate(scenario: str, **options) -> Run:
    simulator = Simulator(SimulateOptions(scenario, ideal=True, **options))
    return Run(simulator.wrench_sensors, list(simulator))


@pytest.fixture(scope="session")
def smooth() -> Run:
    return simulate("smooth", moves=2, motion_seed=3)


@pytest.fixture(scope="session")
def squat() -> Run:
    return simulate("squat", moves=2, motion_seed=6)


@pytest.fixture(scope="session")
def vibrating() -> Run:
    return simulate("vibrating", moves=1, motion_seed=4)


@pytest.fixture(scope="session")
def suspended() -> Run:
    return simulate("suspended", moves=6, motion_seed=5)


@pytest.fixture(scope="session")
def stepping() -> Run:
    return simulate("stepping", moves=1, motion_seed=2)


@pytest.fixture(params=["smooth", "squat", "vibrating", "stepping", "suspended"])
def run(request: pytest.FixtureRequest) -> Run:
    return request.getfixturevalue(request.param)


class Body:
    """Contact-free MuJoCo dynamics at the true state of an instant."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(config_file("symbitron.xml")))
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.data = mujoco.MjData(self.model)

    def set(self, instant: Instant) -> None:
        rotation = np.zeros(9)
        quaternion = instant.base_orientation[[3, 0, 1, 2]]
        mujoco.mju_quat2Mat(rotation, quaternion)
        to_world = rotation.reshape(3, 3)
        self.data.qpos[:] = np.concatenate(
            [instant.base_position, quaternion, instant.true_position]
        )
        self.data.qvel[:] = np.concatenate(
            [
                to_world @ instant.base_linear_velocity,
                instant.base_angular_velocity,
                instant.true_velocity,
            ]
        )
        self.data.qacc[:] = np.concatenate(
            [
                to_world @ instant.base_linear_acceleration,
                instant.base_angular_acceleration,
                instant.true_acceleration,
            ]
        )

    def site(self, name: str) -> tuple[np.ndarray, np.ndarray, int]:
        """World position, rotation and body of a site."""
        site = self.model.site(name).id
        return (
            self.data.site_xpos[site],
            self.data.site_xmat[site].reshape(3, 3),
            int(self.model.site_bodyid[site]),
        )


@pytest.fixture
def body() -> Body:
    return Body()
