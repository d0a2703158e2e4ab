"""Unwraps joint angles that a driver reports within one turn, -π to π or 0 to 2π.

Where a joint crosses the end of that turn, its reported position jumps by 2π between two messages,
which no joint does. A filter would take the jump for motion, and a spline would oscillate around
it. The constant number of whole turns that remains unknown changes no equation of motion.
"""

import logging
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.signals.streams import JointStream

logger = logging.getLogger(__name__)

TURN = 2 * np.pi
# Largest motion, rad, by which a jump may differ from a turn, and largest one of the neighbouring
# steps in a period. Beyond these, a jump of the wrapped angle and a fast motion look alike.
LARGEST_MOTION, LARGEST_STEP = 1.5, 0.75
# A jump may differ from a turn by this noise, rad, and by what the joint travels meanwhile at its
# speed, which may change by this factor.
NOISE = 0.05
ACCELERATION = 1.5
# A log is cut at longer gaps, in periods, across which the joint's speed may have changed.
LONGEST_GAP = 5.5
# Glitches: the share of values, and the number of further ones, that may lie outside the turn.
OUTLIER_SHARE, OUTLIERS = 0.01, 2
# Samples before and after a step that tell the joint's speed.
NEIGHBOURS = 3


@dataclass
class AngleUnwrapper:
    """Unwraps the positions of joints, slice by slice of one log.

    Slices that have messages in common, as consecutive slices have, continue one another without a
    jump.

    Parameters
    ----------
    linear : collection of str
        Prismatic joints, by their names in the log; their positions are lengths.
    logged : set of str
        What was logged about the log before, as in `TopicSelection`.

    Attributes
    ----------
    found : dict of str to None
        Joints whose angles were wrapped so far, in the order in which they were found.
    """

    linear: Collection[str] = ()
    logged: set[str] = field(default_factory=set)
    found: dict[str, None] = field(default_factory=dict)
    # Stamps and turns of the last slice, by topic and joints; none if it had no turns.
    _last: dict[tuple[str, tuple[str, ...]], tuple[IntArray, IntArray]] = field(
        default_factory=dict
    )

    def unwrapped(self, joints: JointStream) -> JointStream:
        """Return joint states with continuous angles.

        Parameters
        ----------
        joints : JointStream
            Messages of one publisher with strictly increasing stamps.
        """
        turns = count_turns(joints, self.linear)
        key = joints.topic, joints.names
        last = self._last.pop(key, None)
        if turns is not None:
            wrapped = np.flatnonzero((turns != turns[:1]).any(axis=0))
            self.found |= dict.fromkeys(joints.names[place] for place in wrapped)
        if last is not None:
            known_stamp, known = last
            _, old, new = np.intersect1d(
                known_stamp, joints.stamp, assume_unique=True, return_indices=True
            )
            if len(new):
                if turns is None:
                    turns = np.zeros(joints.position.shape, dtype=np.int64)
                shift = np.median(known[old] - turns[new], axis=0)
                turns = turns + np.rint(shift).astype(np.int64)
        if turns is None or not turns.any():
            return joints
        self._last[key] = joints.stamp, turns
        return replace(joints, position=joints.position + TURN * turns)

    def restart(self) -> None:
        """Forget the last slice, because the clock was set and its stamps may come again."""
        self._last.clear()

    def report(self, source: str, topic: str) -> None:
        """Log which joints had wrapped angles, those that were named before excepted."""
        new = {f"{topic}: wrapped angle of {name}": name for name in self.found}
        names = [name for key, name in new.items() if key not in self.logged]
        self.logged.update(new)
        if names:
            logger.info(
                "%s: %s: the angles of %s are wrapped to one turn and were unwrapped",
                source,
                topic,
                ", ".join(names),
            )


