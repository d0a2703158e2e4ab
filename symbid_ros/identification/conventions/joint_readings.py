"""Joints whose readings a log exchanges or reverses, found from the efforts."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.diagnosis.findings import Finding, Kind
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.identification.conventions.loose_fit import (
    LooseFit,
    LooseRows,
    loose_rows,
    some_blocks,
)
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.progress import report
from symbid_ros.signals.segments import Segment

# Logs are right in which less than this share of each joint's efforts is left (RMS).
EXPLAINED = 0.01
# Each change has to be likelier by this many nats, and by this many for each row. What counts is
# the share that is left of an effort's variation, since exchanged efforts have other sizes.
# Reversed joints of real logs that are right bring 12 nats at most. A reversed position also has to
# be likelier by this many nats than a reversed effort of the joint, and than both together.
EVIDENCE, LEAST_GAIN = 50.0, 0.1
# All changes together have to halve the residuals (geometric mean) of as many joints as they
# change, and to leave no more than this share of the efforts unexplained (RMS).
HALVED, MOST_LEFT = np.log(2.0), 0.2
BLOCKS = 4  # of the log that are compared
MOST_JOINTS = 20  # every pair is tried
# Friction that gives a joint this share of the power of its effort shows a wrong sign, if the fit
# leaves no more than that share of the effort. Friction of right logs of real robots gives .12.
DRIVEN, MOST_OF_IT = 0.5, 0.5
# Deviations by which that power must be negative. A joint that sticks slips in few rows, which
# friction of either sign explains: that of a real quadruped is negative by .14 deviations at most,
# and positive by 3 to 30 at joints that move for seconds.
CERTAIN = 3.0
# Efforts of so many joints and more are called those of all joints, if they are.
FEWEST_OF_ALL = 3
# What to do if either positions or efforts are exchanged, which no option corrects.
OWN_NAMES = "publish each position and effort under the name of its own joint"
# Signs of position and effort that are tried for each joint.
REVERSALS = (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)
# The same with measured wrenches: one with the wrong sign, as of a payload, looks like an effort
# with the wrong sign.
REVERSALS_BESIDE_WRENCHES = REVERSALS[:2]


@dataclass(frozen=True)
class JointReadings:
    """How the readings of a log belong to the J joints of a model.

    Attributes
    ----------
    names : tuple of str
        Joints of the model.
    order, effort_order : (J,) int64
        Whose position and whose effort in the log are those of each joint.
    position, effort : (J,) float64
        Signs of the readings.
    unexplained : float
        Share of the efforts (RMS) that a fit leaves.
    driven : frozenset of str
        Joints whose efforts the log has.
    """

    names: tuple[str, ...]
    order: IntArray
    effort_order: IntArray
    position: FloatArray
    effort: FloatArray
    unexplained: float = 1.0
    driven: frozenset[str] = frozenset()

    @classmethod
    def unchanged(cls, names: tuple[str, ...]) -> "JointReadings":
        """Return readings that are those of the joints."""
        ones, order = np.ones(len(names)), np.arange(len(names))
        return cls(names, order, order, ones, ones)

    @property
    def exchanged(self) -> dict[str, str]:
        """Names of joints in the model, by their names in the log."""
        return self._named((self.order != self._own) & (self.order == self.effort_order))

    @property
    def exchanged_positions(self) -> tuple[str, ...]:
        """Joints that have the position of another joint, and not its effort."""
        alone = (self.order != self._own) & (self.order != self.effort_order)
        return tuple(self._named(alone).values())

    @property
    def exchanged_efforts(self) -> tuple[str, ...]:
        """Joints that have the effort of another joint, and not its position."""
        alone = (self.effort_order != self._own) & (self.order != self.effort_order)
        return tuple(self._named(alone).values())

    @property
    def _own(self) -> IntArray:
        return np.arange(len(self.names))

    def _named(self, some: BoolArray) -> dict[str, str]:
        """Return the names of some joints, by the names of those whose position they have."""
        return {self.names[self.order[i]]: self.names[i] for i in np.flatnonzero(some)}

    @property
    def reversed_joints(self) -> dict[str, bool]:
        """Joints whose position and velocity have the wrong sign, and whether the effort has."""
        signs = zip(self.names, self.position, self.effort, strict=True)
        return {name: bool(effort < 0) for name, position, effort in signs if position < 0}

    @property
    def reversed_efforts(self) -> tuple[str, ...]:
        """Joints whose effort alone has the wrong sign."""
        signs = zip(self.names, self.position, self.effort, strict=True)
        return tuple(name for name, position, effort in signs if position > 0 > effort)

    @property
    def are_all_efforts_reversed(self) -> bool:
        """Whether efforts of all joints have the wrong sign, of three joints or more."""
        return len(self.driven) >= FEWEST_OF_ALL and self.driven == {*self.reversed_efforts}

    @property
    def are_positions_right(self) -> bool:
        """Whether efforts alone are reversed, and none exchanged, if any reading is wrong."""
        return not (self._is_exchanged.any() or self.reversed_joints)

    @property
    def changed(self) -> int:
        """Number of joints whose readings are changed."""
        return int(np.sum(self._is_exchanged | (self.position < 0) | (self.effort < 0)))

    @property
    def _is_exchanged(self) -> BoolArray:
        """(J,) joints with the position or the effort of another joint."""
        return np.asarray((self.order != self._own) | (self.effort_order != self._own))

    def applied_to(self, segment: Segment) -> Segment:
        """Return a segment with the joints' own readings."""
        return replace(
            segment,
            position=segment.position[:, self.order] * self.position,
            effort=segment.effort[:, self.effort_order] * self.effort,
        )

    def with_exchanged(self, one: int, other: int) -> "JointReadings":
        """Return the readings with those of two joints exchanged."""
        order = self.order.copy()
        order[[one, other]] = order[[other, one]]
        return replace(self.with_exchanged_efforts(one, other), order=order)

    def with_exchanged_efforts(self, one: int, other: int) -> "JointReadings":
        """Return the readings with the efforts of two joints exchanged."""
        order = self.effort_order.copy()
        order[[one, other]] = order[[other, one]]
        return replace(self, effort_order=order)

    def with_reversed(self, joint: int, position: float, effort: float) -> "JointReadings":
        """Return the readings with those of a joint times these signs."""
        signs = [self.position.copy(), self.effort.copy()]
        for each, sign in zip(signs, (position, effort), strict=True):
            each[joint] *= sign
        return replace(self, position=signs[0], effort=signs[1])

    @property
    def fault(self) -> str:
        """What the log exchanges or reverses."""
        said = []
        exchanged = {
            "": tuple(self.exchanged),
            "positions alone of ": self.exchanged_positions,
            "efforts alone of ": self.exchanged_efforts,
        }
        if parts := [f"{what}{', '.join(names)}" for what, names in exchanged.items() if names]:
            said.append(f"the log exchanges {' and '.join(parts)}")
        groups = {
            what: [name for name, is_effort in self.reversed_joints.items() if is_effort == whole]
            for whole, what in (
                (False, "position and velocity"),
                (True, "position, velocity and effort"),
            )
        }
        is_all = self.are_all_efforts_reversed
        groups["efforts"] = ["all joints"] if is_all else list(self.reversed_efforts)
        reversed_ = [f"{what} of {', '.join(names)}" for what, names in groups.items() if names]
        if reversed_:
            said.append(f"{', '.join(reversed_)} have the opposite sign of the model's joint axis")
        return f"{Alarm.READINGS}: {', and '.join(said)}"

    @property
    def options(self) -> dict[str, list[str]]:
        """Values of the options that correct the readings, by option."""
        pairs = [f"{recorded}:={own}" for recorded, own in self.exchanged.items()]
        reversed_ = self.reversed_joints
        reversed_efforts = [name for name, is_effort in reversed_.items() if is_effort]
        scales = [f"{name}:=-1.0" for name in (*reversed_efforts, *self.reversed_efforts)]
        values = {"rename_joint": pairs, "flip_joint": list(reversed_), "effort_scale": scales}
        return {option: given for option, given in values.items() if given}

    @property
    def _needs_driver(self) -> bool:
        """Whether positions or efforts alone are exchanged, which only the driver can correct."""
        return bool(self.exchanged_positions or self.exchanged_efforts)

    @property
    def alarm(self) -> str:
        """The fault and the options that correct it, for an identification."""
        pairs = ((option, one) for option, values in self.options.items() for one in values)
        given = " ".join(f"`{option}` {one}" for option, one in pairs)
        advice = [OWN_NAMES] * self._needs_driver + [f"give {given}"] * bool(given)
        return f"{self.fault}; {', and '.join(advice)}"

    def finding(self, topic: str) -> Finding:
        """Return the doctor's finding about the topic of the joint states."""
        lines = [robot_file_line(option, *values) for option, values in self.options.items()]
        if self._needs_driver:
            advice = ", and ".join([OWN_NAMES, *(f"write {one}" for one in lines)])
        else:
            advice = f"correct the driver or the model, or write {' and '.join(lines)}"
        text = f"{self.fault}; {advice}"
        return Finding.of(topic, Kind.JOINT_READINGS, text, {})


