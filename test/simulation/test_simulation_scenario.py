"""Each scenario is physically consistent and has the intended motion."""

import dataclasses
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import scipy.signal

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import proxqp
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import (
    COM_MOVES,
    SCENARIOS,
    SOLES,
    SQUAT_MOVES,
    STANDING,
    WIDER,
    draw_standing_task,
)
from symbid_ros.simulation.simulator import Simulator


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_stamps_are_multiples_of_the_period(run):
    stamps = run.array("stamp")
    assert stamps[0] == 1_000_000
    assert np.all(np.diff(stamps) == 1_000_000)


def test_published_truth_satisfies_the_equation_of_motion(run, body):
    worst = 0.0
    for instant in run.instants[::7]:
        body.set(instant)
        mujoco.mj_inverse(body.model, body.data)
        residual = body.data.qfrc_inverse.copy()
        residual[6:] -= instant.true_effort
        for sensor, wrench in zip(run.sensors, instant.wrenches, strict=True):
            origin, rotation, link = body.site(sensor.frame_id)
            force = np.zeros(body.model.nv)
            mujoco.mj_applyFT(
                body.model,
                body.data,
                rotation @ wrench[:3],
                rotation @ wrench[3:],
                origin,
                link,
                force,
            )
            residual -= force
        worst = max(worst, np.abs(residual).max())
    assert worst < 1e-8


def test_feet_carry_the_weight_at_rest(smooth, body):
    for instant in smooth.instants[:400:50]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        total = sum(
            body.site(sensor.frame_id)[1] @ wrench[:3]
            for sensor, wrench in zip(smooth.sensors, instant.wrenches, strict=True)
        )
        weight = 41.05 * 9.81
        np.testing.assert_allclose(total, [0.0, 0.0, weight], atol=1e-3 * weight)
        assert np.all(instant.wrenches[:, 2] > 0.4 * weight)


def test_imu_moves_with_the_base_and_its_lever_arm(run, body):
    site = body.model.site("imu_link")
    to_base = np.zeros(9)
    mujoco.mju_quat2Mat(to_base, site.quat)
    to_base = to_base.reshape(3, 3)
    arm = site.pos
    for instant in run.instants[::50]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        to_world = body.data.xmat[1].reshape(3, 3)
        spin, spun = instant.base_angular_velocity, instant.base_angular_acceleration
        specific = (
            instant.base_linear_acceleration
            + np.cross(spun, arm)
            + np.cross(spin, np.cross(spin, arm))
            + to_world.T @ [0.0, 0.0, 9.81]
        )
        np.testing.assert_allclose(instant.imu_angular_velocity, to_base.T @ spin, atol=1e-12)
        np.testing.assert_allclose(instant.imu_linear_acceleration, to_base.T @ specific, atol=1e-9)
        attitude = np.zeros(9)
        mujoco.mju_quat2Mat(attitude, instant.imu_orientation[[3, 0, 1, 2]])
        np.testing.assert_allclose(attitude.reshape(3, 3), to_world @ to_base, atol=1e-12)


def test_truth_is_consistent_in_time(smooth):
    period = 1e-3
    position, velocity, acceleration = (
        smooth.array(name) for name in ("true_position", "true_velocity", "true_acceleration")
    )
    # Semi-implicit Euler: the position is integrated with the new velocity.
    np.testing.assert_allclose(np.diff(velocity, axis=0), period * acceleration[:-1], atol=1e-12)
    np.testing.assert_allclose(np.diff(position, axis=0), period * velocity[1:], atol=1e-12)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_equal_seeds_give_equal_instants(scenario):
    first, second = (
        Simulator(SimulateOptions(scenario, moves=1, motion_seed=2, noise_seed=9)) for _ in range(2)
    )
    runs = [[simulator.step() for _ in range(700)] for simulator in (first, second)]
    for field in dataclasses.fields(runs[0][0]):
        one, other = (np.array([getattr(each, field.name) for each in run]) for run in runs)
        np.testing.assert_array_equal(one, other, strict=True)


def test_noise_seed_changes_the_readings_only():
    first, second = (
        Simulator(SimulateOptions("vibrating", moves=1, noise_seed=seed)) for seed in (0, 1)
    )
    for _ in range(100):
        one, other = first.step(), second.step()
        np.testing.assert_array_equal(one.true_acceleration, other.true_acceleration)
        assert not np.any(one.joint_position == other.joint_position)


def test_motion_seed_changes_the_moves():
    durations = {Simulator(SimulateOptions(moves=3, motion_seed=seed)).steps for seed in range(3)}
    assert len(durations) == 3


def test_iteration_yields_the_remaining_steps():
    simulator = Simulator(SimulateOptions("suspended", moves=1, ideal=True))
    for _ in range(10):
        simulator.step()
    assert len(list(simulator)) == simulator.steps - 10


