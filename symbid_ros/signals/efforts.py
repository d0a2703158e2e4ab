"""Which joint efforts were measured: the others must not enter the equation of motion.

Drivers that know no effort fill it with NaN, or with zeros. Either way the joint's own row of the
equation of motion cannot be used; the rows of the base and of all other joints can.
"""

import logging
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.model.tree import RobotModel

logger = logging.getLogger(__name__)

# A row is left out for whole spans of the clock, ns: those over which no window of rows reaches, so
# that a log gives the same rows whether it is read at once, in slices or live.
SPAN = 4_000_000_000


@dataclass(frozen=True)
class MeasuredEfforts:
    """Efforts (N, J) of a model's joints, and where they were not measured.

    Attributes
    ----------
    values : (N, J) float64
        All finite: short gaps are interpolated, what was not measured is zero.
    spans : (B,) int64
        Which spans of the clock there are, increasing: stamps divided by ``SPAN``.
    lost : (B, J) bool
        In which of them the effort of a driven joint was not measured.
    """

    values: FloatArray
    spans: IntArray
    lost: BoolArray

    def masked(self, stamp: IntArray, effort: FloatArray) -> FloatArray:
        """Return efforts (M, J) at other stamps (M,), NaN in the spans that have none."""
        if not self.lost.any():
            return effort
        span = np.searchsorted(self.spans, stamp // SPAN, side="right") - 1
        return np.where(self.lost[np.maximum(span, 0)], np.nan, effort)

    @property
    def any_row(self) -> bool:
        """Whether some joint's row is left in some span."""
        return not self.lost.size or not self.lost.all()


def measured_efforts(
    stamp: IntArray, effort: FloatArray, model: RobotModel, longest_gap: float, topic: str
) -> MeasuredEfforts:
    """Find the efforts that were measured, and warn of the others.

    Parameters
    ----------
    stamp : (N,) int64
        Nanoseconds, increasing.
    effort : (N, J) float64
        In the model's order, not finite where a message has no value. Changed in place.
    model : RobotModel
        Says which joints are driven: passive ones need no effort, theirs is zero.
    longest_gap : float
        Up to which a joint's effort is interpolated, ns.
    topic : str
        Bag and topic, for warnings.
    """
    number = stamp // SPAN
    starts = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
    lost = np.zeros((len(starts), effort.shape[1]), dtype=bool)
    if not len(starts):
        return MeasuredEfforts(effort, number, lost)
    is_finite = np.isfinite(effort)
    for index, joint in enumerate(model.joints):
        column, finite = effort[:, index], is_finite[:, index]
        if joint.effort == 0.0:
            column[~finite] = 0.0
            continue
        if not finite.all():
            unmeasured = ~_within_gaps(stamp, finite, longest_gap)
            _fill(stamp, column, finite)
            lost[:, index] = np.logical_or.reduceat(unmeasured, starts)
            _warn(topic, joint.name, "is not finite", lost[:, index])
        # A sensor that measures has noise; exact zeros come from a driver that has no sensor.
        is_zero = ~np.logical_or.reduceat(column != 0.0, starts) & ~lost[:, index]
        if is_zero.any():
            lost[:, index] |= is_zero
            _warn(topic, joint.name, "is always zero", lost[:, index])
    return MeasuredEfforts(effort, number[starts], lost)


def _within_gaps(stamp: IntArray, finite: BoolArray, longest: float) -> BoolArray:
    """Return which stamps (N,) are in no gap between finite values longer than ``longest``, ns."""
    known = stamp[finite]
    if not len(known):
        return finite
    # At the ends, where a filter settles, the nearest value is held for as long.
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
    spline = make_interp_spline(seconds[finite], column[finite], k=min(3, count - 1))
    # Beyond the first and last values, which are held there, a cubic would run away.
    inside = np.clip(seconds[~finite], seconds[finite][0], seconds[finite][-1])
    column[~finite] = spline(inside)


def _warn(topic: str, joint: str, what: str, lost: BoolArray) -> None:
    """Say that a joint's row is left out: the same words for every slice of a log."""
    if not lost.any():
        return
    logger.warning(
        "%s: the effort of joint %s %s: its row of the equation of motion is left out%s, all other "
        "rows are used; let the driver fill JointState.effort",
        topic,
        joint,
        what,
        "" if lost.all() else " for as long",
    )
