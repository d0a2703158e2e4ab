"""Wrench sensors of feet show their offsets while the feet are in the air."""

from dataclasses import replace

import numpy as np
import pytest

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.unloaded_sensors import UnloadedSensors
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.signals.segments import Segment
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

WEIGHT, RATE, CYCLE = 400.0, 1000.0, 2000  # N, Hz, samples of a step
OFFSET = np.array([0.1, -0.15, 0.05, 1.5, -1.0, 2.0])
NOISE = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])


def foot(load: float, light: float = 0.0, drift: float = 0.0, steps: int = 8) -> Segment:
    """A foot that carries a load for a second and is in the air for another, again and again.

    It brushes the ground with up to 10 N during the first and last 0.1 s in the air.
    """
    random = np.random.default_rng(3)
    count = steps * CYCLE
    time = np.arange(count) / RATE
    phase = (np.arange(count) % CYCLE) / RATE
    carried = np.where(phase < 1.0, load * (1 + 0.05 * np.sin(20 * time)), light)
    brush = np.maximum(0.0, 1.0 - np.minimum(phase - 1.0, 2.0 - phase) / 0.1) * (phase >= 1.0)
    carried += 10.0 * brush
    wrench = (
        OFFSET + drift * (time / time[-1] - 0.5)[:, None] + NOISE * random.normal(size=(count, 6))
    )
    wrench[:, 5] += carried
    wrench[:, 1] += 0.05 * carried
    empty = np.zeros((count, 0))
    return Segment(
        stamp=(1e9 * time).astype(np.int64),
        rate=RATE,
        position=empty,
        effort=empty,
        angular_velocity=np.zeros((count, 0, 3)),
        linear_acceleration=np.zeros((count, 0, 3)),
        wrenches=wrench[:, None],
        imu_frames=(),
        wrench_frames=("sole",),
    )


def readings(segment: Segment) -> dict:
    sensors = UnloadedSensors(("sole",), WEIGHT)
    sensors.add(segment)
    return sensors.readings()


def test_the_offset_is_what_the_sensor_reads_in_the_air() -> None:
    reading = readings(foot(WEIGHT))["sole"]
    assert np.all(np.abs(reading.mean - OFFSET) < 4 * reading.std)
    assert np.all(reading.std < 0.05 * NOISE)
    assert 4.0 < reading.seconds < 8.0
    finding = reading.finding("/foot")
    assert finding is not None
    assert finding.message.startswith("/foot: reads 2.7 N and 0.19 Nm while the foot is in the air")
    assert finding.figures["force_z_n"] == reading.mean[5]


def test_an_offset_that_drifts_is_known_to_its_change_only() -> None:
    reading = readings(foot(WEIGHT, drift=1.0))["sole"]
    assert np.all(reading.std[3:] > 0.2)
    assert np.all(np.abs(reading.mean - OFFSET) < reading.std)


@pytest.mark.parametrize(
    "segment",
    [foot(15.0), foot(0.0), foot(WEIGHT, light=60.0), foot(WEIGHT, steps=1).cut(0, 1200)],
    ids=["a tool", "suspended", "never in the air", "too short"],
)
def test_other_sensors_show_none(segment: Segment) -> None:
    assert readings(segment) == {}


def test_without_offset_nothing_is_said() -> None:
    segment = foot(WEIGHT)
    segment.wrenches[:] -= OFFSET
    assert readings(segment)["sole"].finding("/foot") is None


def suspect(*feet: Segment) -> tuple[str, float]:
    """Return the suspect of feet A, B, …, whose sensors have no offsets of their own."""
    names = tuple("ABCD"[: len(feet)])
    wrenches = np.concatenate([one.wrenches - OFFSET for one in feet], axis=1)
    sensors = UnloadedSensors(names, WEIGHT)
    sensors.add(replace(feet[0], wrenches=wrenches, wrench_frames=names))
    return sensors.suspect_force()


def test_a_sensor_that_alone_reads_a_force_in_the_air_is_suspected() -> None:
    walking, shifted = foot(WEIGHT), foot(WEIGHT, light=40.0)
    name, force = suspect(walking, shifted, walking, walking)
    assert name == "B"
    assert force == pytest.approx(40.0, rel=0.1)
    for others in ([walking] * 4, [shifted] * 4, [shifted, walking, shifted], [walking, shifted]):
        assert suspect(*others) == ("", 0.0)


@pytest.fixture(scope="module")
def stepped(tmp_path_factory) -> tuple[sy.Log, np.ndarray]:
    """Two steps, one of each foot, and the true offsets of their plates as moment and force."""
    bag = tmp_path_factory.mktemp("stepped") / "bag"
    robot = Simulator(
        SimulateOptions("stepping", moves=2, motion_seed=5, errors="wrench_offset", error_seed=5)
    )
    record(robot, bag)
    force_first = robot.errors.wrench_offset
    return sy.load_bag(bag, load_model(config_file("symbitron.xml"))), np.roll(force_first, 3, 1)


def test_swings_tare_the_plates_of_a_stepping_robot(stepped) -> None:
    log, truth = stepped
    robot = load_model(config_file("symbitron.xml"))
    plain = load_problem(robot, log).checks
    offsets = [one for one in plain.findings if one.kind is Kind.WRENCH_OFFSET]
    assert sorted(one.stream for one in offsets) == ["/left_foot/wrench", "/right_foot/wrench"]
    assert sum("wrench_offset" in alarm for alarm in plain.alarms) == 2
    problem = load_problem(robot, log, IdentifyOptions(sensor_errors=("wrench_offset",)))
    assert not problem.checks.alarms
    for frame, expected in zip(("left_sole", "right_sole"), truth, strict=True):
        tare = problem.checks.tares[frame]
        assert np.all(np.abs(tare.mean - expected) < 4 * tare.std)
    # The solution starts from these readings, and can only know the offsets better.
    found = problem.solve()
    names, place = list(found.unknowns), len(found.unknowns) - 12
    for index in range(12):
        tare = problem.checks.tares[("left_sole", "right_sole")[index // 6]]
        error = names[place + index] - truth.ravel()[index]
        assert abs(error) < 4 * tare.std[index % 6]


def test_a_foot_that_hardly_touches_the_ground_is_not_in_the_air() -> None:
    """Its load has a minimum, and never stays the same."""
    segment = foot(WEIGHT)
    time = np.arange(len(segment)) / RATE
    segment.wrenches[:, 0, 5] += 5.0 + 100.0 * (1 - np.cos(2 * np.pi * time / 2.0))
    segment.wrenches[:, 0, 5] -= segment.wrenches[:, 0, 5].min() - 5.0
    assert readings(foot(WEIGHT)) != {}
    assert readings(segment) == {}
