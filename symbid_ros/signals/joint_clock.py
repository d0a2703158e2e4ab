"""Gives joint states the times at which they were sampled, where their stamps differ from these.

A node that publishes at a rate of its own republishes its last sample when no new one has arrived.
Such a copy repeats every reading of the message before it, although the joints move. Often its
stamps are those of the publisher, not of the samples: they jitter, or run ahead until the next copy
sets them back. The samples themselves are then smoother in time when they are taken as uniform.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays
from symbid_ros.signals.streams import JointStream

# Copies in a row; more of them are a frozen topic.
MOST_COPIES = 3
# Share of the joints that move before and after a copy. The readings of a robot at rest repeat.
MOVING_SHARE = 0.5
# Uniform times are taken if they divide the roughness of the positions by at least this factor ...
GAIN = 1.25
# ... and if the stamps jitter by at least this share of a period; less changes no estimate.
LEAST_JITTER = 0.02
# Periods without a sample after which the times of a log start anew.
LONGEST_GAP = 5.5
FEWEST_MESSAGES = 50
MOTION = 10.0  # roughnesses that a joint travels, as noise at rest does not
LASTING = 4  # messages; a delay of more of them is no late message
# Time, s, over which two clocks count as running at a constant ratio, and over which the period of
# a loop may change.
STEADY, BRIEF = 2.5, 0.25
# Shares of the jitter and of a period that may last; more is a change of the period or a pause.
LASTING_SHARE, LASTING_PART = 0.5, 0.5
MOST_TURNS = 4  # of following such a change, each of which leaves a small part


@dataclass(frozen=True)
class JointClock:
    """Joint states at the times at which they were sampled.

    Attributes
    ----------
    joints : JointStream
        The messages that are no copies.
    copies : (N,) bool
        Messages, of all as recorded, that repeat the one before them.
    jitter : float
        Standard deviation of the stamps about the samples' times, s; 0 if the stamps are kept.
    """

    joints: JointStream
    copies: BoolArray
    jitter: float


def sampled_joints(joints: JointStream) -> JointClock:
    """Drop copies, and take the times of uniform samples where the positions show them.

    Parameters
    ----------
    joints : JointStream
        With strictly increasing stamps.
    """
    copies = find_copies(joints)
    stamp = joints.stamp
    period = float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
    if period <= 0:
        return JointClock(joints, copies, 0.0)
    fresh = map_arrays(joints, lambda values: values[~copies]) if copies.any() else joints
    steps = np.diff(stamp)
    if not copies.any() and np.abs(steps - period).max() < LEAST_JITTER * period:
        return JointClock(fresh, copies, 0.0)
    time, jitter = 1e-9 * (fresh.stamp - stamp[0]), 0.0
    ends = np.flatnonzero(np.diff(fresh.stamp) > LONGEST_GAP * period) + 1
    for first, last in zip([0, *ends], [*ends, len(time)], strict=True):
        piece = slice(first, last)
        steady = _uniform_times(
            time[piece], fresh.position[piece], 1e-9 * period, _skipped(copies, piece)
        )
        if steady is not None:
            jitter = max(jitter, float(np.std(time[piece] - steady)))
            time[piece] = steady
    if jitter == 0:
        return JointClock(fresh, copies, 0.0)
    retimed = stamp[0] + np.rint(1e9 * time).astype(np.int64)
    if not (np.diff(retimed) > 0).all():  # times of two pieces that overlap
        return JointClock(fresh, copies, 0.0)
    return JointClock(replace(fresh, stamp=retimed), copies, jitter)


def find_copies(joints: JointStream) -> BoolArray:
    """Return which messages (N,) repeat all readings of the one before, while the joints move."""
    position = joints.position
    count = len(position)
    copies = np.zeros(count, dtype=bool)
    if count < 4:
        return copies
    candidates = np.flatnonzero((position[1:] == position[:-1]).all(axis=1)) + 1
    if not len(candidates):
        return copies
    for values in (joints.velocity, joints.effort):
        now, before = values[candidates], values[candidates - 1]
        same = (now == before) | (np.isnan(now) & np.isnan(before))
        candidates = candidates[same.all(axis=1)]
    for run in np.split(candidates, np.flatnonzero(np.diff(candidates) > 1) + 1):
        if not 0 < len(run) <= MOST_COPIES or run[0] < 2 or run[-1] + 1 >= count:
            continue
        before = position[run[0] - 1] != position[run[0] - 2]
        after = position[run[-1] + 1] != position[run[-1]]
        if np.mean(before & after) >= MOVING_SHARE:
            copies[run] = True
    return copies


def roughness(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return the RMS (J,) of positions (N, J) minus the cubics through their four neighbours."""
    error = interpolation_error(time, position)
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def interpolation_error(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return positions (N, J) minus the cubic through their four neighbours, (N - 4, J)."""
    count = len(time)
    at = time[2 : count - 2]
    places = [slice(shift, count - 4 + shift) for shift in (0, 1, 3, 4)]
    error = position[2 : count - 2].copy()
    for one, place in enumerate(places):
        weight = np.ones(count - 4)
        for other, elsewhere in enumerate(places):
            if other != one:
                weight *= (at - time[elsewhere]) / (time[place] - time[elsewhere])
        error -= weight[:, None] * position[place]
    return error


def _skipped(copies: BoolArray, piece: slice) -> IntArray:
    """Return how many copies lie before each message of a piece of those that are none."""
    before: IntArray = np.cumsum(copies, dtype=np.int64)[~copies][piece]
    return before


def _uniform_times(
    time: FloatArray, position: FloatArray, period: float, skipped: IntArray
) -> FloatArray | None:
    """Return uniform times (N,) if the positions (N, J) are smoother at these, or None."""
    finite = position[:, np.isfinite(position).all(axis=0)]
    if len(time) < FEWEST_MESSAGES or not finite.size:
        return None
    stamped = roughness(time, finite)
    moving = (stamped > 0) & (finite.std(axis=0) > MOTION * stamped)
    if not moving.any():
        return None
    best, found = -np.log(GAIN), None
    for number in _numbers(time, period, skipped):
        uniform = _followed(number, time)
        if np.std(time - uniform) < LEAST_JITTER * period or (np.diff(uniform) <= 0).any():
            continue
        if _lasts(time - uniform, LASTING, period):
            continue
        rough = np.maximum(roughness(uniform, finite)[moving], 1e-12 * stamped[moving])
        change = float(np.mean(np.log(rough / stamped[moving])))
        if change < best:
            best, found = change, uniform
    return found


def _numbers(time: FloatArray, period: float, skipped: IntArray) -> Iterator[FloatArray]:
    """Yield what the samples' numbers may be, without those that were lost or never taken."""
    yield np.arange(len(time), dtype=float)
    stamped = _stamped_numbers(time, period)
    yield stamped
    if skipped[-1] > skipped[0]:
        yield stamped - (skipped - skipped[0])


def _stamped_numbers(time: FloatArray, period: float) -> FloatArray:
    """Return the samples' numbers (N,) by their times, s: a delay that lasts means lost samples."""
    from scipy.ndimage import median_filter  # noqa: PLC0415  (slow to load, rarely needed)

    delay = time / period - np.arange(len(time))
    middle = median_filter(delay, 2 * LASTING + 1, mode="nearest")
    lost = np.zeros(len(time))
    inner = slice(LASTING + 1, len(time) - LASTING)
    lasts: BoolArray = np.rint(middle[2 * LASTING + 1 :] - middle[: -2 * LASTING - 1]) > 0
    late: IntArray = np.arange(len(time))[inner][lasts]
    for run in np.split(late, np.flatnonzero(np.diff(late) > 1) + 1):
        if not len(run):
            continue
        # The largest steps within the run make up the delay that lasts after it.
        left = np.rint(middle[run[-1] + LASTING] - middle[run[0] - LASTING - 1])
        steps = delay[run] - delay[run - 1]
        for place in np.argsort(-steps):
            lost[run[place]] = min(max(np.rint(steps[place]), 1.0), max(left, 0.0))
            left -= lost[run[place]]
    return np.asarray(np.arange(len(time)) + np.cumsum(lost))


def _followed(number: FloatArray, time: FloatArray) -> FloatArray:
    """Return a function of the sample's number that follows its times, (N,), slowly."""
    slope, offset = np.polyfit(number, time, 1)
    followed = offset + slope * number
    if slope <= 0:
        return np.asarray(followed)
    if time[-1] - time[0] > 4 * STEADY:
        followed = followed + _average(time - followed, STEADY / slope)
    for _ in range(MOST_TURNS):
        if not _lasts(time - followed, BRIEF / slope, slope):
            break
        followed = followed + _average(time - followed, BRIEF / slope)
    return np.asarray(followed)


def _lasts(delay: FloatArray, samples: float, period: float) -> bool:
    """Return whether delays (N,), s, last for more than some samples, as late messages' do not."""
    limit = max(LASTING_PART * period, LASTING_SHARE * float(np.std(delay)))
    return float(np.std(_average(delay, samples))) > limit


def _average(values: FloatArray, samples: float) -> FloatArray:
    """Return the Gaussian moving average of values (N,)."""
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415  (slow to load, rarely needed)

    average: FloatArray = gaussian_filter1d(values, samples, mode="reflect")
    return average
