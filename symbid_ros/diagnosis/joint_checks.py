"""Joint positions against the velocities beside them and against the model's limits."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.defects import ALWAYS
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
# A joint whose position is missing in this share of the messages cannot be placed.
MOST_MISSING = 0.5


@dataclass
class JointCheck:
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
    _count: int = 0
    _messages: int = 0
    _without_position: IntArray = field(init=False)
    _without_effort: IntArray = field(init=False)
    _has_effort: BoolArray = field(init=False)

    def __post_init__(self) -> None:
        """Begin without data."""
        joints = len(self.names)
        self._both = np.zeros((3, joints))
        self._low, self._high = np.full(joints, np.inf), np.full(joints, -np.inf)
        self._without_position = np.zeros(joints, dtype=np.int64)
        self._without_effort = np.zeros(joints, dtype=np.int64)
        self._has_effort = np.zeros(joints, dtype=bool)

    def add(self, joints: JointStream, during: tuple[int, int] = ALWAYS) -> None:
        """Take messages in the order of their stamps; those of other joints are left out.

        What they lack is counted from the first stamp of ``during`` up to the second, ns.
        """
        if joints.names != self.names or len(joints.stamp) < 3:
            return
        inside = slice(*np.searchsorted(joints.stamp, during).tolist())
        is_finite = np.isfinite(joints.effort[inside])
        self._messages += len(is_finite)
        self._without_effort += np.count_nonzero(~is_finite, axis=0)
        self._without_position += np.count_nonzero(~np.isfinite(joints.position[inside]), axis=0)
        self._has_effort |= np.any(is_finite & (joints.effort[inside] != 0.0), axis=0)
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
        return [*self._missing(model), *(found or self._of_velocity())]

    def _missing(self, model: RobotModel | None) -> list[Finding]:
        """Tell which joints lack positions or efforts, of those that need them."""
        if not self._messages:
            return []
        joints = {} if model is None else {joint.name: joint for joint in model.joints}
        known = [i for i, name in enumerate(self.names) if model is None or name in joints]
        driven = [i for i in known if model is None or joints[self.names[i]].effort > 0]
        found = []
        for index in known:
            # Without a model nobody knows whether a joint that never has one needs one.
            most = self._messages if model is not None else self._messages - 1
            if 0 < self._without_position[index] <= most:
                share = float(self._without_position[index] / self._messages)
                is_fatal = model is not None and share >= MOST_MISSING
                found.append(
                    Finding.of(
                        self.topic,
                        Kind.MISSING_JOINT,
                        f"{self._without_position[index]} of {self._messages} messages have no "
                        f"position of {self.names[index]}; let the driver fill "
                        "JointState.position",
                        {"messages": self._without_position[index], "share": share},
                        Severity.UNUSABLE if is_fatal else Severity.WARNING,
                    )
                )
        silent = [i for i in driven if not self._has_effort[i]]
        # The base's rows tell of a floating robot without any effort.
        is_fatal = len(silent) == len(driven) and (model is None or not model.floating)
        if model is None and not is_fatal:
            silent = []  # they may be passive
        for is_zero in (True, False):
            places = [i for i in silent if (self._without_effort[i] < self._messages) == is_zero]
            if places:
                rows = "its row" if len(places) == 1 else "their rows"
                found.append(
                    Finding.of(
                        self.topic,
                        Kind.MISSING_JOINT,
                        f"the effort of {self._of(places)} is "
                        f"{'always zero' if is_zero else 'in no message'}, {rows} of the equation "
                        "of motion cannot be used; let the driver fill JointState.effort",
                        {"joints": len(places)},
                        Severity.UNUSABLE if is_fatal else Severity.WARNING,
                    )
                )
        found += [
            Finding.of(
                self.topic,
                Kind.MISSING_JOINT,
                f"{self._without_effort[i]} of {self._messages} messages have no effort of "
                f"{self.names[i]}; let the driver fill JointState.effort",
                {
                    "messages": self._without_effort[i],
                    "share": self._without_effort[i] / self._messages,
                },
                Severity.WARNING,
            )
            for i in driven
            if self._has_effort[i] and self._without_effort[i]
        ]
        return found

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
            outside += int(min(low - joint.lower, joint.upper - high) < -BEYOND)
        reached = np.abs([self._low, self._high])
        largest = float(np.max(reached[np.isfinite(reached)], initial=0.0))
        # One joint may spin, or have its limits wrong.
        if not outside or 2 * outside < asked or largest <= 2 * np.pi:
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
