"""Finds joint states that were sampled at other times than their stamps say.

A position q that was sampled j too late is off by q̇ j. The noise of two joints is independent, but
j is common to all joints of a message. The variance of j is therefore the slope of the products
r_a r_b of two joints' errors over q̇_a q̇_b.

The error r is the difference between the change of a position and its velocity's integral. A second
check needs no velocities: r is then the difference of a position from those before and after it,
which shows only jitter that changes from message to message. Both judge the times that alignment
uses: copies are dropped, and stamps are replaced where the samples are uniform.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.signals.decimation import low_passed
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.joint_clock import (
    HARMLESS,
    UNIFORM_NOISE,
    interpolation_error,
    sampled_joints,
)
from symbid_ros.signals.streams import JointStream

DEVIATIONS = 4.0
# A smaller share of messages whose stamps jitter hardly changes an estimate either.
LARGEST_SHARE = 0.01
# Hz; cutoff of the velocities that are computed from positions.
MOTION = 10.0
# s over which positions and velocities are compared.
SPAN = 0.1
# Blocks of this duration, s, count as independent.
BLOCK = 2.0
FEWEST_BLOCKS = 4
FEWEST_MESSAGES = 16
# The jitter of both ends adds to that of a difference.
ENDS = 2.0


@dataclass
class JitterMoments:
    """Moments of the joints' errors and velocities.

    Attributes
    ----------
    sums : list of (2,) float64
        Of each block of time: covariance of r_a r_b with q̇_a q̇_b, and variance of the latter,
        summed over pairs of joints, whose errors have unit variance.
    """

    sums: list[FloatArray] = field(default_factory=list)

    def add(self, error: FloatArray, rate: FloatArray) -> None:
        """Add a block of errors (N, J) and velocities (N, J) of J joints."""
        scale = error.std(axis=0)
        moves = (scale > 0) & np.isfinite(scale)
        if np.count_nonzero(moves) < 2:
            return
        error, rate = error[:, moves] / scale[moves], rate[:, moves] / scale[moves]
        count = len(error)
        both = (error * rate).T @ (error * rate) / count
        mean_error, mean_rate = error.T @ error / count, rate.T @ rate / count
        square = (rate**2).T @ (rate**2) / count
        pairs = ~np.eye(len(both), dtype=bool)
        covariance = (both - mean_error * mean_rate)[pairs].sum()
        variance = (square - mean_rate**2)[pairs].sum()
        self.sums.append(np.array([covariance, variance]))

    @property
    def variance(self) -> tuple[float, float]:
        """Variance of the jitter and its standard deviation, s²."""
        if len(self.sums) < FEWEST_BLOCKS:
            return 0.0, np.inf
        sums = np.array(self.sums)
        total = sums.sum(axis=0)
        if total[1] <= 0:
            return 0.0, np.inf
        value = total[0] / total[1]
        left = sums[:, 0] - value * sums[:, 1]
        count = len(sums)
        return float(value), float(np.sqrt(count / (count - 1) * np.sum(left**2)) / total[1])


@dataclass
class JitterCheck:
    """Checks the stamps of joint states against positions and velocities, slice by slice.

    Attributes
    ----------
    topic : str
    """

    topic: str
    _samples: JitterMoments = field(default_factory=JitterMoments)
    _spans: JitterMoments = field(default_factory=JitterMoments)
    _copies: int = 0
    _messages: int = 0
    _corrected: float = 0.0
    _uncorrected: int = 0

    def add(self, joints: JointStream, during: tuple[int, int] = ALWAYS) -> None:
        """Add the messages stamped from the first up to the second, ns."""
        clock = sampled_joints(joints)
        recorded = slice(*np.searchsorted(joints.stamp, during).tolist())
        self._copies += int(np.count_nonzero(clock.copies[recorded]))
        self._messages += recorded.stop - recorded.start
        self._corrected = max(self._corrected, clock.jitter)
        self._uncorrected += clock.uncorrected
        joints = clock.joints
        inside = slice(*np.searchsorted(joints.stamp, during).tolist())
        stamp, position = joints.stamp[inside], joints.position[inside]
        if len(stamp) < FEWEST_MESSAGES:
            return
        rate = 1e9 / max(float(np.median(np.diff(stamp))), 1.0)
        measured = np.isfinite(position).all(axis=0)
        if rate < 4 * MOTION or np.count_nonzero(measured) < 2:
            return
        velocity = joints.velocity[inside]
        filled = measured & np.isfinite(velocity).all(axis=0) & velocity.any(axis=0)
        if np.count_nonzero(filled) >= 2:
            self._add_spans(stamp, position[:, filled], velocity[:, filled], rate)
        self._add_samples(stamp, position[:, measured], rate)

    def _add_samples(self, stamp: IntArray, position: FloatArray, rate: float) -> None:
        slow = low_passed(position, LowPass(min(MOTION, 0.2 * rate), passes=1), rate)
        velocity = np.gradient(slow, 1 / rate, axis=0)[2:-2]
        error = interpolation_error((stamp - stamp[0]) * 1e-9, position)
        for block in _blocks(len(error), rate):
            self._samples.add(error[block], velocity[block])

    def _add_spans(
        self, stamp: IntArray, position: FloatArray, velocity: FloatArray, rate: float
    ) -> None:
        lag = max(1, round(SPAN * rate))
        time = (stamp - stamp[0]) * 1e-9

        def compared(block: slice) -> tuple[FloatArray, FloatArray]:
            """Return errors of the velocities over the spans that begin in a block, and means."""
            part = slice(block.start, block.stop + lag)
            rates, times, places = velocity[part], time[part], position[part]
            steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
            path = np.zeros_like(rates)
            np.cumsum(steps, axis=0, out=path[1:])
            moved = places[lag:] - places[:-lag]
            return (path[lag:] - path[:-lag]) - moved, moved / SPAN

        # Block by block, since arrays of a whole slice would be large.
        blocks = list(_blocks(len(time) - lag, rate))
        sums = np.zeros((2, velocity.shape[1]))
        for block in blocks:
            error, mean = compared(block)
            sums += np.sum([error * mean, mean**2], axis=1)
        # A wrong scale or offset of the velocities is no jitter.
        scale = sums[0] / np.where(sums[1] > 0, sums[1], 1.0)
        for block in blocks:
            error, mean = compared(block)
            self._spans.add(error - mean * scale, mean)

    def findings(self) -> list[Finding]:
        """Return what is wrong with the samples' times, and what was corrected."""
        return [*self._corrections(), *self._errors()]

    def _corrections(self) -> list[Finding]:
        found = []
        if self._copies:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.COPY,
                    f"{self._copies} of {self._messages} messages repeat all readings of the one "
                    "before, although the joints move, and are dropped; publish each sample once",
                    {"copies": self._copies, "messages": self._messages},
                    Severity.WARNING,
                )
            )
        if self._corrected > 0:
            jitter = 1e3 * self._corrected
            found.append(
                Finding.of(
                    self.topic,
                    Kind.STAMP,
                    f"the samples are uniform in time, but their stamps are not, and are "
                    f"corrected by {jitter:.2g} ms (rms); stamp messages when they are sampled",
                    {"jitter_ms": jitter},
                    Severity.WARNING,
                )
            )
        share = self._uncorrected / max(self._messages, 1)
        if self._corrected > 0 and share > LARGEST_SHARE:
            found.append(
                Finding.of(
                    self.topic,
                    Kind.JITTER,
                    f"{100 * min(share, 1.0):.3g} % of the messages keep stamps that jitter, "
                    "because their samples are not uniform in time, while others are corrected; "
                    "stamp messages when they are sampled",
                    {"share": min(share, 1.0)},
                    Severity.WARNING,
                )
            )
        return found

    def _errors(self) -> list[Finding]:
        for moments, times, how in (
            (self._spans, ENDS, "their velocities"),
            (self._samples, UNIFORM_NOISE, "those before and after"),
        ):
            variance, std = moments.variance
            jitter = float(np.sqrt(max(variance, 0.0) / times))
            if jitter > HARMLESS and variance > DEVIATIONS * std:
                return [
                    Finding.of(
                        self.topic,
                        Kind.JITTER,
                        f"positions disagree with {how} as if they were sampled "
                        f"{1e3 * jitter:.1f} ms (rms) before or after their stamps; stamp messages "
                        "when they are sampled, with the sensor's clock",
                        {"jitter_ms": 1e3 * jitter, "deviations": variance / std},
                        Severity.WARNING,
                    )
                ]
        return []


def _blocks(count: int, rate: float) -> Iterator[slice]:
    length = round(BLOCK * rate)
    for start in range(0, count - length + 1, length):
        yield slice(start, start + length)
