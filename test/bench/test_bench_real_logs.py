"""Converters of public logs of real robots, on tiny files in the same formats."""

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import drive_gains
import further_data
import least_squares
import numpy as np
import pytest
import real_data
import real_logs
from quadruped_log import FEET, quadruped_urdf
from real_log_files import arm, motion, torque, write_table
from real_logs import ALL_DATA as REAL_DATA
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses

ROOT = Path(__file__).resolve().parents[2]

RNG = np.random.default_rng(3)
TX40 = [f"joint_{index}" for index in range(1, 7)]


def files_of(name: str, folder: Path) -> list[Path]:
    """Return where the files of a log lie, with their folders made."""
    paths = [folder / file for file in REAL_DATA[name].files]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    return paths


@pytest.fixture(scope="module")
def tx40_files(tmp_path_factory):
    """Motor side of a TX40: motor 6 turns with joints 5 and 6, joint 5 bears both motors."""
    folder = tmp_path_factory.mktemp("tx40")
    angles, currents, urdf = files_of("tx40", folder)
    urdf.write_text(text := arm(TX40, RNG))
    time = np.arange(30000) / 5000.0
    q = motion(time, 6)
    tau = torque(text, time, q)
    motor = np.empty_like(q)
    motor[:, 0] = 32 * q[:, 0]
    motor[:, 1] = 32 * (q[:, 1] + np.pi / 2)
    motor[:, 2] = 45 * (q[:, 2] - np.pi / 2)
    motor[:, 3] = -48 * q[:, 3]
    motor[:, 4] = 45 * q[:, 4]
    motor[:, 5] = 32 * (q[:, 4] + q[:, 5])
    write_table(angles, ",".join(TX40), motor)
    drive = tau / [32, 32, 45, -48, 45, 32]
    drive[:, 4] = (tau[:, 4] - tau[:, 5]) / 45
    write_table(currents, ",".join(TX40), drive)
    return folder, q, tau


def test_tx40_motor_angles_and_torques_become_those_of_the_joints(tx40_files) -> None:
    folder, q, tau = tx40_files
    data = REAL_DATA["tx40"]
    log = data.convert(data.find(folder))
    assert log.robot.measured_joint_names == tuple(TX40)
    both = [log.training, log.heldout]
    np.testing.assert_allclose(np.vstack([each.position for each in both]), q, atol=1e-9)
    np.testing.assert_allclose(np.vstack([each.effort for each in both]), tau, atol=1e-9)
    assert len(log.heldout.time) == len(q) // 4
    assert np.diff(log.heldout.time) == pytest.approx(2e-4)


