"""Compares an IMU's angular velocity with that of the joints above a standing foot."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.imu_gain import gyroscope_findings, proportional_gain
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import (
    JointTable,
    Posture,
    component_first,
    link_poses,
    link_velocity,
)
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.decimation import Decimator
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples, decimated, smoothed

# Calibration errors are tenths of a degree. Larger angles than the second make a log unusable.
SMALLEST_ANGLE = np.radians(1.5)
LARGEST_ANGLE = np.radians(5.0)
# Rotations with a larger standard deviation are not reported.
MAX_ANGLE_STD = np.radians(2.0)
# A larger unexplained share of the joints' rate means that no foot stands.
MOST_LEFT = 0.3
# A mirrored gyroscope must reduce the residual by this factor.
MIRROR_RATIO = 3.0
# Rolling contacts and soft floors change the scale of the rate within this range.
SCALES = 0.6, 1.6
DEVIATIONS = 5.0

# Hz; above it, soft floors and soles let a standing foot rotate.
CUTOFF = 20.0
RATE = 200.0  # Hz at which angular velocities are compared
LONGEST_DELAY = 0.1  # s
# A sole stands if it carries this share of the robot's weight. It transmits moments.
STANDING_LOAD = 0.25
# With three or more feet, which may be points, each stands if it carries this share.
POINT_LOAD = 0.05
FEWEST_POINTS = 3
# Feet on a line or in one spot do not determine the rotation about that line.
LEAST_SPREAD = 0.01


@dataclass
class StanceGyroMoments:
    """Moments of one IMU's angular velocity and of the joints', accumulated by segment.

    Both are in the IMU's axes, minus their means over each segment to remove the gyroscope's bias.

    Attributes
    ----------
    model : RobotModel
        Kinematics, and the weight that determines which foot stands.
    imu : int
        Index of the IMU in the log.
    step : float
        Time between shifts, s.
    """

    model: RobotModel
    imu: int
    count: int = 0
    step: float = 0.0
    cross: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    expected: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    read: FloatArray = field(default_factory=lambda: np.zeros(0))
    slope_square: float = 0.0

    def add(self, segment: Segment) -> None:
        """Add the samples of a segment at which a foot stands."""
        low_pass = LowPass(min(CUTOFF, 0.1 * segment.rate), passes=1)
        stride = max(1, round(segment.rate / RATE))
        shifts = max(1, int(LONGEST_DELAY * segment.rate / stride))
        if self.step == 0.0:
            self.step = stride / segment.rate
            self.cross = np.zeros((2 * shifts + 1, 3, 3))
            self.read = np.zeros(2 * shifts + 1)
        shifts = len(self.cross) // 2
        edge = low_pass.settling(segment.rate)
        if len(segment) - 2 * edge <= 4 * shifts * stride:
            return
        if stride == 1:
            readings = smoothed(segment, low_pass)
        else:
            protected = low_pass.cutoff
            readings = decimated(
                segment, Decimator(segment.rate, stride, low_pass, protected, edge)
            )
        count = len(readings)
        inner = slice(shifts, count - shifts)
        read = readings.angular_velocity[:, self.imu]
        read = read - read.mean(axis=0)
        square = np.sum(read**2, axis=1)
        for expected, is_standing in self._joint_rates(readings):
            stands = is_standing[inner]
            if stands.sum() <= 2 * shifts:
                continue
            swing = (expected[inner] - expected[inner][stands].mean(axis=0)) * stands[:, None]
            # The swing is zero where no foot stands, and so is its sum. The means over standing
            # samples are thus subtracted from the sums of squares alone.
            weight = stands.astype(np.float64)
            for shift in range(2 * shifts + 1):
                late = slice(shift, shift + len(stands))
                self.cross[shift] += swing.T @ read[late]
                total = weight @ read[late]
                self.read[shift] += weight @ square[late] - total @ total / weight.sum()
            self.expected += swing.T @ swing
            self.slope_square += float(np.sum((np.diff(swing, axis=0) / self.step) ** 2))
            self.count += int(stands.sum())

    def _joint_rates(self, readings: SensorSamples) -> Iterator[tuple[FloatArray, BoolArray]]:
        """Yield angular velocities (N, 3) of the IMU in its axes, and where (N,) they are valid."""
        weight = float(np.linalg.norm(self.model.gravity) * self.model.phi[:, 0].sum())
        share = np.linalg.norm(readings.wrenches[:, :, 3:], axis=2) / weight
        # There is no joint between the base and a sensor on the base.
        feet = [
            index
            for index, frame in enumerate(readings.wrench_frames)
            if self.model.frame(frame).link
        ]
        imu_frame = readings.imu_frames[self.imu]
        motion = RelativeLinkMotion.of(self.model, readings.position, readings.velocity)
        if len(feet) < FEWEST_POINTS:
            for foot in feet:
                if not readings.wrenches[:, foot, :3].any():  # a foot rolls on a point
                    continue
                link = self.model.frame(readings.wrench_frames[foot]).link
                expected = motion.rate(self.model, imu_frame, -motion.omega[:, link])
                yield expected, np.asarray(share[:, foot] > STANDING_LOAD)
            return
        is_loaded = share[:, feet] > POINT_LOAD
        frames = tuple(readings.wrench_frames[foot] for foot in feet)
        base_rate, is_determined = base_rate_over_feet(self.model, frames, readings, is_loaded)
        yield motion.rate(self.model, imu_frame, base_rate.T), is_determined


@dataclass(frozen=True)
class RelativeLinkMotion:
    """Motion of the links relative to the base, component first.

    Attributes
    ----------
    omega : (3, L, N) float64
        Angular velocities in base axes.
    rotation : (3, 3, L, N) float64
        Rotations from link axes to base axes.
    """

    omega: FloatArray
    rotation: FloatArray

    @classmethod
    def of(
        cls, model: RobotModel, position: FloatArray, velocity: FloatArray
    ) -> "RelativeLinkMotion":
        """Return the motion for joint positions and velocities (N, J)."""
        posture = Posture.at(JointTable.of(model.joints), component_first(position))
        rest = np.zeros((3, len(position)))
        omega, _ = link_velocity(posture, component_first(velocity), rest, rest)
        return cls(omega, posture.rotation)

    def rate(self, model: RobotModel, frame: str, base: FloatArray) -> FloatArray:
        """Return the angular velocity (N, 3) of a frame in its axes, given the base's (3, N)."""
        mount = model.frame(frame)
        axes = np.einsum("ikn,kj->ijn", self.rotation[:, :, mount.link], mount.rotation)
        rate: FloatArray = np.einsum("ijn,in->nj", axes, base + self.omega[:, mount.link])
        return rate


