"""Readings that stay the same, bit for bit, while the rest of the robot goes on moving."""

from collections import Counter, defaultdict
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

# A reading is frozen that stays the same for so long, and for so many messages,
SHORTEST = 0.1  # s
FEWEST_REPEATS = 20
# though it changes with this share of all other messages: neither encoders that count slow
# steps nor a channel that nothing drives are asked,
LIVELY = 0.9
# and while some other reading changes with this share of its messages: a simulation without
# noise may come to rest altogether.
MOVING = 0.5


@dataclass(frozen=True)
class ChannelChanges:
    """What one sensor reads.

    Attributes
    ----------
    topic, name : str
        Where it is found; the name is empty where it is the whole message.
    stamp : (N,) int64
        Nanoseconds.
    changed : (N,) bool
        Whether a bit of it differs from the message before.
    is_blank : (N,) bool
        Whether it is exactly zero, which a simulated sensor may read for as long as it likes.
    """

    topic: str
    name: str
    stamp: IntArray
    changed: BoolArray
    is_blank: BoolArray


@dataclass
class ChangeCounts:
    """How often one reading changed, and when it did not although others did.

    Attributes
    ----------
    messages, changes : int
        In all, and those that differ from the one before.
    frozen_messages : int
        In the runs.
    runs : list of (int, int)
        First and last stamp, ns, of every stretch without a change.
    """

    messages: int = 0
    changes: int = 0
    frozen_messages: int = 0
    runs: list[tuple[int, int]] = field(default_factory=list)

    @property
    def is_frozen(self) -> bool:
        """Whether some of its runs are none of its habits."""
        others = self.messages - self.frozen_messages
        return bool(self.runs) and self.changes >= max(LIVELY * others, FEWEST_REPEATS)


@dataclass
class FreezeDetector:
    """Looks for frozen readings, slice by slice."""

    readings: dict[tuple[str, str], ChangeCounts] = field(default_factory=dict)

    def add(self, streams: Streams, during: tuple[int, int] = ALWAYS) -> None:
        """Take what was stamped from the first up to the second, ns."""
        readings = list(_readings(streams, during))
        for reading in readings:
            still = self.readings.setdefault((reading.topic, reading.name), ChangeCounts())
            still.messages += len(reading.stamp)
            still.changes += int(np.count_nonzero(reading.changed))
            for first, stop in _runs(reading):
                begin, end = int(reading.stamp[first]), int(reading.stamp[stop - 1])
                if _others_move(readings, reading, begin, end):
                    still.frozen_messages += stop - first
                    still.runs.append((begin, end))

    def findings(self, limited: Container[tuple[str, str]]) -> list[Finding]:
        """Return what froze, but for channels (topic, name) that stand still at a limit."""
        found = []
        for (topic, name), still in self.readings.items():
            if not still.is_frozen or (topic, name) in limited:
                continue
            lasting = sum(end - begin for begin, end in still.runs) * 1e-9
            since = still.runs[0][0] * 1e-9
            what = f"{topic}: {name or 'the reading'}"
            found.append(
                Finding(
                    Kind.FROZEN,
                    topic,
                    Severity.WARNING,
                    f"{what} stays the same to the last bit for {lasting:.3g} s in all, "
                    f"first at {since:.3f} s, while others change; look after the "
                    "sensor or its driver and leave that time out",
                    {"frozen_s": lasting, "since_s": since},
                )
            )
        return found


def _readings(streams: Streams, during: tuple[int, int]) -> Iterator[ChannelChanges]:
    joints = streams.joints
    for field_name in ("position", "effort"):
        values = getattr(joints, field_name)
        for column, name in enumerate(joints.names):
            yield _reading(
                (joints.topic, f"{field_name} of {name}"),
                joints.stamp,
                values[:, column : column + 1],
                during,
            )
    for imu in streams.imus:
        values = np.hstack([imu.angular_velocity, imu.linear_acceleration])
        yield _reading((imu.topic, ""), imu.stamp, values, during)
    for wrench in streams.wrenches:
        values = np.hstack([wrench.force, wrench.torque])
        yield _reading((wrench.topic, ""), wrench.stamp, values, during)


