"""Joint states from several publishers merged into one stream by their stamps."""

from collections.abc import Collection, Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.signals.splines import interpolating_spline
from symbid_ros.signals.streams import JointStream

# A publisher may miss this many of its periods in a row before the merged stream has a gap.
LONGEST_GAP = 5.5
# Publishers count as equally fast up to this ratio of their periods; the first one then gives the
# clock, so that jitter does not change it from one slice of a log to the next.
SIMILAR_PERIOD = 1.5


def merged_joints(
    parts: Sequence[JointStream], source: str, needed: Collection[str] = ()
) -> JointStream:
    """Return the joints of all parts as one stream, on the stamps of the fastest part.

    Values with equal stamps are merged unchanged, others are interpolated by a cubic spline.
    Nothing is interpolated across a gap of a part.

    Parameters
    ----------
    parts : sequence of JointStream
        A joint that several parts name is taken from the first of them.
    source : str
        Name of the recording, for messages.
    needed : collection of str
        Joints of the model, where known: parts that add none of them are ignored.

    Raises
    ------
    DataError
        When parts do not overlap in time, or one has fewer than two messages.
    """
    chosen = _contributing(parts, needed)
    if len(chosen) == 1:
        return chosen[0][0]
    for part, _ in chosen:
        if len(part.stamp) < 2:
            raise DataError(
                f"{source}: {part.topic}: fewer than two messages name {', '.join(part.names)}; "
                "let the driver publish these joints at the rate of the others",
                "E310",
            )
    periods = [float(np.median(np.diff(part.stamp))) for part, _ in chosen]
    first = next(index for index, one in enumerate(periods) if one <= SIMILAR_PERIOD * min(periods))
    stamp = _common_stamps([part for part, _ in chosen], first, periods)
    if not len(stamp):
        described = " and ".join(f"{part.topic} ({', '.join(part.names)})" for part, _ in chosen)
        raise DataError(
            f"{source}: joint states of {described} do not overlap in time; synchronise "
            "the clocks of their publishers",
            "E302",
        )
    columns = [[part.names.index(name) for name in names] for part, names in chosen]

    def merged(field: str) -> FloatArray:
        return np.hstack(
            [
                _at(part.stamp, getattr(part, field)[:, places], stamp)
                for (part, _), places in zip(chosen, columns, strict=True)
            ]
        )

    return JointStream(
        topic=", ".join(dict.fromkeys(part.topic for part, _ in chosen)),
        names=tuple(name for _, names in chosen for name in names),
        stamp=stamp,
        position=merged("position"),
        velocity=merged("velocity"),
        effort=merged("effort"),
    )


def _contributing(
    parts: Sequence[JointStream], needed: Collection[str]
) -> list[tuple[JointStream, tuple[str, ...]]]:
    """Return the parts that add joints, and which; the first part where none does."""
    covered: set[str] = set()
    chosen = []
    for part in parts:
        names = tuple(name for name in part.names if name not in covered)
        if names and (not needed or not set(needed).isdisjoint(names)):
            chosen.append((part, names))
            covered.update(names)
    return chosen or [(parts[0], parts[0].names)]


def _common_stamps(parts: Sequence[JointStream], clock: int, periods: Sequence[float]) -> IntArray:
    """Return the stamps of the clock's part at which every part has data, ns."""
    start = max(int(part.stamp[0]) for part in parts)
    stop = min(int(part.stamp[-1]) for part in parts)
    stamp = parts[clock].stamp
    kept: BoolArray = (stamp >= start) & (stamp <= stop)
    for part, period in zip(parts, periods, strict=True):
        longest = LONGEST_GAP * max(period, periods[clock])
        for before in np.flatnonzero(np.diff(part.stamp) > longest):
            kept &= (stamp <= part.stamp[before]) | (stamp >= part.stamp[before + 1])
    return stamp[kept]


def _at(known: IntArray, values: FloatArray, wanted: IntArray) -> FloatArray:
    """Return values (N, c) given at stamps ``known`` at others (M,) within their span."""
    after = np.searchsorted(known, wanted)
    found: FloatArray = values[after]
    between = np.flatnonzero(known[after] != wanted)
    if not len(between):
        return found
    seconds = (known - known[0]) * 1e-9
    at = (wanted[between] - known[0]) * 1e-9
    finite = np.isfinite(values)
    is_complete = finite.all(axis=0)
    if is_complete.any():
        spline = interpolating_spline(seconds, values[:, is_complete])
        found[np.ix_(between, np.flatnonzero(is_complete))] = spline(at)
    for column in np.flatnonzero(~is_complete):
        here = finite[:, column]
        found[between, column] = np.nan
        if np.count_nonzero(here) < 2:
            continue
        spline = interpolating_spline(seconds[here], values[here, column])
        is_known = here[after[between]] & here[after[between] - 1]
        found[between[is_known], column] = spline(at[is_known])
    return found
