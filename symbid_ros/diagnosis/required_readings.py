"""Finds joints without the positions and efforts that rows of the equation of motion need.

Values may be missing. Efforts may also be constant, without a sign, or almost only noise.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.signals.efforts import rounding_errors
from symbid_ros.signals.streams import JointStream

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
# A joint without a position in this share of the messages makes a log unusable.
MOST_MISSING = 0.5


def list_names(names: Sequence[str], places: Sequence[int]) -> str:
    """Return the joints at these places of ``names``."""
    if len(places) > 2 and len(places) == len(names):
        return "all joints"
    return ", ".join(names[i] for i in places)


class RequiredReadings:
    """Counts of missing values, and signs and moments of efforts.

    Parameters
    ----------
    topic : str
    names : tuple of str
        J joints.
    is_arrays : bool
        Whether the readings are arrays of a user instead of messages.

    Attributes
    ----------
    messages : int
        How many were added.
    """

    def __init__(self, topic: str, names: tuple[str, ...], *, is_arrays: bool) -> None:
        self._topic, self._names, self._is_arrays = topic, names, is_arrays
        self.messages, joints = 0, len(names)
        self._held: frozenset[str] = frozenset()  # joints that the log lacks
        self._without_position = np.zeros(joints, dtype=np.int64)
        self._without_effort = np.zeros(joints, dtype=np.int64)
        self._has_effort = np.zeros(joints, dtype=bool)
        self._constant = np.full(joints, np.nan)  # the only effort; NaN before the first
        self._is_constant = np.ones(joints, dtype=bool)
        self._is_negative = np.zeros(joints, dtype=bool)  # ever, before the user's effort_scale
        self._is_positive = np.zeros(joints, dtype=bool)
        # Number of efforts, their squares, and the squares of their second differences.
        self._efforts = np.zeros((3, joints))

    def add(self, joints: JointStream, inside: slice) -> None:
        """Add the messages ``inside`` a stream."""
        self._held = frozenset(joints.held)
        effort = joints.effort[inside]
        is_finite = np.isfinite(effort)
        self.messages += len(effort)
        self._without_effort += np.count_nonzero(~is_finite, axis=0)
        self._without_position += np.count_nonzero(~np.isfinite(joints.position[inside]), axis=0)
        is_zero = np.abs(effort) <= rounding_errors(effort)[:, None]
        self._has_effort |= np.any(is_finite & ~is_zero, axis=0)
        self._compare_with_constant(effort, is_finite)
        recorded = effort * np.sign([joints.effort_scale.get(name, 1.0) for name in self._names])
        self._is_negative |= np.any(recorded < 0.0, axis=0)
        self._is_positive |= np.any(recorded > 0.0, axis=0)
        self._add_moments(effort)

    def _compare_with_constant(self, effort: FloatArray, is_finite: BoolArray) -> None:
        """Compare efforts (N, J) with the first one of each joint."""
        if not len(effort):
            return
        first = effort[np.argmax(is_finite, axis=0), np.arange(effort.shape[1])]
        self._constant = np.where(np.isnan(self._constant), first, self._constant)
        self._is_constant &= ~np.any(is_finite & (effort != self._constant), axis=0)

    def _add_moments(self, effort: FloatArray) -> None:
        """Add the squares of successive efforts (N, J) and of their second differences."""
        bend = np.diff(effort, 2, axis=0)
        known = np.isfinite(bend)
        middle = np.where(known, effort[1:-1] if len(effort) > 2 else bend, 0.0)
        self._efforts += [
            np.count_nonzero(known, axis=0),
            np.sum(middle**2, axis=0),
            np.sum(np.where(known, bend, 0.0) ** 2, axis=0),
        ]

    def findings(self, model: RobotModel | None, moved: IntArray) -> list[Finding]:
        """Return the findings about required readings.

        ``moved`` (2, J) is the number of spans of time in which each joint moves down and up.
        """
        if not self.messages:
            return []
        joints = {} if model is None else {joint.name: joint for joint in model.joints}
        known = [i for i, name in enumerate(self._names) if model is None or name in joints]
        known = [i for i in known if self._names[i] not in self._held]
        driven = [i for i in known if model is None or joints[self._names[i]].effort > 0]
        moves = moved.sum(axis=0)
        # An effort of one value, not zero, although its joint moves.
        is_stuck = self._has_effort & self._is_constant & (moves >= FEWEST_MOVED)
        usable = [i for i in driven if self._has_effort[i] and not is_stuck[i]]
        return [
            *self._position_findings(known, has_model=model is not None),
            *self._unusable_findings(model, driven, is_stuck),
            *self._held_findings(joints),
            *self._unsigned_findings([i for i in usable if moved[:, i].min() >= FEWEST_REVERSING]),
            *self._noise_findings([i for i in usable if moves[i] > 0]),
            *self._absent("effort", [i for i in usable if self._without_effort[i]]),
        ]

    def _position_findings(self, known: list[int], *, has_model: bool) -> Iterator[Finding]:
        """Yield findings for joints whose positions some messages lack."""
        # Without a model, a joint that never has a position may not need one.
        most = self.messages if has_model else self.messages - 1
        absent = [i for i in known if 0 < self._without_position[i] <= most]
        least = MOST_MISSING * self.messages if has_model else np.inf
        fatal = [i for i in absent if self._without_position[i] >= least]
        yield from self._absent("position", fatal, Severity.UNUSABLE)
        yield from self._absent("position", [i for i in absent if i not in fatal])

    def _unusable_findings(
        self, model: RobotModel | None, driven: list[int], is_stuck: BoolArray
    ) -> Iterator[Finding]:
        """Yield findings for driven joints whose efforts are missing, zero or constant."""
        absent_or_zero = [i for i in driven if not self._has_effort[i]]
        stuck = [i for i in driven if is_stuck[i]]
        # The rows of a floating base and of wrist sensors are usable without any effort.
        has_others = model is not None and bool(model.floating or model.wrist_sensors)
        is_fatal = len(absent_or_zero) + len(stuck) == len(driven) and not has_others
        if model is None and not is_fatal:
            absent_or_zero = []  # they may be passive
        reported = {
            i: f"in no {self._kind}" if self._without_effort[i] == self.messages else "always zero"
            for i in absent_or_zero
        }
        reported |= {i: f"always {self._constant[i]:.6g} although it moves" for i in stuck}
        for what in sorted(set(reported.values())):
            places = [i for i in driven if reported.get(i) == what]
            rows = "its row" if len(places) == 1 else "their rows"
            yield Finding.of(
                self._topic,
                Kind.MISSING_JOINT,
                f"the effort of {list_names(self._names, places)} is {what}, {rows} of the "
                f"equation of motion cannot be used; {self._remedy('effort')}, or, of a joint "
                'without a drive, write effort="0" and a velocity in the `<limit>` of the model',
                {"joints": len(places)},
                Severity.UNUSABLE if is_fatal else Severity.WARNING,
            )

    def _held_findings(self, joints: Mapping[str, Joint]) -> Iterator[Finding]:
        """Yield a finding that names the driven joints that are missing from the log."""
        places = [
            i
            for i, name in enumerate(self._names)
            if name in self._held and name in joints and joints[name].effort > 0
        ]
        if places:
            rows = "its row" if len(places) == 1 else "their rows"
            moving = "it if it moves" if len(places) == 1 else "them if they move"
            yield Finding.of(
                self._topic,
                Kind.MISSING_JOINT,
                f"the log lacks {list_names(self._names, places)}, so {rows} of the equation of "
                f"motion cannot be used; record {moving}",
                {"joints": len(places)},
                Severity.WARNING,
            )

    def _unsigned_findings(self, places: list[int]) -> Iterator[Finding]:
        """Yield a finding if efforts of all these joints, which move both ways, have one sign.

        Friction alone changes its sign, and a joint with a vertical axis carries no weight.
        """
        is_negative, is_positive = self._is_negative[places].any(), self._is_positive[places].any()
        if len(places) < FEWEST_UNSIGNED or (is_negative and is_positive):
            return
        never = "positive" if is_negative else "negative"
        yield Finding.of(
            self._topic,
            Kind.UNSIGNED_EFFORT,
            f"the effort of {list_names(self._names, places)} is never {never}, although the "
            "joints move both ways, as if it were a magnitude; let the driver give efforts their "
            "signs",
            {"joints": len(places)},
            Severity.WARNING,
        )

    def _noise_findings(self, moving: list[int]) -> Iterator[Finding]:
        """Yield a finding if the efforts of joints that move are almost only noise."""
        ratio = self._signal_to_noise
        count, square, bend = self._efforts
        is_noise = (ratio < LEAST_SIGNAL) & (count >= FEWEST_EFFORTS) & (bend < WHITE * square)
        places = [i for i in moving if is_noise[i]]
        if not places:
            return
        low, high = float(ratio[places].min()), float(ratio[places].max())
        span = f"{low:.2g}" if len(places) == 1 else f"{low:.2g} to {high:.2g}"
        yield Finding.of(
            self._topic,
            Kind.EFFORT_NOISE,
            f"the effort of {list_names(self._names, places)} is almost only noise, with a "
            f"signal-to-noise ratio of {span}; load the joints more, by faster motion or a "
            "payload, or measure efforts with less noise",
            {f"{self._names[i]}/signal_to_noise": float(ratio[i]) for i in places},
            Severity.WARNING,
        )

    def _absent(
        self, kind: str, places: list[int], severity: Severity = Severity.WARNING
    ) -> Iterator[Finding]:
        """Yield a finding about joints whose positions or efforts some messages lack."""
        if not places:
            return
        counts = self._without_position if kind == "position" else self._without_effort
        most = int(counts[places].max())
        yield Finding.of(
            self._topic,
            Kind.MISSING_JOINT,
            f"{'' if len(places) == 1 else 'up to '}{most} of {self.messages} {self._kind}s have "
            f"no {kind} of {list_names(self._names, places)}; {self._remedy(kind)}",
            {"messages": most, "share": most / self.messages},
            severity,
        )

    @property
    def _kind(self) -> str:
        return "row" if self._is_arrays else "message"

    def _remedy(self, quantity: str) -> str:
        if self._is_arrays:
            return f"give the {quantity} of every joint in each row"
        return f"let the driver fill JointState.{quantity}"

    @property
    def _signal_to_noise(self) -> FloatArray:
        """Ratio of the effort's RMS signal to its RMS noise, (J,); infinite without noise.

        White noise of variance σ² has second differences of variance 6σ². Those of a signal that
        is smooth from message to message are small.
        """
        _, square, bend = self._efforts
        noise = bend / 6
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.sqrt(np.maximum(square / noise - 1, 0.0))
        return np.where(noise > 0, ratio, np.inf)
