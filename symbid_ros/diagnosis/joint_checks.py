"""Compares joint positions with their velocities and with the model's limits."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.efforts import rounding_errors
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
# Joints that move both ways, this many times each, of which so many have efforts of one sign.
FEWEST_REVERSING, FEWEST_UNSIGNED = 10, 4
# Spans in which a joint moves at least so that its effort cannot be constant.
FEWEST_MOVED = 10
# Efforts of a moving joint with a smaller signal-to-noise ratio are noise: 6 % of their power is
# signal.
LEAST_SIGNAL = 0.25
# Second differences of white noise have six times its power; those of a vibration have more.
WHITE = 7.0
FEWEST_EFFORTS = 500  # messages from which noise is judged
# A position that jumps further than this, rad or m, comes back if the next one is within this share
# of the jump from the one before. Two publishers whose messages alternate in part cause at least so
# many such jumps, as a share of the messages; white noise causes half as many.
JUMP, BACK, TWO_PUBLISHERS = 0.02, 0.2, 0.25
# A joint without a position in this share of the messages makes a log unusable.
MOST_MISSING = 0.5


def position_line(joints: Iterable[str]) -> str:
    """Return the robot file's line that converts positions and velocities of joints to radians."""
    return robot_file_line("position_scale", *(f"{name}:={1 / DEGREES:.9g}" for name in joints))


