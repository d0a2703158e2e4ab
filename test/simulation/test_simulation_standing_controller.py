"""Leg odometry estimates the true state, and the robot stands on its estimate."""

import itertools
from collections import deque

import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import SOLES
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.standing_controller import LegOdometry, StandingController


def odometry() -> LegOdometry:
    robot = Plant(config_file("symbitron.xml"), SOLES)
    return LegOdometry(robot.model, robot.data.qpos.copy(), SOLES)


def true_velocity(instant: Instant) -> np.ndarray:
    x, y, z, w = instant.base_orientation
    axis = np.array([x, y, z])
    linear = instant.base_linear_velocity
    # v + 2 w a × v + 2 a × (a × v), the rotation by a quaternion.
    turned = linear + 2 * np.cross(axis, w * linear + np.cross(axis, linear))
    return np.concatenate([turned, instant.base_angular_velocity, instant.true_velocity])


def rms(errors: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def test_estimated_state_is_close_to_the_true_state():
    legs = odometry()
    places, attitudes, velocities = [], [], []
    for instant in itertools.islice(Simulator(SimulateOptions(motion_seed=1)), 3000):
        state = legs.state(1e-9 * instant.stamp, instant)
        places.append(state.position[:3] - instant.base_position)
        attitudes.append(state.position[3:7] @ instant.base_orientation[[3, 0, 1, 2]])
        velocities.append(state.velocity - true_velocity(instant))
    # Soles move by tenths of a millimetre under a changing load.
    assert np.abs(places).max() < 1e-3
    np.testing.assert_allclose(np.abs(attitudes), 1.0, atol=1e-9)
    velocities = np.array(velocities[20:])
    assert rms(velocities[:, :3]) < 3e-3  # m/s
    assert rms(velocities[:, 3:6]) < 3e-3  # rad/s; gyroscope noise 5e-3
    assert rms(velocities[:, 6:]) < 5e-3  # rad/s; encoder noise 1.3e-2


def test_decreasing_stamps_restart_the_moves():
    instants = list(itertools.islice(Simulator(SimulateOptions(moves=1)), 50))
    controller = StandingController(moves=1)
    first, *_, again = [controller.torques(instant) for instant in (*instants, instants[0])]
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(StandingController(moves=1).torques(instants[0]), first)


@pytest.mark.parametrize("seed", range(3))
def test_robot_stands_with_delays_and_lost_commands(seed):
    robot = Simulator(SimulateOptions(motion_seed=seed, noise_seed=seed), is_commanded=True)
    controller = StandingController(motion_seed=seed)
    late = deque([robot.step()], maxlen=4)  # three periods in addition to the one of lockstep
    random = np.random.default_rng(seed)
    heights = []
    for _ in range(5000):
        torques = controller.torques(late[0]) if random.random() >= 0.05 else None
        late.append(robot.step(torques))
        heights.append(late[-1].base_position[2])
    assert np.ptp(heights) < 0.1
    assert rms([instant.true_acceleration for instant in late]) < 2.0


def test_suspended_scenarios_raise_an_error():
    with pytest.raises(SimulationError, match="smooth, squat") as caught:
        StandingController("suspended")
    assert caught.value.code == "E606"
