"""Readings that stay the same, bit for bit, while the rest of the robot goes on moving."""

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.streams import Streams

# A reading is frozen that stays the same for so long, and for so many messages,
SHORTEST = 0.1  # s
FEWEST = 20
# though it changes with this share of all other messages: neither encoders that count slow
# steps nor a channel that nothing drives are asked,
LIVELY = 0.9
# and while some other reading changes with this share of its messages: a simulation without
# noise may come to rest altogether.
MOVING = 0.5


@dataclass(frozen=True)
class Reading:
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
class Stillness:
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
        return bool(self.runs) and self.changes >= max(LIVELY * others, FEWEST)


@dataclass
class Freezing:
    """Looks for frozen readings, slice by slice."""

    readings: dict[tuple[str, str], Stillness] = field(default_factory=dict)

    def add(self, streams: Streams, during: tuple[int, int] = ALWAYS) -> None:
        """Take what was stamped from the first up to the second, ns."""
        readings = list(_readings(streams, during))
        for reading in readings:
            still = self.readings.setdefault((reading.topic, reading.name), Stillness())
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


def _readings(streams: Streams, during: tuple[int, int]) -> Iterator[Reading]:
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
) -> Reading:
    inside = slice(*np.searchsorted(stamp, during).tolist())
    changed = np.ones(len(stamp), dtype=bool)
    changed[1:] = np.any(differs(values[1:], values[:-1]), axis=1)
    # Zeros, or NaN: what nobody measures does not freeze.
    is_blank = ~np.any(np.nan_to_num(values), axis=1)
    return Reading(*name, stamp[inside], changed[inside], is_blank[inside])


def differs(later: FloatArray, earlier: FloatArray) -> BoolArray:
    """Tell which values are not the same; NaN, what a message does not say, is the same as NaN."""
    differs: BoolArray = later != earlier
    if np.isnan(later).any():
        differs &= ~(np.isnan(later) & np.isnan(earlier))
    return differs


def _runs(reading: Reading) -> Iterator[tuple[int, int]]:
    """Yield first and last but one of the messages of every run that is long enough."""
    edges = np.append(np.flatnonzero(reading.changed), len(reading.stamp))
    if len(edges) == 1 or edges[0] > 0:
        edges = np.append(0, edges)
    for place in np.flatnonzero(np.diff(edges) >= FEWEST).tolist():
        first, stop = int(edges[place]), int(edges[place + 1])
        lasting = (reading.stamp[stop - 1] - reading.stamp[first]) * 1e-9
        if lasting >= SHORTEST and not reading.is_blank[first]:
            yield first, stop


def _others_move(readings: Sequence[Reading], own: Reading, begin: int, end: int) -> bool:
    for other in readings:
        if other is own:
            continue
        first, stop = np.searchsorted(other.stamp, [begin, end]).tolist()
        if stop - first >= 3 and np.mean(other.changed[first:stop]) >= MOVING:
            return True
    return False
