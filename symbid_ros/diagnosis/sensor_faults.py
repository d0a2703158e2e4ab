"""Detects frozen and saturated readings and masks their messages."""

from collections import Counter, defaultdict
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, distinct
from symbid_ros.diagnosis.findings import FaultSpan, Finding, Kind, Severity
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.streams import Stream, Streams

# A reading is frozen if it stays bitwise equal for this time and this many messages,
SHORTEST = 0.1  # s
FEWEST_REPEATS = 20
# although it changes with this share of all other messages, which exempts slow encoders and
# channels without a signal,
LEAST_CHANGES = 0.9
# and while another reading changes with this share of its messages, because a simulation without
# noise may come to rest, where its joints slow down first.
LEAST_MOTION = 0.5
# A joint rests whose position changes by this share of its typical speed,
RESTING = 0.05
# or whose position stops changing at this share of it over the messages before,
SLOW = 0.25
ONSET = 10
# and goes on with a step below this multiple of the typical one.
JUMP = 5.0
# An encoder of a resting joint may flicker by this many of its smallest steps.
FLICKER = 2.0


@dataclass(frozen=True)
class ChannelChanges:
    """Changes of one reading.

    Attributes
    ----------
    topic, name : str
        Topic and channel; the name is empty if the reading is the whole message.
    stamp : (N,) int64
        Nanoseconds.
    changed : (N,) bool
        Whether the reading differs from the previous message.
    values : (N,) or (N, c) float64
        The reading.
    position : (N,) float64 or None
        Position of the joint that the reading belongs to; None for other sensors.
    is_position : bool
        Whether the reading is that position.
    """

    topic: str
    name: str
    stamp: IntArray
    changed: BoolArray
    values: FloatArray
    position: FloatArray | None = None
    is_position: bool = False

    def is_blank(self, message: int) -> bool:
        """Return whether a reading is exactly zero or NaN, which is not frozen."""
        values = self.values[message]
        return bool(np.all((values == 0) | np.isnan(values)))

    def is_at_rest(self, first: int, stop: int) -> bool:
        """Return whether the joint rests from one message up to another.

        An effort may be constant while the joint keeps its position. A position is that of a
        resting joint if the joint slows down before and does not jump afterwards.
        """
        if self.position is None:
            return False
        steps, typical, flicker = self._steps
        if not self.is_position:
            moved = float(np.ptp(self.position[first:stop]))
            return moved <= RESTING * typical * (stop - first)
        begin = max(first - ONSET - 1, 0)
        before = steps[begin : max(first - 1, 0)]
        before = before[np.isfinite(before)]
        onset = float(np.mean(before)) if len(before) else 0.0
        moved = float(np.ptp(self.position[begin:first])) if first > begin else 0.0
        slows_down = onset <= SLOW * typical or moved <= flicker
        return slows_down and not self.jumps_after(stop)

    def jumps_after(self, stop: int) -> bool:
        """Return whether a position jumps at a message."""
        steps, typical, flicker = self._steps
        jump = float(steps[stop - 1]) if stop <= len(steps) else 0.0
        return jump > max(JUMP * typical, flicker)

    @cached_property
    def _steps(self) -> tuple[FloatArray, float, float]:
        """Sizes of the position's steps (N - 1,), a typical one, and the largest of a flicker."""
        position = np.empty(0) if self.position is None else self.position
        steps = np.abs(np.diff(position))
        known = steps[np.isfinite(steps)]
        typical = float(np.sqrt(np.mean(known**2))) if len(known) else 0.0
        return steps, typical, FLICKER * float(np.min(known[known > 0], initial=np.inf))

    def stops(self, *, continues: bool) -> bool:
        """Return whether a position that is constant up to the last message stopped abruptly.

        Without any change that is decided by whether the previous slice's did.
        """
        changes = np.flatnonzero(self.changed)
        if not self.is_position or len(changes) == 0:
            return continues
        return not self.is_at_rest(int(changes[-1]), len(self.stamp))


@dataclass
class ChangeCounts:
    """How often one reading changed, and when it was constant while others changed.

    Attributes
    ----------
    messages, changes : int
        All messages, and those that differ from the previous one.
    frozen_messages : int
        Messages in the runs.
    runs : list of (int, int)
        First and last stamp, ns, of every run without a change.
    jumps, resumptions : int
        Runs after which a position jumped, and after which it continued from the same value.
    continues : bool
        Whether the position stopped abruptly, up to the end of the last slice.
    """

    messages: int = 0
    changes: int = 0
    frozen_messages: int = 0
    runs: list[tuple[int, int]] = field(default_factory=list)
    jumps: int = 0
    resumptions: int = 0
    continues: bool = False

    @property
    def is_frozen(self) -> bool:
        """Whether the reading changes often enough outside the runs to call them frozen.

        A sticking joint also stops abruptly, but then continues from the same position. The reading
        of a frozen encoder jumps, unless the joint happens to have returned.
        """
        others = self.messages - self.frozen_messages
        changes_often = self.changes >= max(LEAST_CHANGES * others, FEWEST_REPEATS)
        return bool(self.runs) and changes_often and self.jumps >= self.resumptions


