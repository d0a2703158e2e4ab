"""Checks of a single IMU: gravity, unit quaternions, angular velocity against orientation."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.imu_gain import (
    GRAVITY,
    GravityMoments,
    accelerometer_findings,
    gyroscope_findings,
    proportional_gain,
)
from symbid_ros.signals.streams import ImuStream, Slice

# Rounding to four decimals, the fewest that drivers use, changes the norm by less than this.
TOLERANCE = 1e-3


@dataclass
class QuaternionCheck:
    """Counts orientations of one IMU that are not unit quaternions.

    Attributes
    ----------
    topic : str
    messages, wrong : int
        Messages with an orientation, and those whose norm is not one.
    worst : float
        Norm that differs most from one.
    """

    topic: str
    messages: int = 0
    wrong: int = 0
    worst: float = 1.0

    def add(self, piece: Slice) -> None:
        """Add a slice of the log."""
        for imu in () if piece.streams is None else piece.streams.imus:
            if imu.topic != self.topic or imu.orientation is None:
                continue
            inside = (imu.stamp >= piece.start) & (imu.stamp < piece.stop)
            norm = np.linalg.norm(imu.orientation[inside], axis=1)
            off = np.abs(norm - 1)
            self.messages += int(np.count_nonzero(np.isfinite(norm)))
            self.wrong += int(np.count_nonzero(off > TOLERANCE))
            if np.any(off > abs(self.worst - 1)):
                self.worst = float(norm[np.nanargmax(off)])

    def findings(self) -> list[Finding]:
        """Return a finding if some orientations are not unit quaternions."""
        if not self.wrong:
            return []
        return [
            Finding(
                Kind.QUATERNION_NORM,
                self.topic,
                Severity.WARNING,
                f"{self.topic}: {self.wrong} of {self.messages} orientations are not unit "
                f"quaternions, the worst has norm {self.worst:.4g}; normalize them, or set the "
                "first element of orientation_covariance to -1",
                {"messages": self.wrong, "worst_norm": self.worst},
            )
        ]


DEGREES = 180 / np.pi
# Mean specific force of a robot that stands, walks or hangs, in multiples of gravity.
GRAVITY_RANGE = 0.5, 5.0
# A wrong unit is recognized if the ratio is within this factor of the conversion.
ALIKE = 1.3
# s over which rotations are compared; fused orientations lag by less.
SPAN = 0.05
# rad/s; slower rotations cannot be distinguished from noise.
SLOWEST = 0.03
# Largest unexplained share of the orientation's rate for a valid gyroscope.
MAX_UNEXPLAINED = 0.5
# Intervals of the comparison per independent one.
INDEPENDENT = 4
# Another interpretation of the quaternion must leave so many times less.
BETTER = 3.0


@dataclass
class RateComparison:
    """Moments of the angular rates from orientation and from the gyroscope."""

    cross: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    orientation_square: float = 0.0

    def add(
        self, before: FloatArray, after: FloatArray, seconds: FloatArray, gyro: FloatArray
    ) -> None:
        """Add quaternions xyzw (N, 4) at both ends of N intervals (s) and mean rates (N, 3)."""
        turn = Rotation.from_quat(before).inv() * Rotation.from_quat(after)
        rate = turn.as_rotvec() / seconds[:, None]
        rate -= rate.mean(axis=0)
        self.cross += rate.T @ gyro
        self.orientation_square += float(np.sum(rate**2))

    @property
    def rotation(self) -> Rotation:
        """The gyroscope's axes in those of the orientation."""
        U, _, Vt = np.linalg.svd(self.cross)
        return Rotation.from_matrix(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)

    def gain(self, gyro: float, count: int) -> tuple[float, float]:
        """Return the gyroscope's gain and its standard deviation from its square, (rad/s)²."""
        return proportional_gain(
            self.orientation_square, float(np.trace(self.cross)), gyro, count / INDEPENDENT
        )

    def unexplained(self, gyro: float, *, mirrored: bool = False, turned: bool = True) -> float:
        """Return the unexplained share of the rate at the best scale and rotation."""
        if turned:
            singular = np.linalg.svd(self.cross, compute_uv=False)
            proper = np.sign(np.linalg.det(self.cross)) * (-1 if mirrored else 1)
            followed = float(singular[0] + singular[1] + proper * singular[2])
        else:
            followed = float(np.trace(self.cross))
        share = max(followed, 0.0) ** 2 / max(gyro * self.orientation_square, 1e-30)
        return float(np.sqrt(max(1 - share, 0.0)))


