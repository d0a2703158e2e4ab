"""Warming: friction of a drive that changes during a log.

The viscous friction of grease and seals falls by tens of percent while a drive warms up, and so
does a part of Coulomb friction, in minutes to hours (Bittencourt et al. 2010, An extended friction
model to capture load and temperature effects in robot joints, IROS; Simoni et al. 2015, Friction
modeling with temperature effects for industrial robot manipulators, IROS; Simoni et al., Modelling
the temperature in joint friction of industrial manipulators, Robotica, DOI
10.1017/S0263574717000509). Temperatures are not measured, so friction is a smooth function of time,
linear in its unknowns. With u the elapsed share of the log, the change until the end is a sum of
(1-u), (1-u)², (1-u)⁴ and (1-u)¹⁰. They follow an exponential decay to 0.16 % (root mean square, of
its height) for all time constants above a tenth of the log, and a steady change exactly. A random
walk with knots a minute apart, as sensor errors have, cannot follow the decay in the first minute,
and needs more unknowns in long logs.

All of them vanish at the end of the log. ``viscous`` and ``coulomb`` are thus the friction at the
end, that of the warm robot.
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.choices import Term
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel

# First and last stamp of a part of a log without long pauses, ns.
Course = tuple[int, int]

# Terms that change with the temperature.
WARMING_TERMS: tuple[Term, ...] = ("viscous", "coulomb")
# Powers of 1 - u.
POWERS = 1, 2, 4, 10
# The unknowns are the changes at these percentages of a part, so that they can be read.
NODES = 0, 10, 30, 60, 100
# Each part of a log has unknowns of its own. With more parts than these, there are too many.
MOST_PARTS = 4
# Pause in which a drive cools, ns: friction may differ after it.
PAUSE = 60_000_000_000

# Before all stamps, ns: courses of a log that is not at hand.
_AGO = 2**62

WARMING_TERM = re.compile(r"(viscous|coulomb)_excess_(?:part(\d+)_)?\d+")


@dataclass(frozen=True)
class Warming:
    """Viscous or Coulomb friction of a joint that changes during a log.

    A log with long pauses has several parts, each with a change of its own. The unknowns are by how
    much friction exceeds that at the end of the last part: after 0, 10, 30 and 60 % of each part,
    and at the end of those before the last.

    Attributes
    ----------
    joint : int
        Index of the joint.
    term : {"viscous", "coulomb"}
        Term that changes.
    courses : tuple of (int, int)
        First and last stamp of each part, ns, in the order of time.
    """

    joint: int
    term: Term
    courses: tuple[Course, ...]

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of its k columns, part by part."""
        last = len(self.courses) - 1
        labels = [f"part{number + 1}_{node}" for number in range(last) for node in NODES]
        labels += [str(node) for node in NODES[:-1]]
        return tuple(f"{self.term}_excess_{label}" for label in labels)

    def columns(self, stamp: IntArray) -> FloatArray:
        """Return (N, k) the factors on the term's column at stamps (N,), zero outside the log."""
        last = len(self.courses) - 1
        columns = []
        for number, (start, stop) in enumerate(self.courses):
            left = (stop - stamp) / max(stop - start, 1)
            powers = POWERS if number == last else (*POWERS, 0)
            nodes = 1 - np.array(NODES[: len(powers)]) / 100
            # Combinations of the powers that are one at a node and zero at the others.
            shape = np.linalg.inv(nodes[:, None] ** powers)
            inside = (left >= 0) & (left <= 1)
            columns.append(
                (np.where(inside, left, 0.0)[:, None] ** powers @ shape) * inside[:, None]
            )
        return np.concatenate(columns, axis=1)

    @property
    def is_of_another_log(self) -> bool:
        """Whether it is known from the information of an earlier log alone."""
        return self.courses[-1][1] < 0


def courses_of(spans: Sequence[Course]) -> tuple[Course, ...]:
    """Return the parts of a log between long pauses, from the first and last stamps of segments."""
    found: list[Course] = []
    for start, stop in sorted(spans):
        if found and start - found[-1][1] < PAUSE:
            found[-1] = found[-1][0], max(stop, found[-1][1])
        else:
            found.append((start, stop))
    return tuple(found)


def is_change(name: str) -> bool:
    """Return whether a parameter is the change of a joint's friction, by its name."""
    return WARMING_TERM.fullmatch(name.rpartition("/")[2]) is not None


def warming_in(
    names: Collection[str], model: RobotModel, courses: Sequence[Course] = ()
) -> tuple[Warming, ...]:
    """Return the friction that changes, whose columns occur in parameter names.

    Without ``courses`` its log is unknown, and other logs are taken to be warm.

    Raises
    ------
    ModelError
        When the robot has no such joint.
    """
    parts: dict[tuple[str, str], int] = {}
    for name in names:
        joint, _, term = name.rpartition("/")
        if match := WARMING_TERM.fullmatch(term):
            key = joint, match[1]
            parts[key] = max(parts.get(key, 1), 1 + int(match[2] or 0))
    for (joint, term), count in parts.items():
        if joint not in model.joint_names or count > MOST_PARTS:
            raise ModelError(
                f"{model.source}: {joint!r} has no {term} friction that changes in {count} parts "
                "of a log; identify the log again with this robot",
                "E117",
            )
    return tuple(
        Warming(
            model.joint_names.index(joint),
            next(one for one in WARMING_TERMS if one == term),
            tuple(courses) or tuple((2000 * i - _AGO, 2000 * i + 999 - _AGO) for i in range(count)),
        )
        for (joint, term), count in parts.items()
    )
