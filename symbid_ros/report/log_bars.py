"""Bars of a real log: which times were used, and which positions and speeds occurred."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.identification.report_data import QUANTILES, Coverage, ForceSeries
from symbid_ros.report.content import JointLimits
from symbid_ros.report.first_screen import rounded_up
from symbid_ros.report.formatting import significant

TICKS = 4  # at most, beside zero
END_TOLERANCE = 0.005  # by which the last one may lie behind the end
# A longer time without data or faults, s, is a pause between recordings; its width, %.
LONGEST_IDLE, PAUSE_WIDTH = 5.0, 2.0
MOST_LABELLED = 4  # parts between pauses
# A bar this short, % of the width, would be invisible.
LEAST_WIDTH = 0.3
FAULT_TITLES = {"gap": "gap", "frozen": "frozen", "silent": "no messages"}
_LOW, _HIGH = QUANTILES.index(0.05), QUANTILES.index(0.95)


@dataclass(frozen=True)
class TimeBar:
    """A part of a row, in percent of the log."""

    left: float
    width: float
    kind: str  # used, break, held-out, gap, frozen or silent
    text: str


@dataclass(frozen=True)
class TimeRow:
    """A row of the timeline."""

    name: str
    bars: tuple[TimeBar, ...]


@dataclass(frozen=True)
class Timeline:
    """Which times of a log were used; ``ticks`` are positions in percent with their labels."""

    rows: tuple[TimeRow, ...]
    ticks: tuple[tuple[float, str], ...]


def timeline(coverage: Coverage, forces: ForceSeries | None, used_title: str = "used") -> Timeline:
    """Return the used times, the held-out part, and the faults of each topic."""
    axis = _TimeAxis.of(coverage)

    def bar(start: float, stop: float, kind: str, what: str) -> TimeBar:
        left, right = axis.place(start), axis.place(stop)
        width = max(right - left, LEAST_WIDTH)
        return TimeBar(
            round(min(left, 100 - width), 2),
            round(width, 2),
            kind,
            f"{what} from {start:.2f} to {stop:.2f} s",
        )

    used = coverage.used.tolist()
    parts = [bar(start, stop, "used", used_title) for start, stop in used]
    # Gaps that are too short to be seen between two bars are drawn over them.
    parts += [
        bar(stop, start, "break", "not used")
        for (_, stop), (start, _) in pairwise(used)
        if axis.place(start) - axis.place(stop) < LEAST_WIDTH
    ]
    rows = [TimeRow(used_title, tuple(parts))]
    if forces is not None:
        kind, title = ("held-out", "held out") if forces.is_held_out else ("shown", "predicted")
        rows.append(TimeRow(title, (bar(forces.start, forces.stop, kind, title),)))
    topics = dict.fromkeys(one["stream"] for one in coverage.faults)
    for topic in topics:
        bars = tuple(
            bar(one["start"], one["stop"], one["kind"], FAULT_TITLES.get(one["kind"], one["kind"]))
            for one in coverage.faults
            if one["stream"] == topic
        )
        rows.append(TimeRow(topic or "all topics", bars))
    return Timeline(tuple(rows), axis.ticks())


@dataclass(frozen=True)
class _TimeAxis:
    """Places of times in percent; pauses between recordings are short, however long they lasted.

    Attributes
    ----------
    times, places : (2 P,) float64
        Start and end of each part without a pause, s, and their places.
    """

    times: FloatArray
    places: FloatArray

    @classmethod
    def of(cls, coverage: Coverage) -> "_TimeAxis":
        spans = coverage.used.tolist()
        spans += [[float(one["start"]), float(one["stop"])] for one in coverage.faults]
        length = max([coverage.duration, *(stop for _, stop in spans), 1e-9])
        parts = [[0.0, 0.0 if spans else length]]
        for start, stop in sorted([*spans, [length, length]]):
            if start - parts[-1][1] > LONGEST_IDLE:
                parts.append([start, stop])
            parts[-1][1] = max(parts[-1][1], stop)
        lengths = np.array([stop - start for start, stop in parts])
        widths = lengths * (100 - PAUSE_WIDTH * (len(parts) - 1)) / max(lengths.sum(), 1e-9)
        left = np.cumsum(widths) - widths + PAUSE_WIDTH * np.arange(len(parts))
        return cls(np.array(parts).ravel(), np.stack([left, left + widths], axis=1).ravel())

    def place(self, time: float) -> float:
        return float(np.interp(time, self.times, self.places))

    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Return places and labels at round times, or of each part if there are pauses."""
        times = self.times
        if len(times) > 2:
            few = len(times) <= 2 * MOST_LABELLED
            times = np.append(times[::2], times[-1]) if few else times[[0, -1]]
            return tuple((self.place(time), f"{significant(time)} s") for time in times.tolist())
        step, length = rounded_up(times[-1] / TICKS), times[-1] * (1 + END_TOLERANCE)
        places = (step * np.arange(int(length / step) + 1)).tolist()
        return tuple((self.place(time), f"{time:g} s") for time in places)


@dataclass(frozen=True)
class JointRange:
    """Positions and speeds of one joint, bars in percent.

    Attributes
    ----------
    name : str
    left, width : float
        All positions, within the limits of the joint if it has any.
    inner_left, inner_width : float
        The middle 90 % of the time.
    positions, speeds : str
        The same in words.
    speed_width : float
        Largest speed in percent of the fastest joint's.
    share : str
        Part of the range between the limits; empty without limits.
    """

    name: str
    left: float
    width: float
    inner_left: float
    inner_width: float
    positions: str
    speeds: str
    speed_width: float
    share: str


def joint_ranges(coverage: Coverage, limits: Mapping[str, JointLimits]) -> tuple[JointRange, ...]:
    """Return positions and speeds visited by each joint that has limits, finite or not."""
    known = [index for index, name in enumerate(coverage.joints) if name in limits]
    fastest = {
        kind: max(
            (
                float(coverage.speed[index, _HIGH])
                for index in known
                if limits[coverage.joints[index]].is_prismatic is kind
            ),
            default=0.0,
        )
        for kind in (False, True)
    }
    ranges = []
    for index in known:
        name = coverage.joints[index]
        limit, position = limits[name], coverage.position[index]
        first, last = float(position[0]), float(position[-1])
        unit = "m" if limit.is_prismatic else "rad"
        span = limit.upper - limit.lower
        is_limited = bool(np.isfinite(span) and span > 0)
        start = min(limit.lower, first) if is_limited else first
        stop = max(limit.upper, last) if is_limited else last
        scale = 100 / (stop - start) if stop > start else 0.0
        low, high = float(position[_LOW]), float(position[_HIGH])
        quick, quickest = float(coverage.speed[index, _HIGH]), fastest[limit.is_prismatic]
        ranges.append(
            JointRange(
                name,
                round(scale * (first - start), 1),
                round(max(scale * (last - first), LEAST_WIDTH), 1),
                round(scale * (low - start), 1),
                round(max(scale * (high - low), LEAST_WIDTH), 1),
                f"{significant(first)} to {significant(last)} {unit}".replace("-", "−"),
                f"{significant(quick)} {unit}/s",
                round(100 * quick / quickest, 1) if quickest > 0 else 0.0,
                f"{100 * (last - first) / span:.0f} %" if is_limited else "",
            )
        )
    return tuple(ranges)
