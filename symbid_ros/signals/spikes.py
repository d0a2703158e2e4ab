"""Detects spikes: readings that jump away for a few messages and back, as dropouts and bit errors.

A spike in a position looks like an enormous acceleration, and one in an effort outweighs all other
rows. Their messages are dropped, and alignment interpolates across the short gap.
"""

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays
from symbid_ros.signals.defects import Defect, DefectCounts
from symbid_ros.signals.streams import JointStream, WrenchStream

# A spike lasts for at most this many messages. Medians of twice as many and one ignore it.
LONGEST = 4
WINDOW = 2 * LONGEST + 1
FEWEST = 100  # messages that tell what is usual
MOST = 0.01  # share of messages with a spike; more often, a reading is usual
# A position has a spike if it deviates from the median of its window by this length, rad or m, and
# by what this acceleration, rad/s² or m/s², causes in a period, since no joint accelerates so;
LEAST_JUMP, LARGEST_ACCELERATION = 0.01, 1000.0
# by this multiple of a quantile of the deviations, and by this multiple of that of the steps from
# message to message.
TYPICAL_RATIO, STEP_RATIO, QUANTILE = 10.0, 4.0, 0.975
# Longest window without a gap, in periods.
LONGEST_WINDOW = 1.5 * WINDOW
# An effort, force or torque has a spike if it is at least this multiple of all others, and so
# many Nm or N.
OTHERS_RATIO, LEAST_LOAD = 8.0, 0.01

S = TypeVar("S", JointStream, WrenchStream)
N = TypeVar("N", bound=np.generic)


def without_spikes(stream: S, tally: DefectCounts) -> S:
    """Return a stream without messages that have a spike; they are counted in ``tally``.

    Parameters
    ----------
    stream : JointStream or WrenchStream
        Messages with strictly increasing stamps; angles are continuous.
    tally : DefectCounts
        Counts of the topic.
    """
    if len(stream.stamp) < FEWEST:
        return stream
    found = {name: wrong for name, wrong in _spikes(stream) if wrong.any()}
    if not found:
        return stream
    wrong: BoolArray = np.logical_or.reduce(list(found.values()))
    tally.add(Defect.SPIKE, stream.stamp, wrong, found)
    return map_arrays(stream, lambda values: values[~wrong])


def _spikes(stream: JointStream | WrenchStream) -> Iterator[tuple[str, BoolArray]]:
    """Yield the name of each reading that may have spikes, and which messages (N,) have one."""
    if isinstance(stream, WrenchStream):
        yield "wrench.force", _load_spikes(np.linalg.norm(stream.force, axis=1))
        yield "wrench.torque", _load_spikes(np.linalg.norm(stream.torque, axis=1))
        return
    for column, name in enumerate(stream.names):
        yield f"position of {name}", _position_spikes(stream.stamp, stream.position[:, column])
        yield f"effort of {name}", _load_spikes(np.abs(stream.effort[:, column]))


def _position_spikes(stamp: IntArray, position: FloatArray) -> BoolArray:
    """Return which positions (N,) jump away from those before and after, and back."""
    found = np.zeros(len(position), dtype=bool)
    known = np.flatnonzero(np.isfinite(position))
    if len(known) < FEWEST:
        return found
    stamp, position = stamp[known], position[known]
    # Few positions ever change so abruptly. This takes a fraction of the time of the medians.
    largest = np.abs(np.diff(position, 2)).max()
    if largest < LEAST_JUMP:
        return found
    period = float(np.median(np.diff(stamp)))
    least = max(LEAST_JUMP, LARGEST_ACCELERATION * (period * 1e-9) ** 2)
    if largest < least:
        return found
    away = np.abs(position - np.median(_windows(position), axis=1))
    typical, step = (
        float(np.quantile(each, QUANTILE)) for each in (away, np.abs(np.diff(position)))
    )
    least = max(least, TYPICAL_RATIO * typical, STEP_RATIO * step)
    places = np.flatnonzero(away >= least)
    # Across a gap, a joint may have travelled any distance.
    lengths = np.ptp(_windows(stamp)[places], axis=1)
    is_jump = lengths <= LONGEST_WINDOW * period
    found[known[places[is_jump]]] = True
    return found


def _load_spikes(load: FloatArray) -> BoolArray:
    """Return which magnitudes (N,) are far beyond all others and last for a few messages."""
    found = np.zeros(len(load), dtype=bool)
    known = np.flatnonzero(np.isfinite(load))
    if len(known) < FEWEST:
        return found
    most = int(MOST * len(known)) + 1
    values = load[known]
    # Sorting the largest takes longer than finding that many are alike.
    if np.count_nonzero(OTHERS_RATIO * values > values.max()) > most:
        return found
    largest = np.sort(np.partition(values, -most - 1)[-most - 1 :])[::-1]
    gaps = np.flatnonzero((largest[:-1] >= OTHERS_RATIO * largest[1:]) & (largest[1:] > 0))
    if not len(gaps) or largest[gaps[-1]] < LEAST_LOAD:
        return found
    places = np.flatnonzero(values >= largest[gaps[-1]])
    usual = np.median(_windows(values)[places], axis=1)
    found[known[places[usual < largest[gaps[-1]]]]] = True
    return found


def _windows(values: NDArray[N]) -> NDArray[N]:
    """Return the window (N, WINDOW) around each value (N,); the ends are mirrored."""
    windows: NDArray[N] = sliding_window_view(np.pad(values, LONGEST, mode="reflect"), WINDOW)
    return windows
