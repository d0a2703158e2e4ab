"""Finds the likely cause of residuals that are correlated in time, by trying candidates.

Each candidate adds columns to the rows of a log: terms of joints that were not identified, effects
that no option models, and sensor errors, linearised about the estimate. The one whose columns best
predict blocks of the log that were left out is named, with the force that would remain.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.choices import SENSOR_ERROR_KINDS, TERMS, TYPICAL_ERRORS
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.diagnosis.timing import SLOWEST, TOLERANCE
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.alarms import Alarm, coloured_alarm
from symbid_ros.estimation.unexplained import UnexplainedForce, force_text
from symbid_ros.identification.causes.brief_disturbance import brief_disturbance
from symbid_ros.identification.causes.candidate_causes import GROUPS, Candidate, CandidateRows
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.signals.segments import Segment

# Share by which a cause must reduce the square error of left-out blocks to be named.
LEAST_GAIN = 0.3
# Deviations of sensor errors that are tried, in typical ones.
WIDEST = 10.0
# Weight that keeps columns finite which others replace, as a share of their squares.
RIDGE = 1e-3
# Share of the rows with the largest value of a quantity, in which more than half of the square
# error makes it "mostly" there.
QUARTER, MOSTLY = 0.25, 0.5
# Share of the log in which a contact touches less than any foot on which a robot stands or walks.
# Before their first message, flags count as touching.
SELDOM = 0.05

NO_OPTION = "no option models it, but the standard deviations contain it"
WARM = "leave `joint_terms` and `sensor_errors` out, or give a later `start`, with warm drives"
WRONG_EFFORTS = "the wrong efforts in another alarm may explain it; correct these first"
WRONG_WEIGHING = "what contradicts the weighing in another alarm may explain it; correct that first"
FROZEN = "the joint at rest in another alarm may explain it; check that first"
MISSING_INERTIA = "the missing inertia in another alarm may explain it; correct that first"
DELAY_ALARM = "the delay in another alarm"
WRONG_READINGS = "the wrong readings of joints in another alarm may explain it; correct these first"
EFFECTS = {
    "viscous": "viscous friction",
    "warming": "viscous friction that changes during the log",
    "coulomb": "Coulomb friction",
    "armature": "armature",
    "offset": "constant torques",
    "stribeck": "Stribeck friction",
    "quadratic": "friction that grows with the square of the speed",
    "load": "friction in proportion to the load",
    "presliding": "friction that changes its sign after the velocity does",
    "stiffness": "springs at joints",
    "lead": "friction that changes its sign before the velocity does",
    "creep": "friction that rises with the speed of slow joints",
    "delay": "a delay",
    "effort_delay": "delays of single efforts",
    "torque_gain": "gains of the efforts",
    "encoder_offset": "encoder offsets",
    "compliance": "elasticity",
    "imu_mounting": "the mounting of the IMU",
    "imu_bias": "the bias of the IMU",
    "sensor_delay": "delays of sensors",
    "link_length": "lengths of links",
    "joint_axis": "directions of joint axes",
    "frame_pose": "frames of sensors",
    "wrench_offset": "offsets of the wrench sensors",
    "sensor_drift": "offsets of wrist sensors that change during the log",
    "wrench_gain": "gains of the wrench sensors",
    "wrench_position": "positions of the wrench sensors",
    "support": "a support without a sensor, such as a cable",
    "typical": "several sensor errors together",
}
SEVERAL = "typical"
# What to do about causes that are neither joint terms nor sensor errors.
ADVICE = {
    "delay": "give `sensor_errors` sensor_delay, or correct the stamps of one of them",
    "effort_delay": "remove the delay or filter of these drives' readings",
    "support": "remove it, or record its force as a wrench",
    "warming": WARM,
    "sensor_drift": "let the sensor warm up, or give a shorter part with `start` and `stop`",
}


@dataclass(frozen=True)
class Cause:
    """A candidate that explains residuals.

    Attributes
    ----------
    kind : str
        Key of ``EFFECTS``.
    gain : float
        Share by which it reduces the square error of left-out blocks.
    remains : float
        RMS error with it of left-out blocks, over that without it, of the coordinate in question.
    detail : str
        Where it is largest, and how large.
    """

    kind: str
    gain: float
    remains: float
    detail: str

    @property
    def advice(self) -> str:
        """What to do about it."""
        if self.kind in TERMS:
            return f"leave `joint_terms` out, or add {self.kind} to it"
        if self.kind == "wrench_offset":
            return "give a `tare`, or `sensor_errors` wrench_offset"
        if self.kind in SENSOR_ERROR_KINDS or self.kind == SEVERAL:
            return f"give `sensor_errors` {self.kind}"
        return ADVICE.get(self.kind, NO_OPTION)


def explained(
    problem: LoadedProblem, found: Identification, known_cause: str = ""
) -> Identification:
    """Return an identification whose alarms name their likely cause.

    Joints that the log lacks and contacts that are always lifted are named beside any alarm; other
    causes are tried for correlated residuals, unless their cause is known. A brief disturbance
    comes first of all alarms.
    """
    found = _with_tried_causes(problem, found, known_cause)
    if not found.alarms:
        return found
    more = (*_lacking_joints(problem), *_lifted_contacts(problem))
    return found.with_alarms((*found.alarms, *more)) if more else found


def _lacking_joints(problem: LoadedProblem) -> tuple[str, ...]:
    """Return an alarm about joints that the log lacks, which explains other alarms."""
    model = problem.parameters.model
    names = held_joints(model.joint_names, problem.dataset.segments)
    own = [name for name in names if name in model.measured_joint_names]
    if not own:
        return ()
    motion = "it moved" if len(own) == 1 else "they moved"
    return (
        f"{Alarm.LACKING_JOINTS} {', '.join(own)}, assumed to be at rest: if {motion}, "
        "this explains the other alarms; record the joint states of all joints, or give the names "
        "in the log as `rename_joint`",
    )


def _lifted_contacts(problem: LoadedProblem) -> tuple[str, ...]:
    """Return an alarm about contacts that hardly touch anything according to their flags.

    A flag that is stuck at false lets the model carry what this contact carries.
    """
    contacts = problem.parameters.model.contacts
    each = [one.touching for one in problem.dataset.segments if one.touching is not None]
    if contacts is None or not each:
        return ()
    share = np.concatenate(each).mean(axis=0)
    lifted = [name for name, one in zip(contacts.frames, share, strict=True) if one < SELDOM]
    if not lifted:
        return ()
    verb, subject = ("touches", "it stands") if len(lifted) == 1 else ("touch", "they stand")
    return (
        f"{Alarm.LIFTED} {', '.join(lifted)} hardly {verb} anything: if {subject}, this explains "
        "the other alarms; correct the topic in `contact_flag`, or leave it out there",
    )


def held_joints(names: tuple[str, ...], segments: Iterable[Segment]) -> list[str]:
    """Return the joints without an effort that are at the same position throughout the log."""
    first: FloatArray | None = None
    is_held = np.ones(len(names), dtype=bool)
    for segment in segments:
        first = segment.position[0] if first is None else first
        is_held &= np.all(segment.position == first, axis=0)
        is_held &= ~np.isfinite(segment.effort).any(axis=0)
    return [] if first is None else [names[index] for index in np.flatnonzero(is_held)]


def _with_tried_causes(
    problem: LoadedProblem, found: Identification, known_cause: str
) -> Identification:
    """Return an identification whose alarm of correlated residuals names their likely cause."""
    verdict = found.estimate.verdict
    if verdict is None or not verdict.is_coloured or not verdict.unexplained:
        return found
    worst = verdict.unexplained[0]
    if known_cause:
        return _with_cause(found, "", known_cause)
    try:
        rows = CandidateRows.of(problem, found)
    except SymbidError:
        rows = None
    disturbance = None if rows is None else brief_disturbance(rows)
    if disturbance is not None:
        return _with_cause(found, "", disturbance.sentence, is_first=True)
    if any(one.kind is Kind.TORQUE_GAIN for one in problem.checks.findings):
        return _with_cause(found, "", WRONG_EFFORTS)
    if any(Alarm.WEIGHING in alarm for alarm in verdict.alarms):
        return _with_cause(found, "", WRONG_WEIGHING)
    if rows is None:
        when, sentence = "", "the log is too short to try likely causes; record longer"
    else:
        late = {Kind.DELAY, Kind.EFFORT_DELAY}
        is_late = any(one.kind in late for one in problem.checks.findings)
        sentence = _explanation(rows, worst, DELAY_ALARM if is_late else "")
        when = _when(rows, worst.coordinate)
    return _with_cause(found, when, sentence)


def _with_cause(
    found: Identification, when: str, sentence: str, *, is_first: bool = False
) -> Identification:
    """Return an identification whose alarm of correlated residuals says when and why."""
    verdict = found.estimate.verdict
    assert verdict is not None
    named = coloured_alarm(verdict.whiteness, verdict.unexplained, when=when, cause=sentence)
    alarms = [named if Alarm.COLOURED in alarm else alarm for alarm in verdict.alarms]
    if is_first:
        alarms.sort(key=lambda alarm: alarm != named)
    return found.with_alarms(tuple(alarms))


def _explanation(rows: CandidateRows, worst: UnexplainedForce, delay: str = "") -> str:
    """Return the likely cause of an unexplained force as the end of a sentence.

    ``delay`` replaces the description of a delay, of which another alarm gives the size.
    """
    cause = best_cause(rows, worst.coordinate)
    if cause is None:
        tried = ", ".join(EFFECTS[one.kind] for one in rows.candidates)
        slow = ""
        if rows.rate < TOLERANCE * SLOWEST:
            slow = f"the rate of {rows.rate:.3g} Hz may be too low for the motion: raise it, or "
        return (
            f"none of these explains it: {tried}; {slow}check link lengths and frames of the model"
        )
    likely = "likely cause" if cause.gain > MOSTLY else "partial cause"
    left = force_text(worst.size * cause.remains, worst.unit)
    what = f"{EFFECTS[cause.kind]}{cause.detail}"
    if cause.kind in ("delay", "effort_delay") and delay:
        what = delay
    return f"{likely}: {what}; with this, {left} remain unexplained; {cause.advice}"


def best_cause(rows: CandidateRows, coordinate: str) -> Cause | None:
    """Return the cause that best explains all coordinates and one in particular."""
    worst = rows.model.coordinates.index(coordinate)
    tests = LeftOutBlocks(rows)
    before, total = tests.errors()

    def tried(kind: str, *candidates: Candidate) -> Cause:
        after, left = tests.errors(*candidates)
        remains = after[worst] / before[worst] if before[worst] > 0 else 1.0
        return Cause(kind, float(1 - (remains + left / total) / 2), float(np.sqrt(remains)), "")

    singles = {one.kind: tried(one.kind, one) for one in rows.candidates}
    if not singles:
        return None
    best = max(singles.values(), key=lambda cause: cause.gain)
    if best.kind == "effort_delay" and _is_similar(singles["delay"], best):
        best = singles["delay"]
    of_sensors = [one for one in rows.candidates if one.kind in TYPICAL_ERRORS]
    if len(of_sensors) > 1:
        together = tried(SEVERAL, *of_sensors)
        if not _is_similar(best, together):
            best = together
    if best.gain < LEAST_GAIN:
        return None
    if best.kind == SEVERAL:
        largest = max(of_sensors, key=lambda one: singles[one.kind].gain)
        return replace(best, detail=f", above all {EFFECTS[largest.kind]}")
    (one,) = (one for one in rows.candidates if one.kind == best.kind)
    return replace(best, detail=_detail(one, tests.coefficients(one)))


def _is_similar(one: Cause, wider: Cause) -> bool:
    """Return whether a wider cause leaves more than half of what another one leaves."""
    return 1 - wider.gain >= MOSTLY * (1 - one.gain)


def _when(rows: CandidateRows, coordinate: str) -> str:
    """Return when a joint's error is largest; empty if it is spread or belongs to a base."""
    index = rows.model.coordinates.index(coordinate)
    if index < 6 * rows.model.floating:
        return ""
    used = rows.valid[:, index]
    square = rows.error[used, index] ** 2
    speed, force = rows.speed[used, index], np.abs(rows.force[used, index])
    share = {
        "at reversals": _share_of_largest(square, -speed),
        "at high speed": _share_of_largest(square, speed),
        "under large load": _share_of_largest(square, force),
    }
    most = max(share, key=lambda name: share[name])
    return most if share[most] > MOSTLY else ""


