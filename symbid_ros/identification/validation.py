"""Validation of an identified robot on a log that was not used, without a known truth."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.errors import DataError
from symbid_ros.estimation.verdict import Verdict
from symbid_ros.identification.dataset import AlignedLog
from symbid_ros.identification.error_changes import (
    ALL_JOINTS,
    BASE_FORCE,
    BASE_MOMENT,
    SLOW_STRETCHES,
    WRIST_SENSORS,
    describe_change,
    percent,
)
from symbid_ros.identification.force_errors import (
    ErrorChange,
    ForceError,
    ForceRows,
    TotalMass,
    differ_relevantly,
)
from symbid_ros.identification.prediction import ForcePredictor
from symbid_ros.identification.result import Result
from symbid_ros.json_documents import versioned
from symbid_ros.signals.joined_log import as_one_log
from symbid_ros.signals.log import Log, require_log
from symbid_ros.signals.segments import Segment

Advice = Literal["better", "equal", "worse", "mixed", "unfit"]

FEWEST_SLOW = 10  # rows below which slow stretches are not reported
NO_MODEL = 100.0  # percent; the error of a prediction of zero
# A joint whose error grows by less, as a share of its measured effort, does not change the advice.
# Joints with hardly any effort are compared with this share of all joints' effort instead.
NOTICEABLE, SMALL_EFFORT = 0.01, 0.05
# Share of errors in their 90 % interval below which standard deviations are too small, and rows
# that a single coordinate needs to be named.
LEAST_COVERAGE, COVERAGE_ROWS = 0.7, 20
# Normalised square above which the robot or its load is not that of the identified log. Logs of
# one robot have 1 to 1.4.
OTHER_ROBOT = 100.0
# Percent error of a joint with that many rows above which nothing of its effort is predicted.
NOTHING = 90.0


@dataclass(frozen=True)
class PredictedEfforts:
    """Measured and predicted forces in N windows, for plots; NaN where a row is not used.

    Attributes
    ----------
    stamp : (N,) int64
        Centres of the windows, ns.
    joints : tuple of str
        Names of the J joints.
    measured, before, after : (N, J) float64
        Motor efforts, measured and predicted by the original and the identified model, Nm or N.
    base : str
        Link of a floating base; empty if the base is fixed.
    wrench_measured, wrench_before, wrench_after : (N, 6) float64
        Moment and force of the environment in base axes; no columns if the base is fixed.
    """

    stamp: IntArray
    joints: tuple[str, ...]
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    base: str
    wrench_measured: FloatArray
    wrench_before: FloatArray
    wrench_after: FloatArray

    @classmethod
    def of(cls, rows: ForceRows) -> "PredictedEfforts":
        """Return the series of a log."""
        model, first = rows.model, rows.first_joint
        measured = rows.effort.copy()
        measured[:, :first] = rows.y[:, :first]
        measured = np.where(rows.valid, measured, np.nan)
        before, after = measured - rows.error_before, measured - rows.error_after
        return cls(
            rows.stamp,
            model.joint_names,
            measured[:, first:],
            before[:, first:],
            after[:, first:],
            model.links[0].name if model.floating else "",
            measured[:, :first],
            before[:, :first],
            after[:, :first],
        )


@dataclass(frozen=True)
class Validation:
    """How well an identified robot predicts a log, compared with the original model.

    The rows are those of the identification: the equation of motion averaged over its windows, or
    at its filtered instants. Identified sensor errors are removed from both predictions.

    Attributes
    ----------
    result, model, method, log : str
        Names of the result, the robot, the method and the log.
    seconds, seconds_used : float
        Length of the log, and of its part that the identification used, s.
    coordinates : tuple of ForceError
        Moment and force on a floating base, then the joints.
    torque, base_moment, base_force : ForceError or None
        All joints, and the wrench on a floating base. Without efforts on a fixed base, ``torque``
        is about the forces of wrist sensors.
    slow : ForceError or None
        All joints on slow stretches, where gravity alone loads them.
    slow_seconds : float
        Length of these, s.
    mass : TotalMass or None
        None for a fixed base.
    coverage : float or None
        Share of errors inside their 90 % interval; None for methods without covariance. The
        variance is that of the estimate plus that of the residuals of the identified log, whose
        noise is scaled to the rate of this one.
    normalized_square : float or None
        Mean of squared errors over their predicted variance; about 1 for right intervals.
    advice : {"better", "equal", "worse", "mixed", "unfit"}
        The identified model compared with the original one, beyond chance; unfit if it errs by more
        than was measured.
    verdict : str
        The same as a sentence with figures.
    file_percents : dict of str to float
        Percent errors, as ``percent_after``, of what each model file of the result holds.
    efforts : PredictedEfforts
    deciding : tuple of ForceError
        Errors by which the advice was chosen; ``main`` is one of them.
    worse : tuple of str
        Joints, or moment and force on the base, that the identified model predicts clearly worse.
    not_judged : tuple of str
        Joints without a row: they hardly move, or their efforts are unknown.
    """

    result: str
    model: str
    method: str
    log: str
    seconds: float
    seconds_used: float
    coordinates: tuple[ForceError, ...]
    torque: ForceError | None
    base_moment: ForceError | None
    base_force: ForceError | None
    slow: ForceError | None
    slow_seconds: float
    mass: TotalMass | None
    coverage: float | None
    normalized_square: float | None
    advice: Advice
    verdict: str
    file_percents: dict[str, float]
    efforts: PredictedEfforts = field(repr=False, compare=False)
    deciding: tuple[ForceError, ...] = ()
    worse: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()

    @property
    def is_better(self) -> bool:
        """Whether the identified model predicts the log better than the original one."""
        return self.advice == "better"

    @property
    def main(self) -> ForceError:
        """The error that every verdict states: of all joints, or of the base without efforts."""
        found = self.base_force if self.torque is None else self.torque
        assert found is not None  # a log has rows of the joints or of the base
        return found

    @property
    def percent_before(self) -> float | None:
        """Error of the original model, percent of the measured torque."""
        return self.main.percent_before

    @property
    def percent_after(self) -> float | None:
        """Error of the identified model, percent of the measured torque."""
        return self.main.percent_after

    @property
    def change(self) -> str:
        """The errors by which the advice was chosen, before and after."""
        return ", ".join(describe_change(one) for one in self.deciding or (self.main,))

    @property
    def uncovered(self) -> tuple[ForceError, ...]:
        """Coordinates of whose errors too few lie in their 90 % interval."""
        return tuple(
            one
            for one in self.coordinates
            if one.coverage is not None
            and one.coverage < LEAST_COVERAGE
            and one.rows >= COVERAGE_ROWS
        )

    @property
    def is_covered(self) -> bool:
        """Whether the intervals hold about as many errors as they claim, if there are any."""
        return not self.uncovered and (self.coverage is None or self.coverage >= LEAST_COVERAGE)

    @property
    def is_of_other_robot(self) -> bool:
        """Whether the errors are those of another robot or load than the identified one."""
        return (self.normalized_square or 0.0) > OTHER_ROBOT and not self.is_covered

    @property
    def unpredicted(self) -> tuple[str, ...]:
        """Joints of whose efforts nothing is predicted."""
        return tuple(
            one.name
            for one in self.coordinates
            if not one.name.startswith("base/")
            and one.rows >= COVERAGE_ROWS
            and (one.percent_after or 0.0) > NOTHING
        )

    @property
    def groups(self) -> tuple[ForceError, ...]:
        """Errors over several coordinates."""
        every = self.torque, self.slow, self.base_moment, self.base_force
        return tuple(one for one in every if one is not None)

    def document(self) -> dict[str, object]:
        """Return everything but the series, for JSON."""
        mass = None
        if self.mass is not None:
            mass = {f"{name}_kg": value for name, value in asdict(self.mass).items()}
        errors = {
            name: None if error is None else error.document()
            for name in ("torque", "slow", "base_moment", "base_force")
            for error in [getattr(self, name)]
        }
        document = {
            "verdict": self.verdict,
            "advice": self.advice,
            "worse": list(self.worse),
            "not_judged": list(self.not_judged),
            "percent_before": self.percent_before,
            "percent_after": self.percent_after,
            "file_percents": self.file_percents,
            "result": self.result,
            "model": self.model,
            "method": self.method,
            "log": self.log,
            "duration_s": self.seconds,
            "used_s": self.seconds_used,
            "coverage": self.coverage,
            "normalized_square": self.normalized_square,
            "mass": mass,
            "slow_s": self.slow_seconds,
            **errors,
            "coordinates": [one.document() for one in self.coordinates],
        }
        return versioned("validation", document)

    def __repr__(self) -> str:
        lines = [f"<Validation of {self.result} on {self.log}: {self.verdict}"]
        lines += [
            f"  {one.name}: {one.rmse_before:.3g} → {one.rmse_after:.3g} {one.unit}"
            f" ({percent(one.percent_before)} → {percent(one.percent_after)})"
            for one in self.coordinates
        ]
        return "\n".join(lines) + ">"

    def _repr_html_(self) -> str:
        titles = "", "measured", "before", "after", "unit", "before %", "after %"
        head = "".join(f"<th>{title}</th>" for title in titles)
        rows = "".join(
            f"<tr><td>{escape(one.name)}</td><td>{one.measured:.3g}</td>"
            f"<td>{one.rmse_before:.3g}</td><td>{one.rmse_after:.3g}</td><td>{one.unit}</td>"
            f"<td>{percent(one.percent_before)}</td><td>{percent(one.percent_after)}</td></tr>"
            for one in (*self.groups, *self.coordinates)
        )
        return (
            f"<h4>{escape(self.result)} on {escape(self.log)}</h4>"
            f"<p><b>{escape(self.verdict)}</b></p><table><tr>{head}</tr>{rows}</table>"
        )


@on_one_blas_thread
def validate(
    result: Result | str | Path, log: Log | Sequence[Log], *, payload: Sequence[str] = ()
) -> Validation:
    """Compare what an identified robot predicts for a log with what was measured.

    Parameters
    ----------
    result : Result, str or Path
        A result, or the folder of a saved one.
    log : Log or sequence of Log
        Measurements that the identification did not use, also of several recordings.
    payload : sequence of str
        Payloads that the robot carries in it: ``LINK,MASS,X,Y,Z``, or ``LINK,MASS`` if the result
        has identified the place.

    Returns
    -------
    Validation
        Errors of the original and of the identified model (Nm or N, and percent of what was
        measured), and a verdict.

    Raises
    ------
    BagError, DataError, ModelError
        When the log is invalid or of another robot.
    EstimateError
        When a file of the result is missing or invalid.
    """
    log = as_one_log(log)
    predictor = predictor_of(result, log, payload)
    return validate_segments(predictor, AlignedLog(log, predictor.parameters.model), log.source)


def validate_segments(
    predictor: ForcePredictor, segments: Iterable[Segment], source: str
) -> Validation:
    """Validate a result on aligned segments of a log named ``source``; see :func:`validate`."""
    return assess(predictor, ForceRows.of(predictor, segments, source), source)


def predictor_of(result: Result | str | Path, log: Log, payload: Sequence[str]) -> ForcePredictor:
    """Return what predicts the forces of a log with payloads; see :func:`validate`."""
    require_log(log)
    if isinstance(result, Result):
        predictor = result.predictor
    elif isinstance(result, str | Path):
        predictor = ForcePredictor.load(Path(result))
    else:
        raise DataError(
            "result must be a Result (see symbid_ros.identify) or the folder of a saved one, not "
            f"{type(result).__name__}",
            "E511",
        )
    return predictor.with_frames_of(log).carrying(payload)


def assess(predictor: ForcePredictor, rows: ForceRows, source: str) -> Validation:
    """Return the validation of a result on rows of a log named ``source``."""
    model = rows.model
    joints = rows.joints if model.floating else rows.main
    drives = ALL_JOINTS if len(rows.joints) else WRIST_SENSORS
    groups: dict[str, IntArray] = {}
    if len(joints):
        groups[drives] = joints
    if model.floating:
        groups |= {BASE_MOMENT: np.arange(3), BASE_FORCE: np.arange(3, 6)}
    errors = {name: rows.error(places, name) for name, places in groups.items()}
    changes = {name: rows.change(places) for name, places in groups.items()}
    slow, slow_seconds = None, 0.0
    if len(joints) and np.count_nonzero(is_slow := rows.is_slow) >= FEWEST_SLOW:
        slow = rows.selected(is_slow).error(joints, SLOW_STRETCHES)
        slow_seconds = rows.duration * float(np.mean(is_slow))
    coordinates = tuple(
        rows.error(np.array([place]), model.coordinates[place]) for place in rows.used.tolist()
    )
    worse = _worse_joints(rows, {one.name: one for one in coordinates})
    advice = _advice(changes, worse)
    calibration = rows.calibration()
    has_weight = model.floating and model.contacts is None
    found = Validation(
        result=predictor.name,
        model=model.name,
        method=predictor.estimate.method,
        log=source,
        seconds=rows.duration,
        seconds_used=min(float(len(rows.seconds & predictor.seconds)), rows.duration),
        coordinates=coordinates,
        torque=errors.get(drives),
        base_moment=errors.get(BASE_MOMENT),
        base_force=errors.get(BASE_FORCE),
        slow=slow,
        slow_seconds=slow_seconds,
        mass=rows.total_mass(predictor) if has_weight else None,
        coverage=None if calibration is None else calibration[0],
        normalized_square=None if calibration is None else calibration[1],
        advice=advice,
        verdict="",
        file_percents=rows.file_errors(rows.main),
        efforts=PredictedEfforts.of(rows),
        worse=tuple(name for name, change in changes.items() if change.is_increase) + tuple(worse),
        not_judged=tuple(
            model.joint_names[joint]
            for joint in model.moving_joints
            if len(joints)
            and rows.first_joint + joint not in joints
            # A mimic joint has no row of its own: its load is part of its leader's.
            and joint not in model.followers
        ),
    )
    if found.percent_after is not None and found.percent_after >= NO_MODEL:
        found = replace(found, advice="unfit")
    deciding = [errors[name] for name in _deciding(found, changes)]
    if found.advice == "mixed":
        deciding += worse.values()
    found = replace(found, deciding=tuple(deciding))
    verdict = _verdict(found, changes)
    if found.is_better and not found.is_of_other_robot:
        verdict += _repeated_alarms(predictor.estimate.verdict)
    return replace(found, verdict=verdict)


def _worse_joints(rows: ForceRows, errors: Mapping[str, ForceError]) -> dict[str, ForceError]:
    """Return the errors of joints that got worse, beyond chance and by a noticeable amount."""
    if not len(rows.joints):
        return {}
    least = SMALL_EFFORT * rows.error(rows.joints, ALL_JOINTS).measured
    worse = {}
    for place in rows.joints.tolist():
        error = errors[rows.model.coordinates[place]]
        if error.rmse_after - error.rmse_before <= NOTICEABLE * max(error.measured, least):
            continue
        if rows.change(np.array([place]), len(rows.joints)).is_increase:
            worse[error.name] = error
    return worse


def _advice(changes: Mapping[str, ErrorChange], worse: Collection[str]) -> Advice:
    is_better = any(change.is_decrease for change in changes.values())
    if any(change.is_increase for change in changes.values()):
        return "mixed" if is_better else "worse"
    if worse:
        return "mixed"
    return "better" if is_better else "equal"


def _deciding(found: Validation, changes: Mapping[str, ErrorChange]) -> list[str]:
    """Return which errors tell a reader why the advice was chosen, the main one among them."""
    main = found.main.name
    smaller = [name for name, change in changes.items() if change.is_decrease]
    larger = [name for name, change in changes.items() if change.is_increase]
    if found.advice == "mixed":
        return [name for name in changes if name == main or name in smaller + larger]
    others = {"better": smaller, "worse": larger}.get(found.advice, [])
    return [main] if main in others else [*others, main]


def _verdict(found: Validation, changes: Mapping[str, ErrorChange]) -> str:
    used = f"on {found.seconds:.0f} s that were not used"
    if found.seconds_used > 0:
        used = (
            f"on {found.seconds:.0f} s, of which the identification used "
            f"{found.seconds_used:.0f} s; repeat this with another log"
        )
    better = [name for name, change in changes.items() if change.is_decrease]
    start = {
        "better": "use it"
        if found.main.name in better
        else f"use it, {' and '.join(better)} got better",
        "equal": "too few data to tell whether it is better, repeat this with a longer log"
        if differ_relevantly(found.percent_before, found.percent_after)
        else "hardly differs from the original",
        "worse": "do not use it, it is worse than the original",
        "mixed": f"do not use it yet, {' and '.join(found.worse)} got worse",
        "unfit": "do not use it, it errs by more than was measured (give the robot file, units and "
        "signs of the identification)",
    }[found.advice]
    if found.is_better and found.is_of_other_robot:
        start = "better than the original, but not fit for this robot or load"
    elif found.is_better:
        limits = [f"for {' and '.join(found.unpredicted)}"] * bool(found.unpredicted)
        limits += ["its standard deviations"] * (not found.is_covered)
        start = ", but not ".join([start, " and not ".join(limits)]) if limits else start
    return f"{start}: {found.change} {used}{_reservations(found)}"


def _repeated_alarms(identified: Verdict | None) -> str:
    """Return the alarms of the identification without their advice; empty if there are none."""
    alarms = () if identified is None else identified.alarms
    if not alarms:
        return ""
    said = "; ".join(alarm.partition("; ")[0] for alarm in alarms)
    return f"; alarms of its identification: {said}"


def _reservations(found: Validation) -> str:
    """Return which intervals and joints the advice is not about; empty if there are none."""
    remarks = []
    if found.is_of_other_robot:
        ratio = float(np.sqrt(found.normalized_square or 0.0))
        remarks.append(
            f"the errors are {ratio:.0f} times as large as in the identified log, so the robot or "
            "its load differs from the identified one: give what it carries as `payload`, or "
            "identify this log"
        )
    elif not found.is_covered and found.coverage is not None:
        shares = {"all": found.coverage}
        shares |= {one.name: one.coverage or 0.0 for one in found.uncovered}
        listed = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
        remarks.append(f"too few errors lie in their 90 % interval ({listed})")
    if found.not_judged:
        are = "is" if len(found.not_judged) == 1 else "are"
        remarks.append(
            f"{' and '.join(found.not_judged)} {are} not judged, because in this log "
            f"{'it hardly moves' if are == 'is' else 'they hardly move'} or the effort is unknown"
        )
    return "".join(f"; {remark}" for remark in remarks)
