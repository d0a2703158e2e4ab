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
# At least BLOCKS blocks with a joint at an end are compared, and more until each end occurs in
# BLOCKS_OF_END of them. Some other blocks are compared as well.
BLOCKS, BLOCKS_OF_END = 16, 4
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
    seen = np.zeros_like(samples)  # blocks with each end
    blocks: dict[int, Segment] = {}
    for segment in segments:
        depth = end_stop_depth(segment.position, robot.joints)
        count += len(depth)
        samples += np.count_nonzero(depth > 0, axis=0), np.count_nonzero(depth < 0, axis=0)
        for block in cut_into_blocks(segment) if depth.any() else ():
            depth = end_stop_depth(block.position, robot.joints)
            is_at = np.array([(depth > 0).any(axis=0), (depth < 0).any(axis=0)])
            is_new = bool(np.any(is_at & (seen < BLOCKS_OF_END)))
            if is_new or (len(blocks) < BLOCKS and is_at.any()):
                blocks[int(block.stamp[0])] = block
                seen += is_at
    is_driven = [not one.sensor and one.mimic is None and one.effort > 0 for one in robot.joints]
    is_end = (samples > 0) & (samples < MOST * count) & np.array(is_driven, dtype=bool)
    ends = [
        EndStop(joint, (UPPER, LOWER)[side], float(samples[side, joint] / count))
        for side, joint in np.argwhere(is_end).tolist()
    ]
    if not ends or not blocks:
        return ()
    blocks |= {int(block.stamp[0]): block for block in some_blocks(segments)}
    # A block's rows contain the forces during this block alone.
    parts = [loose_rows([block], robot) for block in blocks.values()]
    places = np.cumsum([0, *(0 if one is None else len(one.y) for one in parts)]).tolist()
    long_enough = [one for one in parts if one is not None]
    if not long_enough:
        return ()
    rows = LooseRows.joined(long_enough)
    pushes = [_Push.of(end, tuple(blocks.values()), rows, places) for end in ends]
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
    def of(
        cls, end: EndStop, blocks: Sequence[Segment], rows: LooseRows, places: Sequence[int]
    ) -> "_Push":
        """Return the difference that the force makes in the efforts, and so in the rows.

        ``places`` tell where the rows of each block begin and end.
        """
        robot = rows.parameters.model
        depths = [end.depth(block, robot) for block in blocks]
        deepest = max(float(one.max(initial=0.0)) for one in depths) or 1.0
        efforts = np.concatenate([np.nan_to_num(block.effort[:, end.joint]) for block in blocks])
        size = LOOSE * float(np.sqrt(np.mean(efforts**2))) or 1.0
        columns, sums = np.zeros((*rows.y.shape, 2)), np.zeros(2)
        for block, depth, first, last in zip(blocks, depths, places[:-1], places[1:], strict=True):
            if not depth.any():
                continue
            inside = slice(first, last)
            for place, push in enumerate((size * np.sign(depth), size * depth / deepest)):
                effort = block.effort.copy()
                effort[:, end.joint] += push
                sums[place] += push.sum()
                if different := loose_rows([replace(block, effort=effort)], robot):
                    change = different.y - rows.y[inside]
                    columns[inside, :, place] = np.where(rows.valid[inside], change, 0.0)
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
