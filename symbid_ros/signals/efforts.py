"""Detection of joint efforts that were not measured.

Drivers without effort sensors fill JointState.effort with NaN, zeros or another constant. The
joint's own row of the equation of motion is then unusable, while the rows of the base and of other
joints are not affected.
"""

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.splines import interpolating_spline

logger = logging.getLogger(__name__)

# Rows are dropped for whole spans of the clock, ns. No window crosses their limits, so a log gives
# the same rows whether it is read at once, in slices or live.
SPAN = 4_000_000_000
# rad and m; a joint that moves this far within a span has no constant effort.
MOVED = 0.1, 0.01
# Efforts below this share of the largest of the same instant are rounding errors of computed ones.
ROUNDING = 1e-9


@dataclass(frozen=True)
class MeasuredEfforts:
    """Efforts of a model's J joints, and where they were not measured.

    Attributes
    ----------
    values : (N, J) float64
        Finite efforts: short gaps are interpolated, unmeasured efforts are zero.
    spans : (B,) int64
        Increasing numbers of the spans of the clock, stamps divided by ``SPAN``.
    lost : (B, J) bool
        Spans in which the effort of a driven joint was not measured.
    """

    values: FloatArray
    spans: IntArray
    lost: BoolArray

    def masked(self, stamp: IntArray, effort: FloatArray) -> FloatArray:
        """Return efforts (M, J) at other stamps (M,) with NaN in the spans without measurement."""
        if not self.lost.any():
            return effort
        span = np.searchsorted(self.spans, stamp // SPAN, side="right") - 1
        return np.where(self.lost[np.maximum(span, 0)], np.nan, effort)

    @property
    def any_row(self) -> bool:
        """Whether any joint has a usable row in any span."""
        return not self.lost.size or not self.lost.all()


def measured_efforts(
    stamp: IntArray,
    position: FloatArray,
    effort: FloatArray,
    *,
    model: RobotModel,
    longest_gap: float,
    topic: str,
    remedy: str,
    held: Collection[str] = (),
) -> MeasuredEfforts:
    """Find out which efforts were measured, and log a warning about the others.

    Parameters
    ----------
    stamp : (N,) int64
        Nanoseconds, increasing.
    position : (N, J) float64
        In the model's order, finite.
    effort : (N, J) float64
        In the model's order, NaN where a message has no value; changed in place.
    model : RobotModel
        Tells which joints are driven; the effort of passive joints is zero.
    longest_gap : float
        Longest gap to interpolate, ns.
    topic, remedy : str
        Log and topic, and what to do, for warnings.
    held : collection of str
        Joints that the log lacks, which is no fault of their driver.
    """
    number = stamp // SPAN
    starts = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
    lost = np.zeros((len(starts), effort.shape[1]), dtype=bool)
    if not len(starts):
        return MeasuredEfforts(effort, number, lost)
    is_finite = np.isfinite(effort)
    unmeasured: dict[tuple[str, bool], list[str]] = {}

    def lose(joint: int, what: str, is_lost: BoolArray) -> None:
        lost[:, joint] |= is_lost
        if is_lost.any() and model.joint_names[joint] not in held:
            unmeasured.setdefault((what, bool(lost[:, joint].all())), []).append(
                model.joint_names[joint]
            )

    rounding = rounding_errors(effort)
    for index, joint in enumerate(model.joints):
        column, finite = effort[:, index], is_finite[:, index]
        if joint.effort == 0.0:
            column[~finite] = 0.0
            continue
        if not finite.all():
            is_absent = ~_within_gaps(stamp, finite, longest_gap)
            _fill(stamp, column, finite)
            lose(index, "is missing or not finite", np.logical_or.reduceat(is_absent, starts))
        # Measurements are noisy; exact zeros come from a driver without a sensor.
        is_zero = ~np.logical_or.reduceat(np.abs(column) > rounding, starts) & ~lost[:, index]
        lose(index, "is always zero", is_zero)
        changes = np.zeros(len(stamp), dtype=bool)
        changes[1:] = np.diff(column) != 0.0
        changes[starts] = False
        path = position[:, index]
        travel = np.maximum.reduceat(path, starts) - np.minimum.reduceat(path, starts)
        is_constant = ~np.logical_or.reduceat(changes, starts) & ~lost[:, index]
        is_constant &= travel > MOVED[joint.kind == "prismatic"]
        lose(index, "never changes while it moves", is_constant)
    for (what, is_whole), names in unmeasured.items():
        _warn(topic, names, what if is_whole else f"{what} in part of the log", remedy)
    return MeasuredEfforts(effort, number[starts], lost)


def rounding_errors(effort: FloatArray) -> FloatArray:
    """Return the size (N,) up to which efforts (N, J) of an instant count as zero."""
    size = np.where(np.isfinite(effort), np.abs(effort), 0.0).T
    # Comparing columns takes a fraction of the time of each row's maximum.
    return np.asarray(ROUNDING * reduce(np.maximum, size, np.zeros(len(effort))))


def _within_gaps(stamp: IntArray, finite: BoolArray, longest: float) -> BoolArray:
    """Return which stamps (N,) do not lie in a gap between finite values above ``longest`` ns."""
    known = stamp[finite]
    if not len(known):
        return finite
    # Beyond the first and last finite values, these are held for up to ``longest``.
    edges = np.concatenate([[known[0] - int(longest)], known, [known[-1] + int(longest)]])
    after = np.clip(np.searchsorted(edges, stamp), 1, len(edges) - 1)
    is_short = edges[after] - edges[after - 1] <= longest
    is_inside = (stamp >= edges[0]) & (stamp <= edges[-1])
    return np.asarray(finite | (is_short & is_inside))


def _fill(stamp: IntArray, column: FloatArray, finite: BoolArray) -> None:
    """Interpolate the values (N,) that are not finite, in place."""
    count = int(np.count_nonzero(finite))
    if count < 2:
        column[:] = 0.0
        return
    seconds = (stamp - stamp[0]) * 1e-9
    spline = interpolating_spline(seconds[finite], column[finite])
    # A cubic would diverge beyond the first and last finite values, which are held instead.
    inside = np.clip(seconds[~finite], seconds[finite][0], seconds[finite][-1])
    column[~finite] = spline(inside)


def _warn(topic: str, joints: Sequence[str], what: str, remedy: str) -> None:
    """Warn that joints' rows are dropped, with the same text for every slice of a log."""
    logger.warning(
        "%s: the effort of %s %s: %s of the equation of motion %s dropped there, all other rows "
        "are used; %s",
        topic,
        ", ".join(joints),
        what,
        "its row" if len(joints) == 1 else "their rows",
        "is" if len(joints) == 1 else "are",
        remedy,
    )