def test_smooth_motion_is_smooth(smooth):
    assert 0.1 < rms(smooth.array("true_acceleration")) < 0.5


def com_path(run, body):
    path = []
    for instant in run.instants[::100]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        mujoco.mj_comPos(body.model, body.data)
        path.append(body.data.subtree_com[1].copy())
    return np.array(path)


def test_centre_of_mass_follows_its_moves(smooth, body):
    path = com_path(smooth, body)
    offsets = (path - path[0] - COM_MOVES.centre) / COM_MOVES.half_widths
    distances = np.linalg.norm(offsets, axis=1)
    arrived = np.argmax(distances < 1.0)  # the start is higher
    assert distances[arrived] < 1.0
    assert distances[arrived:].max() < 1.05
    assert np.ptp(offsets, axis=0).min() > 0.7
    feet = np.array([body.site(sensor.frame_id)[0] for sensor in smooth.sensors])
    np.testing.assert_allclose(feet, [[-0.115, 0.13, 0.0], [-0.115, -0.13, 0.0]], atol=2e-3)


def test_wide_moves_go_further_in_the_same_time_but_no_higher():
    plant = Plant(config_file("symbitron.xml"), SOLES)
    tasks = [draw_standing_task(plant, 40, 3, *STANDING[name]) for name in ("smooth", "wide")]
    smooth, wide = (task.com for task in tasks)
    offsets = (wide.points[1:] - wide.points[0] - COM_MOVES.centre) / COM_MOVES.half_widths
    assert WIDER * 0.9 < np.abs(offsets[:, :2]).max() < WIDER
    assert np.abs(offsets[:, 2]).max() < 1.0
    assert wide.duration == pytest.approx(smooth.duration, rel=0.1)


def test_squat_bends_the_knees_and_moves_vertically(squat, body):
    path = com_path(squat, body)
    forward, sideways, height = np.ptp(path, axis=0)
    assert height > 0.04
    assert max(forward, sideways) < 0.5 * height
    depth = (path - path[0] - SQUAT_MOVES.centre)[:, 2] / SQUAT_MOVES.half_widths[2]
    assert depth.min() > -1.1
    knees = squat.array("true_position")[:, [2, 7]]
    assert np.ptp(knees, axis=0).min() > 0.4
    np.testing.assert_allclose(
        squat.instants[-1].base_position[1], squat.instants[0].base_position[1], atol=0.02
    )


def test_vibration_has_the_amplitude_and_frequency_of_the_thesis(vibrating):
    acceleration = vibrating.array("true_acceleration")
    assert 8.0 < rms(acceleration) < 10.0
    frequency, power = scipy.signal.welch(acceleration, fs=1000.0, nperseg=1024, axis=0)
    share = power.sum(axis=1) / power.sum()
    median = frequency[np.searchsorted(np.cumsum(share), 0.5)]
    assert 250.0 < median < 460.0


def test_suspended_robot_has_no_floor_contact(suspended, body):
    topics = [sensor.topic for sensor in suspended.sensors]
    assert topics == ["left_foot/wrench", "right_foot/wrench", "suspension/wrench"]
    wrenches = suspended.array("wrenches")
    assert not wrenches[:, :2].any()
    upward = []
    for instant in suspended.instants[::20]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        upward.append((body.site("suspension")[1] @ instant.wrenches[2, :3])[2])
        assert body.data.site("left_sole").xpos[2] > 0.1
    assert np.mean(upward) == pytest.approx(41.05 * 9.81, rel=0.02)


def test_suspended_robot_rotates_about_all_axes(suspended):
    attitudes = suspended.array("base_orientation")
    tilt = np.degrees(2 * np.arccos(np.clip(np.abs(attitudes @ attitudes[0]), 0, 1)))
    assert 10.0 < tilt.max() < 25.0
    assert np.ptp(suspended.array("true_position"), axis=0).min() > 0.02


def test_a_failure_is_reported_with_its_time(tmp_path):
    feeble = tmp_path / "feeble.xml"
    feeble.write_text(config_file("symbitron.xml").read_text().replace("-100 100", "-10 10"))
    with pytest.raises(SimulationError, match=r"at -?\d+\.\d{3} s"):
        list(Simulator(SimulateOptions(moves=1), model_path=feeble))


def test_quadratic_programs_are_solved_without_avx_in_every_process():
    """The AVX builds round differently depending on how memory is aligned."""
    script = (
        "from symbid_ros.simulation.controller import proxqp; print(proxqp.dense.QP.__module__)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "avx" not in ran.stdout.lower()
    assert proxqp.dense.QP.__module__ == ran.stdout.strip()