def _share_of_largest(square: FloatArray, quantity: FloatArray) -> float:
    """Return the share of the squares in the quarter of rows with the largest quantity."""
    total = float(square.sum())
    if total == 0:
        return 0.0
    some = np.argsort(-quantity)[: max(1, round(QUARTER * len(quantity)))]
    return float(square[some].sum()) / total


def _detail(cause: Candidate, values: FloatArray) -> str:
    """Return where a cause is largest and how large, in the words of the alarm."""
    if cause.kind == "delay":
        late = "efforts" if values[0] < 0 else "positions"
        return f" of the {late} by {1e3 * abs(values[0]):.2g} ms"
    if cause.kind == "support":
        return f", of some {force_text(abs(float(values[1])), 'N')}"
    size = np.abs(values) * np.sqrt(np.mean(cause.columns**2, axis=(0, 1)))
    largest = int(np.argmax(size))
    owner, value = cause.owners[largest], float(values[largest])
    if cause.kind == "effort_delay":
        late = "late" if value < 0 else "early"
        return f", {1e3 * abs(value):.2g} ms {late} at {owner}"
    if cause.kind == "torque_gain":
        return f", {100 * value:+.2g} % at {owner}"
    if cause.kind == "encoder_offset":
        return f", {np.degrees(value):+.2g}° at {owner}"
    return f", mostly of {owner}"


