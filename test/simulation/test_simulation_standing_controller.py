"""Leg odometry estimates the true state, and the robot stands on its estimate."""

import itertools
from collections import deque

import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant, RobotFailureError
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


@pytest.mark.parametrize("seed", range(2))
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


def inertias(factor: float) -> dict[str, np.ndarray]:
    """Return the robot's inertias times a factor, by link."""
    robot = load_model(config_file("symbitron.xml"))
    return dict(zip(robot.link_names, factor * robot.phi, strict=True))


# The quadratic program determines torques to some tenths of a Nm: weak directions end where the
# solver begins.
SAME = 0.4  # Nm


class Answers:
    """A robot that stands, and the torques of each of its periods."""

    def __init__(self, seed: int = 2, controller: StandingController | None = None) -> None:
        self.robot = Simulator(SimulateOptions(motion_seed=seed, noise_seed=2), is_commanded=True)
        self.controller = controller or StandingController(motion_seed=seed)
        self.torques: list[np.ndarray] = []
        self.instant = self.robot.step()

    def go_on(self, steps: int) -> None:
        for _ in range(steps):
            self.torques.append(self.controller.torques(self.instant))
            self.instant = self.robot.step(self.torques[-1])

    @property
    def largest_step(self) -> float:
        """Largest change of a torque from one of the last 1100 periods to the next, Nm."""
        return float(np.abs(np.diff(self.torques[-1100:], axis=0)).max())


def test_a_new_model_takes_over_within_a_second_and_without_a_jump():
    stand = Answers()
    stand.go_on(1500)
    usual = stand.largest_step
    proposal = stand.controller.propose(inertias(0.8))
    assert np.abs(proposal.torque_change).max() > 5 * SAME
    stand.controller.adopt(proposal)
    assert stand.controller.is_changing
    stand.go_on(1100)
    assert not stand.controller.is_changing
    assert stand.largest_step < 1.5 * usual
    # Now the torques are those of the new model alone.
    again = stand.controller.propose(inertias(0.8))
    assert np.abs(again.torque_change).max() < SAME
    back = stand.controller.propose(inertias(1.0))
    assert np.abs(back.torque_change).max() > 5 * SAME


def test_a_model_that_is_withdrawn_leaves_without_a_jump():
    stand = Answers()
    stand.go_on(1500)
    usual = stand.largest_step
    stand.controller.adopt(stand.controller.propose(inertias(0.8)))
    stand.go_on(400)
    stand.controller.fall_back()
    stand.go_on(500)
    assert not stand.controller.is_changing
    stand.go_on(100)
    assert stand.largest_step < 1.5 * usual
    same = stand.controller.propose(inertias(1.0))
    assert np.abs(same.torque_change).max() < SAME
    stand.controller.fall_back()  # nothing to fall back to
    assert not stand.controller.is_changing


def test_a_model_stays_when_the_moves_restart():
    instants = list(itertools.islice(Simulator(SimulateOptions(moves=1)), 50))
    controller = StandingController(moves=1)
    first, *_ = [controller.torques(instant) for instant in instants]
    controller.adopt(controller.propose(inertias(0.8)))
    again = controller.torques(instants[0])
    assert not controller.is_changing
    assert np.abs(again - first).max() > 1.0


def test_suspended_scenarios_raise_an_error():
    with pytest.raises(SimulationError, match="smooth, wide, squat") as caught:
        StandingController("suspended")
    assert caught.value.code == "E606"


@pytest.mark.parametrize("learns", [False, True])
def test_a_robot_that_falls_with_a_wrong_model_stands_once_it_has_its_own(tmp_path, learns):
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    wrong = parameters.apply(draw_prior(parameters, "percent", 25.0, 2).mean)
    model = tmp_path / "wrong.xml"
    model.write_text(mjcf_text(wrong, config_file("symbitron.xml")))
    stand = Answers(0, StandingController(model_path=model))
    stand.go_on(2000)
    if learns:
        stand.controller.adopt(stand.controller.propose(inertias(1.0)))
        stand.go_on(6000)
    else:
        with pytest.raises(RobotFailureError, match="end stop"):
            stand.go_on(6000)