def find_readings(segments: Iterable[Segment], robot: RobotModel) -> JointReadings | None:
    """Return how the joints of a log are to be read; None if their readings are right.

    Joints are exchanged or reversed one after another as long as that explains the efforts better.
    The effort of a joint that mostly overcomes friction has the wrong sign if that friction would
    drive the joint. Efforts or positions of all joints have it if friction would drive the robot,
    and with the opposite sign takes power at every joint.
    """
    log = _LogPart.of(segments, robot)
    if not 0 < len(log.moving) <= MOST_JOINTS:
        return None
    readings = log.readings
    rows = log.rows(readings)
    if rows is None:
        return None
    first = rows.fit()
    if (together := _reversed_together(log, first)) is not None:
        return together
    # A joint at rest has no rows, so no residual would contradict an exchange with its effort.
    moving = tuple(index for index in log.moving if rows.has_rows[index])
    if not moving:
        return None
    log = replace(log, moving=moving)
    has_wrenches = log.has_wrenches
    explained = first.shares[[*moving]].max() < EXPLAINED
    reversals = REVERSALS_BESIDE_WRENCHES if has_wrenches else REVERSALS
    found = None if explained else _likelier(log, rows, reversals)
    readings, best = found or (readings, first)
    for joint in () if has_wrenches else moving:
        is_driven = best.power[joint] < -max(DRIVEN, CERTAIN * best.power_std[joint])
        if is_driven and best.shares[joint] < MOST_OF_IT:
            readings = readings.with_reversed(joint, 1.0, -1.0)
    readings = replace(readings, unexplained=best.unexplained)
    return readings if readings.changed else None


