"""Compares joint positions with their velocities and with the model's limits."""

from collections.abc import Iterable, Iterator

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.required_readings import RequiredReadings, list_names
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.streams import JointStream

DEGREES = 180 / np.pi
# s over which positions are compared with the mean of the velocities.
SPAN = 0.04
# rad/s or m/s; slower joints are not checked.
SLOWEST = 0.02
# Velocities match positions above this correlation.
LEAST_CORRELATION = 0.9
# Matching velocities outside this range of scales are filtered or wrongly scaled.
SCALES = 0.5, 2.0
ALIKE = 1.3
# At least so many joints whose scales agree to this ratio, outside this range: they have the clock
# of their stamps in common.
SAME, FEWEST_SAME, CLOCK_SCALES = 1.02, 3, (0.8, 1.25)
# A position further outside the limits, rad, is not the joint's.
LIMIT_MARGIN = 0.35
# Angles of a robot's only joint beyond this, rad, are degrees: few joints turn five times.
FAR = 10 * np.pi
# rad/s or m/s (RMS) that no joint of a robot reaches: readings of 4096 a turn that are taken for
# radians do so at half a radian per second.
FASTEST = 300.0
# Degrees within one turn jump by a circle, apart from the joint's motion: 10 degrees in a message
# are 2000 degrees/s at 200 Hz.
CIRCLE, WRAP_MARGIN = 360.0, 10.0
# A position that jumps further than this, rad or m, comes back if the next one is within this share
# of the jump from the one before. Two publishers whose messages alternate in part cause at least so
# many such jumps, as a share of the messages; white noise causes half as many.
JUMP, BACK, TWO_PUBLISHERS = 0.02, 0.2, 0.25


def position_line(joints: Iterable[str]) -> str:
    """Return the robot file's line that converts positions and velocities of joints to radians."""
    return robot_file_line("position_scale", *(f"{name}:={1 / DEGREES:.9g}" for name in joints))


