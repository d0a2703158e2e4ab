"""Feet that stand tell how the base turns, unless they stand in line."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot, random_rotation
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.stance_gyro_check import (
    GyroFit,
    StanceGyroMoments,
    _peak,
    base_rate_over_feet,
    fit_gyro,
    is_usable,
    mounting_findings,
)
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.model.load import load_model
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples

FEET = ("foot_0", "foot_1", "foot_2")
LINK = """<link name="{name}"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at}"/><axis xyz="{axis}"/>
<limit lower="-9" upper="9" effort="80" velocity="20"/></joint>"""


@pytest.fixture(scope="module")
def tripod(tmp_path_factory):
    """Three feet that slide anywhere under a base: any turn of it leaves them where they are."""
    parts = [LINK.format(name="base")]
    for index in range(3):
        parent = "base"
        for axis, letter in zip(("1 0 0", "0 1 0", "0 0 1"), "xyz", strict=True):
            child = FEET[index] if letter == "z" else f"slider_{index}_{letter}"
            parts.append(LINK.format(name=child))
            parts.append(
                JOINT.format(
                    name=f"{letter}_{index}", parent=parent, child=child, at="0 0 0", axis=axis
                )
            )
            parent = child
    path = tmp_path_factory.mktemp("tripod") / "tripod.urdf"
    path.write_text(f'<robot name="tripod">{"".join(parts)}</robot>')
    return load_model(path, "floating")


def stood_on(
    tripod, feet: np.ndarray, loaded: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return truth, told rate and where it is told, of a base that turns over feet at rest."""
    time = np.linspace(0, 1, 21)
    step = 1e-6
    angles = np.outer(time, [0.5, -0.3, 0.8])
    now, then = (Rotation.from_rotvec(angles + dt * np.array([0.5, -0.3, 0.8])) for dt in (0, step))
    truth = (now.inv() * then).as_rotvec() / step

    def seen(rotation: Rotation, sway: float) -> np.ndarray:
        base = np.outer(np.sin(3 * (time + sway)), [0.1, 0.05, 0.2]) + np.array([0, 0, 1.0])
        return np.hstack([rotation.inv().apply(foot - base) for foot in feet])

    position = seen(now, 0.0)
    velocity = (seen(then, step) - position) / step
    order = [tripod.joint_names.index(f"{axis}_{foot}") for foot in range(3) for axis in "xyz"]
    joints = np.zeros((2, len(time), 9))
    joints[0][:, order], joints[1][:, order] = position, velocity
    readings = SensorSamples(
        stamp=np.round(time * 1e9).astype(np.int64),
        position=joints[0],
        velocity=joints[1],
        acceleration=np.zeros_like(joints[0]),
        effort=np.zeros_like(joints[0]),
        **dict.fromkeys(
            ("angular_velocity", "angular_acceleration", "specific_force"),
            np.zeros((len(time), 0, 3)),
        ),
        wrenches=np.zeros((len(time), 3, 6)),
        imu_frames=(),
        wrench_frames=FEET,
    )
    if loaded is None:
        loaded = np.ones((len(time), 3), dtype=bool)
    told, is_told = base_rate_over_feet(tripod, FEET, readings, loaded)
    return truth, told, is_told


def test_a_tripod_tells_how_its_base_turns(tripod) -> None:
    feet = np.array([[0.3, 0, 0], [-0.2, 0.25, 0], [-0.2, -0.25, 0.1]])
    truth, told, is_told = stood_on(tripod, feet)
    assert is_told.all()
    np.testing.assert_allclose(told, truth, atol=1e-4)


@pytest.mark.parametrize("aside", [0.0, 0.02])
def test_three_feet_in_line_do_not(tripod, aside) -> None:
    """Nor do those nearly in line: about that line a foot that gives would turn the base far."""
    feet = np.array([[0.3, 0.3, 0], [0.0, aside, 0], [-0.3, -0.3, 0]])
    _, told, is_told = stood_on(tripod, feet)
    assert not is_told.any()
    assert not told.any()


def test_two_feet_are_too_few(tripod) -> None:
    feet = np.array([[0.3, 0, 0], [-0.2, 0.25, 0], [-0.2, -0.25, 0.1]])
    loaded = np.ones((21, 3), dtype=bool)
    loaded[5:9, 1] = False
    truth, told, is_told = stood_on(tripod, feet, loaded)
    np.testing.assert_array_equal(is_told, loaded.all(axis=1))
    assert not told[~is_told].any()
    np.testing.assert_allclose(told[is_told], truth[is_told], atol=1e-4)


RATE, STEP = 400.0, 1 / 200  # Hz of the log; s of the comparison
SHIFTS = 20  # 0.1 s