def find_common_reversal(segments: Iterable[Segment], robot: RobotModel) -> JointReadings | None:
    """Return the readings of a log that reverses all efforts or all positions, else None.

    A log in which friction takes power costs a single fit: it is not searched any further.
    """
    log = _LogPart.of(segments, robot)
    rows = log.rows(log.readings) if log.moving else None
    return None if rows is None else _reversed_together(log, rows.fit())


@dataclass(frozen=True)
class _LogPart:
    """The first blocks of a log, and the ``moving`` joints: those with efforts and positions."""

    blocks: tuple[Segment, ...]
    robot: RobotModel
    moving: tuple[int, ...]

    @classmethod
    def of(cls, segments: Iterable[Segment], robot: RobotModel) -> "_LogPart":
        blocks = tuple(islice(some_blocks(segments), BLOCKS))
        if not blocks:
            return cls((), robot, ())
        driven = np.any([np.isfinite(one.effort).any(axis=0) for one in blocks], axis=0)
        measured = [robot.joint_names.index(name) for name in robot.measured_joint_names]
        return cls(blocks, robot, tuple(index for index in measured if driven[index]))

    @property
    def readings(self) -> JointReadings:
        """Those of the joints, unchanged."""
        names = self.robot.joint_names
        driven = frozenset(names[index] for index in self.moving)
        return replace(JointReadings.unchanged(names), driven=driven)

    @property
    def has_wrenches(self) -> bool:
        """Whether any wrench is measured."""
        return any(one.wrench_frames for one in self.blocks)

    def rows(self, readings: JointReadings) -> LooseRows | None:
        """Return the rows of the log with other readings; None if it is too short."""
        return loose_rows([readings.applied_to(one) for one in self.blocks], self.robot)


