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
from symbid_ros.signals.defects import JITTER, typical_period
from symbid_ros.signals.streams import JointStream

# Copies in a row; more of them are a frozen topic. If most messages are copies, the publisher is
# that many times faster than the samples, and each is repeated about as often.
MOST_COPIES, MOST_TIMES = 3, 2.0
# Share of the joints that move before and after a copy. The readings of a robot at rest repeat.
MOVING_SHARE = 0.5
# Uniform times are taken if they divide the roughness of the positions by at least this factor ...
GAIN = 1.25
# ... and if the stamps jitter by at least this share of a period; less changes no estimate.
LEAST_JITTER = 0.02
# Periods without a sample after which the times of a log start anew, if the delay lasts.
LONGEST_GAP = 5.5
FEWEST_MESSAGES = 50
MOTION = 10.0  # roughnesses that a joint travels, as noise at rest does not
# A delay of more messages, and for a longer time, s, is a pause or a loss. Stamps that jitter by
# several periods delay many messages in a row, so that several times are tried.
LASTING, LASTING_TIMES = 4, (0.0, 0.02, 0.06)
# Samples whose cubic tells the position between them, and the variance that white noise of unit
# variance has about it if the samples are uniform.
NEIGHBOURS = (-2, -1, 1, 2)
UNIFORM_NOISE = 1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2
# Smaller deviations of stamps, s, hardly change an estimate.
HARMLESS = 0.5e-3
# Part of a period; of samples that are closer, one is dropped, as no curve passes through both.
CLOSEST = 0.1
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
        The messages that are neither copies nor too close to the one before.
    copies : (N,) bool
        Messages, of all as recorded, that repeat the one before them.
    jitter : float
        Standard deviation of the stamps about the samples' times, s; 0 if the stamps are kept.
    uncorrected : int
        Number of messages whose stamps jitter as well, but are kept, because no uniform times suit
        their positions.
    """

    joints: JointStream
    copies: BoolArray
    jitter: float
    uncorrected: int = 0


def sampled_joints(joints: JointStream) -> JointClock:
    """Drop copies, and take the times of uniform samples where the positions show them.

    Parameters
    ----------
    joints : JointStream
        With strictly increasing stamps.
    """
    copies = find_copies(joints)
    stamp = joints.stamp
    fresh = map_arrays(joints, lambda values: values[~copies]) if copies.any() else joints
    period = typical_period(fresh.stamp)
    if period <= 0:
        return JointClock(joints, copies, 0.0)
    steps = np.diff(stamp)
    if not copies.any() and np.abs(steps - period).max() < LEAST_JITTER * period:
        return JointClock(fresh, copies, 0.0)
    time, jitter, uncorrected = 1e-9 * (fresh.stamp - stamp[0]), 0.0, 0
    ends = _pauses(time, 1e-9 * period)
    for first, last in zip([0, *ends], [*ends, len(time)], strict=True):
        piece = slice(first, last)
        steady = _uniform_times(
            time[piece], fresh.position[piece], 1e-9 * period, _skipped(copies, piece)
        )
        if steady is not None:
            jitter = max(jitter, float(np.std(time[piece] - steady)))
            time[piece] = steady
        elif _jitters(time[piece], fresh.position[piece]):
            uncorrected += last - first
    if jitter > 0:
        fresh = replace(fresh, stamp=stamp[0] + np.rint(1e9 * time).astype(np.int64))
    closest = CLOSEST * float(np.median(steps))
    return JointClock(_without_close_samples(fresh, closest), copies, jitter, uncorrected)


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
    runs = np.split(candidates, np.flatnonzero(np.diff(candidates) > 1) + 1)
    most = float(MOST_COPIES)
    if are_usual := 2 * len(candidates) > count and len(runs) >= FEWEST_MESSAGES:
        most = max(most, MOST_TIMES * float(np.median([len(run) for run in runs])))
    # Beyond both ends the joints count as moving.
    moves = np.concatenate([position[1:] != position[:-1], np.full((1, position.shape[1]), True)])
    for run in runs:
        is_inside = len(run) > 0 and run[0] >= 2 and run[-1] + 1 < count
        if not 0 < len(run) <= most or not (is_inside or are_usual):
            continue
        before = moves[run[0] - 2]  # of a run from the second message: the last row
        if np.mean(before & moves[run[-1]]) >= MOVING_SHARE:
            copies[run] = True
    return copies


def roughness(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return the RMS (J,) of positions (N, J) minus the cubics through their four neighbours.

    Each difference is divided by what white noise would add to it, relative to uniform samples.
    """
    weights = _interpolation_weights(time)
    noise = np.sqrt((1 + np.sum(weights**2, axis=1)) / UNIFORM_NOISE)
    error = _minus_neighbours(position, weights) / noise[:, None]
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def interpolation_error(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return positions (N, J) minus the cubic through their four neighbours, (N - 4, J)."""
    return _minus_neighbours(position, _interpolation_weights(time))


def _minus_neighbours(position: FloatArray, weights: FloatArray) -> FloatArray:
    """Return positions (N, J) minus the weighted sum of their four neighbours, (N - 4, J)."""
    count = len(position)
    error = position[2 : count - 2].copy()
    for weight, shift in zip(weights.T, NEIGHBOURS, strict=True):
        error -= weight[:, None] * position[2 + shift : count - 2 + shift]
    return error


def _interpolation_weights(time: FloatArray) -> FloatArray:
    """Return the weights (N - 4, 4) of four neighbours in the cubic through them."""
    count = len(time)
    at = time[2 : count - 2]
    places = [time[2 + shift : count - 2 + shift] for shift in NEIGHBOURS]
    weights = np.ones((count - 4, len(places)))
    for one, place in enumerate(places):
        for other, elsewhere in enumerate(places):
            if other != one:
                weights[:, one] *= (at - elsewhere) / (place - elsewhere)
    return weights


def _pauses(time: FloatArray, period: float) -> IntArray:
    """Return the first sample after each gap in times (N,), s, whose delay lasts."""
    late: IntArray = np.flatnonzero(np.diff(time) > LONGEST_GAP * period) + 1
    if not len(late):
        return late
    delay = time / period - np.arange(len(time))
    before, after = _lasting_delays(delay, _lasting(period)[-1])
    step = np.diff(time, prepend=time[0]) / period
    kept: IntArray = late[(after - before)[late] > LASTING_PART * (step[late] - 1)]
    return kept


def _without_close_samples(joints: JointStream, closest: float) -> JointStream:
    """Return joint states without those less than a time, ns, after the one before.

    The times of two pieces may overlap, too.
    """
    stamp = joints.stamp
    if (np.diff(stamp) >= closest).all():
        return joints
    kept = np.ones(len(stamp), dtype=bool)
    last = stamp[0]
    for index in range(1, len(stamp)):
        kept[index] = stamp[index] - last >= closest
        last = stamp[index] if kept[index] else last
    return map_arrays(joints, lambda values: values[kept])


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
    best, found = -np.log(GAIN), None
    for number in _numbers(time, period, skipped):
        uniform = _followed(number, time)
        if np.std(time - uniform) < LEAST_JITTER * period or (np.diff(uniform) <= 0).any():
            continue
        if _lasts(time - uniform, _lasting(period)[-1], period):
            continue
        rough = roughness(uniform, finite)
        moving = (stamped > 0) & (finite.std(axis=0) > MOTION * np.minimum(rough, stamped))
        if not moving.any():
            continue
        rough = np.maximum(rough[moving], 1e-12 * stamped[moving])
        change = float(np.mean(np.log(rough / stamped[moving])))
        if change < best:
            best, found = change, uniform
    return found


def _jitters(time: FloatArray, position: FloatArray) -> bool:
    """Return whether times (N,), s, of joints that move jitter enough to change an estimate."""
    if len(time) < FEWEST_MESSAGES:  # too few to be used
        return False
    steps = np.diff(time)
    period = np.median(steps)
    if np.median(np.abs(steps - period)) < JITTER * period:
        return False
    number = np.arange(len(time), dtype=float)
    finite = position[:, np.isfinite(position).all(axis=0)]
    rough = np.minimum(roughness(number, finite), roughness(time, finite))
    moves = bool((finite.std(axis=0) > MOTION * rough).any())
    return moves and float(np.std(time - _followed(number, time))) > HARMLESS


def _numbers(time: FloatArray, period: float, skipped: IntArray) -> Iterator[FloatArray]:
    """Yield what the samples' numbers may be, without those that were lost or never taken."""
    found = [np.arange(len(time), dtype=float)]
    yield found[0]
    for messages in _lasting(period):
        stamped = _stamped_numbers(time, period, messages)
        without = [stamped - (skipped - skipped[0])] if skipped[-1] > skipped[0] else []
        for number in (stamped, *without):
            if not any(np.array_equal(number, one) for one in found):
                found.append(number)
                yield number


def _stamped_numbers(time: FloatArray, period: float, messages: int) -> FloatArray:
    """Return the samples' numbers (N,) by their times, s: a delay that lasts means lost samples."""
    delay = time / period - np.arange(len(time))
    before, after = _lasting_delays(delay, messages)
    lost = np.zeros(len(time))
    late: IntArray = np.flatnonzero(np.rint(after - before)[1:] > 0) + 1
    for run in np.split(late, np.flatnonzero(np.diff(late) > 1) + 1):
        if not len(run):
            continue
        # The largest steps within the run make up the delay that lasts after it.
        left = np.rint(after[run[-1]] - before[run[0]])
        steps = delay[run] - delay[run - 1]
        for place in np.argsort(-steps):
            lost[run[place]] = min(max(np.rint(steps[place]), 1.0), max(left, 0.0))
            left -= lost[run[place]]
    return np.asarray(np.arange(len(time)) + np.cumsum(lost))


def _lasting(period: float) -> list[int]:
    """Return for how many messages a delay may last that is a pause or a loss; ``period`` in s."""
    return sorted({max(LASTING, round(time / period)) for time in LASTING_TIMES})


def _lasting_delays(delay: FloatArray, messages: int) -> tuple[FloatArray, FloatArray]:
    """Return the median delays (N,) of the messages before and after each, of delays (N,)."""
    from scipy.ndimage import median_filter  # noqa: PLC0415  (slow to load, rarely needed)

    middle = median_filter(delay, 2 * messages + 1, mode="reflect")
    places = np.arange(len(delay))
    before: FloatArray = middle[np.maximum(places - messages - 1, 0)]
    after: FloatArray = middle[np.minimum(places + messages, len(delay) - 1)]
    return before, after


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
    """Return the Gaussian moving average of values (N,), reflected at the ends."""
    from scipy.signal import oaconvolve  # noqa: PLC0415  (slow to load, rarely needed)

    reach = int(4 * samples + 0.5)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / samples) ** 2)
    reflected = np.pad(values, reach, mode="symmetric")
    average: FloatArray = oaconvolve(reflected, weights / weights.sum(), mode="valid")
    return average
