"""Positions in degrees, found from the efforts.

Degrees beyond the limits of joints are found by `symbid_ros.diagnosis.joint_checks`. Continuous
joints have no limits, but gravity acts by the sine of the right angle.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.joint_checks import DEGREES, position_line
from symbid_ros.errors import DataError
from symbid_ros.identification.conventions.loose_fit import loose_rows, some_blocks
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

TURN = 2 * np.pi
BLOCKS = 4  # of the log that are compared
# Degrees have to leave no more than this share of the efforts unexplained (RMS), and no more than
# this share of what radians leave.
MOST_LEFT, HALVED = 0.2, 0.5
# Degrees need so many rows per unknown, and this share of the rows of radians: joints that hardly
# move have no rows, and few rows are always explained.
FEWEST_ROWS, LEAST_SHARE = 3, 0.3


@dataclass(frozen=True)
class FoundDegrees:
    """Angles that explain the efforts if they are read as degrees.

    Attributes
    ----------
    joints : tuple of str
        Joints that turn.
    travel : float
        Largest range of a reading.
    before, after : float
        Share of the efforts (RMS) that radians and degrees leave unexplained.
    """

    joints: tuple[str, ...]
    travel: float
    before: float
    after: float

    @property
    def message(self) -> str:
        """What is wrong and how to correct it."""
        return (
            f"positions change by up to {self.travel:.3g}, and the efforts say that this is in "
            f"degrees, which leave {100 * self.after:.2g} % of them unexplained, radians "
            f"{100 * self.before:.2g} %; use rad and rad/s, or write "
            f"{position_line(self.joints)}"
        )

    def finding(self, topic: str) -> Finding:
        """Return the doctor's finding about a topic of joint states."""
        figures = {"travel": self.travel, "left": self.after, "left_in_rad": self.before}
        return Finding.of(topic, Kind.UNIT, self.message, figures, Severity.UNUSABLE)


def find_degrees(segments: Iterable[Segment], robot: RobotModel) -> FoundDegrees | None:
    """Return the angles of a log if the efforts of a fixed base say that they are in degrees."""
    turning = np.array([joint.kind == "revolute" for joint in robot.joints])
    blocks = list(islice(some_blocks(segments), BLOCKS))
    if robot.floating or not blocks or not turning.any():
        return None
    low = np.min([one.position.min(axis=0) for one in blocks], axis=0)
    high = np.max([one.position.max(axis=0) for one in blocks], axis=0)
    travel = float((high - low)[turning].max())
    if travel <= TURN:
        return None
    scale = np.where(turning, 1 / DEGREES, 1.0)
    converted = [replace(one, position=one.position * scale) for one in blocks]
    as_read, as_degrees = loose_rows(blocks, robot), loose_rows(converted, robot)
    if as_read is None or as_degrees is None:
        return None
    count = as_degrees.valid.sum()
    if count < max(FEWEST_ROWS * as_degrees.K.shape[2], LEAST_SHARE * as_read.valid.sum()):
        return None
    before, after = as_read.fit().unexplained, as_degrees.fit().unexplained
    if after > min(MOST_LEFT, HALVED * before):
        return None
    measured = set(robot.measured_joint_names)
    names = [joint.name for joint in robot.joints if joint.kind == "revolute"]
    joints = tuple(name for name in names if name in measured)
    return FoundDegrees(joints, travel, before, after)


def refuse_degrees(segments: Iterable[Segment], robot: RobotModel, source: str) -> None:
    """Raise an error if the efforts of a log say that its positions are in degrees."""
    if (found := find_degrees(segments, robot)) is not None:
        raise DataError(
            f"{source}: {found.message}; give `unchecked` to use the log anyway", "E517"
        )