def _reversed_together(log: _LogPart, own: LooseFit) -> JointReadings | None:
    """Return readings with all efforts, or all positions, reversed if friction shows that.

    Single joints do not: their links may have any mass here, and explain either sign. ``own`` is
    the fit to the readings of the log.
    """
    if own.dissipates or log.has_wrenches:
        return None
    found = {}
    for signs in ((1.0, -1.0), (-1.0, 1.0)):
        changed = log.readings
        for joint in log.moving:
            changed = changed.with_reversed(joint, *signs)
        if (rows := log.rows(changed)) is not None:
            found[signs] = replace(changed, unexplained=(fit := rows.fit()).unexplained), fit
    if len(found) < 2:
        return None
    (efforts, fit), (positions, other) = found.values()
    if other.cost + EVIDENCE < fit.cost:
        efforts, fit = positions, other
    is_likelier = fit.cost < own.cost and fit.unexplained < MOST_LEFT
    takes_power = bool(np.all(fit.power[[*log.moving]] > 0)) and fit.dissipates
    return efforts if is_likelier and takes_power else None


def _likelier(
    log: _LogPart, rows: LooseRows, reversals: Sequence[tuple[float, float]]
) -> tuple[JointReadings, LooseFit] | None:
    """Return readings that explain the efforts much better, with their fit; None if none do.

    ``rows`` are those of the readings of the log.
    """
    readings = log.readings
    count = int(rows.valid.sum())
    best = rows.fit()
    first_cost = best_cost = best.cost - rows.variation_cost
    while True:
        changes = list(_changes(readings, log.moving, reversals))
        tried = []
        for number, (changed, joint) in enumerate(changes):
            report("looking for exchanged and reversed joints", number / len(changes))
            if (found := log.rows(changed)) is not None:
                fit = found.fit()
                tried.append((fit.cost - found.variation_cost, fit, changed, joint))
        if not tried:
            break
        cost, fit, changed, joint = min(tried, key=lambda one: one[0])
        if cost > best_cost - max(EVIDENCE, LEAST_GAIN * count):
            break
        rivals = [one for one, other, _, of in tried if of == joint and other is not fit]
        if joint is not None and min(rivals) < cost + EVIDENCE:
            break
        best, best_cost, readings = fit, cost, changed
    least = HALVED * count * readings.changed / len(log.moving)
    if first_cost - best_cost <= least or best.unexplained >= MOST_LEFT:
        return None
    return readings, best


def _changes(
    readings: JointReadings, moving: Sequence[int], reversals: Sequence[tuple[float, float]]
) -> Iterator[tuple[JointReadings, int | None]]:
    """Yield readings with a pair of joints exchanged or a joint reversed, and the latter joint.

    Of a pair, both positions and efforts are exchanged, or the efforts alone.
    """
    for one, other in combinations(moving, 2):
        yield readings.with_exchanged(one, other), None
        yield readings.with_exchanged_efforts(one, other), None
    for joint in moving:
        for signs in reversals:
            yield readings.with_reversed(joint, *signs), joint