class JointCheck:
    """Moments of velocities and position changes, the range of positions, and required readings.

    Parameters
    ----------
    topic : str
    names : tuple of str
        J joints.
    is_arrays : bool
        Whether the readings are arrays of a user instead of messages.
    """

    def __init__(self, topic: str, names: tuple[str, ...], *, is_arrays: bool = False) -> None:
        self.topic, self.names = topic, names
        self._required = RequiredReadings(topic, names, is_arrays=is_arrays)
        joints = len(names)
        self._both, self._count = np.zeros((3, joints)), 0
        self._low, self._high = np.full(joints, np.inf), np.full(joints, -np.inf)
        self._is_converted = np.zeros(joints, dtype=bool)  # by the user's position_scale
        self._returns = np.zeros(joints, dtype=np.int64)  # jumps to and fro
        self._wraps = np.zeros(joints, dtype=np.int64)  # jumps by 360
        self._moved = np.zeros((2, joints), dtype=np.int64)  # spans with motion down and up
        self._speeds = np.zeros((2, joints))  # number of spans, and squares of their mean velocity

    def add(self, joints: JointStream, during: tuple[int, int] = ALWAYS) -> None:
        """Add messages in the order of their stamps; messages of other joints are ignored.

        Missing values are counted from the first stamp of ``during`` up to the second, ns.
        """
        if joints.names != self.names or len(joints.stamp) < 3:
            return
        self._is_converted = np.isin(self.names, list(joints.position_scale))
        inside = slice(*np.searchsorted(joints.stamp, during).tolist())
        self._required.add(joints, inside)
        self._add_returns(joints.position[inside])
        position = joints.position
        jump = np.abs(np.diff(position, axis=0))
        self._wraps += np.count_nonzero(np.abs(jump - CIRCLE) < WRAP_MARGIN, axis=0)
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
        path = np.zeros_like(position)
        np.cumsum(steps, axis=0, out=path[1:])
        velocity = (path[first + lag] - path[first]) / seconds
        self._moved += [
            np.count_nonzero(change < -SLOWEST, axis=0),
            np.count_nonzero(change > SLOWEST, axis=0),
        ]
        self._speeds += [np.isfinite(change).sum(axis=0), np.nansum(change**2, axis=0)]
        # Intervals without a velocity are not compared.
        known = np.isfinite(velocity) & np.isfinite(change)
        change, velocity = np.where(known, change, 0.0), np.where(known, velocity, 0.0)
        self._both += [
            np.sum(change**2, axis=0),
            np.sum(change * velocity, axis=0),
            np.sum(velocity**2, axis=0),
        ]
        self._count += len(change)

    def _add_returns(self, position: FloatArray) -> None:
        """Count the jumps of successive positions (N, J) that come back at once."""
        if len(position) < 3:
            return
        jump = position[1:-1] - position[:-2]
        row, joint = np.nonzero(np.abs(jump) > JUMP)
        jump, rest = jump[row, joint], position[row + 2, joint] - position[row, joint]
        size = np.abs(jump)
        beyond = np.abs(np.remainder(jump + np.pi, 2 * np.pi) - np.pi)
        is_wrapped = (size > np.pi) & (beyond < BACK * size)
        returns = (np.abs(rest) < BACK * size) & ~is_wrapped
        self._returns += np.bincount(joint[returns], minlength=len(self._returns))

    def findings(self, model: RobotModel | None) -> list[Finding]:
        """Return the findings about positions, velocities and efforts."""
        if two := self._publisher_findings():
            return two
        found = self._wrap_findings(model) or self._count_findings(model)
        if not found and model is not None:
            found = self._degree_findings(model)
        return [*self._required.findings(model, self._moved), *(found or self._velocity_findings())]

    def _publisher_findings(self) -> list[Finding]:
        """Return a finding if positions jump to and fro, which would disturb all other checks."""
        places = np.flatnonzero(self._returns > TWO_PUBLISHERS * self._required.messages).tolist()
        if not places:
            return []
        return [
            Finding.of(
                self.topic,
                Kind.TWO_PUBLISHERS,
                f"positions of {list_names(self.names, places)} jump to and fro between two "
                "values, as if two nodes published on this topic; record the topic of one of them, "
                "or stop the other",
                {"jumps": int(self._returns.max()), "messages": self._required.messages},
            )
        ]

    def _velocity_findings(self) -> list[Finding]:
        change, product, velocity = self._both / max(self._count, 1)
        moves = (np.sqrt(change) > SLOWEST) & (velocity > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = product / np.sqrt(change * velocity)
            scale = product / change
        found = []
        wrong = np.flatnonzero(moves & (correlation < -LEAST_CORRELATION)).tolist()
        if wrong:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.VELOCITY,
                    f"position and velocity of {list_names(self.names, wrong)} have opposite "
                    "signs; measure both along the joint's axis",
                    {f"{self.names[i]}/scale": float(scale[i]) for i in wrong},
                )
            )
        off = moves & (correlation > LEAST_CORRELATION)
        for factor, what in ((1 / DEGREES, "positions"), (DEGREES, "velocities")):
            like = off & (scale / factor > 1 / ALIKE) & (scale / factor < ALIKE)
            if what == "positions":
                like &= ~self._is_converted  # then it is the velocities that have another unit
            if like.any():
                places = np.flatnonzero(like).tolist()
                remedy = "use rad and rad/s"
                if what == "positions":
                    remedy += f", or write {position_line(self.names[i] for i in places)}"
                found.append(
                    Finding.of(
                        self.topic,
                        Kind.UNIT,
                        f"{what} of {list_names(self.names, places)} are {DEGREES:.1f} times what "
                        f"the other quantity implies, as if in degrees; {remedy}",
                        {f"{self.names[i]}/scale": float(scale[i]) for i in places},
                        Severity.UNUSABLE if what == "positions" else Severity.WARNING,
                    )
                )
                off &= ~like
        places = np.flatnonzero(off & ((scale < SCALES[0]) | (scale > SCALES[1]))).tolist()
        kind, what = Kind.VELOCITY, "units and gear ratios of both"
        if self._has_common_scale(scale[off]):
            places = np.flatnonzero(off).tolist()
            kind, what = Kind.STAMP_RATE, "the rate of the stamps, then units and gear ratios"
        if places:
            found.append(
                Finding.of(
                    self.topic,
                    kind,
                    f"velocity of {list_names(self.names, places)} is "
                    f"{float(np.median(scale[places])):.3g} times the rate of change of the "
                    f"position; check {what}",
                    {f"{self.names[i]}/scale": float(scale[i]) for i in places},
                    Severity.WARNING,
                )
            )
        return found

    @staticmethod
    def _has_common_scale(scales: FloatArray) -> bool:
        """Return whether the velocities of many joints are wrong by one factor (k,)."""
        if len(scales) < FEWEST_SAME or scales.max() > SAME * scales.min():
            return False
        return not CLOCK_SCALES[0] < float(np.median(scales)) < CLOCK_SCALES[1]

    def _wrap_findings(self, model: RobotModel | None) -> list[Finding]:
        """Return a finding if positions jump by 360 from one end of a turn to the other."""
        span = self._high - self._low
        is_one_turn = np.abs(span - CIRCLE) < WRAP_MARGIN
        places = np.flatnonzero((self._wraps > 0) & is_one_turn).tolist()
        if not places:
            return []
        hinges = self._hinges(model) if model is not None else [self.names[i] for i in places]
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"positions of {list_names(self.names, places)} jump by 360 between the ends of "
                "one turn, as if in degrees; use rad and rad/s, or write "
                f"{position_line(hinges)}",
                {f"{self.names[i]}/wraps": int(self._wraps[i]) for i in places},
            )
        ]

    def _hinges(self, model: RobotModel) -> list[str]:
        """Return the names of all revolute joints with readings."""
        kinds = {joint.name: joint.kind for joint in model.joints}
        return [
            name
            for name, low, high in zip(self.names, self._low, self._high, strict=True)
            if kinds.get(name) == "revolute" and low <= high
        ]

    def _count_findings(self, model: RobotModel | None) -> list[Finding]:
        """Return a finding if positions are too fast or too far for radians and for degrees."""
        count, squares = self._speeds
        speed = np.sqrt(squares / np.maximum(count, 1))
        is_far, checked = np.zeros(len(self.names), dtype=bool), 0
        for index, joint in self._limited_hinges(model):
            low, high = float(self._low[index]), float(self._high[index])
            # A joint within a turn may have wrong limits instead.
            is_far[index] = max(-low, high) > 2 * np.pi and all(
                _leaves(joint, low / unit, high / unit) for unit in (1.0, DEGREES)
            )
            checked += 1
        # One joint may turn many times, or have wrong limits.
        if 2 * np.count_nonzero(is_far) < checked or (checked > 1 and is_far.sum() == 1):
            is_far[:] = False
        places = np.flatnonzero(is_far | (speed > FASTEST)).tolist()
        if not places:
            return []
        largest = float(np.max(np.maximum(np.abs(self._low), np.abs(self._high))[places]))
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"positions of {list_names(self.names, places)} reach {largest:.3g} and change by "
                f"up to {float(speed[places].max()):.3g} per second (RMS), as if in encoder "
                "counts; give rad (m), or the factor to it as `position_scale` JOINT:=FACTOR",
                {"largest": largest} | {f"{self.names[i]}/speed": float(speed[i]) for i in places},
            )
        ]

    def _limited_hinges(self, model: RobotModel | None) -> Iterator[tuple[int, Joint]]:
        """Yield the column and joint of each revolute joint with limits and readings."""
        for index, name in enumerate(self.names):
            if (
                model is None
                or name not in model.joint_names
                or self._low[index] > self._high[index]
            ):
                continue
            joint = model.joints[model.joint_names.index(name)]
            if joint.kind == "revolute" and np.isfinite(joint.upper - joint.lower):
                yield index, joint

    def _degree_findings(self, model: RobotModel) -> list[Finding]:
        """Return a finding if positions are within the limits only when read as degrees."""
        checked, reached = 0, list[float]()
        for index, joint in self._limited_hinges(model):
            low, high = float(self._low[index]), float(self._high[index])
            checked += 1
            if _leaves(joint, low / DEGREES, high / DEGREES):
                return []
            if _leaves(joint, low, high):
                reached.append(max(abs(low), abs(high)))
        outside, largest = len(reached), max(reached, default=0.0)
        # One joint may turn several times, or have wrong limits.
        least = FAR if outside == checked == 1 else 2 * np.pi
        is_alone = outside == 1 < checked
        if not outside or is_alone or 2 * outside < checked or largest <= least:
            return []
        joints = (
            "1 joint leave its limits" if outside == 1 else f"{outside} joints leave their limits"
        )
        return [
            Finding.of(
                self.topic,
                Kind.UNIT,
                f"positions of {joints} in {model.source} and reach {largest:.3g}, as if in "
                f"degrees; use rad and rad/s, or write {position_line(self._hinges(model))}, or "
                "correct the limits in the model if the joints turn that far",
                {"joints": outside, "largest": largest},
            )
        ]


def _leaves(joint: Joint, low: float, high: float) -> bool:
    """Return whether positions from low to high, rad, are beyond a joint's limits."""
    return min(low - joint.lower, joint.upper - high) < -LIMIT_MARGIN