@dataclass
class JointCheck:
    """Moments of velocities, position changes and efforts, and the range of positions.

    Attributes
    ----------
    topic : str
    names : tuple of str
        J joints.
    is_arrays : bool
        Whether the readings are arrays of a user instead of messages.
    """

    topic: str
    names: tuple[str, ...]
    is_arrays: bool = False
    _both: FloatArray = field(init=False)
    _low: FloatArray = field(init=False)
    _high: FloatArray = field(init=False)
    _is_converted: BoolArray = field(init=False)  # by the user's position_scale
    _held: frozenset[str] = frozenset()  # joints that the log lacks
    _count: int = 0
    _messages: int = 0
    _without_position: IntArray = field(init=False)
    _without_effort: IntArray = field(init=False)
    _has_effort: BoolArray = field(init=False)
    _constant: FloatArray = field(init=False)  # the only effort; NaN before the first
    _is_constant: BoolArray = field(init=False)
    _is_negative: BoolArray = field(init=False)  # ever, before the user's effort_scale
    _is_positive: BoolArray = field(init=False)
    _returns: IntArray = field(init=False)  # jumps to and fro
    _wraps: IntArray = field(init=False)  # jumps by 360
    _moved: IntArray = field(init=False)  # number of spans with motion down and up
    _speeds: FloatArray = field(init=False)  # number of spans, and squares of their mean velocity
    # Number of efforts, their squares, and the squares of their second differences.
    _efforts: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Allocate empty moments."""
        joints = len(self.names)
        self._both = np.zeros((3, joints))
        self._low, self._high = np.full(joints, np.inf), np.full(joints, -np.inf)
        self._without_position = np.zeros(joints, dtype=np.int64)
        self._without_effort = np.zeros(joints, dtype=np.int64)
        self._has_effort = np.zeros(joints, dtype=bool)
        self._constant = np.full(joints, np.nan)
        self._is_constant = np.ones(joints, dtype=bool)
        self._is_negative = np.zeros(joints, dtype=bool)
        self._is_positive = np.zeros(joints, dtype=bool)
        self._returns = np.zeros(joints, dtype=np.int64)
        self._wraps = np.zeros(joints, dtype=np.int64)
        self._moved = np.zeros((2, joints), dtype=np.int64)
        self._speeds = np.zeros((2, joints))
        self._efforts = np.zeros((3, joints))
        self._is_converted = np.zeros(joints, dtype=bool)

    def add(self, joints: JointStream, during: tuple[int, int] = ALWAYS) -> None:
        """Add messages in the order of their stamps; messages of other joints are ignored.

        Missing values are counted from the first stamp of ``during`` up to the second, ns.
        """
        if joints.names != self.names or len(joints.stamp) < 3:
            return
        self._held = frozenset(joints.held)
        self._is_converted = np.isin(self.names, list(joints.position_scale))
        inside = slice(*np.searchsorted(joints.stamp, during).tolist())
        is_finite = np.isfinite(joints.effort[inside])
        self._messages += len(is_finite)
        self._without_effort += np.count_nonzero(~is_finite, axis=0)
        self._without_position += np.count_nonzero(~np.isfinite(joints.position[inside]), axis=0)
        is_zero = np.abs(joints.effort[inside]) <= rounding_errors(joints.effort[inside])[:, None]
        self._has_effort |= np.any(is_finite & ~is_zero, axis=0)
        self._compare_with_constant(joints.effort[inside], is_finite)
        scale = np.array([joints.effort_scale.get(name, 1.0) for name in self.names])
        recorded = joints.effort[inside] * np.sign(scale)
        self._is_negative |= np.any(recorded < 0.0, axis=0)
        self._is_positive |= np.any(recorded > 0.0, axis=0)
        self._add_efforts(joints.effort[inside])
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

    def _compare_with_constant(self, effort: FloatArray, is_finite: BoolArray) -> None:
        """Compare efforts (N, J) with the first one of each joint."""
        if not len(effort):
            return
        first = effort[np.argmax(is_finite, axis=0), np.arange(effort.shape[1])]
        self._constant = np.where(np.isnan(self._constant), first, self._constant)
        self._is_constant &= ~np.any(is_finite & (effort != self._constant), axis=0)

    @property
    def _is_stuck(self) -> BoolArray:
        """Whether an effort (J,) is one value, not zero, although its joint moves."""
        moves = self._moved.sum(axis=0) >= FEWEST_MOVED
        return np.asarray(self._has_effort & self._is_constant & moves)

    def _add_efforts(self, effort: FloatArray) -> None:
        """Add the squares of successive efforts (N, J) and of their second differences."""
        bend = np.diff(effort, 2, axis=0)
        known = np.isfinite(bend)
        middle = np.where(known, effort[1:-1] if len(effort) > 2 else bend, 0.0)
        self._efforts += [
            np.count_nonzero(known, axis=0),
            np.sum(middle**2, axis=0),
            np.sum(np.where(known, bend, 0.0) ** 2, axis=0),
        ]

    @property
    def signal_to_noise(self) -> FloatArray:
        """Ratio of the effort's RMS signal to its RMS noise, (J,); infinite without noise.

        White noise of variance σ² has second differences of variance 6σ². Those of a signal that
        is smooth from message to message are small.
        """
        _, square, bend = self._efforts
        noise = bend / 6
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(np.maximum(square / noise - 1, 0.0))
        return np.where(noise > 0, ratio, np.inf)

    def findings(self, model: RobotModel | None) -> list[Finding]:
        """Return the findings about positions, velocities and efforts."""
        if two := self._publisher_findings():
            return two
        found = self._wrap_findings(model) or self._count_findings(model)
        if not found and model is not None:
            found = self._degree_findings(model)
        return [*self._missing_value_findings(model), *(found or self._velocity_findings())]

    def _publisher_findings(self) -> list[Finding]:
        """Return a finding if positions jump to and fro, which would disturb all other checks."""
        places = np.flatnonzero(self._returns > TWO_PUBLISHERS * self._messages).tolist()
        if not places:
            return []
        return [
            Finding.of(
                self.topic,
                Kind.TWO_PUBLISHERS,
                f"positions of {self._list_names(places)} jump to and fro between two values, as "
                "if two nodes published on this topic; record the topic of one of them, or stop "
                "the other",
                {"jumps": int(self._returns.max()), "messages": self._messages},
            )
        ]

    def _missing_value_findings(self, model: RobotModel | None) -> list[Finding]:
        """Return findings for joints that lack required positions or efforts."""
        if not self._messages:
            return []
        joints = {} if model is None else {joint.name: joint for joint in model.joints}
        known = [i for i, name in enumerate(self.names) if model is None or name in joints]
        known = [i for i in known if self.names[i] not in self._held]
        driven = [i for i in known if model is None or joints[self.names[i]].effort > 0]
        # Without a model, a joint that never has a position may not need one.
        most = self._messages if model is not None else self._messages - 1
        absent = [i for i in known if 0 < self._without_position[i] <= most]
        fatal = [
            i
            for i in absent
            if model is not None and self._without_position[i] >= MOST_MISSING * self._messages
        ]
        found = [
            *self._absent("position", fatal, Severity.UNUSABLE),
            *self._absent("position", [i for i in absent if i not in fatal], Severity.WARNING),
        ]
        absent_or_zero = [i for i in driven if not self._has_effort[i]]
        stuck = [i for i in driven if self._is_stuck[i]]
        # The rows of a floating base and of wrist sensors are usable without any effort.
        has_others = model is not None and bool(model.floating or model.wrist_sensors)
        is_fatal = len(absent_or_zero) + len(stuck) == len(driven) and not has_others
        if model is None and not is_fatal:
            absent_or_zero = []  # they may be passive
        reported = {
            i: f"in no {self._kind}" if self._without_effort[i] == self._messages else "always zero"
            for i in absent_or_zero
        }
        reported |= {i: f"always {self._constant[i]:.6g} although it moves" for i in stuck}
        for what in sorted(set(reported.values())):
            places = [i for i in driven if reported.get(i) == what]
            rows = "its row" if len(places) == 1 else "their rows"
            found.append(
                Finding.of(
                    self.topic,
                    Kind.MISSING_JOINT,
                    f"the effort of {self._list_names(places)} is {what}, {rows} of the equation "
                    f"of motion cannot be used; {self._remedy('effort')}, or, of a joint without a "
                    'drive, write effort="0" and a velocity in the `<limit>` of the model',
                    {"joints": len(places)},
                    Severity.UNUSABLE if is_fatal else Severity.WARNING,
                )
            )
        found += self._held_findings(joints)
        driven = [i for i in driven if self._has_effort[i] and i not in stuck]
        found += self._unsigned_findings(driven)
        found += self._noise_findings(driven)
        incomplete = [i for i in driven if self._without_effort[i]]
        return found + list(self._absent("effort", incomplete, Severity.WARNING))

    def _held_findings(self, joints: Mapping[str, Joint]) -> Iterator[Finding]:
        """Yield a finding that names the driven joints that are missing from the log."""
        places = [
            i
            for i, name in enumerate(self.names)
            if name in self._held and name in joints and joints[name].effort > 0
        ]
        if places:
            rows = "its row" if len(places) == 1 else "their rows"
            moving = "it if it moves" if len(places) == 1 else "them if they move"
            yield Finding.of(
                self.topic,
                Kind.MISSING_JOINT,
                f"the log lacks {self._list_names(places)}, so {rows} of the equation of motion "
                f"cannot be used; record {moving}",
                {"joints": len(places)},
                Severity.WARNING,
            )

    def _unsigned_findings(self, driven: list[int]) -> Iterator[Finding]:
        """Yield a finding if efforts of all joints that move both ways have one sign.

        Friction alone changes its sign, and a joint with a vertical axis carries no weight.
        """
        reverses = self._moved.min(axis=0) >= FEWEST_REVERSING
        places = [i for i in driven if reverses[i]]
        is_negative, is_positive = self._is_negative[places].any(), self._is_positive[places].any()
        if len(places) < FEWEST_UNSIGNED or (is_negative and is_positive):
            return
        never = "positive" if is_negative else "negative"
        yield Finding.of(
            self.topic,
            Kind.UNSIGNED_EFFORT,
            f"the effort of {self._list_names(places)} is never {never}, although the joints move "
            "both ways, as if it were a magnitude; let the driver give efforts their signs",
            {"joints": len(places)},
            Severity.WARNING,
        )

    def _noise_findings(self, driven: list[int]) -> Iterator[Finding]:
        """Yield a finding if the efforts of joints that move are almost only noise."""
        ratio = self.signal_to_noise
        count, square, bend = self._efforts
        is_noise = (ratio < LEAST_SIGNAL) & (count >= FEWEST_EFFORTS) & (bend < WHITE * square)
        is_noise &= np.any(self._moved > 0, axis=0)
        places = [i for i in driven if is_noise[i]]
        if not places:
            return
        low, high = float(ratio[places].min()), float(ratio[places].max())
        span = f"{low:.2g}" if len(places) == 1 else f"{low:.2g} to {high:.2g}"
        yield Finding.of(
            self.topic,
            Kind.EFFORT_NOISE,
            f"the effort of {self._list_names(places)} is almost only noise, with a "
            f"signal-to-noise ratio of {span}; load the joints more, by faster motion or a "
            "payload, or measure efforts with less noise",
            {f"{self.names[i]}/signal_to_noise": float(ratio[i]) for i in places},
            Severity.WARNING,
        )

    def _absent(self, kind: str, places: list[int], severity: Severity) -> Iterator[Finding]:
        """Yield a finding about joints whose positions or efforts some messages lack."""
        if not places:
            return
        counts = self._without_position if kind == "position" else self._without_effort
        most = int(counts[places].max())
        yield Finding.of(
            self.topic,
            Kind.MISSING_JOINT,
            f"{'' if len(places) == 1 else 'up to '}{most} of {self._messages} {self._kind}s have "
            f"no {kind} of {self._list_names(places)}; {self._remedy(kind)}",
            {"messages": most, "share": most / self._messages},
            severity,
        )

    @property
    def _kind(self) -> str:
        return "row" if self.is_arrays else "message"

    def _remedy(self, quantity: str) -> str:
        if self.is_arrays:
            return f"give the {quantity} of every joint in each row"
        return f"let the driver fill JointState.{quantity}"

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
                    f"position and velocity of {self._list_names(wrong)} have opposite signs; "
                    "measure both along the joint's axis",
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
                        f"{what} of {self._list_names(places)} are {DEGREES:.1f} times what the "
                        f"other quantity implies, as if in degrees; {remedy}",
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
                    f"velocity of {self._list_names(places)} is "
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
                f"positions of {self._list_names(places)} jump by 360 between the ends of one "
                f"turn, as if in degrees; use rad and rad/s, or write {position_line(hinges)}",
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
                f"positions of {self._list_names(places)} reach {largest:.3g} and change by up to "
                f"{float(speed[places].max()):.3g} per second (RMS), as if in encoder counts; give "
                "rad (m), or the factor to it as `position_scale` JOINT:=FACTOR",
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

    def _list_names(self, places: list[int]) -> str:
        if len(places) > 2 and len(places) == len(self.names):
            return "all joints"
        return ", ".join(self.names[i] for i in places)


def _leaves(joint: Joint, low: float, high: float) -> bool:
    """Return whether positions from low to high, rad, are beyond a joint's limits."""
    return min(low - joint.lower, joint.upper - high) < -LIMIT_MARGIN