@dataclass
class ImuCheck:
    """Checks one IMU without a model, slice by slice.

    Attributes
    ----------
    topic : str
    """

    topic: str
    _messages: int = 0
    _size: float = 0.0
    _seconds: float = 0.0
    _count: int = 0
    _gyro_square: float = 0.0
    _rates: RateComparison = field(default_factory=RateComparison)
    _wxyz_rates: RateComparison = field(default_factory=RateComparison)
    _gravity: GravityMoments = field(default_factory=GravityMoments)

    def add(self, imu: ImuStream) -> None:
        """Add messages in the order of their stamps."""
        norm = np.linalg.norm(imu.linear_acceleration, axis=1)
        norm = norm[np.isfinite(norm)]
        self._messages += len(norm)
        self._size += float(norm.sum())
        self._gravity.add(imu)
        if imu.orientation is None or len(imu.stamp) < 3:
            return
        length = np.linalg.norm(imu.orientation, axis=1)
        known = (np.abs(length - 1) < 0.1) & np.isfinite(imu.angular_velocity).all(axis=1)
        stamp, rate = imu.stamp[known], imu.angular_velocity[known]
        if len(stamp) < 3:
            return
        lag = max(1, round(SPAN * 1e9 / max(float(np.median(np.diff(stamp))), 1.0)))
        time = (stamp - stamp[0]) * 1e-9
        steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
        turned = np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        if len(stamp) <= 2 * lag:
            return
        first = np.arange(0, len(stamp) - lag, lag)
        seconds = time[first + lag] - time[first]
        gyro = (turned[first + lag] - turned[first]) / seconds[:, None]
        gyro -= gyro.mean(axis=0)
        orientation = imu.orientation[known]
        before, after = orientation[first], orientation[first + lag]
        self._rates.add(before, after, seconds, gyro)
        # The driver may publish w, x, y, z.
        self._wxyz_rates.add(np.roll(before, -1, 1), np.roll(after, -1, 1), seconds, gyro)
        self._gyro_square += float(np.sum(gyro**2))
        self._count += len(gyro)

    def findings(self) -> list[Finding]:
        """Return the findings of this IMU."""
        found = [*self._gravity_findings(), *self._gyro_findings()]
        return found or self._gain_findings()

    def _gain_findings(self) -> list[Finding]:
        """Return findings about scale errors, if units and axes are right."""
        # A wrong gyroscope shortens the mean specific force.
        return self._gyro_gain_findings() or accelerometer_findings(self.topic, self._gravity)

    def _gyro_gain_findings(self) -> list[Finding]:
        if self._rates.orientation_square > SLOWEST**2 * max(self._count, 1):
            gain, std = self._rates.gain(self._gyro_square, self._count)
            reference = "the rate at which the orientation changes"
            if turning := gyroscope_findings(self.topic, gain, std, reference):
                return turning
        if self._gravity.is_known:
            gain, std = self._gravity.gyroscope
            reference = "the rate at which gravity turns in linear_acceleration"
            return gyroscope_findings(self.topic, gain, std, reference)
        return []

    def _gravity_findings(self) -> list[Finding]:
        mean = self._size / max(self._messages, 1)
        figures = {"mean_m_s2": mean}
        if not self._messages or GRAVITY_RANGE[0] * GRAVITY < mean < GRAVITY_RANGE[1] * GRAVITY:
            return []
        if 1 / ALIKE < mean < ALIKE:
            return [
                Finding.of(
                    self.topic,
                    Kind.UNIT,
                    f"linear_acceleration is {mean:.3g} on average, as if in g; use m/s² (REP-145)",
                    figures,
                )
            ]
        if mean < GRAVITY_RANGE[0] * GRAVITY:
            return [
                Finding.of(
                    self.topic,
                    Kind.GRAVITY,
                    f"linear_acceleration is {mean:.3g} m/s² on average, it lacks gravity; "
                    "give the raw specific force, +9.81 upwards at rest (REP-145)",
                    figures,
                )
            ]
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"linear_acceleration is {mean:.3g} on average, not {GRAVITY} m/s²; check its "
                "unit and range",
                figures,
            )
        ]

    def _gyro_findings(self) -> list[Finding]:
        orientation_rate = np.sqrt(self._rates.orientation_square / max(self._count, 1))
        gyro = np.sqrt(self._gyro_square / max(self._count, 1))
        if min(orientation_rate, gyro) < SLOWEST:
            return []
        plain = self._rates.unexplained(self._gyro_square, turned=False)
        figures = {"left": plain, "rate_ratio": float(gyro / orientation_rate)}
        if plain < MAX_UNEXPLAINED:
            if 1 / ALIKE < gyro / orientation_rate / DEGREES < ALIKE:
                return [
                    Finding.of(
                        self.topic,
                        Kind.UNIT,
                        f"angular_velocity is {gyro / orientation_rate:.3g} times the rate at "
                        "which the orientation changes, as if in degrees; use rad/s",
                        figures,
                    )
                ]
            return []
        if self._wxyz_rates.unexplained(self._gyro_square, turned=False) * BETTER < plain:
            return [
                Finding.of(
                    self.topic,
                    Kind.ORIENTATION,
                    "the orientation matches angular_velocity only if read as w, x, y, z; assign "
                    "x, y, z and w by name",
                    figures,
                    Severity.WARNING,
                )
            ]
        for mirrored in (False, True):
            if self._rates.unexplained(self._gyro_square, mirrored=mirrored) < min(
                MAX_UNEXPLAINED, plain / BETTER
            ):
                rotation = self._rates.rotation
                # Without negative zeros.
                euler = np.round(rotation.as_euler("xyz", degrees=True), 1) + 0.0
                roll, pitch, yaw = euler.tolist()
                angle = float(np.degrees(rotation.magnitude()))
                how = (
                    "an axis reversed"
                    if mirrored
                    else f"its axes rotated by {angle:.0f} degrees (roll {roll:g}, pitch "
                    f"{pitch:g}, yaw {yaw:g})"
                )
                angles = {"angle_deg": angle, "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}
                return [
                    Finding.of(
                        self.topic,
                        Kind.IMU_MOUNTING,
                        f"angular_velocity matches the orientation only with {how}; publish both "
                        "in the axes of header.frame_id",
                        figures | ({} if mirrored else angles),
                    )
                ]
        return []
