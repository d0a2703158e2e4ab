"""IMU checks on either side of their limits, and the closed form of unexplained rates."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_rotation
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.imu_checks import ImuCheck, QuaternionCheck, RateComparison
from symbid_ros.signals.streams import ImuStream, JointStream, Slice, Streams

PERIOD = 10_000_000  # ns
COUNT = 1501
TIME = np.arange(COUNT) * 1e-2
OMEGA = 2 * np.pi * np.array([0.6, 0.4, 0.8])
DEGREES = 180 / np.pi


def stream(rotation, rate, force=(0.0, 0.0, 9.81)):
    force = np.broadcast_to(force, (COUNT, 3)).copy()
    quaternion = rotation.as_quat() if isinstance(rotation, Rotation) else rotation
    return ImuStream("/imu", "imu", PERIOD * np.arange(COUNT), quaternion, rate, force)


def turning(amplitude=0.4):
    """Return rotations in time and their angular velocities, by differences of a microsecond."""

    def at(time):
        return Rotation.from_rotvec(amplitude * np.sin(np.outer(time, OMEGA) + np.arange(3)))

    return at(TIME), (at(TIME - 5e-7).inv() * at(TIME + 5e-7)).as_rotvec() / 1e-6


def findings(imu, *cuts):
    check = ImuCheck("/imu")
    for first, stop in zip((0, *cuts), (*cuts, COUNT), strict=True):
        part = slice(first, stop)
        check.add(
            replace(
                imu,
                stamp=imu.stamp[part],
                orientation=None if imu.orientation is None else imu.orientation[part],
                angular_velocity=imu.angular_velocity[part],
                linear_acceleration=imu.linear_acceleration[part],
            )
        )
    return check.findings()


@pytest.mark.parametrize(
    ("size", "kind", "says"),
    [
        (0.51 * 9.81, Kind.ACCELEROMETER_GAIN, "-49.0 % from gravity"),
        (0.9935 * 9.81, Kind.ACCELEROMETER_GAIN, "-0.6 % from gravity"),
        (0.9945 * 9.81, None, ""),
        (1.0055 * 9.81, None, ""),
        (1.0065 * 9.81, Kind.ACCELEROMETER_GAIN, "+0.7 % from gravity"),
        (4.99 * 9.81, Kind.ACCELEROMETER_GAIN, "+399.0 % from gravity"),
        (5.01 * 9.81, Kind.UNIT, "is 49.1 on average, not 9.81"),
        (0.49 * 9.81, Kind.GRAVITY, "lacks gravity"),
        (1.29, Kind.UNIT, "as if in g"),
        (1.31, Kind.GRAVITY, "lacks gravity"),
        (0.78, Kind.UNIT, "as if in g"),
        (0.76, Kind.GRAVITY, "lacks gravity"),
        (0.0, Kind.GRAVITY, "lacks gravity"),
    ],
)
def test_the_mean_specific_force_is_near_gravity(size, kind, says):
    """Readings that are not finite do not count."""
    imu = stream(np.zeros((COUNT, 4)), np.zeros((COUNT, 3)), size * np.array([0.6, 0, 0.8]))
    imu.linear_acceleration[::7, 1] = np.nan
    found = findings(replace(imu, orientation=None), 700)
    assert [one.kind for one in found] == ([] if kind is None else [kind])
    for one in found:
        assert says in one.message
        is_gain = kind is Kind.ACCELEROMETER_GAIN
        assert one.severity is (Severity.WARNING if is_gain else Severity.UNUSABLE)
        assert one.figures["mean_m_s2"] == pytest.approx(size)
        assert ("gain" in one.figures) is is_gain
    imu.linear_acceleration[:] = np.nan
    assert findings(imu) == []


@pytest.mark.parametrize(("gravity", "kind"), [(9.81, None), (0.0, Kind.GRAVITY)])
def test_fast_motion_does_not_hide_that_gravity_was_removed(gravity, kind):
    """The readings of a jumping robot are as large as gravity, but their mean is not."""
    rotation, rate = turning()
    shakes = 15.0 * np.sin(2 * np.pi * np.outer(TIME, [2.0, 3.0, 2.5]))
    imu = stream(rotation, rate, rotation.inv().apply(shakes + np.array([0.0, 0.0, gravity])))
    found = findings(imu, 700)
    assert [one.kind for one in found] == [kind] * (kind is not None)
    assert all("lacks gravity" in one.message for one in found)


@pytest.mark.parametrize(
    ("scale", "kind"),
    [
        (1.0, None),
        (0.955, None),
        (1.045, None),
        (0.945, Kind.GYROSCOPE_GAIN),
        (1.055, Kind.GYROSCOPE_GAIN),
        (0.1, Kind.GYROSCOPE_GAIN),
        (-1.0, Kind.IMU_MOUNTING),
        (DEGREES * 1.296, Kind.UNIT),
        (DEGREES * 1.304, Kind.GYROSCOPE_GAIN),
        (DEGREES / 1.296, Kind.UNIT),
        (DEGREES / 1.304, Kind.GYROSCOPE_GAIN),
    ],
)
@pytest.mark.parametrize("cuts", [(), (700,)])
def test_the_scale_of_a_gyroscope_is_judged(scale, kind, cuts):
    """By the orientation, without gravity; a bias does not matter."""
    rotation, rate = turning()
    found = findings(stream(rotation, scale * rate + 0.5, np.full(3, np.nan)), *cuts)
    assert [one.kind for one in found] == ([] if kind is None else [kind])
    for one in found:
        if kind is Kind.GYROSCOPE_GAIN:
            assert one.figures["gain"] == pytest.approx(scale, rel=5e-3)
            assert one.severity is Severity.WARNING
            continue
        assert one.figures["rate_ratio"] == pytest.approx(abs(scale), rel=2e-3)
        assert one.figures["left"] == pytest.approx(1.0 if scale < 0 else 0.0, abs=0.1)
        assert one.severity is Severity.UNUSABLE


@pytest.mark.parametrize("scale", [1.0, 0.5, 1.3])
def test_a_wrong_gyroscope_is_not_the_accelerometers_fault(scale):
    """Forces are turned by the angular velocity before they are averaged."""
    rotation, rate = turning()
    force = rotation.inv().apply([0.0, 0.0, 9.81])
    found = findings(stream(rotation, scale * rate, force))
    assert [one.kind for one in found] == [Kind.GYROSCOPE_GAIN] * (scale != 1)


@pytest.mark.parametrize(("amplitude", "is_found"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("slow", ["gyroscope", "orientation"])
def test_slow_rotations_are_not_compared(amplitude, is_found, slow):
    """Both rates must exceed 0.03 rad/s."""
    # Small rotations have rates in proportion to their size.
    rotation, rate = turning(1e-3)
    size = amplitude * 0.03 / np.sqrt(np.mean(np.sum(rate**2, axis=1)))
    if slow == "gyroscope":
        rotation, rate = turning()
        rate *= -amplitude * 0.03 / np.sqrt(np.mean(np.sum(rate**2, axis=1)))
    else:
        rotation, rate = turning(1e-3 * size)
        rate = -10 * rate
    assert len(findings(stream(rotation, rate))) == is_found


@pytest.mark.parametrize("cuts", [(), (700,)])
def test_rotated_axes_are_found_with_their_angle(cuts):
    rotation, rate = turning()
    for angle in (70.0, 180.0):
        turn = Rotation.from_rotvec(np.radians(angle) * np.array([0.6, 0.0, 0.8])).as_matrix()
        (found,) = findings(stream(rotation, rate @ turn), *cuts)
        assert found.kind is Kind.IMU_MOUNTING
        assert found.figures["angle_deg"] == pytest.approx(angle, abs=0.5)
        assert f"rotated by {angle:.0f} degrees" in found.message
        euler = [found.figures[f"{one}_deg"] for one in ("roll", "pitch", "yaw")]
        mounting = Rotation.from_euler("xyz", euler, degrees=True)
        np.testing.assert_allclose(mounting.as_matrix(), turn, atol=0.01)
    (found,) = findings(stream(rotation, rate * [1, 1, -1]), *cuts)
    assert "an axis reversed" in found.message
    assert "angle_deg" not in found.figures


def test_w_first_is_found_and_noise_is_no_fault():
    rotation, rate = turning()
    (found,) = findings(stream(np.roll(rotation.as_quat(), 1, axis=1), rate), 700)
    assert (found.kind, found.severity) == (Kind.ORIENTATION, Severity.WARNING)
    noise = np.random.default_rng(0).normal(size=rate.shape)
    assert findings(stream(rotation, noise)) == []


def test_unknown_orientations_and_rates_are_left_out():
    rotation, rate = turning()
    imu = stream(rotation, -rate)
    (clean,) = findings(imu)
    imu.orientation[::5] = 0.0
    imu.orientation[1::50] = np.nan
    imu.orientation[2::50] *= 1.5
    imu.angular_velocity[3::50] = np.nan
    (found,) = findings(imu)
    assert found.kind is clean.kind
    assert found.figures["rate_ratio"] == pytest.approx(1, rel=0.02)
    # Norms that are off by less than a tenth are known.
    imu = stream(1.09 * rotation.as_quat(), -rate)
    assert len(findings(imu)) == 1
    imu = stream(1.11 * rotation.as_quat(), -rate, np.full(3, np.nan))
    assert findings(imu) == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_unexplained_rates_are_those_of_the_best_rotation(seed, mirrored):
    """Against SciPy's solution of Wahba's problem and a line through the origin."""
    rng = np.random.default_rng(seed)
    rate = rng.normal(size=(50, 3)) * [1.0, 0.5, 2.0]
    gyro = 0.3 * rate @ random_rotation(rng) + 0.2 * rng.normal(size=rate.shape)
    if mirrored:
        gyro[:, 0] *= -1
    moments = RateComparison(rate.T @ gyro, float(np.sum(rate**2)))
    square = float(np.sum(gyro**2))

    def left(other):
        fit = max(np.sum(rate * other) / np.sum(other**2), 0.0)
        return np.linalg.norm(rate - fit * other) / np.linalg.norm(rate)

    for sign in (1, -1):
        turn, _ = Rotation.align_vectors(rate, sign * gyro)
        expected = left(turn.apply(sign * gyro))
        assert moments.unexplained(square, mirrored=sign < 0) == pytest.approx(expected)
        if sign > 0:
            assert (moments.rotation * turn.inv()).magnitude() == pytest.approx(0.0, abs=1e-6)
    assert moments.unexplained(square, turned=False) == pytest.approx(left(gyro))
    assert RateComparison().unexplained(1.0, turned=False) == 1.0


def test_moments_have_no_bias():
    rotation, _ = turning()
    comparison = RateComparison()
    first = np.arange(0, COUNT - 5, 5)
    seconds = np.full(len(first), 0.05)
    gyro = np.random.default_rng(1).normal(size=(len(first), 3))
    quaternion = rotation.as_quat()
    for _ in range(2):
        comparison.add(quaternion[first], quaternion[first + 5], seconds, gyro)
    turn = (rotation[first].inv() * rotation[first + 5]).as_rotvec() / 0.05
    turn -= turn.mean(axis=0)
    np.testing.assert_allclose(comparison.cross, 2 * turn.T @ gyro)
    assert comparison.orientation_square == pytest.approx(2 * np.sum(turn**2))


def piece(orientation, start, stop, topic="/imu"):
    count = 0 if orientation is None else len(orientation)
    stamp = np.arange(10, dtype=np.int64)
    other = np.zeros((10, 3))
    assert count in (0, 10)
    joints = JointStream("/joints", ("hip",), stamp, *[np.zeros((10, 1))] * 3)
    imus = (ImuStream(topic, "imu", stamp, orientation, other, other),)
    return Slice(start, stop, Streams("log", joints, imus, ()), {}, ())


def test_quaternions_of_another_norm_are_counted_within_their_slice():
    unit = np.tile([0.0, 0.6, 0.0, 0.8], (10, 1))
    check = QuaternionCheck("/imu")
    check.add(piece(unit, 0, 10))
    check.add(piece(unit * 1.0009, 0, 10))
    check.add(piece(unit * 0.9991, 0, 10))
    assert (check.messages, check.wrong, check.findings()) == (30, 0, [])
    wrong = unit * np.array([1, 0.998, 1, 1.3, 0.5, np.nan, 1, 1, 0.1, 9])[:, None]
    check.add(piece(wrong, 1, 8))
    (finding,) = check.findings()
    assert finding.figures == {"messages": 3, "worst_norm": pytest.approx(0.5)}
    assert (
        "3 of 36 orientations are not unit quaternions, the worst has norm 0.5" in finding.message
    )
    check.add(piece(unit * 1.4, 3, 4))
    assert check.worst == pytest.approx(0.5)
    check.add(piece(unit * 1.6, 3, 4))
    assert (check.wrong, check.worst) == (5, pytest.approx(1.6))
    before = check.messages
    check.add(piece(unit * 2, 0, 10, topic="/other"))
    check.add(piece(None, 0, 10))
    check.add(Slice(0, 10, None, {}, ()))
    assert (check.messages, check.wrong) == (before, 5)