class LeftOutBlocks:
    """Square errors of blocks that are predicted from other blocks.

    The moments of all whitened columns are formed once, group by group.
    """

    def __init__(self, rows: CandidateRows) -> None:
        p = rows.K.shape[2]
        parts, self._places, width = [rows.K], {}, p
        for one in rows.candidates:
            parts.append(one.columns)
            self._places[one.kind] = np.arange(width, width + one.columns.shape[2])
            width += one.columns.shape[2]
        flat = np.concatenate([*parts, rows.residual[:, :, None]], axis=2)
        whitening = np.linalg.inv(np.linalg.cholesky(rows.covariance))
        self._rows = [flat[rows.group == group] for group in range(GROUPS)]
        self._whitened = np.empty((GROUPS, width + 1, width + 1))
        for group, some in enumerate(self._rows):
            white = (whitening @ some).reshape(-1, width + 1)
            self._whitened[group] = white.T @ white
        self._known = np.arange(p)
        total = np.einsum("gii->i", self._whitened)
        # One row of the prior for each known column.
        self._ridge = np.where(np.arange(width) < p, 1.0, RIDGE * total[:-1])
        for one in rows.candidates:
            if one.std is not None:
                self._ridge[self._places[one.kind]] = 1 / (WIDEST * one.std) ** 2

    def _columns(self, *causes: Candidate) -> IntArray:
        return np.concatenate([self._known, *(self._places[one.kind] for one in causes)])

    def _solve(self, moments: FloatArray, used: IntArray) -> FloatArray:
        H = moments[np.ix_(used, np.append(used, -1))]
        # A column that is zero keeps a coefficient of zero.
        ridge = np.where(self._ridge[used] > 0, self._ridge[used], 1.0)
        try:
            return np.asarray(np.linalg.solve(H[:, :-1] + np.diag(ridge), H[:, -1]))
        except np.linalg.LinAlgError:  # by rounding; such columns explain nothing
            return np.zeros(len(used))

    def errors(self, *causes: Candidate) -> tuple[FloatArray, float]:
        """Return the sums of squares with the columns of candidates.

        They are that of each coordinate (n,), and that of all after whitening.
        """
        used = self._columns(*causes)
        everything = self._whitened.sum(axis=0)
        each, total = np.zeros(self._rows[0].shape[1]), 0.0
        for rows, whitened in zip(self._rows, self._whitened, strict=True):
            x = np.zeros(len(everything))
            x[used], x[-1] = -self._solve(everything - whitened, used), 1.0
            each += np.sum((rows @ x) ** 2, axis=0)
            total += float(x @ whitened @ x)
        return each, total

    def coefficients(self, cause: Candidate) -> FloatArray:
        """Return the coefficients (m,) of a candidate from all rows."""
        found = self._solve(self._whitened.sum(axis=0), self._columns(cause))
        return found[len(self._known) :]