def over_a_foot(mounting, *, delay=0.0, scale=1.0, loaded=slice(None), share=0.3):
    """Return a robot and its log on one foot at rest, from rotations of links alone.

    The IMU reports in its frame's axes turned by ``mounting``.
    """
    model = random_robot(11, links=5, wrench_frames=1)
    foot = replace(model.frame("wrench_0"), link=4)
    imu_frame = replace(model.frame("imu_link"), link=1)
    chain = tuple(replace(joint, kind="revolute", parent=k) for k, joint in enumerate(model.joints))
    model = replace(model, frames=(imu_frame, foot), joints=chain)
    time = np.arange(1600) / RATE
    omega = 2 * np.pi * np.array([0.9, 1.3, 1.7, 2.1])

    def position(at):
        return 0.4 * np.sin(omega * at[:, None] + np.arange(4))

    def imu(at):
        poses = link_poses(model, position(at))
        frame = model.frame("imu_link")
        base = poses.rotation[:, 4].swapaxes(1, 2)
        return Rotation.from_matrix(base @ poses.rotation[:, frame.link] @ frame.rotation)

    early = time - delay
    turn = (imu(early - 5e-6).inv() * imu(early + 5e-6)).as_rotvec() / 1e-5
    force = np.zeros((len(time), 1, 6))
    weight = 9.81 * model.phi[:, 0].sum()
    force[loaded, 0, 4] = share * weight
    force[loaded, 0, 0] = 0.02 * share * weight  # Nm, of a sole
    segment = Segment(
        stamp=np.round(time * 1e9).astype(np.int64),
        rate=RATE,
        position=position(time),
        effort=np.zeros((len(time), 4)),
        # With a bias, which does not matter.
        angular_velocity=(scale * turn @ mounting + 0.3)[:, None],
        linear_acceleration=np.zeros((len(time), 1, 3)),
        wrenches=force,
        imu_frames=("imu_link",),
        wrench_frames=("wrench_0",),
    )
    return model, segment, turn


def fitted(model, *segments):
    moments = StanceGyroMoments(model, 0)
    for segment in segments:
        moments.add(segment)
    return moments, fit_gyro(moments)


@pytest.mark.parametrize(
    ("delay", "scale"), [(0.0, 1.0), (0.012, 0.5), (-0.03, 57.3), (0.095, 1.0), (-0.095, 1.0)]
)
@pytest.mark.parametrize("seed", [0, 1])
def test_rotation_delay_and_scale_of_a_gyroscope_are_found(delay, scale, seed) -> None:
    mounting = random_rotation(np.random.default_rng(seed))
    model, segment, turn = over_a_foot(mounting, delay=delay, scale=scale)
    moments, found = fitted(model, segment)
    assert moments.step == pytest.approx(STEP)
    assert len(moments.cross) == len(moments.read) == 2 * SHIFTS + 1
    # What a delay between two shifts leaves.
    assert found.left < 0.03
    assert found.mirrored > 0.2
    np.testing.assert_allclose(found.rotation, mounting, atol=5e-3)
    assert found.angle == pytest.approx(Rotation.from_matrix(mounting).magnitude(), abs=5e-3)
    assert found.delay == pytest.approx(delay, abs=1e-3)
    assert found.scale == pytest.approx(scale, rel=0.02)
    rms = np.sqrt(np.mean(np.sum((turn - turn.mean(axis=0)) ** 2, axis=1)))
    assert found.rate == pytest.approx(rms, rel=0.05)
    slope = np.gradient(turn, 1 / RATE, axis=0)
    pace = np.sqrt(np.mean(np.sum(slope**2, axis=1)))
    assert np.sqrt(moments.slope_square / moments.count) == pytest.approx(pace, rel=0.05)


@pytest.mark.parametrize(("frequency", "is_seen"), [(5.0, True), (120.0, False)])
def test_vibrations_above_the_cutoff_do_not_count(frequency, is_seen) -> None:
    model, segment, turn = over_a_foot(np.eye(3))
    size = np.sqrt(np.mean(np.sum(turn**2, axis=1)))
    shake = size * np.sin(2 * np.pi * frequency * segment.stamp * 1e-9)
    shaken = segment.angular_velocity + shake[:, None, None] * [1.0, 0.0, 0.0]
    _, found = fitted(model, replace(segment, angular_velocity=shaken))
    assert (found.left > 0.3) is is_seen
    assert (found.left < 0.05) is not is_seen


