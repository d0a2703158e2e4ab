"""Joint positions against the velocities beside them and against the model's limits."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.streams import JointStream

DEGREES = 180 / np.pi
# s over which positions are compared with the mean of the velocities.
SPAN = 0.04
# rad/s or m/s; a joint that hardly moves says nothing.
SLOWEST = 0.02
# Velocities belong to positions that follow them so well,
FOLLOWED = 0.9
# and those are filtered, or scaled, that differ by more.
SCALES = 0.5, 2.0
ALIKE = 1.3
# Beyond its limits by more, rad, and the joint is elsewhere.
BEYOND = 0.35


@dataclass
class JointMotion:
    """Moments of velocities and of positions' changes, and the positions' range.

    Attributes
    ----------
    topic : str
    names : tuple of str
        J joints.
    """

    topic: str
    names: tuple[str, ...]
    _both: FloatArray = field(init=False)
    _low: FloatArray = field(init=False)
    _high: FloatArray = field(init=False)
    _efforts: bool = False
    _count: int = 0

    def __post_init__(self) -> None:
        """Begin without data."""
        joints = len(self.names)
        self._both = np.zeros((3, joints))
        self._low, self._high = np.full(joints, np.inf), np.full(joints, -np.inf)

    def add(self, joints: JointStream) -> None:
        """Take messages in the order of their stamps; those of other joints are left out."""
        if joints.names != self.names or len(joints.stamp) < 3:
            return
        self._efforts |= bool(np.any(np.nan_to_num(joints.effort) != 0.0))
        position = joints.position
        self._low = np.fmin(self._low, np.nanmin(position, axis=0, initial=np.inf))
        self._high = np.fmax(self._high, np.nanmax(position, axis=0, initial=-np.inf))
        period = max(float(np.median(np.diff(joints.stamp))), 1.0)
        lag = max(1, round(SPAN * 1e9 / period))
        if len(position) <= 2 * lag:
            return
        time = (joints.stamp - joints.stamp[0]) * 1e-9
        first = np.arange(0, len(position) - lag, lag)
        seconds = (time[first + lag] - time[first])[:, None]
        change = (position[first + lag] - position[first]) / seconds
        steps = 0.5 * (joints.velocity[1:] + joints.velocity[:-1]) * np.diff(time)[:, None]
        path = np.vstack([np.zeros((1, len(self.names))), np.cumsum(steps, axis=0)])
        velocity = (path[first + lag] - path[first]) / seconds
        # A driver that leaves velocities out, or sometimes, says nothing of them.
        known = np.isfinite(velocity) & np.isfinite(change)
        change, velocity = np.where(known, change, 0.0), np.where(known, velocity, 0.0)
        self._both += [
            np.sum(change**2, axis=0),
            np.sum(change * velocity, axis=0),
            np.sum(velocity**2, axis=0),
        ]
        self._count += len(change)

    def findings(self, model: RobotModel | None) -> list[Finding]:
        """Return what is wrong with positions or velocities."""
        found = self._of_degrees(model) if model is not None else []
        if not self._efforts and self._count:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.MISSING_JOINT,
                    "every effort is zero in every message; let the driver fill JointState.effort",
                    {"joints": len(self.names)},
                )
            )
        return found or self._of_velocity()

    def _of_velocity(self) -> list[Finding]:
        change, both, velocity = self._both / max(self._count, 1)
        moves = (np.sqrt(change) > SLOWEST) & (velocity > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            follows = both / np.sqrt(change * velocity)
            scale = both / change
        found = []
        wrong = np.flatnonzero(moves & (follows < -FOLLOWED)).tolist()
        if wrong:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.VELOCITY,
                    f"position and velocity of {self._of(wrong)} have opposite signs; count both "
                    "along the joint's axis",
                    {f"{self.names[i]}/scale": float(scale[i]) for i in wrong},
                )
            )
        off = moves & (follows > FOLLOWED)
        for factor, what in ((1 / DEGREES, "positions"), (DEGREES, "velocities")):
            like = off & (scale / factor > 1 / ALIKE) & (scale / factor < ALIKE)
            if like.any():
                places = np.flatnonzero(like).tolist()
                found.append(
                    Finding.of(
                        self.topic,
                        Kind.UNIT,
                        f"{what} of {self._of(places)} are {DEGREES:.1f} times what the others "
                        "tell, as if in degrees; give rad and rad/s",
                        {f"{self.names[i]}/scale": float(scale[i]) for i in places},
                        Severity.UNUSABLE if what == "positions" else Severity.WARNING,
                    )
                )
                off &= ~like
        places = np.flatnonzero(off & ((scale < SCALES[0]) | (scale > SCALES[1]))).tolist()
        if places:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.VELOCITY,
                    f"velocity of {self._of(places)} is "
                    f"{float(np.median(scale[places])):.3g} of how the position changes; check "
                    "units and gear ratios of both",
                    {f"{self.names[i]}/scale": float(scale[i]) for i in places},
                    Severity.WARNING,
                )
            )
        return found

    def _of_degrees(self, model: RobotModel) -> list[Finding]:
        """Tell whether positions are within the limits only if they are degrees."""
        asked = outside = 0
        for index, name in enumerate(self.names):
            if name not in model.joint_names or self._low[index] > self._high[index]:
                continue
            joint = model.joints[model.joint_names.index(name)]
            if joint.kind != "revolute" or not np.isfinite(joint.upper - joint.lower):
                continue
            low, high = self._low[index], self._high[index]
            asked += 1
            if min(low / DEGREES - joint.lower, joint.upper - high / DEGREES) < -BEYOND:
                return []
            outside += min(low - joint.lower, joint.upper - high) < -BEYOND
        largest = float(np.max(np.abs([self._low, self._high]), initial=0.0))
        # One joint may spin, or have its limits wrong.
        if not outside or 2 * outside < asked or not 2 * np.pi < largest < np.inf:
            return []
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"positions of {outside} joints leave their limits in {model.source} and reach "
                f"{largest:.3g}, as if in degrees; give rad",
                {"joints": outside, "largest": largest},
            )
        ]

    def _of(self, places: list[int]) -> str:
        if len(places) > 2 and len(places) == len(self.names):
            return "all joints"
        return ", ".join(self.names[i] for i in places)
