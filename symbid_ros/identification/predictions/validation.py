"""Validation of an identified robot on a log that was not used, without a known truth."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.errors import DataError, OptionError
from symbid_ros.identification.offset_changes import offset_changes, without_offset_changes
from symbid_ros.identification.predictions.error_changes import (
    ALL_JOINTS,
    BASE_FORCE,
    BASE_MOMENT,
    SLOW_STRETCHES,
    WRIST_SENSORS,
    enumerate_words,
)
from symbid_ros.identification.predictions.force_errors import (
    SENSOR_PARTS,
    ErrorChange,
    ForceError,
    ForceRows,
    differ_relevantly,
)
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation_result import (
    Advice,
    PredictedEfforts,
    Validation,
)
from symbid_ros.identification.result import Result
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.signals.joined_log import as_one_log
from symbid_ros.signals.log import Log, require_log
from symbid_ros.signals.segments import Segment

FEWEST_SLOW = 10  # rows below which slow stretches are not reported
NO_MODEL = 100.0  # percent; the error of a prediction of zero
# A joint whose error grows by less, as a share of its measured effort, does not change the advice.
# Joints with hardly any effort are compared with this share of all joints' effort instead.
NOTICEABLE, SMALL_EFFORT = 0.01, 0.05


@on_one_blas_thread
def validate(
    result: Result | str | Path, log: Log | Sequence[Log], *, payload: str | Sequence[str] = ()
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
    OptionError
        When a payload is invalid.
    """
    log = as_one_log(log)
    predictor = predictor_of(result, log, payload)
    return validate_segments(predictor, AlignedLog(log, predictor.parameters.model), log.source)


def validate_segments(
    predictor: ForcePredictor, segments: Iterable[Segment], source: str
) -> Validation:
    """Validate a result on aligned segments of a log named ``source``; see :func:`validate`."""
    return assess(predictor, ForceRows.of(predictor, segments, source), source)


def predictor_of(
    result: Result | str | Path, log: Log, payload: str | Sequence[str]
) -> ForcePredictor:
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
    payloads = (payload,) if isinstance(payload, str) else payload
    if not isinstance(payloads, Sequence) or not all(isinstance(one, str) for one in payloads):
        raise OptionError(
            f"`payload`: {payload!r} is not valid; give text or a list of texts", "E501"
        )
    return predictor.with_frames_of(log).carrying(payloads)


def assess(predictor: ForcePredictor, rows: ForceRows, source: str) -> Validation:
    """Return the validation of a result on rows of a log named ``source``."""
    offsets = offset_changes(rows)
    rows, model = without_offset_changes(rows, offsets), rows.model
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
    worse = _worse_parts(rows)
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
        offsets=offsets,
        alarms=() if (judged := predictor.estimate.verdict) is None else judged.alarms,
    )
    if found.percent_after is not None and found.percent_after >= NO_MODEL:
        found = replace(found, advice="unfit")
    deciding = [errors[name] for name in _deciding(found, changes)]
    if found.advice == "mixed":
        deciding += worse.values()
    found = replace(found, deciding=tuple(deciding))
    verdict = _verdict(found, changes)
    verdict += _reservations(found, has_sensors=bool(model.wrist_sensors))
    return replace(found, verdict=verdict + _repeated_alarms(found.alarms))


def _worse_parts(rows: ForceRows) -> dict[str, ForceError]:
    """Return the errors of joints and wrist sensors that got worse, beyond chance and noticeably.

    Without rows of the joints, the forces of the sensors are judged together.
    """
    names = rows.model.coordinates
    parts = {names[place]: np.array([place]) for place in rows.joints.tolist()}
    parts |= rows.of_sensors(tuple(SENSOR_PARTS) if parts else ("moment",))
    least = SMALL_EFFORT * rows.error(rows.joints, ALL_JOINTS).measured if len(rows.joints) else 0.0
    worse = {}
    for name, places in parts.items():
        error = rows.error(places, name)
        floor = least if name in names else 0.0
        if error.rmse_after - error.rmse_before <= NOTICEABLE * max(error.measured, floor):
            continue
        if rows.change(places, len(parts)).is_increase:
            worse[name] = error
    return worse


def _advice(changes: Mapping[str, ErrorChange], worse: Collection[str]) -> Advice:
    is_better = any(change.is_decrease for change in changes.values())
    if any(change.is_increase for change in changes.values()):
        return "mixed" if is_better else "worse"
    if worse:
        return "mixed"
    return "better" if is_better else "equal"


def _deciding(found: Validation, changes: Mapping[str, ErrorChange]) -> list[str]:
    """Return which errors explain the advice, the main one among them."""
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
        else f"use it, {enumerate_words(better)} got better",
        "equal": "too few data to tell whether it is better, repeat this with a longer log"
        if differ_relevantly(found.percent_before, found.percent_after)
        else "hardly differs from the original",
        "worse": "do not use it, it is worse than the original",
        "mixed": f"do not use it yet, {enumerate_words(found.worse)} got worse",
        "unfit": "do not use it, its error is larger than the measured forces (give the robot "
        "file, units and signs of the identification)",
    }[found.advice]
    if found.is_better and found.is_of_other_robot:
        start = "better than the original, but not fit for this robot or load"
    elif found.is_better:
        limits = [f"for {enumerate_words(found.unpredicted)}"] * bool(found.unpredicted)
        limits += [f"its offset of {one.frame}" for one in found.offsets]
        limits += ["its standard deviations"] * (not found.is_covered)
        start = ", but not ".join([start, " and not ".join(limits)]) if limits else start
        start += f", although {found.counted_alarms}" if found.alarms else ""
    return f"{start}: {found.change} {used}"


def _repeated_alarms(alarms: Sequence[str]) -> str:
    """Return the alarms of the identification without their advice; empty if there are none."""
    if not alarms:
        return ""
    said = "; ".join(alarm.partition("; ")[0] for alarm in alarms)
    return f"; alarms of its identification: {said}"


def _reservations(found: Validation, *, has_sensors: bool) -> str:
    """Return which intervals and joints the advice is not about; empty if there are none."""
    remarks = [
        f"{change}, which is left out: another tare or drift" for change in map(str, found.offsets)
    ]
    if found.is_of_other_robot:
        ratio = float(np.sqrt(found.normalized_square or 0.0))
        differs = (
            "the robot, its load or its wrist sensor" if has_sensors else "the robot or its load"
        )
        wrong = "the identification is wrong, as its alarms say, or " if found.alarms else ""
        remarks.append(
            f"the errors are {ratio:.0f} times as large as in the identified log, so {wrong}"
            f"{differs} differs from the identified one: give what it carries as `payload`, or "
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
            f"{enumerate_words(found.not_judged)} {are} not judged, because in this log "
            f"{'it hardly moves' if are == 'is' else 'they hardly move'} or the effort is unknown"
        )
    return "".join(f"; {remark}" for remark in remarks)