def test_only_times_under_load_count() -> None:
    model, segment, _ = over_a_foot(np.eye(3), loaded=slice(400, 1000))
    moments, found = fitted(model, segment)
    # The filter moves the edges by a sample or two.
    assert moments.count == pytest.approx(300, abs=4)
    assert found.left < 0.02
    for share in (0.24, 0.26):
        model, segment, _ = over_a_foot(np.eye(3), share=share)
        moments, found = fitted(model, segment)
        assert (moments.count > 0) == (found is not None) == (share > 0.25)
    # Twice the largest shift at least, and a segment twice as long as that.
    for length in (2 * SHIFTS - 5, 2 * SHIFTS + 5):
        model, segment, _ = over_a_foot(np.eye(3), loaded=slice(400, 400 + 2 * length))
        count = fitted(model, segment)[0].count
        assert count == (pytest.approx(length, abs=4) if length > 2 * SHIFTS else 0)


def test_a_foot_that_transmits_no_moment_may_roll() -> None:
    """A ball turns with the shank, so it does not tell how the robot turns."""
    model, segment, _ = over_a_foot(np.eye(3))
    force = segment.wrenches * np.repeat([0.0, 1.0], 3)
    assert fitted(model, replace(segment, wrenches=force))[1] is None


def test_segments_add_up_and_short_ones_are_ignored() -> None:
    model, segment, _ = over_a_foot(np.eye(3))
    whole, _ = fitted(model, segment)
    parts, found = fitted(model, segment.cut(0, 800), segment.cut(0, 100), segment.cut(800, 1600))
    assert 0.8 * whole.count < parts.count < whole.count
    assert found.left < 0.02
    assert found.rate == pytest.approx(fit_gyro(whole).rate, rel=0.1)
    swing = np.trace(parts.expected) / parts.count
    assert swing == pytest.approx(np.trace(whole.expected) / whole.count, rel=0.2)
    # A sensor on the base has no joint above it.
    base = tuple(replace(frame, link=0) for frame in model.frames)
    assert fitted(replace(model, frames=base), segment)[1] is None


def moments_of(expected, read, count, step=STEP):
    """Return the moments of rates (N, 3), the IMU's at one shift."""
    slope = np.sum((np.diff(expected, axis=0) / step) ** 2)
    cross = np.zeros((3, 3, 3))
    cross[1] = expected.T @ read
    return StanceGyroMoments(
        None, 0, count, step, cross, expected.T @ expected, np.full(3, np.sum(read**2)), slope
    )


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_what_no_rotation_explains_is_left(seed, mirrored) -> None:
    """Against SciPy's solution of Wahba's problem, and the Fisher information of its residual."""
    rng = np.random.default_rng(seed)
    count = 400
    time = STEP * np.arange(count)
    expected = np.sin(np.outer(time, [7.0, 11.0, 5.0]) + np.arange(3)) * [1.0, 0.3, 0.5]
    expected -= expected.mean(axis=0)
    read = 0.7 * expected @ random_rotation(rng) + 0.1 * rng.normal(size=expected.shape)
    if mirrored:
        read[:, 1] *= -1
    found = fit_gyro(moments_of(expected, read, count))
    left = []
    for sign in (1, -1):
        rotation, _ = Rotation.align_vectors(expected, sign * read)
        turned = rotation.apply(sign * read)
        fit = np.sum(turned * expected) / np.sum(turned**2)
        left.append(np.linalg.norm(expected - fit * turned) / np.linalg.norm(expected))
        if sign == 1:
            np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-6)
            assert found.angle == pytest.approx(rotation.magnitude())
    assert (found.left, found.mirrored) == pytest.approx(tuple(left))
    assert found.scale == pytest.approx(np.linalg.norm(read) / np.linalg.norm(expected))
    assert found.rate == pytest.approx(np.sqrt(np.mean(np.sum(expected**2, axis=1))))
    # Independent samples: two per period of the mean frequency of the motion.
    slope = np.diff(expected, axis=0) / STEP
    frequency = np.sqrt(np.sum(slope**2) / np.sum(expected**2)) / (2 * np.pi)
    sigma = found.left * found.rate * np.sqrt(count / (2 * frequency * count * STEP))
    information = sum(np.eye(3) * (x @ x) - np.outer(x, x) for x in expected)
    assert found.angle_std == pytest.approx(sigma / np.sqrt(np.linalg.eigvalsh(information)[0]))
    assert found.delay_std == pytest.approx(sigma / np.sqrt(np.sum(slope**2)))


