"""From a loaded log to a checked identification: the trial on its end, causes and alarms."""

from contextlib import suppress
from dataclasses import replace

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.causes.gain_check import wrist_sensor_alarms, wrong_factors
from symbid_ros.identification.causes.joint_alarms import with_explained_alarms
from symbid_ros.identification.end_check import CheckedTrial, EndCheck, percents
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.predictions.force_errors import RELEVANT
from symbid_ros.identification.predictions.holdout import hold_out, rest_at_end
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation import validate_segments
from symbid_ros.identification.report_data import ForceSeries
from symbid_ros.identification.report_series import (
    PositionTrace,
    coverage,
    force_series,
    report_data,
)
from symbid_ros.identification.terms.resting_joints import motionless_joints
from symbid_ros.progress import report
from symbid_ros.signals.segments import split
from symbid_ros.signals.weak_form import WINDOWS

# Verdicts with which the stated prior is tried.
NOT_BETTER = "worse", "mixed", "unfit"
PRIOR_KEPT = (
    "the prior is kept at ±25 % (keep_prior), because the prior that was estimated from the data "
    "predicts the last quarter worse: {}"
)
NO_MOTION = (
    f"{Alarm.AT_REST} only, and its end, which checks the result, is the same posture; record "
    "motion of all joints"
)
UNPREDICTED = (
    f"{Alarm.UNPREDICTED_END}: {{}}; record longer and more varied motion, or look for what "
    "differs there, such as a load or a contact"
)


def identify_problem(problem: LoadedProblem) -> tuple[LoadedProblem, Identification]:
    """Identify a log and check the result; a trial without its last quarter predicts the latter.

    The trial chooses joint terms, prior scale and sensor errors from the earlier part alone. It
    uses the window length of the whole log. If the identified robot predicts the last quarter worse
    than the model file, and better with the stated prior, that prior is kept: where the equation of
    motion is wrong, the data would widen it without bound. If factors on some joints' efforts
    predict it much better, these are identified, and an alarm says so.

    Returns
    -------
    LoadedProblem
        The problem that was solved: the given one, or the same with the stated prior or with
        factors of efforts.
    Identification

    Raises
    ------
    SymbidError
        When the log cannot be identified.
    """
    report("solving")
    has_known_units = problem.options.has_known_units
    found = problem.solve()
    log = coverage(problem)
    check = None
    if not problem.options.no_holdout:
        report("holding out the end of the log")
        try:
            check = hold_out(problem, found.window, log.begin)
        except SymbidError as error:
            reason = rest_at_end(problem) or str(error)
            none = HoldOut(0.0, None, None, "none", 0.0, {}, f"no part of the log: {reason}")
            check = EndCheck(none)
        if check.holdout.advice in NOT_BETTER and problem.options.is_empirical:
            kept = _with_kept_prior(problem, check, log.begin)
            problem, found, check = kept or (problem, found, check)
        signed = _with_signed_drives(problem, check, log.begin)
        problem, found, check = signed or (problem, found, check)
    model = problem.columns.model
    # Efforts without signs are predicted badly, and no factor corrects them.
    is_signed = model.floating or not problem.checks.has_unsigned_efforts
    alarm = None
    if is_signed and check is not None and check.holdout.advice == "unfit":
        alarm = UNPREDICTED.format(check.holdout.summary)
    elif is_signed and check is not None:
        wrong = wrong_factors(problem, check, lambda one: _tried(one, log.begin))
        if wrong is not None:
            alarm = wrong.alarm
            problem, found, check = wrong.trial or (problem, found, check)
    found = with_explained_alarms(problem, found, has_known_units=has_known_units)
    found = problem.with_provenance(found)
    last = () if alarm is None else (alarm,)
    if is_signed:
        last = (*wrist_sensor_alarms(problem), *last)
    if not model.floating and motionless_joints(problem.dataset.samples.position, model).all():
        last = (*last, NO_MOTION)
    alarms = (*found.alarms, *last)
    # A wrong rate of the stamps makes inertias and friction wrong, and other alarms follow from it.
    of_clock = {one.message for one in problem.checks.findings if one.kind is Kind.STAMP_RATE}
    found = found.with_alarms(tuple(sorted(alarms, key=lambda one: one not in of_clock)))
    forces = None if check is None else check.forces
    if forces is None:
        forces = _predict_end(problem, found, log.begin)
    found = replace(
        found,
        estimate=replace(found.estimate, holdout=None if check is None else check.holdout),
        report=report_data(problem, found, forces, log),
    )
    return problem, found


def _tried(problem: LoadedProblem, begin: int) -> CheckedTrial:
    found = problem.solve()
    return CheckedTrial(problem, found, hold_out(problem, found.window, begin))


def _with_kept_prior(problem: LoadedProblem, before: EndCheck, begin: int) -> CheckedTrial | None:
    """Identify with the stated prior; None unless that predicts the end of the log better."""
    kept = problem.with_prior(problem.prior, replace(problem.options, keep_prior=True))
    try:
        trial = _tried(kept, begin)
    except SymbidError:
        return None
    found, errors = trial.found, percents(trial.check, before)
    if errors is None or RELEVANT * errors[0] >= errors[1]:
        return None
    remarks = (*found.estimate.remarks, PRIOR_KEPT.format(before.holdout.summary))
    return trial._replace(found=replace(found, estimate=replace(found.estimate, remarks=remarks)))


def _with_signed_drives(
    problem: LoadedProblem, before: EndCheck, begin: int
) -> CheckedTrial | None:
    """Identify with negative armature and friction; None unless that predicts the end better.

    Where the equation of motion is wrong, negative terms follow its errors and mislead elsewhere.
    That of a floating base has those of IMUs and contacts as well.
    """
    choice = problem.solved.problem.choice
    is_judged = before.holdout.percent_after is not None and not problem.columns.model.floating
    if choice is None or not (is_judged and choice.contradicts_signs) or choice.signed_drives:
        return None
    try:
        trial = _tried(problem.with_signed_drives(), begin)
        errors = percents(trial.check, before)
    except SymbidError:
        return None
    return trial if errors is not None and RELEVANT * errors[0] < errors[1] else None


def _predict_end(problem: LoadedProblem, found: Identification, begin: int) -> ForceSeries | None:
    """Predict the last quarter of the log, or all of a short one, with the final estimate."""
    dataset, trace = problem.dataset, PositionTrace()
    predictor = ForcePredictor.of(found, problem.parameters)
    part = dataset.segments
    with suppress(SymbidError):
        _, part = split(dataset.segments, max(found.window, *WINDOWS), dataset.source)
    try:
        efforts = validate_segments(predictor, trace.of(part), dataset.source).efforts
    except SymbidError:  # too short for a prediction
        return None
    model = predictor.parameters.model
    return force_series(efforts, model, trace, begin=begin, window=found.window, is_held_out=False)
