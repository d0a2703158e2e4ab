"""An IMU's rate of turn against the one that the joints tell while a foot stands."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import JointTable, Posture, link_poses, link_velocity
from symbid_ros.dynamics.spatial import component_first
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples, smoothed

# Calibration leaves tenths of a degree, a wrong axis ninety.
LARGEST_ANGLE = np.radians(5.0)
# A rotation that is known no better says nothing.
LARGEST_DOUBT = np.radians(2.0)
# More of the joints' rate than this is not followed where the foot does not stand.
MOST_LEFT = 0.3
# Mirrored, a gyroscope must follow so many times better to be called so.
MIRRORED = 3.0
# A point that rolls, and a floor that gives, leave a rate of turn within these of itself.
SCALES = 0.6, 1.6
DEVIATIONS = 5.0

# Hz; above it the compliance of floors and soles turns a foot that stands.
CUTOFF = 20.0
RATE = 200.0  # Hz at which rates of turn are compared
LONGEST_DELAY = 0.1  # s
# A sole stands that carries this share of the robot's weight,
STANDING_LOAD = 0.25
# and of three feet and more, which may be points, each that carries this share of it.
POINT_LOAD = 0.05
FEWEST_POINTS = 3
# Feet nearly in line, or on one spot, do not tell how the robot turns about that line.
LEAST_SPREAD = 0.01


@dataclass
class StanceGyroMoments:
    """Moments of one IMU's rate of turn and of the joints', gathered stretch by stretch.

    Both are in the IMU's axes, less their means over each stretch: a gyroscope's bias is no
    fault of its mounting.

    Attributes
    ----------
    model : RobotModel
        Kinematics, and the weight that tells which foot stands.
    imu : int
        Which of the log's IMUs.
    step : float
        s between shifts.
    """

    model: RobotModel
    imu: int
    count: int = 0
    step: float = 0.0
    cross: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    told: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    read: FloatArray = field(default_factory=lambda: np.zeros(0))
    slope_square: float = 0.0

    def add(self, segment: Segment) -> None:
        """Take the instants of a stretch in which some foot stands."""
        low_pass = LowPass(min(CUTOFF, 0.1 * segment.rate), passes=1)
        readings = smoothed(segment, low_pass)
        stride = max(1, round(segment.rate / RATE))
        shifts = max(1, int(LONGEST_DELAY * segment.rate / stride))
        if self.step == 0.0:
            self.step = stride / segment.rate
            self.cross = np.zeros((2 * shifts + 1, 3, 3))
            self.read = np.zeros(2 * shifts + 1)
        shifts = len(self.cross) // 2
        readings = readings[::stride]
        count = len(readings)
        if count <= 4 * shifts:
            return
        inner = slice(shifts, count - shifts)
        read = readings.imus[self.imu].angular_velocity
        for told, is_standing in self._told(readings):
            stands = is_standing[inner]
            if stands.sum() <= 2 * shifts:
                continue
            swing = (told[inner] - told[inner][stands].mean(axis=0)) * stands[:, None]
            for shift in range(2 * shifts + 1):
                late = read[shift : shift + len(stands)]
                late = (late - late[stands].mean(axis=0)) * stands[:, None]
                self.cross[shift] += swing.T @ late
                self.read[shift] += np.sum(late**2)
            self.told += swing.T @ swing
            self.slope_square += float(np.sum((np.diff(swing, axis=0) / self.step) ** 2))
            self.count += int(stands.sum())

    def _told(self, readings: SensorSamples) -> Iterator[tuple[FloatArray, BoolArray]]:
        """Yield rates of turn (N, 3) of the IMU, in its axes, and where (N,) they hold."""
        weight = float(np.linalg.norm(self.model.gravity) * self.model.phi[:, 0].sum())
        share = np.linalg.norm(readings.wrenches[:, :, 3:], axis=2) / weight
        # Between a sensor on the base and the base no joint could tell of turning.
        feet = [
            index
            for index, frame in enumerate(readings.wrench_frames)
            if self.model.frame(frame).link
        ]
        imu_frame = readings.imu_frames[self.imu]
        motion = RelativeLinkMotion.of(self.model, readings.position, readings.velocity)
        if len(feet) < FEWEST_POINTS:
            for foot in feet:
                link = self.model.frame(readings.wrench_frames[foot]).link
                told = motion.rate(self.model, imu_frame, -motion.omega[:, link])
                yield told, np.asarray(share[:, foot] > STANDING_LOAD)
            return
        is_loaded = share[:, feet] > POINT_LOAD
        frames = tuple(readings.wrench_frames[foot] for foot in feet)
        turning, is_told = turning_over(self.model, frames, readings, is_loaded)
        yield motion.rate(self.model, imu_frame, turning.T), is_told


@dataclass(frozen=True)
class RelativeLinkMotion:
    """Links as the joints move them under a base at rest, component first.

    Attributes
    ----------
    omega : (3, L, N) float64
        Rates of turn, in base axes.
    rotation : (3, 3, L, N) float64
        From link axes to base axes.
    """

    omega: FloatArray
    rotation: FloatArray

    @classmethod
    def of(
        cls, model: RobotModel, position: FloatArray, velocity: FloatArray
    ) -> "RelativeLinkMotion":
        """Move joints at positions and velocities (N, J)."""
        posture = Posture.at(JointTable.of(model.joints), component_first(position))
        rest = np.zeros((3, len(position)))
        omega, _ = link_velocity(posture, component_first(velocity), rest, rest)
        return cls(omega, posture.rotation)

    def rate(self, model: RobotModel, frame: str, base: FloatArray) -> FloatArray:
        """Return the rate (N, 3) of a frame, in its axes, on a base that turns at (3, N)."""
        mount = model.frame(frame)
        axes = np.einsum("ikn,kj->ijn", self.rotation[:, :, mount.link], mount.rotation)
        rate: FloatArray = np.einsum("ijn,in->nj", axes, base + self.omega[:, mount.link])
        return rate


def turning_over(
    model: RobotModel, feet: tuple[str, ...], readings: SensorSamples, is_loaded: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Return how the base turns over feet whose origins stay where they are.

    Of feet that may roll no rate of turn is known, but three points fix a body: least squares of
    J_base V + J_joints q̇ = 0 over the linear velocities of those (N, F) that are loaded.

    Returns
    -------
    (N, 3) float64, (N,) bool
        Rates of turn in base axes, and where they are told.
    """
    jacobian = contact_jacobian(model, feet, link_poses(model, readings.position))
    jacobian = jacobian.reshape(len(readings), len(feet), 2, 3, model.dof)[:, :, 1]
    jacobian = jacobian * is_loaded[:, :, None, None]
    base = jacobian[..., :6].reshape(len(readings), -1, 6)
    carried = np.einsum("nfij,nj->nfi", jacobian[..., 6:], readings.velocity)
    moment = np.swapaxes(base, 1, 2) @ base
    # What is left of the angular part once the base may slide anywhere: the feet's spread, m².
    count = np.maximum(is_loaded.sum(axis=1), 1)[:, None, None]
    spread = moment[:, :3, :3] - moment[:, :3, 3:] @ moment[:, 3:, :3] / count
    is_told = is_loaded.sum(axis=1) >= FEWEST_POINTS
    is_told &= np.linalg.eigvalsh(spread)[:, 0] > LEAST_SPREAD * np.trace(spread, axis1=1, axis2=2)
    target = np.swapaxes(base, 1, 2) @ carried.reshape(len(readings), -1, 1)
    twist = np.zeros((len(readings), 6))
    twist[is_told] = -np.linalg.solve(moment[is_told], target[is_told])[:, :, 0]
    return twist[:, :3], is_told