@dataclass
class FreezeDetector:
    """Detects frozen readings, slice by slice."""

    readings: dict[tuple[str, str], ChangeCounts] = field(default_factory=dict)

    def add(self, streams: Streams, during: tuple[int, int] = ALWAYS) -> None:
        """Take what was stamped from the first up to the second, ns."""
        readings = list(_all_changes(streams, during))
        for reading in readings:
            counts = self.readings.setdefault((reading.topic, reading.name), ChangeCounts())
            counts.messages += len(reading.stamp)
            counts.changes += int(np.count_nonzero(reading.changed))
            continued = counts.continues
            counts.continues = reading.stops(continues=continued)
            for first, stop in _constant_runs(reading):
                # The previous slice shows how this run began.
                goes_on = continued and first == 0 and not reading.changed[0]
                start, end = int(reading.stamp[first]), int(reading.stamp[stop - 1])
                if not goes_on and reading.is_at_rest(first, stop):
                    continue
                # All joints that stop abruptly are those of a driver that repeats its last message.
                if reading.is_position or _others_move(readings, reading, start, end):
                    counts.frozen_messages += stop - first
                    counts.runs.append((start, end))
                    if reading.is_position and stop < len(reading.stamp):
                        jumps = reading.jumps_after(stop)
                        counts.jumps += jumps
                        counts.resumptions += not jumps

    def findings(self, limited: Container[tuple[str, str]]) -> list[Finding]:
        """Return the frozen readings, except channels (topic, name) that are at a limit."""
        found = []
        alike = defaultdict[tuple[str, tuple[tuple[int, int], ...]], list[str]](list)
        for (topic, name), counts in self.readings.items():
            if counts.is_frozen and (topic, name) not in limited:
                alike[topic, tuple(counts.runs)].append(name)
        for (topic, runs), names in alike.items():
            duration = sum(end - start for start, end in runs) * 1e-9
            since = runs[0][0] * 1e-9
            what = self._described(topic, names)
            found.append(
                Finding(
                    Kind.FROZEN,
                    topic,
                    Severity.WARNING,
                    f"{topic}: {what} {'is' if len(names) == 1 else 'are'} frozen for "
                    f"{duration:.3g} s in total, first at {since:.3f} s; check the sensor and its "
                    "driver, and exclude that time",
                    {"frozen_s": duration, "since_s": since},
                )
            )
        return found

    def _described(self, topic: str, names: Sequence[str]) -> str:
        """Return which channels of a topic are meant, those of all joints in short."""
        if not any(names):
            return "the reading"
        described = []
        for kind in ("position", "effort"):
            start = f"{kind} of "
            own = [name.removeprefix(start) for name in names if name.startswith(start)]
            every = sum(where == topic and name.startswith(start) for where, name in self.readings)
            if own:
                described.append(
                    start + ("all joints" if 2 < len(own) == every else ", ".join(own))
                )
        return " and ".join(described)

    def spans(self, limited: Container[tuple[str, str]]) -> list[FaultSpan]:
        """Return when readings were frozen, except channels (topic, name) that are at a limit."""
        return [
            FaultSpan(Kind.FROZEN, topic, start, stop)
            for (topic, name), counts in self.readings.items()
            if counts.is_frozen and (topic, name) not in limited
            for start, stop in counts.runs
        ]


def _all_changes(streams: Streams, during: tuple[int, int]) -> Iterator[ChannelChanges]:
    joints = streams.joints
    inside = _inside(joints.stamp, during)
    stamp, position = joints.stamp[inside], np.asfortranarray(joints.position[inside])
    for field_name in ("position", "effort"):
        values = np.asfortranarray(getattr(joints, field_name))
        changed = _changes(values)[inside]
        for column, name in enumerate(joints.names):
            yield ChannelChanges(
                joints.topic,
                f"{field_name} of {name}",
                stamp,
                changed[:, column],
                values[inside, column],
                position[:, column],
                is_position=field_name == "position",
            )
    for imu in streams.imus:
        yield _any_changes(imu, during, imu.angular_velocity, imu.linear_acceleration)
    for wrench in streams.wrenches:
        yield _any_changes(wrench, during, wrench.force, wrench.torque)


def _any_changes(sensor: Stream, during: tuple[int, int], *vectors: FloatArray) -> ChannelChanges:
    values = _columns(vectors)
    inside = _inside(sensor.stamp, during)
    # Uniting columns takes a fraction of the time of np.any for each message.
    changed: BoolArray = reduce(np.logical_or, _changes(values)[inside].T)
    return ChannelChanges(sensor.topic, "", sensor.stamp[inside], changed, values[inside])


