"""Finds a brief stretch of a log that no model of the robot explains, such as a collision.

A contact of a few seconds moves the whole estimate, so that the residuals of the other seconds grow
as well. Without the stretch they shrink, which no error of the model does.
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.identification.causes.candidate_causes import CandidateRows

# Length of the bins in which errors are added up, s, and fewest bins.
BIN, FEWEST_BINS = 1.0, 10
# Longest stretch, as a share of the log, and the least share of the square error in it.
LONGEST, MOSTLY = 0.15, 0.8
# Energy of a bin in the stretch, over the median one.
UNUSUAL = 3.0
# The error of the other rows, apart from the stretch, that an estimate without it leaves (RMS).
REMAINS = 1 / 3
PASSES = 3  # of the stretch, and of the deviations of residuals
LEAST = 1e-3  # deviation of residuals, as a share of the force


@dataclass(frozen=True)
class BriefDisturbance:
    """A stretch of a log in which another force acts.

    Attributes
    ----------
    start, stop : float
        Since the first row, s.
    duration : float
        Of the log, s.
    """

    start: float
    stop: float
    duration: float

    @property
    def sentence(self) -> str:
        """When it is, and what to do, as the end of a sentence."""
        if self.start < BIN:
            advice = f"leave out these first {self.stop:.0f} s with `start`"
        elif self.stop > self.duration - BIN:
            advice = f"leave out these last {self.duration - self.start:.0f} s with `stop`"
        else:
            advice = "identify the part before or after it alone, with `stop` or `start`"
        return (
            f"likely cause: a contact or a collision from {self.start:.0f} to {self.stop:.0f} s of "
            f"the log; the model explains the rest without it; {advice}. It may be the cause of "
            "other alarms as well"
        )


def brief_disturbance(rows: CandidateRows) -> BriefDisturbance | None:
    """Return the stretch without which an estimate explains the other rows; None if none is."""
    elapsed = (rows.stamp - rows.span[0]) * 1e-9
    bins = (elapsed / BIN).astype(np.int64)
    count = int(bins.max()) + 1
    if count < FEWEST_BINS:
        return None
    before = np.where(rows.valid, rows.error, 0.0)
    size = np.sqrt(np.diag(rows.covariance))
    error: FloatArray = before
    is_inside, share = np.zeros(len(bins), bool), 0.0
    first = last = 0
    for _ in range(PASSES):
        square = np.sum((error / size) ** 2, axis=1)
        energy = np.bincount(bins, square, minlength=count).astype(np.float64)
        first, last = _densest(energy)
        share = float(energy[first:last].sum() / max(energy.sum(), 1e-300))
        is_inside = (bins >= first) & (bins < last)
        error, size = _error_without(rows, is_inside)
    after, at_first = (float(np.sum((one[~is_inside] / size) ** 2)) for one in (error, before))
    if share < MOSTLY or after > REMAINS**2 * at_first:
        return None
    return BriefDisturbance(BIN * first, BIN * last, BIN * count)


def _densest(energy: FloatArray) -> tuple[int, int]:
    """Return the short stretch whose energy most exceeds what bins usually have."""
    count = len(energy)
    sums = np.concatenate([[0.0], np.cumsum(energy - UNUSUAL * np.median(energy))])
    best, found = 0.0, (0, 1)
    for length in range(1, max(1, int(LONGEST * count)) + 1):
        excess = sums[length:] - sums[:-length]
        at = int(np.argmax(excess))
        if excess[at] > best:
            best, found = float(excess[at]), (at, at + length)
    return found


def _error_without(rows: CandidateRows, is_left_out: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the errors (N, n) of an estimate from the other rows, and their deviations (n,)."""
    kept = rows.valid & ~is_left_out[:, None]
    number = np.maximum(kept.sum(axis=0), 1)
    force = np.sqrt(np.sum(np.where(kept, rows.force, 0.0) ** 2, axis=0) / number)
    least = np.maximum(LEAST * force, 1e-9)
    size = np.sqrt(np.sum(np.where(kept, rows.error, 0.0) ** 2, axis=0) / number)
    error = rows.residual
    for _ in range(PASSES):
        weight = np.where(kept, 1 / np.maximum(size, least), 0.0)
        K = (rows.K * weight[..., None]).reshape(-1, rows.K.shape[2])
        y = (np.where(kept, rows.residual, 0.0) * weight).reshape(-1)
        x = np.linalg.solve(K.T @ K + np.eye(K.shape[1]), K.T @ y)
        error = np.where(rows.valid, rows.residual - rows.K @ x, 0.0)
        size = np.sqrt(np.sum(np.where(kept, error, 0.0) ** 2, axis=0) / number)
    return error, np.maximum(size, least)
