"""A commanded robot executes external torques within its limits."""

import dataclasses

import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Drives, Rejection
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator


def drives_of(simulator: Simulator) -> Drives:
    return Drives(simulator.joint_names, simulator.drive_names, simulator.torque_limits)


def test_equal_external_torques_give_equal_instants():
    options = {"moves": 1, "motion_seed": 5, "noise_seed": 6}
    internal, commanded = (
        Simulator(SimulateOptions(**options)),
        Simulator(SimulateOptions(**options), is_commanded=True),
    )
    places = [internal.joint_names.index(name) for name in internal.drive_names]
    for _ in range(300):
        one = internal.step()
        other = commanded.step(one.true_effort[places])
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_drives_are_named_by_their_joints():
    simulator = Simulator(SimulateOptions(moves=1), is_commanded=True)
    torques = np.arange(1.0, 9.0)
    effort = dict(zip(simulator.joint_names, simulator.step(torques).true_effort, strict=True))
    assert [effort[name] for name in simulator.drive_names] == torques.tolist()
    assert effort["R_aie"] == effort["L_aie"] == 0.0
    assert simulator.torque_limits.tolist() == [[-100.0, 100.0]] * 8


def test_without_a_command_the_torques_do_not_change():
    simulator = Simulator(SimulateOptions(moves=1), is_commanded=True)
    settled = simulator.step().true_effort
    assert np.abs(settled).max() > 1.0  # the torques of standing
    simulator.step(np.full(8, 2.0))
    assert set(simulator.step().true_effort) == {0.0, 2.0}


def test_simulation_continues_after_the_motion():
    simulator = Simulator(SimulateOptions("tare"), is_commanded=True)
    stamps = [simulator.step().stamp for _ in range(simulator.steps + 2)]
    assert stamps[-1] == (simulator.steps + 2) * simulator.period_ns


@pytest.mark.parametrize("torques", [np.zeros(7), np.zeros((8, 1)), np.full(8, np.nan)])
def test_commands_of_wrong_shape_raise_an_error(torques):
    simulator = Simulator(SimulateOptions(moves=1), is_commanded=True)
    with pytest.raises(SimulationError, match="8") as caught:
        simulator.step(torques)
    assert caught.value.code == "E611"


def test_uncommanded_robot_rejects_torques():
    with pytest.raises(SimulationError, match="is_commanded"):
        Simulator(SimulateOptions(moves=1)).step(np.zeros(8))


def test_safe_torques_dissipate_energy():
    simulator = Simulator(SimulateOptions(moves=1, ideal=True), is_commanded=True)
    drives = drives_of(simulator)
    places = [simulator.joint_names.index(name) for name in simulator.drive_names]
    instant = simulator.step()
    for _ in range(150):  # the robot starts to fall
        instant = simulator.step(drives.safe_torques(instant.joint_velocity))
        power = instant.true_effort[places] * instant.true_velocity[places]
        # Torques are one period late, in which a small velocity may change its sign.
        assert np.all(power < 1e-3)
    assert np.abs(instant.true_velocity).max() > 0.5


def test_invalid_torques_are_rejected_with_a_reason():
    drives = drives_of(Simulator(SimulateOptions(moves=1)))
    assert drives.validate(np.full(8, 100.0)) is None
    assert drives.validate(np.full(8, np.inf)) is Rejection.NOT_FINITE
    assert drives.validate(np.full(8, -100.1)) is Rejection.BEYOND_LIMIT