def _reading(
    name: tuple[str, str], stamp: IntArray, values: FloatArray, during: tuple[int, int]
) -> ChannelChanges:
    inside = slice(*np.searchsorted(stamp, during).tolist())
    changed = np.ones(len(stamp), dtype=bool)
    changed[1:] = np.any(differs(values[1:], values[:-1]), axis=1)
    # Zeros, or NaN: what nobody measures does not freeze.
    is_blank = ~np.any(np.nan_to_num(values), axis=1)
    return ChannelChanges(*name, stamp[inside], changed[inside], is_blank[inside])


def differs(later: FloatArray, earlier: FloatArray) -> BoolArray:
    """Tell which values are not the same; NaN, what a message does not say, is the same as NaN."""
    differs: BoolArray = later != earlier
    if np.isnan(later).any():
        differs &= ~(np.isnan(later) & np.isnan(earlier))
    return differs


def _runs(reading: ChannelChanges) -> Iterator[tuple[int, int]]:
    """Yield first and last but one of the messages of every run that is long enough."""
    edges = np.append(np.flatnonzero(reading.changed), len(reading.stamp))
    if len(edges) == 1 or edges[0] > 0:
        edges = np.append(0, edges)
    for place in np.flatnonzero(np.diff(edges) >= FEWEST_REPEATS).tolist():
        first, stop = int(edges[place]), int(edges[place + 1])
        lasting = (reading.stamp[stop - 1] - reading.stamp[first]) * 1e-9
        if lasting >= SHORTEST and not reading.is_blank[first]:
            yield first, stop


def _others_move(
    readings: Sequence[ChannelChanges], own: ChannelChanges, begin: int, end: int
) -> bool:
    for other in readings:
        if other is own:
            continue
        first, stop = np.searchsorted(other.stamp, [begin, end]).tolist()
        if stop - first >= 3 and np.mean(other.changed[first:stop]) >= MOVING:
            return True
    return False


# A channel is saturated that was at its extreme so often,
FEWEST_AT_LIMIT = 10
# so often in a row,
IN_A_ROW = 5
# so many times as often as at any of its next values,
OFTENER = 5
NEXT = 16
# and had so many values in all: a coarse one is at its extremes all the time.
VALUES = 50


@dataclass
class ExtremeCounts:
    """How often a channel was at its outermost values.

    Attributes
    ----------
    counts : Counter of float
        Messages at each of the outermost values.
    longest : dict of float to int
        The most of them in a row.
    """

    counts: Counter[float] = field(default_factory=Counter)
    longest: dict[float, int] = field(default_factory=dict)

    def add(self, values: FloatArray, outermost: FloatArray) -> None:
        """Take values (N,), of which some are given as the outermost ones, from outside in."""
        for value in outermost.tolist():
            at = np.flatnonzero(np.diff(np.concatenate([[0], values == value, [0]]).astype(int)))
            runs = at[1::2] - at[::2]
            self.counts[value] += int(runs.sum())
            self.longest[value] = max(self.longest.get(value, 0), int(runs.max(initial=0)))

    def keep(self, sign: int) -> None:
        """Forget what is not outermost upwards (1) or downwards (-1)."""
        outermost = sorted(self.counts, key=lambda value: -sign * value)[: NEXT + 1]
        self.counts = Counter({value: self.counts[value] for value in outermost})
        self.longest = {value: self.longest[value] for value in outermost}

    def limit(self, sign: int) -> tuple[float, int] | None:
        """Return the value at which it is saturated and how often; None if it is not.

        There must have been several values.
        """
        value = max(self.counts, key=lambda value: sign * value)
        count = self.counts[value]
        others = max(self.counts[other] for other in self.counts if other != value)
        is_limit = (
            count >= max(FEWEST_AT_LIMIT, OFTENER * others) and self.longest[value] >= IN_A_ROW
        )
        return (value, count) if is_limit else None


