"""Joint states from several publishers merged into one stream by their stamps."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import DataError
from symbid_ros.signals.defects import typical_period
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

    A joint's positions and velocities may come from one part and its efforts from another. Values
    with equal stamps are merged unchanged, others are interpolated by a cubic spline.
    Nothing is interpolated across a gap of a part.

    Parameters
    ----------
    parts : sequence of JointStream
        Of several parts with positions, or efforts, of a joint the first is taken.
    source : str
        Name of the recording, for messages.
    needed : collection of str
        Joints of the model, where known: parts that add nothing to them are ignored.

    Raises
    ------
    DataError
        When parts do not overlap in time, or one has fewer than two messages.
    """
    chosen = _contributing(parts, needed)
    if len(chosen) == 1:
        return chosen[0]
    for part in chosen:
        if len(part.stamp) < 2:
            raise DataError(
                f"{source}: {part.topic}: fewer than two messages name {', '.join(part.names)}; "
                "let the driver publish these joints at the rate of the others",
                "E310",
            )
    periods = [typical_period(part.stamp) for part in chosen]
    first = next(index for index, one in enumerate(periods) if one <= SIMILAR_PERIOD * min(periods))
    stamp = _common_stamps(chosen, first, periods)
    if not len(stamp):
        described = " and ".join(f"{part.topic} ({', '.join(part.names)})" for part in chosen)
        raise DataError(
            f"{source}: joint states of {described} do not overlap in time; synchronise "
            "the clocks of their publishers",
            "E302",
        )
    names = tuple(dict.fromkeys(name for part in chosen for name in part.names))

    def merged(field: str, sources: dict[str, int]) -> FloatArray:
        values = np.empty((len(stamp), len(names)))
        for index, part in enumerate(chosen):
            given = [name for name in names if sources[name] == index]
            columns = [part.names.index(name) for name in given]
            places = [names.index(name) for name in given]
            values[:, places] = _at(part.stamp, getattr(part, field)[:, columns], stamp)
        return values

    of_motion, of_efforts = _sources(chosen, _with_positions), _sources(chosen, _with_efforts)
    return JointStream(
        topic=", ".join(dict.fromkeys(part.topic for part in chosen)),
        names=names,
        stamp=stamp,
        position=merged("position", of_motion),
        velocity=merged("velocity", of_motion),
        effort=merged("effort", of_efforts),
    )


def _contributing(parts: Sequence[JointStream], needed: Collection[str]) -> list[JointStream]:
    """Return the parts that add joints, or readings of these; the first part where none does."""
    covered: set[tuple[str, str]] = set()
    chosen = []
    for part in parts:
        adds = {("name", name) for name in part.names}
        adds |= {("position", name) for name in _with_positions(part)}
        adds |= {("effort", name) for name in _with_efforts(part)}
        adds -= covered
        if adds and (not needed or any(name in needed for _, name in adds)):
            chosen.append(part)
            covered |= adds
    return chosen or [parts[0]]


def _sources(
    parts: Sequence[JointStream], measured: Callable[[JointStream], list[str]]
) -> dict[str, int]:
    """Return the first part that measures each joint, or that names it where none does."""
    found: dict[str, int] = {}
    for named in ([measured(part) for part in parts], [part.names for part in parts]):
        for index, names in enumerate(named):
            for name in names:
                found.setdefault(name, index)
    return found


def _with_positions(part: JointStream) -> list[str]:
    """Return the joints with measured positions."""
    measured = np.isfinite(part.position).T
    return [name for name, each in zip(part.names, measured, strict=True) if each.any()]


def _with_efforts(part: JointStream) -> list[str]:
    """Return the joints with measured efforts; many drivers fill others with zeros."""
    measured = np.where(np.isfinite(part.effort), part.effort, 0.0).T
    return [name for name, each in zip(part.names, measured, strict=True) if each.any()]


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