@dataclass(frozen=True)
class GyroFit:
    """How an IMU's rate of turn and the joints' agree best.

    Attributes
    ----------
    rotation : (3, 3) float64
        From the axes in which the IMU reports to those of its frame in the model.
    angle, angle_std : float
        Of that rotation, rad, and of its least certain axis.
    delay, delay_std : float
        How much later than the joint states the IMU reports, s.
    left : float
        Share of the joints' rate that the IMU's does not follow.
    mirrored : float
        The same if an axis of the gyroscope had its sign reversed.
    rate : float
        Root mean square of the joints' rate of turn, rad/s.
    scale : float
        Of the IMU's rate over the joints'.
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


def fit_gyro(rates: StanceGyroMoments) -> GyroFit | None:
    """Return how they agree best over rotations and delays; None where no foot stands."""
    if rates.count == 0 or not rates.told.any():
        return None
    # Wahba's problem by Kabsch's singular values, at each delay and whatever the unit.
    values = np.array([_followed(cross) for cross in rates.cross]) / np.sqrt(
        np.maximum(rates.read, 1e-30)
    )
    best = int(np.argmax(values))
    peak = _peak(values, best)
    delay = (peak - len(values) // 2) * rates.step
    U, singular, Vt = np.linalg.svd(rates.cross[best])
    proper = float(np.sign(np.linalg.det(U @ Vt)))
    rotation = U @ np.diag([1.0, 1.0, proper]) @ Vt
    total = float(np.trace(rates.told))
    left, mirrored = (
        np.sqrt(max(1 - max(value, 0.0) ** 2 / max(rates.read[best] * total, 1e-30), 0.0))
        for value in (
            singular[0] + singular[1] + proper * singular[2],
            singular[0] + singular[1] - proper * singular[2],
        )
    )
    # What is left over may be as slow as the motion: a foot that gives, a floor that sways.
    pace = min(np.sqrt(rates.slope_square / total) / (2 * np.pi), CUTOFF)
    independent = max(2 * pace * rates.count * rates.step, 1.0)
    error = left * np.sqrt(total / rates.count)
    spread = np.linalg.eigvalsh(rates.told)
    # A turn about one axis alone leaves rounding on the others.
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
    )


def _followed(cross: FloatArray) -> float:
    """Return the largest trace of R cross over rotations R."""
    U, singular, Vt = np.linalg.svd(cross)
    return float(singular[0] + singular[1] + np.sign(np.linalg.det(U @ Vt)) * singular[2])


def _peak(values: FloatArray, best: int) -> float:
    """Return where the parabola through the largest value and its neighbours is largest."""
    if best in (0, len(values) - 1):
        return float(best)
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2 * at + after
    return best + (0.5 * (before - after) / bend if bend < 0 else 0.0)


def is_told(found: GyroFit) -> bool:
    """Tell whether a foot stood still while the robot turned."""
    return min(found.left, found.mirrored) < MOST_LEFT


def mounting_findings(topic: str, found: GyroFit) -> Iterator[Finding]:
    """Yield what is wrong with an IMU's mounting, or with its unit."""
    if not SCALES[0] < found.scale < SCALES[1]:
        yield Finding(
            Kind.UNIT,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity is {found.scale:.3g} times the rate at which the joints "
            "turn the robot above its feet; give rad/s",
            {"rate_ratio": found.scale},
        )
        return
    if found.mirrored * MIRRORED < found.left and found.mirrored < MOST_LEFT:
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity follows the joints only if an axis has its sign reversed "
            f"({100 * found.left:.0f} % of the rate is left over as it is, "
            f"{100 * found.mirrored:.1f} % then); repair the driver",
            {"left": found.left, "left_if_mirrored": found.mirrored},
        )
    elif (
        found.left < MOST_LEFT
        and found.angle_std < LARGEST_DOUBT
        and found.angle > LARGEST_ANGLE + DEVIATIONS * found.angle_std
    ):
        angle, doubt = np.degrees([found.angle, found.angle_std]).tolist()
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE,
            f"{topic}: reports in axes turned by {angle:.1f} ± {doubt:.1g} degrees from its frame "
            "in the model, as the joints show above a standing foot; correct the frame's "
            "orientation in the model, or header.frame_id",
            {"angle_deg": angle, "angle_std_deg": doubt},
        )
