"""Joints that lean on the ends of their ranges, where no sensor measures the force of the stop."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.identification.conventions.loose_fit import (
    LooseFit,
    LooseRows,
    loose_rows,
    some_blocks,
)
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.end_stops import end_stop_depth
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.weak_form import cut_into_blocks

Options = TypeVar("Options", bound=RobotOptions)

logger = logging.getLogger(__name__)

# The efforts have to be likelier with a stop by this many nats.
EVIDENCE = 50.0
# A joint that is at an end for a larger share of the log has other limits than the file states.
MOST = 0.5
ENDS = 8  # at which joints are most often, and which are compared
BLOCKS = 16  # in which joints are at ends, and which are compared beside some others
LOOSE = 30.0  # prior deviation of a stop's force, in efforts of the joint
UPPER, LOWER = 1, -1


@dataclass(frozen=True)
class EndStop:
    """An end of a joint's range.

    Attributes
    ----------
    joint : int
    side : int
        1 for the upper end, -1 for the lower one.
    share : float
        Of the log during which the joint is there.
    """

    joint: int
    side: int
    share: float

    def depth(self, block: Segment, robot: RobotModel) -> FloatArray:
        """Return how far the joint is beyond the point at which the stop may push (M,)."""
        depth = self.side * end_stop_depth(block.position, robot.joints)[:, self.joint]
        return np.asarray(np.maximum(depth, 0.0))


def find_end_stops(segments: Iterable[Segment], robot: RobotModel) -> tuple[EndStop, ...]:
    """Return the ends of ranges at which a log shows the force of a stop.

    There the effort pushes outwards by more than links and friction need. This force is fitted
    together with loose inertias and friction: a constant, and one in proportion to the depth.
    """
    count, samples = 0, np.zeros((2, len(robot.joints)))
    blocks: dict[int, Segment] = {}
    for segment in segments:
        depth = end_stop_depth(segment.position, robot.joints)
        count += len(depth)
        samples += np.count_nonzero(depth > 0, axis=0), np.count_nonzero(depth < 0, axis=0)
        for block in cut_into_blocks(segment) if depth.any() else ():
            if len(blocks) < BLOCKS and end_stop_depth(block.position, robot.joints).any():
                blocks[int(block.stamp[0])] = block
    is_driven = [not one.sensor and one.mimic is None and one.effort > 0 for one in robot.joints]
    is_end = (samples > 0) & (samples < MOST * count) & np.array(is_driven, dtype=bool)
    order = np.argsort(-np.where(is_end, samples, 0.0), axis=None)[: min(ENDS, is_end.sum())]
    sides, joints = np.unravel_index(order, samples.shape)
    ends = [
        EndStop(joint, (UPPER, LOWER)[side], float(samples[side, joint] / count))
        for side, joint in zip(sides.tolist(), joints.tolist(), strict=True)
    ]
    if not ends or not blocks:
        return ()
    blocks |= {int(block.stamp[0]): block for block in some_blocks(segments)}
    rows = loose_rows(blocks.values(), robot)
    if rows is None:
        return ()
    pushes = [_Push.of(end, tuple(blocks.values()), rows) for end in ends]
    complete = _fit(rows, pushes)
    found = []
    for place, (end, push) in enumerate(zip(ends, pushes, strict=True)):
        others = [one for one in pushes if one is not push]
        sizes = complete.theta[rows.K.shape[2] + 2 * place :][:2]
        gain = _fit(rows, others).cost - complete.cost
        if gain >= EVIDENCE and end.side * float(sizes @ push.sums) > 0:
            found.append(end)
    return tuple(found)


@dataclass(frozen=True)
class _Push:
    """The force of a stop of unit size.

    Attributes
    ----------
    columns : (N, n, 2) float64
        What a constant force and one in proportion to the depth add to the rows.
    sums : (2,) float64
        Of these forces over the samples.
    """

    columns: FloatArray
    sums: FloatArray

    @classmethod
    def of(cls, end: EndStop, blocks: Sequence[Segment], rows: LooseRows) -> "_Push":
        """Return the difference that the force makes in the efforts, and so in the rows."""
        robot = rows.parameters.model
        depths = [end.depth(block, robot) for block in blocks]
        deepest = max(float(one.max(initial=0.0)) for one in depths) or 1.0
        efforts = np.concatenate([np.nan_to_num(block.effort[:, end.joint]) for block in blocks])
        size = LOOSE * float(np.sqrt(np.mean(efforts**2))) or 1.0
        columns, sums = np.zeros((*rows.y.shape, 2)), np.zeros(2)
        for place in range(2):
            changed = []
            for block, depth in zip(blocks, depths, strict=True):
                effort = block.effort.copy()
                push = size * (depth / deepest if place else np.sign(depth))
                effort[:, end.joint] += push
                sums[place] += push.sum()
                changed.append(replace(block, effort=effort))
            different = loose_rows(changed, robot)
            assert different is not None
            columns[..., place] = np.where(rows.valid, different.y - rows.y, 0.0)
        return cls(columns, sums)


def _fit(rows: LooseRows, pushes: Sequence[_Push]) -> LooseFit:
    empty = np.zeros((*rows.y.shape, 0))
    return rows.fit(np.concatenate([empty, *(one.columns for one in pushes)], axis=2))


def with_found_end_stops(
    options: Options, robot: RobotModel, segments: Iterable[Segment], source: str
) -> Options:
    """Return options with the joints that lean on end stops, and log a warning for each end."""
    if options.end_stops:
        return options
    found = find_end_stops(segments, robot)
    if not found:
        return options
    names = [robot.joints[one.joint].name for one in found]
    for one, name in zip(found, names, strict=True):
        joint = robot.joints[one.joint]
        position = joint.upper if one.side == UPPER else joint.lower
        logger.warning(
            "%s: %s leans on the end of its range at %.4g for %.2g %% of the log, where no sensor "
            "measures the force of the stop; rows with this force are left out. Give `end_stops` "
            "%s if that is right, otherwise none",
            source,
            name,
            position,
            100 * one.share,
            ",".join(dict.fromkeys(names)),
        )
    return replace(options, end_stops=tuple(dict.fromkeys(names)))
