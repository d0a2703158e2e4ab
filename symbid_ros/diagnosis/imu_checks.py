"""An IMU by itself: gravity in its acceleration, its rate of turn against its orientation."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.signals.streams import ImuStream, Slice

# Four decimals of a quaternion, the fewest that drivers print, leave its norm this near to one.
TOLERANCE = 1e-3


@dataclass
class QuaternionCheck:
    """The quaternions of one IMU's topic.

    Attributes
    ----------
    topic : str
    messages, wrong : int
        With an orientation, and with one whose norm is not one.
    worst : float
        Norm furthest from one.
    """

    topic: str
    messages: int = 0
    wrong: int = 0
    worst: float = 1.0

    def add(self, piece: Slice) -> None:
        """Take a slice in which no topic was silent."""
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
        """Return whether some are no rotations."""
        if not self.wrong:
            return []
        return [
            Finding(
                Kind.QUATERNION_NORM,
                self.topic,
                Severity.WARNING,
                f"{self.topic}: {self.wrong} of {self.messages} orientations are no unit "
                f"quaternions, the worst has norm {self.worst:.4g}; normalise them, or mark the "
                "orientation absent by a covariance of -1",
                {"messages": self.wrong, "worst_norm": self.worst},
            )
        ]


GRAVITY = 9.81
DEGREES = 180 / np.pi
# A robot that stands, walks, hangs or is shaken feels this many times gravity on average.
FELT = 0.5, 5.0
# A unit is recognised within this factor of its size.
ALIKE = 1.3
# s over which turns are compared: fused orientations come late by less.
SPAN = 0.05
# rad/s; a slower robot does not tell its axes from noise.
SLOWEST = 0.03
# Share of the orientation's rate that an honest gyroscope may leave over.
MOST_LEFT = 0.5
# Another reading of the quaternion is right that leaves so many times less.
BETTER = 3.0


@dataclass
class RateComparison:
    """Moments of the rates that a quaternion and a gyroscope tell."""

    cross: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    told: float = 0.0

    def add(
        self, before: FloatArray, after: FloatArray, seconds: FloatArray, read: FloatArray
    ) -> None:
        """Take xyzw (N, 4) at both ends of N spans of so many s (N,), and mean rates (N, 3)."""
        turn = Rotation.from_quat(before).inv() * Rotation.from_quat(after)
        rate = turn.as_rotvec() / seconds[:, None]
        rate -= rate.mean(axis=0)
        self.cross += rate.T @ read
        self.told += float(np.sum(rate**2))

    @property
    def angle(self) -> float:
        """Degrees between the axes of the two."""
        U, _, Vt = np.linalg.svd(self.cross)
        rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))

    def left(self, read: float, *, mirrored: bool = False, turned: bool = True) -> float:
        """Return the share of the rate that is left over at the best scale, and rotation."""
        if turned:
            singular = np.linalg.svd(self.cross, compute_uv=False)
            proper = np.sign(np.linalg.det(self.cross)) * (-1 if mirrored else 1)
            followed = float(singular[0] + singular[1] + proper * singular[2])
        else:
            followed = float(np.trace(self.cross))
        share = max(followed, 0.0) ** 2 / max(read * self.told, 1e-30)
        return float(np.sqrt(max(1 - share, 0.0)))


@dataclass
class ImuCheck:
    """What one IMU says of itself, slice by slice.

    Attributes
    ----------
    topic : str
    """

    topic: str
    _messages: int = 0
    _size: float = 0.0
    _seconds: float = 0.0
    _count: int = 0
    _read: float = 0.0
    _plain: RateComparison = field(default_factory=RateComparison)
    _rolled: RateComparison = field(default_factory=RateComparison)

    def add(self, imu: ImuStream) -> None:
        """Take messages in the order of their stamps."""
        norm = np.linalg.norm(imu.linear_acceleration, axis=1)
        norm = norm[np.isfinite(norm)]
        self._messages += len(norm)
        self._size += float(norm.sum())
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
        read = (turned[first + lag] - turned[first]) / seconds[:, None]
        read -= read.mean(axis=0)
        orientation = imu.orientation[known]
        before, after = orientation[first], orientation[first + lag]
        self._plain.add(before, after, seconds, read)
        # What is called x is w, and so on.
        self._rolled.add(np.roll(before, -1, 1), np.roll(after, -1, 1), seconds, read)
        self._read += float(np.sum(read**2))
        self._count += len(read)

    def findings(self) -> list[Finding]:
        """Return what is wrong with it, whatever the robot."""
        return [*self._of_gravity(), *self._of_turning()]

    def _of_gravity(self) -> list[Finding]:
        felt = self._size / max(self._messages, 1)
        figures = {"mean_m_s2": felt}
        if not self._messages or FELT[0] * GRAVITY < felt < FELT[1] * GRAVITY:
            return []
        if 1 / ALIKE < felt < ALIKE:
            return [
                Finding.of(
                    self.topic,
                    Kind.UNIT,
                    f"linear_acceleration is {felt:.3g} on average, as if in g; give m/s² "
                    "(REP-145)",
                    figures,
                )
            ]
        if felt < FELT[0] * GRAVITY:
            return [
                Finding.of(
                    self.topic,
                    Kind.GRAVITY,
                    f"linear_acceleration is {felt:.3g} m/s² on average, gravity is not in it; "
                    "give the raw specific force, +9.81 upwards at rest (REP-145)",
                    figures,
                )
            ]
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"linear_acceleration is {felt:.3g} on average, not {GRAVITY} m/s²; check its "
                "unit and range",
                figures,
            )
        ]

    def _of_turning(self) -> list[Finding]:
        told = np.sqrt(self._plain.told / max(self._count, 1))
        read = np.sqrt(self._read / max(self._count, 1))
        if min(told, read) < SLOWEST:
            return []
        plain = self._plain.left(self._read, turned=False)
        figures = {"left": plain, "rate_ratio": float(read / told)}
        if plain < MOST_LEFT:
            if 1 / ALIKE < read / told / DEGREES < ALIKE:
                return [
                    Finding.of(
                        self.topic,
                        Kind.UNIT,
                        f"angular_velocity is {read / told:.3g} times the rate at which the "
                        "orientation turns, as if in degrees; give rad/s",
                        figures,
                    )
                ]
            return []
        if self._rolled.left(self._read, turned=False) * BETTER < plain:
            return [
                Finding.of(
                    self.topic,
                    Kind.ORIENTATION,
                    "the orientation follows angular_velocity only as w, x, y, z; fill x, y, z "
                    "and w each by its name",
                    figures,
                    Severity.WARNING,
                )
            ]
        for mirrored in (False, True):
            if self._plain.left(self._read, mirrored=mirrored) < min(MOST_LEFT, plain / BETTER):
                angle = self._plain.angle
                how = "an axis reversed" if mirrored else f"its axes turned by {angle:.0f} degrees"
                return [
                    Finding.of(
                        self.topic,
                        Kind.IMU_MOUNTING,
                        f"angular_velocity follows the orientation only with {how}; give both in "
                        "the axes of header.frame_id",
                        figures | ({} if mirrored else {"angle_deg": angle}),
                    )
                ]
        return []
