"""Readings that pile up at their largest or smallest value."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.diagnosis.freezing import differs
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.streams import Streams

# A channel is saturated that was at its extreme so often,
FEWEST = 10
# so often in a row,
IN_A_ROW = 5
# so many times as often as at any of its next values,
OFTENER = 5
NEXT = 16
# and had so many values in all: a coarse one is at its extremes all the time.
VALUES = 50


@dataclass
class Extreme:
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
        is_limit = count >= max(FEWEST, OFTENER * others) and self.longest[value] >= IN_A_ROW
        return (value, count) if is_limit else None


@dataclass
class Saturation:
    """Looks for saturated channels, slice by slice."""

    extremes: dict[tuple[str, str, int], Extreme] = field(default_factory=dict)
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
            extreme = self.extremes.setdefault((topic, name, sign), Extreme())
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