def test_another_part_of_a_log_is_held_out(tx40_files) -> None:
    folder, q, _ = tx40_files
    log = REAL_DATA["tx40"].convert(REAL_DATA["tx40"].find(folder))
    other = real_logs.parted(log, "first")
    np.testing.assert_allclose(other.heldout.position, q[: len(q) // 4], atol=1e-9)
    np.testing.assert_allclose(other.training.position, q[len(q) // 4 :], atol=1e-9)
    twice = log.training.joined(log.training)
    assert np.all(np.diff(twice.time) > 0)
    assert len(twice.time) == 2 * len(log.training.time)


def test_the_file_of_another_run_is_read(tx40_files, tmp_path) -> None:
    folder, *_ = tx40_files
    data = REAL_DATA["tx40"]
    angles, *others = data.find(folder)
    found = data.find(folder, {angles.name: tmp_path / "other.csv"})
    assert found == [tmp_path / "other.csv", *others]


def test_tx40_coupled_friction_acts_with_and_against_both_joints() -> None:
    """Virtual power of rotor 6: τ5 q̇5 + τ6 q̇6 = f (q̇5 + q̇6)."""
    velocity = RNG.normal(size=(40, 6))
    acceleration = RNG.normal(size=(40, 6))
    columns = real_data.wrist_coupling(velocity, acceleration)
    rotor = velocity[:, 4] + velocity[:, 5]
    power = columns[:, :, 2][:, 4:] * velocity[:, 4:]
    np.testing.assert_allclose(power.sum(axis=1), np.abs(rotor))
    # Viscous: (q̇5 + q̇6)² less the joints' own friction, q̇5² and q̇6².
    power = (columns[:, :, 1] * velocity).sum(axis=1)
    np.testing.assert_allclose(power, rotor**2 - (velocity[:, 4:] ** 2).sum(axis=1))
    assert not columns[:, :4].any()


def test_the_table_of_a_synthetic_log_shows_what_explains_it(tx40_files, capsys, monkeypatch):
    folder, *_ = tx40_files
    monkeypatch.setattr(sys, "argv", ["", "tx40", "--data", str(folder), "--reference-only"])
    real_logs.main()
    printed = capsys.readouterr().out
    assert printed.count("other content than") == 3
    errors = {
        cells[1].strip(): float(cells[2])
        for line in printed.splitlines()
        if (cells := line.split("|"))[2:] and re.fullmatch(r" *[\d.e+]+ *", cells[2])
    }
    assert errors["least squares: links, viscous, coulomb, offset"] < 0.5
    assert errors["model file, inertias alone"] > 20.0


def test_an_identification_is_judged_on_the_samples_of_the_reference(tx40_files) -> None:
    folder, *_ = tx40_files
    data = REAL_DATA["tx40"]
    log = data.convert(data.find(folder))
    heldout = least_squares.sample(log.robot, log.heldout, log.cutoff)
    options = {"friction": True, "offset": True}
    title, found, notes = real_logs.identified(log, heldout, options)
    assert title == "symbid, friction=True, offset=True"
    assert found.overall < 1.0
    assert found.each.shape == (6,)
    assert "total mass" in notes


def of(recording):
    return recording.time, recording.position, recording.effort


def test_lwr4_arrays_are_read_in_the_order_of_the_model(tmp_path) -> None:
    run, urdf = files_of("lwr4", tmp_path)
    urdf.write_text(arm([f"lwr_{index}_joint" for index in range(7)], RNG))
    # The first and the last second are left out: the authors' filter settles there.
    count, inside = 441, slice(201, 240)
    q, tau = RNG.normal(size=(2, count, 7))
    times = 1.46e9 + np.arange(count) / 200
    np.savez(run, times=times, positions=q, torques=tau, target_positions=np.nan * q)
    log = REAL_DATA["lwr4"].convert([run, urdf])
    both = [np.concatenate(each) for each in zip(of(log.training), of(log.heldout), strict=True)]
    for found, given in zip(both, (times, q, tau), strict=True):
        np.testing.assert_array_equal(found, given[inside])
    assert len(log.heldout.time) == 10


def test_panda_has_one_value_a_line_and_no_hand(tmp_path) -> None:
    times, positions, torques, urdf = files_of("panda", tmp_path)
    text = arm([f"panda_joint{index}" for index in range(1, 8)], RNG, hand="panda_hand_joint")
    urdf.write_text(text)
    q, tau, time = RNG.normal(size=(20, 7)), RNG.normal(size=(20, 7)), np.cumsum(RNG.random(20))
    for path, values in ((times, time), (positions, q), (torques, tau)):
        path.write_text("\n".join(str(value) for value in values.ravel()))
    log = REAL_DATA["panda"].convert([times, positions, torques, urdf])
    assert len(log.robot.joints) == 7
    assert {link.name for link in log.robot.links} == {"base", *(f"link_{i}" for i in range(7))}
    np.testing.assert_array_equal(log.training.position, q[:15])
    np.testing.assert_array_equal(log.heldout.effort, tau[15:])
    # Gaz et al.: no friction at rest, and at speed a constant of each direction.
    (friction,) = log.published.values()
    assert friction(np.zeros((1, 7)), np.zeros((1, 7))) == pytest.approx(0.0, abs=1e-12)
    span = friction(np.full((1, 7), 9.0), None) - friction(np.full((1, 7), -9.0), None)
    np.testing.assert_allclose(span[0, [0, 3]], [0.54615, 1.2794], rtol=1e-6)


def test_ur10e_currents_become_torques(tmp_path) -> None:
    run, urdf = files_of("ur10e", tmp_path)
    urdf.write_text(arm([f"axis_{index}" for index in range(6)], RNG))
    rows = RNG.normal(size=(20, 31))
    rows[:, 0] = 798.467 + np.arange(20) / 100
    np.savetxt(run, rows, delimiter=",")
    log = REAL_DATA["ur10e"].convert([run, urdf])
    np.testing.assert_allclose(log.training.position, rows[:15, 1:7])
    gains = [14.87, 13.26, 11.13, 10.62, 11.03, 11.47]
    np.testing.assert_allclose(log.heldout.effort / rows[15:, 13:19], np.tile(gains, (5, 1)))


@pytest.fixture
def human_files(tmp_path):
    """A body that turns about its vertical axis while it moves sideways, arms at rest."""
    table, urdf = files_of("human", tmp_path)
    hinge = '<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/></joint>'
    joints = [
        hinge.format("right_arm", "pelvis", "right", "continuous"),
        hinge.format("wrist", "left", "hand", "continuous"),
        hinge.format("helmet", "pelvis", "head", "fixed"),
        hinge.format("left_arm", "pelvis", "left", "continuous"),
    ]
    body = (
        '<inertial><mass value="60"/><inertia ixx="3" iyy="3" izz="3" ixy="0" ixz="0" iyz="0"/>'
        "</inertial>"
    )
    light = body.replace("60", "1e-6").replace('"3"', '"1e-9"')
    links = [f'<link name="pelvis">{body}</link>'] + [
        f'<link name="{name}">{light}</link>' for name in ("left", "right", "hand", "head")
    ]
    urdf.write_text(f'<robot name="human">{"".join(links + joints)}</robot>')
    time = np.arange(900) / 30.0
    angle, rate = 0.9 * np.sin(1.1 * time), 0.99 * np.cos(1.1 * time)
    place = np.stack([1 + 0.1 * np.sin(time), 0.4 + 0 * time, 1 + 0.05 * np.cos(2 * time)], axis=1)
    force = 60 * np.stack([-0.1 * np.sin(time), 0 * time, 9.81 - 0.2 * np.cos(2 * time)], axis=1)
    spin = 3 * np.gradient(rate, time)
    moment = np.cross(place, force) + spin[:, None] * [0, 0, 1]
    half = angle[:, None] / 2
    pose = np.hstack([place, np.sin(half) * [0, 0, 1], np.cos(half)])
    angles = np.tile([0.1, 0.2, 0.3], (len(time), 1))  # left_arm, wrist, right_arm
    names = ",".join([*(f"q_{index}" for index in range(10)), "Fx,Fy,Fz,Mx,My,Mz"])
    write_table(table, names, np.hstack([pose, angles, force, moment]))
    return tmp_path


def test_joints_of_the_human_are_ordered_depth_first_siblings_by_name(human_files) -> None:
    data = REAL_DATA["human"]
    _, urdf = data.find(human_files)
    assert real_data.joint_order(urdf) == ["left_arm", "wrist", "right_arm"]
    log = data.convert(data.find(human_files))
    by_name = dict(zip(log.robot.measured_joint_names, log.training.position[0], strict=True))
    assert by_name == pytest.approx({"left_arm": 0.1, "wrist": 0.2, "right_arm": 0.3})


def test_the_plate_feels_the_motion_of_the_human(human_files) -> None:
    """The wrench follows from Newton and Euler above, not from this project's dynamics."""
    data = REAL_DATA["human"]
    log = data.convert(data.find(human_files))
    heldout = least_squares.sample(log.robot, log.heldout, log.cutoff)
    ((title, error),) = [
        each for each in real_logs.references(log, heldout, heldout) if "file" in each[0]
    ]
    assert title == "model file, inertias alone"
    assert error.overall < 0.5
    assert error.each[2] < 5.0  # moment about the vertical: inertia times angular acceleration
    assert not heldout.is_used[:, 6:].any()
    plate = real_data.to_log(log.robot, log.training).streams()
    assert plate.wrenches[0].force[:, 2].mean() == pytest.approx(60 * 9.81, rel=0.01)
    np.testing.assert_allclose(plate.imus[0].linear_acceleration[:, 2].mean(), 9.81, rtol=0.01)


def test_kinova_reads_the_measured_torques(tmp_path) -> None:
    run, urdf = files_of("kinova", tmp_path)
    urdf.write_text(arm([f"joint_{index}" for index in range(1, 8)], RNG))
    kinds = ["Position", "Torque", "TorqueSm"]
    names = ",".join(["Time", *(f"{kind}{joint}" for kind in kinds for joint in range(1, 8))])
    values = np.column_stack([np.arange(20.0), RNG.normal(size=(20, 21))])
    write_table(run, names, values)
    log = REAL_DATA["kinova"].convert([run, urdf])
    np.testing.assert_allclose(log.training.position, values[:15, 1:8])
    np.testing.assert_allclose(log.heldout.effort, values[15:, 15:])
    assert np.diff(log.training.time) == pytest.approx(1e-3)


def test_a_double_pendulum_reads_its_measured_torques_once_an_instant(tmp_path) -> None:
    run, urdf = files_of("double_pendulum", tmp_path)
    urdf.write_text(arm(["Joint1", "Joint2"], RNG))
    names = "time,pos_meas1,pos_meas2,tau_con1,tau_meas1,tau_meas2"
    values = np.column_stack([0.002 * np.arange(41), RNG.normal(size=(41, 5))])
    values[20, 0] = values[19, 0]
    write_table(run, names, values)
    log = REAL_DATA["double_pendulum"].convert([run, urdf])
    kept = np.delete(values, 20, axis=0)
    np.testing.assert_allclose(log.training.position, kept[:30, 1:3])
    np.testing.assert_allclose(log.heldout.effort, kept[30:, 4:])


def test_a_gen3_has_continuous_angles_and_torques_of_the_other_sign(tmp_path) -> None:
    *tables, urdf = files_of("gen3", tmp_path)
    urdf.write_text(arm([f"joint_{index}" for index in range(1, 8)], RNG))
    time = 3.0 + 0.01 * np.arange(40.0)
    position, effort = motion(9 * time, 7), RNG.normal(size=(40, 7))
    wrapped = (position + np.pi) % (2 * np.pi) - np.pi
    for path, values in zip(tables, (wrapped, effort, time), strict=True):
        np.savetxt(path, values)
    log = REAL_DATA["gen3"].convert([*tables, urdf])
    np.testing.assert_allclose(
        np.diff(log.training.position, axis=0), np.diff(position, axis=0)[:29]
    )
    np.testing.assert_allclose(log.training.effort, -effort[:30])
    assert log.training.time[0] == 0.0


def test_an_airbot_is_read_at_100_hz(tmp_path) -> None:
    *tables, urdf = files_of("airbot", tmp_path)
    urdf.write_text(arm([f"joint{index}" for index in range(1, 7)], RNG))
    position, effort = RNG.normal(size=(2, 40, 6))
    for path, values in zip(tables, (position, effort), strict=True):
        write_table(path, ",".join("abcdef"), values)
    log = REAL_DATA["airbot"].convert([*tables, urdf])
    np.testing.assert_allclose(log.heldout.position, position[30:])
    np.testing.assert_allclose(log.heldout.effort, effort[30:])
    assert np.diff(log.heldout.time) == pytest.approx(0.01)


def test_an_xmate_has_the_published_denavit_hartenberg_parameters(tmp_path) -> None:
    position = RNG.uniform(-1.0, 1.0, (1200, 7))
    effort = RNG.normal(size=(1200, 7))
    for path, rows in zip(files_of("xmate", tmp_path), (position, effort), strict=True):
        np.savetxt(path, rows)
    data = REAL_DATA["xmate"]
    log = data.convert(data.find(tmp_path))
    np.testing.assert_allclose(log.training.effort, effort[:900])
    assert np.diff(log.training.time) == pytest.approx(1e-3)
    poses = link_poses(log.robot, position)
    turn, place = Rotation.identity(len(position)), np.zeros((len(position), 3))
    quarters = [0.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]
    offsets = [0.3415, 0.0, 0.394, 0.0, 0.366, 0.0, 0.2503]
    for index, (quarter, offset) in enumerate(zip(quarters, offsets, strict=True)):
        turn = turn * Rotation.from_euler("x", 90 * quarter, degrees=True)
        turn = turn * Rotation.from_euler("z", position[:, [index]])
        place = place + turn.apply([0.0, 0.0, offset])
        link = log.robot.link_names.index(f"link{index + 1}")
        np.testing.assert_allclose(poses.rotation[:, link], turn.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(poses.position[:, link], place, atol=1e-9)


def test_the_pose_of_a_base_gives_what_an_imu_feels() -> None:
    """A base that turns about z at 2 rad/s and accelerates along the world's x axis."""
    time = 0.01 * np.arange(60)
    place = np.stack([1.5 * time**2, 0 * time, 0 * time], axis=1)
    turn = Rotation.from_rotvec(np.outer(2 * time, [0, 0, 1]))
    felt = real_data.imu_readings(time, turn, np.gradient(place, time, axis=0))
    np.testing.assert_allclose(felt[:, :3], [[0, 0, 2]] * 60, atol=1e-9)
    force = turn.apply(felt[:, 3:])
    np.testing.assert_allclose(force[2:-2], [[3.0, 0, 9.81]] * 56, atol=1e-9)


def test_tiago_has_no_torque_of_its_torso_and_holds_other_joints(tmp_path) -> None:
    positions, currents, urdf = files_of("tiago", tmp_path)
    names = ["torso_lift_joint", *(f"arm_{index}_joint" for index in range(1, 8)), "gripper"]
    urdf.write_text(arm(names, RNG))
    values = RNG.normal(size=(6800, 9))
    for path in (positions, currents):
        write_table(path, ",".join(["t", *names[:8]]), values)
    log = REAL_DATA["tiago"].convert([positions, currents, urdf])
    assert list(log.robot.measured_joint_names) == names[:8]
    assert np.isnan(log.training.effort[:, 0]).all()
    gains = [13.6, 13.6, -8.7, -8.7, *[-20.5968] * 3]
    np.testing.assert_allclose(log.training.effort[0, 1:], values[921, 2:] * gains)


def test_the_clock_of_the_a1_follows_from_positions_and_velocities() -> None:
    time = np.cumsum(RNG.uniform(1.0e-3, 1.4e-3, 600))
    phase = np.arange(12) / 3
    position = np.sin(5 * time[:, None] + phase)
    found = further_data._clock(position, 5 * np.cos(5 * time[:, None] + phase))
    np.testing.assert_allclose(np.gradient(found)[50:-50], 1.2e-3, rtol=0.1)
    np.testing.assert_allclose(found, time - time[0], atol=0.01 * time[-1])


@pytest.mark.parametrize("radius", [0.0, 0.05])
def test_forces_at_named_contacts_change_no_projected_force(tmp_path, radius) -> None:
    path = tmp_path / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    robot = sy.load_model(path, "floating")
    frames = tuple(
        replace(frame, radius=radius) if frame.name in FEET else frame for frame in robot.frames
    )
    robot = replace(robot, frames=frames)
    q = RNG.uniform(-0.5, 0.5, (5, len(robot.measured_joint_names)))
    above = Rotation.random(5, rng=RNG).as_matrix()[:, 2]
    P = least_squares.contact_projections(robot, q, FEET, above)
    poses = link_poses(robot, q)
    forces = RNG.normal(size=(5, len(FEET), 3))
    wrenches = np.zeros((5, len(FEET), 6))
    for index, frame in enumerate(map(robot.frame, FEET)):
        axes = poses.rotation[:, frame.link] @ frame.rotation
        in_base = np.einsum("tij,tj->ti", axes, forces[:, index])
        moment = np.cross(-radius * above, in_base)
        wrenches[:, index, :3] = np.einsum("tji,tj->ti", axes, moment)
        wrenches[:, index, 3:] = forces[:, index]
    J = contact_jacobian(robot, FEET, poses).reshape(5, len(FEET), 6, -1)
    acting = np.einsum("tfan,tfa->tn", J, wrenches)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", P, acting), 0.0, atol=1e-9)
    # A projection's trace is its rank.
    rank = robot.dof - 3 * len(FEET)
    np.testing.assert_allclose(np.trace(P, axis1=1, axis2=2), rank)


@pytest.mark.parametrize("seconds", [4.0, 10.0])
def test_the_mean_specific_force_points_upwards(seconds) -> None:
    """A base that turns about a horizontal axis, and moves to and fro once in four seconds."""
    time = np.arange(0, seconds, 0.01)
    angle = 0.4 * np.sin(5 * time)
    rate = np.stack([2 * np.cos(5 * time), 0 * time, 0 * time], axis=1)
    above = np.stack([0 * time, np.sin(angle), np.cos(angle)], axis=1)
    forwards = np.stack([np.sin(np.pi * time / 2), 0 * time, 0 * time], axis=1)
    found = least_squares.upward(sy.BaseMotion(rate, 0 * rate, 9.81 * above + forwards), 0.01)
    whole = time < 4.0 * (seconds // 4.0)
    np.testing.assert_allclose(found[whole], above[whole], atol=0.02)


def test_rows_near_pauses_are_left_out() -> None:
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(2, 3, 0.01)])
    clock = np.arange(0, 3, 0.1)
    near = least_squares.is_near_pause(time, clock, 0.15)
    np.testing.assert_array_equal(near, (clock > 0.84) & (clock < 2.15))


def rows(velocity, force):
    every = slice(None)
    return least_squares.Sampled(velocity, velocity, velocity, None, force, 0.1, np.inf, every)


def test_least_squares_weights_rows_by_their_residuals() -> None:
    """Two rows of one parameter, the second ten times noisier: BLUE is the weighted mean."""
    count = 4000
    noise = RNG.normal(size=(count, 2)) * [0.1, 1.0]
    force = 2.0 + noise
    samples = rows(np.ones((count, 2)), force)
    (found,) = least_squares.solve(np.ones((count, 2, 1)), samples)
    weights = np.array([1 / force[:, 0].var(), 1 / force[:, 1].var()])
    expected = (force.mean(axis=0) * weights).sum() / weights.sum()
    assert found == pytest.approx(expected, abs=1e-4)


def test_rows_of_resting_joints_are_left_out_of_fit_and_score() -> None:
    force = np.array([[1.0], [100.0], [1.0]])
    velocity = np.array([[0.5], [0.01], [-0.5]])
    samples = rows(velocity, force)
    assert samples.is_used.ravel().tolist() == [True, False, True]
    assert least_squares.solve(np.ones((3, 1, 1)), samples) == pytest.approx(1.0)
    assert least_squares.score(samples, 0.9 * np.ones((3, 1))).overall == pytest.approx(10.0)


def test_the_ratio_of_two_errors_has_a_90_percent_interval() -> None:
    """Errors that are alike within a second, of two estimates that share a part of them."""
    samples = replace(rows(np.ones((2000, 6)), np.ones((2000, 6))), period=0.01)
    held = np.arange(2000) // 100
    rng = np.random.default_rng(11)  # its own, whichever tests ran before

    def errors(size: float, common: np.ndarray) -> least_squares.Score:
        own = rng.normal(size=(20, 6))[held]
        return least_squares.score(samples, samples.force + common + size * own)

    ratios = []
    for _ in range(400):
        common = rng.normal(size=(20, 6))[held]
        ratios.append(least_squares.error_ratio(errors(0.5, common), errors(1.0, common), samples))
    _, low, high = np.transpose(ratios)
    truth = np.sqrt(1.25 / 2.0)
    assert 0.84 < np.mean((low < truth) & (truth < high)) < 0.96
    one = errors(1.0, common)
    assert least_squares.error_ratio(one, one, samples) == pytest.approx((1.0, 1.0, 1.0))


def test_absent_files_are_named_with_their_source(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["", "lwr4", "--data", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"lacks .*measurements_1.npz.*FloBaRoID commit 4e2e5a2"):
        real_logs.main()


REAL = os.environ.get("SYMBID_REAL_LOGS")
PAGE = (ROOT / "docs/real-logs.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("data", [*REAL_DATA.values(), drive_gains.DATA], ids=lambda one: one.title)
def test_the_page_names_the_content_of_each_input(data) -> None:
    for path, digest in data.files.items():
        assert len(digest) == 64
        assert re.search(rf"`{re.escape(Path(path).name)}`\s{digest[:16]}[,.]", PAGE)


@pytest.mark.parametrize("name", REAL_DATA)
def test_published_reference_errors_are_those_of_the_data(name, capsys, monkeypatch) -> None:
    """Needs the data: SYMBID_REAL_LOGS=DIR with one folder for each log, named like it."""
    if REAL is None:
        pytest.skip(f"SYMBID_REAL_LOGS is unset: the figures of {name} were NOT checked")
    data = REAL_DATA[name]
    try:
        files = data.find(Path(REAL) / name)
    except real_data.MissingDataError as error:
        pytest.skip(f"the figures of {name} were NOT checked: {error}")
    assert [real_data.sha256(path) for path in files] == list(data.files.values())
    folder = str(Path(REAL) / name)
    monkeypatch.setattr(sys, "argv", ["", name, "--data", folder, "--reference-only"])
    real_logs.main()
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert len(printed) >= 3
    for line in printed:
        assert line in PAGE


@pytest.mark.parametrize("name", ["tx40", "lwr4", "panda", "ur10e", "ur10", "fer", "med7", "tiago"])
def test_readings_in_unknown_units_are_predicted_as_well(name, capsys, monkeypatch) -> None:
    """Least squares know that efforts are in Nm; the error is a share of the readings."""
    if REAL is None:
        pytest.skip(f"SYMBID_REAL_LOGS is unset: drive gains of {name} were NOT checked")
    try:
        REAL_DATA[name].find(Path(REAL) / name)
    except real_data.MissingDataError as error:
        pytest.skip(f"drive gains of {name} were NOT checked: {error}")
    folder = str(Path(REAL) / name)
    monkeypatch.setattr(sys, "argv", ["", name, "--data", folder, "--option", "drive_gain=all"])
    real_logs.main()
    errors = {}
    for line in capsys.readouterr().out.splitlines():
        if line.startswith(("| least squares", "| symbid")):
            title, overall, *_ = line.strip("| ").split(" | ")
            errors[title.partition(" ")[0]] = float(overall)
    # Only with the drive that joints 5 and 6 share is the TX40 predicted far better.
    assert errors["symbid,"] < (0.5 if name == "tx40" else 1.05) * errors["least"]


def test_the_commands_shown_identify_a_public_log(monkeypatch, tmp_path) -> None:
    if REAL is None:
        pytest.skip("SYMBID_REAL_LOGS is unset: the commands on a public log were NOT run")
    try:
        REAL_DATA["lwr4"].find(Path(REAL) / "lwr4")
    except real_data.MissingDataError as error:
        pytest.skip(f"the commands on a public log were NOT run: {error}")
    data = (Path(REAL) / "lwr4").resolve()
    monkeypatch.chdir(tmp_path)
    first, *others = re.search(r"## With commands.*?```sh\n(.*?)```", PAGE, re.DOTALL)[
        1
    ].splitlines()
    assert first.startswith("python bench/real_logs.py")
    words = shlex.split(first.replace("DIR", shlex.quote(str(data))))[2:]
    monkeypatch.setattr(sys, "argv", ["", *words])
    real_logs.main()
    statuses = {}
    for line in others:
        symbid, *words = shlex.split(line)
        ended = subprocess.run(
            [Path(sys.executable).parent / symbid, *words],
            capture_output=True,
            text=True,
            check=False,
        )
        statuses[words[0]] = ended.returncode
        assert ended.returncode <= 1, ended.stderr
    assert list(statuses) == ["identify", "validate", "report", "apply"]
    assert statuses["validate"] == statuses["report"] == statuses["apply"] == 0
    assert (tmp_path / "lwr4" / "robot.urdf.orig").is_file()
    assert (tmp_path / "lwr4_result" / "report.html").is_file()