@dataclass
class SaturationDetector:
    """Looks for saturated channels, slice by slice."""

    extremes: dict[tuple[str, str, int], ExtremeCounts] = field(default_factory=dict)
    values: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, streams: Streams, during: tuple[int, int] = ALWAYS) -> None:
        """Take what was stamped from the first up to the second, ns."""
        for topic, names, stamp, readings in channels(streams):
            inside = slice(*np.searchsorted(stamp, during).tolist())
            block = readings[inside]
            changed = differs(block[1:], block[:-1])
            for column, name in enumerate(names):
                # At rest, and without noise, all channels repeat themselves; a limit is one's own.
                alone = np.count_nonzero(changed, axis=1) - changed[:, column] > 0
                self._add(topic, name, block[1:, column], alone)

    def _add(self, topic: str, name: str, values: FloatArray, moving: BoolArray) -> None:
        values = values[moving & np.isfinite(values)]
        distinct = np.unique(values)
        self.values[topic, name] = max(self.values[topic, name], len(distinct))
        for sign, outermost in ((1, distinct[::-1][: NEXT + 1]), (-1, distinct[: NEXT + 1])):
            extreme = self.extremes.setdefault((topic, name, sign), ExtremeCounts())
            extreme.add(values, outermost)
            extreme.keep(sign)

    @property
    def limits(self) -> dict[tuple[str, str, int], tuple[float, int]]:
        """By topic, name and sign the limit of each saturated channel, and how often it is met."""
        return {
            (topic, name, sign): limit
            for (topic, name, sign), extreme in self.extremes.items()
            if self.values[topic, name] >= VALUES and (limit := extreme.limit(sign)) is not None
        }

    def findings(self) -> list[Finding]:
        """Return which channels are saturated."""
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


def channels(streams: Streams) -> Iterator[tuple[str, list[str], IntArray, FloatArray]]:
    """Yield topic, names, stamps (N,) and readings (N, c) that a range may limit."""
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
            np.hstack([imu.angular_velocity, imu.linear_acceleration]),
        )
    for wrench in streams.wrenches:
        names = [f"wrench.{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]
        yield wrench.topic, names, wrench.stamp, np.hstack([wrench.force, wrench.torque])


S = TypeVar("S", JointStream, ImuStream, WrenchStream)


def mask_faulty_messages(streams: Streams) -> tuple[Streams, tuple[Finding, ...]]:
    """Return what is left of a stretch of a log, and why messages were left out.

    A gap is left where they were, across which nothing is interpolated.
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
    sensors: list[JointStream | ImuStream | WrenchStream] = [
        streams.joints,
        *streams.imus,
        *streams.wrenches,
    ]
    stamps = {sensor.topic: sensor.stamp for sensor in sensors}
    for (topic, name), still in freezing.readings.items():
        if still.is_frozen and (topic, name) not in limited:
            stamp = stamps[topic]
            wrong[topic] += [(stamp >= begin) & (stamp <= end) for begin, end in still.runs]
    return (
        replace(
            streams,
            joints=_without(streams.joints, wrong),
            imus=tuple(_without(imu, wrong) for imu in streams.imus),
            wrenches=tuple(_without(wrench, wrong) for wrench in streams.wrenches),
        ),
        findings,
    )


def _without(stream: S, wrong: dict[str, list[BoolArray]]) -> S:
    if stream.topic not in wrong:
        return stream
    kept = ~np.logical_or.reduce(wrong[stream.topic])
    arrays: dict[str, Any] = {
        entry.name: value[kept]
        for entry in fields(stream)
        if isinstance(value := getattr(stream, entry.name), np.ndarray)
    }
    return replace(stream, **arrays)