def count_turns(joints: JointStream, linear: Collection[str] = ()) -> IntArray | None:
    """Return the turns (N, J) to add to each position; None if no angle is wrapped."""
    position = joints.position
    if len(position) < 2:
        return None
    # Most logs have no wrapped angle. This takes a fraction of the time of finding the jumps.
    lowest, highest = np.fmin.reduce(position, axis=0), np.fmax.reduce(position, axis=0)
    candidates = np.flatnonzero(highest - lowest >= TURN - LARGEST_MOTION)
    turns: IntArray | None = None
    for column in candidates.tolist():
        if joints.names[column] in linear:
            continue
        known = np.flatnonzero(np.isfinite(position[:, column]))
        angle, velocity = position[known, column], joints.velocity[known, column]
        jumps = _turns_per_step(joints.stamp[known], angle, velocity)
        if not jumps.any():
            continue
        if turns is None:
            turns = np.zeros(position.shape, dtype=np.int64)
        turns[known[1:], column] = jumps
        turns[:, column] = np.cumsum(turns[:, column])
    return turns


def _turns_per_step(stamp: IntArray, angle: FloatArray, velocity: FloatArray) -> IntArray:
    """Return the turns (N - 1,) that the steps between finite angles (N,) of a joint lack."""
    step = np.diff(angle)
    turns = -np.rint(step / TURN).astype(np.int64)
    motion = step + TURN * turns
    jumps = np.flatnonzero((np.abs(turns) == 1) & (np.abs(motion) <= LARGEST_MOTION))
    if len(jumps):
        interval = np.diff(stamp) * 1e-9
        period = float(np.median(interval))
        interval = np.maximum(interval, period)  # stamps may jitter
        is_turn = interval[jumps] <= LONGEST_GAP * period
        is_turn &= _is_slow(jumps, motion, interval, velocity, period)
        is_turn &= _is_within_turn(jumps, angle)
        jumps = jumps[is_turn]
    found = np.zeros(len(step), dtype=np.int64)
    found[jumps] = turns[jumps]
    return found


def _is_slow(
    jumps: IntArray,
    motion: FloatArray,
    interval: FloatArray,
    velocity: FloatArray,
    period: float,
) -> BoolArray:
    """Return which jumps (K,) differ from a turn by no more than what the joint's speed allows."""
    # Speeds from the neighbouring steps, without whole turns.
    speeds = np.pad(np.abs(motion) / interval, NEIGHBOURS - 1, mode="edge")
    others = np.delete(np.arange(2 * NEIGHBOURS - 1), NEIGHBOURS - 1)
    steps = np.sort(speeds[jumps[:, None] + others], axis=1)
    # Speeds from velocities, last those that are missing.
    speeds = np.pad(np.abs(velocity), NEIGHBOURS - 1, constant_values=np.nan)
    measured = np.sort(speeds[jumps[:, None] + np.arange(2 * NEIGHBOURS)], axis=1)
    # The second smallest speed is that of the joint even beside a glitch, or where a driver
    # computes velocities from the wrapped angle.
    measured_motion = np.nan_to_num(measured[:, 1]) * interval[jumps]
    is_slow = (steps[:, 1] * period <= LARGEST_STEP) & (measured_motion <= LARGEST_MOTION)
    expected = np.maximum(steps[:, -1] * interval[jumps], measured_motion)
    is_allowed: BoolArray = is_slow & (np.abs(motion[jumps]) <= NOISE + ACCELERATION * expected)
    return is_allowed


def _is_within_turn(jumps: IntArray, angle: FloatArray) -> BoolArray:
    """Return which jumps (K,) lead from one end to the other of a turn that holds all angles."""
    ends = np.sort(np.stack([angle[jumps], angle[jumps + 1]]), axis=0)
    ordered = np.sort(angle)
    below = np.searchsorted(ordered, ends[1] - TURN - NOISE)
    above = len(angle) - np.searchsorted(ordered, ends[0] + TURN + NOISE)
    is_within: BoolArray = below + above <= OUTLIERS + OUTLIER_SHARE * len(angle)
    return is_within