def _changes(values: FloatArray) -> BoolArray:
    """Return which values (N, c) differ from those before."""
    changed = np.ones_like(values, dtype=bool)
    changed[1:] = differs(values[1:], values[:-1])
    return changed


def _columns(vectors: Sequence[FloatArray]) -> FloatArray:
    """Return vectors (N, 3) beside one another, in Fortran order: columns are used one by one."""
    return np.vstack([one.T for one in vectors]).T


def _inside(stamp: IntArray, during: tuple[int, int]) -> slice:
    return slice(*np.searchsorted(stamp, during).tolist())


def differs(later: FloatArray, earlier: FloatArray) -> BoolArray:
    """Return which values differ; NaN, a missing value, equals NaN."""
    differs: BoolArray = later != earlier
    if np.isnan(later).any():
        differs &= ~(np.isnan(later) & np.isnan(earlier))
    return differs


def _constant_runs(reading: ChannelChanges) -> Iterator[tuple[int, int]]:
    """Yield start and stop index of the messages of every run that is long enough."""
    edges = np.append(np.flatnonzero(reading.changed), len(reading.stamp))
    if len(edges) == 1 or edges[0] > 0:
        edges = np.append(0, edges)
    for place in np.flatnonzero(np.diff(edges) >= FEWEST_REPEATS).tolist():
        first, stop = int(edges[place]), int(edges[place + 1])
        duration = (reading.stamp[stop - 1] - reading.stamp[first]) * 1e-9
        if duration >= SHORTEST and not reading.is_blank(first):
            yield first, stop


def _others_move(
    readings: Sequence[ChannelChanges], own: ChannelChanges, start: int, end: int
) -> bool:
    for other in readings:
        if other is own:
            continue
        first, stop = np.searchsorted(other.stamp, [start, end]).tolist()
        if stop - first >= 3 and np.mean(other.changed[first:stop]) >= LEAST_MOTION:
            return True
    return False


# A channel is saturated if it was at its extreme value this often,
FEWEST_AT_LIMIT = 10
# this often in a row,
LONGEST_RUN = 5
# this many times as often as at any of its next values,
FREQUENCY_RATIO = 5
NEXT_VALUES = 16
# and had this many values in total, because a coarse channel is often at its extremes.
VALUES = 50
MANY = 256  # values of which the distinct ones are found quickly
SAMPLE = 4096  # values in which extreme ones are sought first


@dataclass
class ExtremeCounts:
    """How often a channel was at its extreme values.

    Attributes
    ----------
    counts : Counter of float
        Messages at each of the extreme_values values.
    longest : dict of float to int
        Longest run of messages at each value.
    """

    counts: Counter[float] = field(default_factory=Counter)
    longest: dict[float, int] = field(default_factory=dict)

    def add(self, values: FloatArray, extreme_values: FloatArray) -> None:
        """Add values (N,) and count those equal to the given extreme values."""
        if not len(extreme_values):
            return
        lowest, highest = extreme_values.min(), extreme_values.max()
        places = np.flatnonzero((values >= lowest) & (values <= highest))
        found = values[places]
        if len(places) == len(extreme_values):  # each value occurs once
            self.counts.update(extreme_values.tolist())
            self.longest = dict.fromkeys(extreme_values.tolist(), 1) | self.longest
            return
        for value in extreme_values.tolist():
            at = places[found == value]
            ends = np.flatnonzero(np.diff(at) > 1)
            runs = np.diff(ends, prepend=-1, append=len(at) - 1)
            self.counts[value] += len(at)
            self.longest[value] = max(self.longest.get(value, 0), int(runs.max()))

    def keep(self, sign: int) -> None:
        """Keep only the largest (1) or smallest (-1) values."""
        extreme_values = sorted(self.counts, key=lambda value: -sign * value)[: NEXT_VALUES + 1]
        self.counts = Counter({value: self.counts[value] for value in extreme_values})
        self.longest = {value: self.longest[value] for value in extreme_values}

    def limit(self, sign: int) -> tuple[float, int] | None:
        """Return the limit and the number of messages at it; None if the channel is not saturated.

        Requires at least two values.
        """
        value = max(self.counts, key=lambda value: sign * value)
        count = self.counts[value]
        others = max(self.counts[other] for other in self.counts if other != value)
        is_limit = (
            count >= max(FEWEST_AT_LIMIT, FREQUENCY_RATIO * others)
            and self.longest[value] >= LONGEST_RUN
        )
        return (value, count) if is_limit else None