def base_rate_over_feet(
    model: RobotModel, feet: tuple[str, ...], readings: SensorSamples, is_loaded: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Return the base's angular velocity over feet whose origins are fixed.

    Feet may roll, but three fixed points determine a body's motion: the least-squares solution of
    J_base V + J_joints q̇ = 0 for the linear velocities of the loaded feet (N, F).

    Returns
    -------
    (N, 3) float64, (N,) bool
        Angular velocities in base axes, and where they are determined.
    """
    jacobian = contact_jacobian(model, feet, link_poses(model, readings.position))
    jacobian = jacobian.reshape(len(readings), len(feet), 2, 3, model.dof)[:, :, 1]
    jacobian = jacobian * is_loaded[:, :, None, None]
    base = jacobian[..., :6].reshape(len(readings), -1, 6)
    carried = np.einsum("nfij,nj->nfi", jacobian[..., 6:], readings.velocity)
    moment = np.swapaxes(base, 1, 2) @ base
    # Schur complement of the angular part after eliminating translation: spread of the feet, m².
    count = np.maximum(is_loaded.sum(axis=1), 1)[:, None, None]
    spread = moment[:, :3, :3] - moment[:, :3, 3:] @ moment[:, 3:, :3] / count
    is_determined = is_loaded.sum(axis=1) >= FEWEST_POINTS
    is_determined &= np.linalg.eigvalsh(spread)[:, 0] > LEAST_SPREAD * np.trace(
        spread, axis1=1, axis2=2
    )
    target = np.swapaxes(base, 1, 2) @ carried.reshape(len(readings), -1, 1)
    twist = np.zeros((len(readings), 6))
    twist[is_determined] = -np.linalg.solve(moment[is_determined], target[is_determined])[:, :, 0]
    return twist[:, :3], is_determined


@dataclass(frozen=True)
class GyroFit:
    """Best fit of an IMU's angular velocity to the joints'.

    Attributes
    ----------
    rotation : (3, 3) float64
        From the IMU's axes to those of its frame in the model.
    angle, angle_std : float
        Angle of the rotation and its standard deviation about the least certain axis, rad.
    delay, delay_std : float
        Delay of the IMU relative to the joint states, s.
    left : float
        Unexplained share of the joints' rate.
    mirrored : float
        Unexplained share with one axis of the gyroscope reversed.
    rate : float
        Root mean square of the joints' rate, rad/s.
    scale : float
        Ratio of the IMU's rate to the joints'.
    gain, gain_std : float
        The same without the noise of either, and its standard deviation.
    """

    rotation: FloatArray
    angle: float
    angle_std: float
    delay: float
    delay_std: float
    left: float
    mirrored: float
    rate: float
    scale: float
    gain: float = 1.0
    gain_std: float = 0.0


def fit_gyro(rates: StanceGyroMoments) -> GyroFit | None:
    """Return the best fit over rotations and delays; None if no foot stands."""
    if rates.count == 0 or not rates.expected.any():
        return None
    # Wahba's problem by Kabsch's singular values at each delay, independent of the unit.
    values = np.array([_largest_trace(cross) for cross in rates.cross]) / np.sqrt(
        np.maximum(rates.read, 1e-30)
    )
    best = int(np.argmax(values))
    peak = _peak(values, best)
    delay = (peak - len(values) // 2) * rates.step
    U, singular, Vt = np.linalg.svd(rates.cross[best])
    proper = float(np.sign(np.linalg.det(U @ Vt)))
    rotation = U @ np.diag([1.0, 1.0, proper]) @ Vt
    total = float(np.trace(rates.expected))
    left, mirrored = (
        np.sqrt(max(1 - max(value, 0.0) ** 2 / max(rates.read[best] * total, 1e-30), 0.0))
        for value in (
            singular[0] + singular[1] + proper * singular[2],
            singular[0] + singular[1] - proper * singular[2],
        )
    )
    # The residual may be as slow as the motion, such as from a soft foot or floor.
    pace = min(np.sqrt(rates.slope_square / total) / (2 * np.pi), CUTOFF)
    independent = max(2 * pace * rates.count * rates.step, 1.0)
    error = left * np.sqrt(total / rates.count)
    followed = float(singular[0] + singular[1] + proper * singular[2])
    gain, gain_std = proportional_gain(total, followed, float(rates.read[best]), independent)
    spread = np.linalg.eigvalsh(rates.expected)
    # Rotation about a single axis leaves rounding errors on the others.
    across = np.sqrt(max(float(spread[0] + spread[1]), 0.0) / rates.count)
    return GyroFit(
        rotation=rotation,
        angle=float(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))),
        angle_std=float(error / max(across, 1e-12) / np.sqrt(independent)),
        delay=float(delay),
        delay_std=float(
            error / np.sqrt(max(rates.slope_square, 1e-30) / rates.count) / np.sqrt(independent)
        ),
        left=float(left),
        mirrored=float(mirrored),
        rate=float(np.sqrt(total / rates.count)),
        scale=float(np.sqrt(rates.read[best] / total)),
        gain=gain,
        gain_std=gain_std,
    )


def _largest_trace(cross: FloatArray) -> float:
    """Return the largest trace of R cross over rotations R."""
    U, singular, Vt = np.linalg.svd(cross)
    return float(singular[0] + singular[1] + np.sign(np.linalg.det(U @ Vt)) * singular[2])


def _peak(values: FloatArray, best: int) -> float:
    """Return the maximum of the parabola through the largest value and its neighbours."""
    if best in (0, len(values) - 1):
        return float(best)
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2 * at + after
    return best + (0.5 * (before - after) / bend if bend < 0 else 0.0)


def is_usable(found: GyroFit) -> bool:
    """Return whether a foot stood still while the robot turned."""
    return min(found.left, found.mirrored) < MOST_LEFT


def mounting_findings(topic: str, found: GyroFit) -> Iterator[Finding]:
    """Yield the findings about an IMU's mounting or unit."""
    if not SCALES[0] < found.scale < SCALES[1]:
        yield Finding(
            Kind.UNIT,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity is {found.scale:.3g} times the rate at which the joints "
            "rotate the robot above its feet; use rad/s",
            {"rate_ratio": found.scale},
        )
        return
    if found.mirrored * MIRROR_RATIO < found.left and found.mirrored < MOST_LEFT:
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity matches the joints only with one axis reversed "
            f"(unexplained: {100 * found.mirrored:.1f} % of the rate instead of "
            f"{100 * found.left:.0f} %); correct the sign in the driver",
            {"left": found.left, "left_if_mirrored": found.mirrored},
        )
        return
    if (
        found.left < MOST_LEFT
        and found.angle_std < MAX_ANGLE_STD
        and found.angle > SMALLEST_ANGLE + DEVIATIONS * found.angle_std
    ):
        is_large = found.angle > LARGEST_ANGLE + DEVIATIONS * found.angle_std
        angle, angle_std = np.degrees([found.angle, found.angle_std]).tolist()
        roll, pitch, yaw = Rotation.from_matrix(found.rotation).as_euler("xyz", degrees=True)
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE if is_large else Severity.WARNING,
            f"{topic}: reports in axes rotated by {angle:.1f} ± {angle_std:.1g} degrees from "
            "its frame in the model, according to the joints above a standing foot (roll "
            f"{roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f} in the frame's axes); correct the "
            "frame's orientation in the model, or header.frame_id",
            {
                "angle_deg": angle,
                "angle_std_deg": angle_std,
                "roll_deg": float(roll),
                "pitch_deg": float(pitch),
                "yaw_deg": float(yaw),
            },
        )
    if found.left < MOST_LEFT:
        reference = "the rate at which the joints rotate the robot above its feet"
        yield from gyroscope_findings(topic, found.gain, found.gain_std, reference)
