"""Scale errors of an IMU that gravity shows, and samples taken at other times than their stamps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.imu_checks import ImuCheck
from symbid_ros.diagnosis.imu_gain import proportional_gain
from symbid_ros.diagnosis.jitter import JitterCheck
from symbid_ros.signals.streams import ImuStream, JointStream

RATE = 250
TIME = np.arange(0, 40, 1 / RATE)
STAMP = np.round(TIME * 1e9).astype(np.int64)


def rocking_imu(turn: float = 0.3, sway: float = 0.03, seed: int = 1) -> ImuStream:
    """Return what an IMU reads on a body that rocks by so many rad and sways by so many metres."""
    rng = np.random.default_rng(seed)
    omega = rng.uniform(0.3, 1.5, 3)

    def attitude(time):
        return Rotation.from_rotvec(turn * np.sin(np.outer(time, omega) + np.arange(3)))

    rotation = attitude(TIME)
    rate = (rotation.inv() * attitude(TIME + 1e-6)).as_rotvec() / 1e-6
    pace = 2 * np.pi * rng.uniform(0.2, 0.8, 3)
    acceleration = -sway * pace**2 * np.sin(np.outer(TIME, pace) + np.arange(3))
    force = rotation.inv().apply(acceleration + np.array([0, 0, 9.81]))
    return ImuStream(
        "/imu",
        "imu",
        STAMP,
        rotation.as_quat(),
        rate + 0.01 + 5e-3 * rng.standard_normal(rate.shape),
        force + 0.03 * rng.standard_normal(rate.shape),
    )


def found(imu: ImuStream) -> list:
    check = ImuCheck("/imu")
    check.add(imu)
    return check.findings()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("turn", "sway"), [(0.0, 0.0), (0.3, 0.03), (0.6, 0.05)])
def test_a_calibrated_imu_is_clean(turn, sway, seed) -> None:
    imu = rocking_imu(turn, sway, seed)
    assert found(imu) == []
    assert found(replace(imu, orientation=None)) == []


@pytest.mark.parametrize("gain", [0.98, 1.01, 1.05])
@pytest.mark.parametrize(("turn", "sway"), [(0.0, 0.0), (0.3, 0.03)])
def test_an_accelerometers_gain(turn, sway, gain) -> None:
    imu = rocking_imu(turn, sway)
    imu = replace(imu, linear_acceleration=gain * imu.linear_acceleration)
    (finding,) = found(imu)
    assert (finding.kind, finding.severity) == (Kind.ACCELEROMETER_GAIN, Severity.WARNING)
    assert finding.figures["gain"] == pytest.approx(gain, abs=2e-3)
    assert "gravity" in finding.message


def test_a_short_log_says_nothing_of_gains() -> None:
    imu = rocking_imu()
    check = ImuCheck("/imu")
    short = {name: getattr(imu, name)[: 8 * RATE] for name in ("stamp", "angular_velocity")}
    force = 1.05 * imu.linear_acceleration[: 8 * RATE]
    check.add(replace(imu, orientation=None, linear_acceleration=force, **short))
    assert check.findings() == []


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_a_gyroscopes_gain_differs_from_the_orientations(gain) -> None:
    imu = rocking_imu()
    imu = replace(imu, angular_velocity=gain * imu.angular_velocity)
    (finding,) = found(imu)
    assert (finding.kind, finding.severity) == (Kind.GYROSCOPE_GAIN, Severity.WARNING)
    assert finding.figures["gain"] == pytest.approx(gain, abs=5e-3)
    assert "orientation" in finding.message


@pytest.mark.parametrize("gain", [0.85, 1.15])
def test_a_gyroscopes_gain_differs_from_the_turn_of_gravity(gain) -> None:
    imu = replace(rocking_imu(0.6, 0.0), orientation=None)
    imu = replace(imu, angular_velocity=gain * imu.angular_velocity)
    (finding,) = found(imu)
    assert finding.kind is Kind.GYROSCOPE_GAIN
    assert finding.figures["gain"] == pytest.approx(gain, abs=0.02)
    assert "gravity" in finding.message


def test_a_gain_is_the_value_nearest_to_one_that_noise_allows() -> None:
    rng = np.random.default_rng(2)
    truth = rng.standard_normal(10_000)
    expected = truth + 0.3 * rng.standard_normal(len(truth))
    for gain in (0.5, 1.0, 2.0):
        read = gain * (truth + 0.3 * rng.standard_normal(len(truth)))
        told, std = proportional_gain(expected @ expected, expected @ read, read @ read, len(read))
        assert abs(told - 1) <= abs(gain - 1) + 0.01
        assert abs(told - gain) <= 0.1 * gain
        assert std == pytest.approx(told * 0.42 / 100, rel=0.1)


def joints(times: np.ndarray, *, filled: bool = True) -> JointStream:
    """Return joint states sampled at other times than their stamps."""
    rng = np.random.default_rng(3)
    omega = 2 * np.pi * rng.uniform(0.2, 1.0, 4)
    angle = np.outer(times, omega) + np.arange(4)
    noise = rng.standard_normal((2, *angle.shape))
    velocity = 0.5 * omega * np.cos(angle) + 5e-3 * noise[1]
    return JointStream(
        "/joints",
        ("a", "b", "c", "d"),
        STAMP,
        0.5 * np.sin(angle) + 3e-5 * noise[0],
        velocity if filled else np.full_like(velocity, np.nan),
        np.zeros_like(velocity),
    )


def jitter_of(stream: JointStream) -> list:
    check = JitterCheck("/joints")
    for start in range(0, len(STAMP), 5000):
        check.add(stream, (STAMP[start], int(STAMP[start]) + 5000 * 1_000_000_000 // RATE))
    return check.findings()


@pytest.mark.parametrize("filled", [True, False])
def test_samples_of_their_stamps_are_clean(filled) -> None:
    assert jitter_of(joints(TIME, filled=filled)) == []
    rng = np.random.default_rng(5)
    coarse = joints(TIME, filled=filled)
    coarse.position[:] = np.round(coarse.position, 4)
    assert jitter_of(coarse) == []
    # Irregular stamps are right if the samples were taken then.
    times = TIME + rng.uniform(-1e-3, 1e-3, len(TIME))
    irregular = replace(joints(times, filled=filled), stamp=np.round(times * 1e9).astype(np.int64))
    assert jitter_of(irregular) == []


@pytest.mark.parametrize("filled", [True, False])
def test_samples_that_jitter_about_their_stamps(filled) -> None:
    late = np.random.default_rng(4).uniform(-5e-3, 5e-3, len(TIME))
    (finding,) = jitter_of(joints(TIME + late, filled=filled))
    assert (finding.kind, finding.severity) == (Kind.JITTER, Severity.WARNING)
    assert finding.figures["jitter_ms"] == pytest.approx(5 / np.sqrt(3), rel=0.15)


def test_stamps_that_wander_slowly() -> None:
    late = 5e-3 * np.sin(2 * np.pi * 0.9 * TIME)
    (finding,) = jitter_of(joints(TIME + late))
    assert finding.kind is Kind.JITTER
    # Without velocities a slow change of the clock looks like motion.
    assert jitter_of(joints(TIME + late, filled=False)) == []


def test_velocities_of_another_scale_are_no_jitter() -> None:
    stream = joints(TIME)
    assert jitter_of(replace(stream, velocity=1.05 * stream.velocity + 0.01)) == []
