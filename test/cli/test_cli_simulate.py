"""``symbid simulate`` as a user runs it."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from symbid_ros.bags import read_streams
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.systematic_errors import ERRORS


def test_help_names_every_scenario_and_error(symbid_here):
    shown = symbid_here("simulate", "--help", columns=200)
    assert shown.returncode == 0
    words = (
        "smooth",
        "wide",
        "vibrating",
        "one_leg",
        "stepping",
        "suspended",
        "tare",
        "typical",
        *ERRORS,
    )
    assert [word for word in words if word not in shown.stdout] == []


def test_tare_shows_the_plates_offsets(symbid_here, tmp_path):
    bag, robot = tmp_path / "tare", tmp_path / "robot.xml"
    done = symbid_here(
        *("simulate", "--scenario", "tare", "--errors", "typical", "--error-seed", 3),
        *("--friction", "--true-model", robot, "--out", bag),
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{bag}: 5.0 s, ")
    drawn = Simulator(
        SimulateOptions("smooth", errors="wrench_offset", error_seed=3)
    ).errors.wrench_offset
    streams = read_streams([bag])
    for wrench, offset in zip(streams.wrenches, drawn, strict=False):
        # Mean of 5000 readings of noise 1 N and .1 Nm: within five standard errors.
        np.testing.assert_allclose(wrench.force.mean(axis=0), offset[:3], atol=5 / 5000**0.5)
        np.testing.assert_allclose(wrench.torque.mean(axis=0), offset[3:], atol=0.5 / 5000**0.5)
    with AnyReader([bag]) as reader:
        assert {c.msgcount for c in reader.connections} == {5000}
    assert mujoco.MjModel.from_xml_path(str(robot)).joint("L_kfe").armature[0] == 0.009


def test_payload_is_carried_from_its_time_on(symbid_here, tmp_path):
    bag = tmp_path / "bag"
    done = symbid_here(
        *("simulate", "--moves", 1, "--ideal", "--payload-link", "base_link"),
        *("--payload-mass", 2, "--payload-position", 0.1, -0.05, 0.2, "--payload-time", 0.5),
        *("--out", bag),
    )
    assert (done.returncode, done.stderr) == (0, "")
    load = sum(wrench.force[:, 2] for wrench in read_streams([bag]).wrenches) / 9.81
    assert load[:400].mean() == pytest.approx(41.05, rel=2e-3)
    assert load[-300:].mean() == pytest.approx(43.05, rel=2e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--errors", "wrench_gian"), "no systematic error 'wrench_gian'; give typical or any of"),
        (("--friction-file", "absent.yaml"), "absent.yaml: cannot be read"),
        (("--error-seed", "-1"), "--error-seed"),
        (("--scenario", "dance"), "'dance' is not one of"),
        (("--payload-mass", "2", "--payload-link", "tail"), "no link 'tail' for a payload"),
        (("--payload-link", "R_foot"), "--payload-link has no effect without --payload-mass"),
        (("--payload-time", "3"), "--payload-time has no effect without --payload-mass"),
        (
            ("--payload-mass", "1", "--payload-time", "1e6", "--moves", "1"),
            "--payload-time 1e+06 s is after the end of the motion",
        ),
        (("--rate", "100"), "--rate has no effect without --trajectory"),
        (("--truth-percent", "50"), "--truth-percent has no effect without --trajectory"),
        (("--gyro-noise", "0.5"), "--gyro-noise has no effect without --trajectory"),
        (("--payload-position", "1", "2"), "3 arguments; see `symbid simulate --help`"),
        (("--payload-mass", "inf", "--payload-link", "base_link"), "--payload-mass"),
    ],
)
def test_bad_options_end_with_one_line(symbid_here, tmp_path, options, message):
    done = symbid_here("simulate", "--out", tmp_path / "bag", *options)
    assert done.returncode == 2
    assert done.stderr.startswith("symbid: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "bag").exists()


def test_simulation_that_is_terminated_leaves_nothing(tmp_path):
    process = subprocess.Popen(
        [
            *(Path(sys.executable).parent / "symbid", "simulate"),
            *("--moves", "1000", "--out", tmp_path / "bag"),
        ]
    )
    while process.poll() is None and not [*tmp_path.glob(".bag.*/bag/bag_0.mcap")]:
        time.sleep(0.01)
    process.terminate()
    assert process.wait(300) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