def test_without_a_standing_foot_there_is_no_fit() -> None:
    rates = np.random.default_rng(0).normal(size=(9, 3))
    assert fit_gyro(moments_of(rates, rates, 0)) is None
    assert fit_gyro(moments_of(0 * rates, rates, 9)) is None
    assert fit_gyro(moments_of(rates, rates, 9)).left == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("values", "peak"),
    [
        ([-((x - 2.3) ** 2) for x in range(6)], 2.3),
        ([-3 * (x - 1.8) ** 2 for x in range(6)], 1.8),
        ([5.0, 4.0, 1.0], 0.0),
        ([1.0, 4.0, 5.0], 2.0),
        ([2.0, 2.0, 2.0], 1.0),
    ],
)
def test_the_peak_is_a_parabolas(values, peak) -> None:
    best = int(np.argmax(values)) if len(set(values)) > 1 else 1
    assert _peak(np.array(values), best) == pytest.approx(peak)


def fit(**changes):
    nominal = GyroFit(np.eye(3), 0.0, 0.0, 0.0, 0.0, left=0.05, mirrored=0.9, rate=1.0, scale=1.0)
    return replace(nominal, **changes)


@pytest.mark.parametrize(
    ("left", "mirrored", "expected"),
    [(0.29, 0.9, True), (0.31, 0.9, False), (0.9, 0.29, True), (0.9, 0.31, False)],
)
def test_a_fit_is_usable_if_it_explains_seven_tenths(left, mirrored, expected) -> None:
    assert is_usable(fit(left=left, mirrored=mirrored)) is expected


@pytest.mark.parametrize(
    ("found", "kind", "figures"),
    [
        (fit(), None, {}),
        (fit(scale=0.61), None, {}),
        (fit(scale=1.59), None, {}),
        (fit(scale=0.59), Kind.UNIT, {"rate_ratio": 0.59}),
        (fit(scale=1.61, angle=1.0), Kind.UNIT, {"rate_ratio": 1.61}),
        (
            fit(left=0.91, mirrored=0.29),
            Kind.IMU_MOUNTING,
            {"left": 0.91, "left_if_mirrored": 0.29},
        ),
        (fit(left=0.85, mirrored=0.29), None, {}),
        (fit(left=0.95, mirrored=0.31), None, {}),
        (fit(left=0.2, mirrored=0.06, angle=1.0), Kind.IMU_MOUNTING, {"left": 0.2}),
        (fit(angle=np.radians(5.1)), Kind.IMU_MOUNTING, {"angle_deg": 5.1, "angle_std_deg": 0.0}),
        (fit(angle=np.radians(1.6)), Kind.IMU_MOUNTING, {"angle_deg": 1.6}),
        (fit(angle=np.radians(1.4)), None, {}),
        (fit(angle=np.radians(6.4), angle_std=np.radians(1.0)), None, {}),
        (fit(angle=np.radians(6.6), angle_std=np.radians(1.0)), Kind.IMU_MOUNTING, {}),
        (fit(gain=1.049), None, {}),
        (fit(gain=0.951), None, {}),
        (fit(gain=1.051), Kind.GYROSCOPE_GAIN, {"gain": 1.051}),
        (fit(gain=0.949), Kind.GYROSCOPE_GAIN, {"gain": 0.949}),
        (fit(gain=1.099, gain_std=0.01), None, {}),
        (fit(gain=1.101, gain_std=0.01), Kind.GYROSCOPE_GAIN, {"gain_std": 0.01}),
        (fit(gain=1.2, left=0.31), None, {}),
        (
            fit(angle=np.radians(10.1), angle_std=np.radians(1.0)),
            Kind.IMU_MOUNTING,
            {"angle_deg": 10.1, "angle_std_deg": 1.0},
        ),
        (fit(angle=1.0, angle_std=np.radians(1.9)), Kind.IMU_MOUNTING, {}),
        (fit(angle=1.0, angle_std=np.radians(2.1)), None, {}),
        (fit(angle=1.0, left=0.29), Kind.IMU_MOUNTING, {}),
        (fit(angle=1.0, left=0.31), None, {}),
    ],
)
def test_mounting_and_unit_are_judged(found, kind, figures) -> None:
    findings = list(mounting_findings("/imu", found))
    assert [one.kind for one in findings] == ([] if kind is None else [kind])
    for one in findings:
        assert {name: one.figures[name] for name in figures} == pytest.approx(figures)


@pytest.mark.parametrize(
    ("angle", "std", "severity"),
    [
        (4.9, 0.0, Severity.WARNING),
        (5.1, 0.0, Severity.UNUSABLE),
        (9.9, 1.0, Severity.WARNING),
        (10.1, 1.0, Severity.UNUSABLE),
    ],
)
def test_a_log_with_a_large_angle_is_unusable(angle, std, severity) -> None:
    (one,) = mounting_findings("/imu", fit(angle=np.radians(angle), angle_std=np.radians(std)))
    assert (one.kind, one.severity) == (Kind.IMU_MOUNTING, severity)