@dataclass
class SaturationDetector:
    """Detects saturated channels, slice by slice."""

    extremes: dict[tuple[str, str, int], ExtremeCounts] = field(default_factory=dict)
    # Distinct values of each channel; of those with more than VALUES, a part.
    values: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, streams: Streams, during: tuple[int, int] = ALWAYS) -> None:
        """Take what was stamped from the first up to the second, ns."""
        for topic, names, stamp, readings in channels(streams):
            inside = slice(*np.searchsorted(stamp, during).tolist())
            block = np.asfortranarray(readings[inside])
            changed = differs(block[1:], block[:-1])
            moving = changed.sum(axis=1, dtype=np.int16)
            for column, name in enumerate(names):
                # At rest without noise all channels repeat; only a limit stops a single channel.
                others_move = moving - changed[:, column] > 0
                self._add(topic, name, block[1:, column], others_move)

    def _add(self, topic: str, name: str, values: FloatArray, moving: BoolArray) -> None:
        counted = moving & np.isfinite(values)
        if not counted.all():
            values = values[counted]
        if self.values[topic, name] < VALUES:
            count = max(len(distinct(some)) for some in (values[:MANY], values[-MANY:]))
            if count < VALUES:
                count = len(distinct(values))
            self.values[topic, name] = max(self.values[topic, name], count)
        for sign in (1, -1):
            extreme_values = sign * _largest(sign * values, NEXT_VALUES + 1)
            extreme = self.extremes.setdefault((topic, name, sign), ExtremeCounts())
            extreme.add(values, extreme_values)
            extreme.keep(sign)

    @property
    def limits(self) -> dict[tuple[str, str, int], tuple[float, int]]:
        """Limit of each saturated channel by topic, name and sign, and the messages at it."""
        return {
            (topic, name, sign): limit
            for (topic, name, sign), extreme in self.extremes.items()
            if self.values[topic, name] >= VALUES and (limit := extreme.limit(sign)) is not None
        }

    def findings(self) -> list[Finding]:
        """Return a finding for each saturated channel."""
        found = []
        for (topic, name, sign), (value, count) in self.limits.items():
            found.append(
                Finding(
                    Kind.SATURATED,
                    topic,
                    Severity.WARNING,
                    f"{topic}: {name} is exactly {value:.6g} in {count} messages and never "
                    f"{'more' if sign > 0 else 'less'}; widen the sensor's range or move less",
                    {"limit": value, "messages": count},
                )
            )
        return found


def _largest(values: FloatArray, count: int) -> FloatArray:
    """Return the largest distinct values, at most ``count`` of them."""
    # Sorting all values takes long: those below one of the largest of a sample are omitted.
    sample = values[:: max(1, len(values) // SAMPLE)]
    if len(sample) > count:
        found = distinct(values[values >= np.partition(sample, -count)[-count]])
        if len(found) >= count:
            return found[-count:]
    return distinct(values)[-count:]


def channels(streams: Streams) -> Iterator[tuple[str, list[str], IntArray, FloatArray]]:
    """Yield topic, names, stamps (N,) and readings (N, c) of channels that may saturate."""
    joints = streams.joints
    yield joints.topic, [f"effort of {name}" for name in joints.names], joints.stamp, joints.effort
    for imu in streams.imus:
        names = [
            f"{kind}.{axis}"
            for kind in ("angular_velocity", "linear_acceleration")
            for axis in "xyz"
        ]
        yield (
            imu.topic,
            names,
            imu.stamp,
            _columns([imu.angular_velocity, imu.linear_acceleration]),
        )
    for wrench in streams.wrenches:
        names = [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]
        yield wrench.topic, names, wrench.stamp, _columns([wrench.force, wrench.torque])


def mask_faulty_messages(streams: Streams) -> tuple[Streams, tuple[Finding, ...]]:
    """Remove frozen and saturated messages, and return the findings that explain why.

    The removed messages leave gaps, which are not interpolated.
    """
    freezing, saturation = FreezeDetector(), SaturationDetector()
    freezing.add(streams)
    saturation.add(streams)
    limits = saturation.limits
    limited = {(topic, name) for topic, name, _ in limits}
    findings = (*saturation.findings(), *freezing.findings(limited))
    if not findings:
        return streams, ()
    wrong: dict[str, list[BoolArray]] = defaultdict(list)
    for topic, names, _, readings in channels(streams):
        for (where, name, _), (value, _) in limits.items():
            if where == topic:
                wrong[topic].append(np.asarray(readings[:, names.index(name)] == value))
    stamps = {stream.topic: stream.stamp for stream in streams.all}
    for (topic, name), counts in freezing.readings.items():
        if counts.is_frozen and (topic, name) not in limited:
            stamp = stamps[topic]
            wrong[topic] += [(stamp >= start) & (stamp <= end) for start, end in counts.runs]

    def kept(stream: Stream) -> slice | BoolArray:
        faulty = wrong.get(stream.topic)
        return ~np.logical_or.reduce(faulty) if faulty else slice(None)

    return streams.select(kept), findings
