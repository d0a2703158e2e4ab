"""Joints whose readings a log exchanges, found from the efforts."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.identification.loose_fit import LooseRows, loose_rows, some_blocks
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

# Efforts of which less is left (RMS) with the log's order are in the right one. Real drives leave
# up to 0.15.
EXPLAINED = 0.01
# Each exchange has to be likelier by this many nats, and by this many for each row.
EVIDENCE, LEAST_GAIN = 50.0, 0.1
# All exchanges together have to halve the residuals (geometric mean), and to leave no more than
# this share of the efforts unexplained (RMS).
HALVED, MOST_LEFT = np.log(2.0), 0.2
BLOCKS = 4  # of the log that are compared
MOST_JOINTS = 20  # every pair is tried


def find_order(segments: Sequence[Segment], robot: RobotModel) -> IntArray | None:
    """Return which joint's readings in a log are those of each joint; None if each has its own.

    Pairs are exchanged one after another as long as that explains the efforts better.

    Parameters
    ----------
    segments : sequence of Segment
        Of the log.
    robot : RobotModel
    """
    blocks = list(some_blocks(segments))[:BLOCKS]
    driven = np.any([np.isfinite(one.effort).any(axis=0) for one in blocks], axis=0)
    measured = [robot.joint_names.index(name) for name in robot.measured_joint_names]
    moving = [index for index in measured if blocks and driven[index]]
    if not 1 < len(moving) <= MOST_JOINTS:
        return None

    def read(order: IntArray) -> LooseRows | None:
        exchanged = [
            replace(one, position=one.position[:, order], effort=one.effort[:, order])
            for one in blocks
        ]
        return loose_rows(exchanged, robot)

    order = np.arange(len(robot.joints))
    rows = read(order)
    if rows is None:
        return None
    count = int(rows.valid.sum())
    best = first = rows.fit()
    if first.unexplained < EXPLAINED:
        return None
    while True:
        tried = [
            (found.fit(), other)
            for other in _exchanged(order, moving)
            if (found := read(other)) is not None
        ]
        fit, other = min(tried, key=lambda one: one[0].cost, default=(best, order))
        if fit.cost > best.cost - max(EVIDENCE, LEAST_GAIN * count):
            break
        best, order = fit, other
    is_right = first.cost - best.cost > HALVED * count and best.unexplained < MOST_LEFT
    return order if is_right else None


def _exchanged(order: IntArray, moving: Sequence[int]) -> Iterator[IntArray]:
    """Yield an order with each pair of joints exchanged."""
    for one, other in combinations(moving, 2):
        exchanged = order.copy()
        exchanged[[one, other]] = order[[other, one]]
        yield exchanged
