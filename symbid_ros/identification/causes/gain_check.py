"""Finds efforts and wrist sensors of an arm with wrong factors, such as those of torque constants.

Links follow such errors in part: residuals stay small, and masses come out far off. With a factor
on each effort as a further unknown, both fit. The readings of a wrist sensor are efforts too; they
have one factor in common, relative to the efforts of the joints.

Where no joint stands out, factors of all joints near 1 may be what possible links need to explain
the log: torque constants of data sheets err by ten percent and more.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.effort_findings import GAINS
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.effort_columns import EffortColumns
from symbid_ros.identification.calibration.drive_gains import named_joints
from symbid_ros.identification.end_check import CheckedTrial, EndCheck, percents
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.wrist_sensors import component_names
from symbid_ros.options import robot_file_line
from symbid_ros.signals.sensor_errors import DRIVE_GAIN, SensorErrors

# Prior deviation of the factors, and their least mean square in deviations. It is .2 to 3.5 on
# simulated arms with right efforts.
PLAUSIBLE, LEAST_SQUARE = 0.2, 5.0
# Least mean square, in posterior deviations, by which possible links differ from the most probable
# ones, for factors of all joints near 1. It is up to .02 on simulated arms with right efforts.
LEAST_EXCESS = 0.3
# Most of the held-out error that remains with the factors: its share, and its size in percent.
# Above that, something else is wrong, which factors follow.
REMAINS, UNDERSTOOD = 0.9, 10.0
# The share with factors near 1 of all joints, and the least held-out error for which these are
# tried, %. It is up to .2 % on simulated arms with right efforts, even if the model lacks a
# payload, and .5 % or more with factors that err by a fifth.
REMAINS_NEAR, LEAST_ERROR = 0.95, 0.3
# Most of their prior deviations by which such factors may differ from 1. Without a limit, factors
# and masses can shrink together, and the noise with them.
MOST_DEVIATIONS = 4.0
# The share if the factors of the named joints alone do not explain the log.
REMAINS_OPEN = 0.85
# Part of the improvement by factors of all joints that those of the named ones must bring.
LEAST_PART = 1 / 3
# A factor is named if it differs from the usual one by these, in deviations and as a share.
CERTAIN, RELEVANT = 3.0, 0.05
# Torque constants err by less than this ratio, units and currents by more. Factors that differ by
# more need the evidence of a held-out error that falls to the share after it; on public logs, none
# of the trials that did not find currents came below .85.
LARGEST, HALVED = 3.0, 0.5
# Correlation of the factors of a sensor's components, which have one calibration.
ALIKE = 0.99


class _Improvement(NamedTuple):
    """A trial with factors, and held-out errors without and with them, %."""

    trial: CheckedTrial
    before: float
    after: float

    @property
    def remains(self) -> float:
        """Share of the error that remains."""
        return self.after / self.before

    @property
    def halves(self) -> bool:
        """Whether the trial errs by so little that its factors are beyond doubt."""
        return self.remains <= HALVED

    @property
    def errors(self) -> str:
        return (
            f"the error at the end of the log is {self.after:.2g} % instead of {self.before:.2g} %"
        )

    @property
    def factors(self) -> dict[str, float]:
        """The joints whose factors are unknowns, with reading over torque."""
        solved = self.trial.problem.solved
        gains = solved.posterior.mean[len(solved.problem.parameters) :]
        names = solved.problem.sensor_names
        return {
            name.rpartition("/")[0]: float(1 / gain)
            for name, gain in zip(names, gains, strict=True)
        }

    @property
    def named_factors(self) -> str:
        return ", ".join(f"{joint} {factor:.2g}" for joint, factor in self.factors.items())


@dataclass(frozen=True)
class WrongFactors:
    """Efforts that have other factors than those of most joints.

    Attributes
    ----------
    alarm : str
    trial : CheckedTrial or None
        The identification in which these factors are unknowns; None if it explains too little.
    is_settled : bool
        Whether factors near 1 of all joints are no alternative: the other joints' factors are so
        alike that they can be taken as right, or the factors differ by more than torque constants.
    """

    alarm: str
    trial: CheckedTrial | None
    is_settled: bool = False


class _Unlike(NamedTuple):
    """Joints whose efforts differ from those of the others, with the factors of their readings.

    ``are_plausible`` says whether these factors may be errors of torque constants.
    """

    factors: dict[str, float]
    others_agree: bool
    are_plausible: bool


def wrong_factors(
    problem: LoadedProblem, check: EndCheck, tried: Callable[[LoadedProblem], CheckedTrial]
) -> WrongFactors | None:
    """Return which efforts' factors explain a log better; None if none do.

    If some joints differ from others that agree, their factors alone are identified: the others
    give the scale. If the others do not agree and some factors differ as those of currents do, all
    factors are identified, and the model's masses give the scale. Otherwise, if the others do not
    agree, or possible links explain the log much worse than others do, factors near 1 of all joints
    are identified where these predict the end of the log better, differ, and are plausible.

    Parameters
    ----------
    problem : LoadedProblem
    check : EndCheck
        Its check on the end of the log.
    tried : callable
        Identifies another problem of the log.
    """
    if not check.holdout.percent_after or not _is_candidate(problem):
        return None

    def trial_with(
        joints: tuple[str, ...], most: float, percent: float | None = None
    ) -> _Improvement | None:
        """Return an identification with factors of joints, if at most this share remains."""
        try:
            trial = tried(problem.with_drive_gains(joints, percent))
            errors = percents(check, trial.check)
        except SymbidError:
            return None
        if errors is None or errors[1] > most * errors[0]:
            return None
        return _Improvement(trial, *errors)

    found, every = None, None
    if _square(problem.solved) > LEAST_SQUARE:
        every = trial_with(("all",), REMAINS)
    if every is not None and every.after > UNDERSTOOD:
        every = None
    if every is not None:
        found = _of_unlike_joints(every, trial_with)
    if found is not None:
        is_near = not found.is_settled
    else:
        is_near = _excess(problem.solved) > LEAST_EXCESS or (every is not None and every.halves)
    if not is_near or check.holdout.percent_after < LEAST_ERROR:
        return found
    near = trial_with(("all",), REMAINS_NEAR, 100 * PLAUSIBLE)
    if near is None or not _are_near_and_unlike(list(near.factors.values())):
        return found
    return WrongFactors(_near_alarm(near), near.trial)


def _are_near_and_unlike(factors: Sequence[float]) -> bool:
    """Return whether factors are those of torque constants, and not one of all masses.

    A common factor scales the masses that follow from a log and explains nothing. It only brings
    them closer to those of a model that lacks a payload.
    """
    least, most = min(factors), max(factors)
    limit = np.exp(MOST_DEVIATIONS * PLAUSIBLE)
    return 1 / limit < least and most < limit and most > (1 + RELEVANT) * least


def _of_unlike_joints(
    every: _Improvement, trial_with: Callable[..., _Improvement | None]
) -> WrongFactors | None:
    """Return the joints whose efforts have other factors than those of most joints, if any.

    ``every`` is the trial with factors of all joints.
    """
    unlike = _unlike(every.trial.problem.solved)
    if unlike is None or not (unlike.are_plausible or every.halves):
        return None
    some = None
    if unlike.are_plausible or unlike.others_agree:
        some = trial_with(tuple(unlike.factors), 1 - LEAST_PART * (1 - every.remains))
    if some is not None:
        return WrongFactors(
            f"{_alarm(some.factors, some)}; the factors of these joints are identified, "
            "`drive_gain` none takes their efforts as they are",
            some.trial,
            unlike.others_agree,
        )
    if not unlike.are_plausible:
        return WrongFactors(_open_alarm(every), every.trial, is_settled=True)
    if every.remains > REMAINS_OPEN:
        return None
    line = robot_file_line(
        "effort_scale", *(f"{name}:={1 / at:.3g}" for name, at in unlike.factors.items())
    )
    return WrongFactors(
        f"{_alarm(unlike.factors, every)}, or write {line}, or let `drive_gain` all identify the "
        "factors, which leaves the scale of the masses open without a known payload",
        None,
        unlike.others_agree,
    )


def _alarm(factors: Mapping[str, float], improvement: _Improvement) -> str:
    named = ", ".join(
        f"{joint} reads {factor:.2g} times the torque" for joint, factor in factors.items()
    )
    return (
        f"{Alarm.WRONG_FACTORS}: relative to the other joints, {named}; with these factors, "
        f"{improvement.errors}; check torque constants and gear ratios"
    )


def _open_alarm(every: _Improvement) -> str:
    return (
        f"{Alarm.WRONG_FACTORS}: those of the joints differ more than torque constants err, as "
        f"those of currents do (reading over torque: {every.named_factors}); with these, "
        f"{every.errors}; all factors are identified, but only their ratios: the scale of factors "
        "and masses is that of the model file's masses; give a known `payload` or the "
        "`effort_scale` of the joints, `drive_gain` none takes efforts as they are"
    )


def _near_alarm(near: _Improvement) -> str:
    return (
        f"{Alarm.UNCERTAIN_FACTORS} (reading over torque: {near.named_factors}); with these, "
        f"{near.errors}; check torque constants, gear ratios and link lengths; the factors are "
        f"identified and assumed to be 1 within about {100 * PLAUSIBLE:.0f} %, `drive_gain` none "
        "takes efforts as they are"
    )


def _excess(solved: SolvedProblem) -> float:
    """Return the mean square of the change by limits of possible links, in deviations."""
    found = solved.posterior
    change = found.factor @ (solved.consistent_unknowns() - found.mean)
    return float(change @ change) / len(change)


def _is_candidate(problem: LoadedProblem) -> bool:
    """Return whether all forces of a log are efforts of an arm, whose terms the data chose."""
    options, parameters = problem.options, problem.parameters
    model = parameters.model
    return (
        options.finds_drive_gains
        and not (model.floating or model.contacts or model.wrist_sensors or parameters.payloads)
        and not problem.dataset.samples.wrench_frames
        and problem.solved.problem.calibrated_rows is None
        and len(named_joints(("all",), model)) > 1
    )


def _square(solved: SolvedProblem) -> float:
    """Return the mean square of the factors' errors, in deviations, about an estimate."""
    joints = named_joints(("all",), solved.problem.parameters.model)
    factors, covariance = _factors_beside(solved, joints, np.eye(len(joints)))
    error = factors - 1
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def _factors_beside(
    solved: SolvedProblem, joints: tuple[str, ...], correlation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return factors (k,) of joints' efforts beside the other unknowns, and their covariance.

    ``correlation`` (k, k) is that of their prior.
    """
    problem, phi = solved.problem, solved.posterior.mean
    parameters = problem.parameters
    errors = SensorErrors.of((DRIVE_GAIN,), parameters.model, (), (), joints)
    plain = solved.chosen.rows.layout
    layout = plain.extended(errors.names, errors.structure(parameters.model))
    rows = EffortColumns(layout, len(joints)).beside(solved.chosen, phi)
    ones = np.ones(len(joints))
    root = PLAUSIBLE * np.linalg.cholesky(correlation).astype(np.float64)
    prior = solved.posterior.prior.extended(errors.names, ones, PLAUSIBLE * ones, root)
    wide = replace(
        problem, prior=prior, is_empirical=False, pseudo_measurements=None, term_deviations=None
    )
    found = SolvedProblem.approximate(
        wide, rows, np.append(phi, ones), is_coupled=solved.chosen.is_coupled
    ).posterior
    factor = found.deviation_factor[len(phi) :]
    return found.mean[len(phi) :], factor @ factor.T


def wrist_sensor_alarms(problem: LoadedProblem) -> tuple[str, ...]:
    """Return an alarm for each wrist sensor whose gain contradicts the efforts of an arm.

    The efforts of the joints before the sensor feel what lies beyond it too.
    """
    solved, parameters = problem.solved, problem.parameters
    model = parameters.model
    is_checked = not (model.floating or model.contacts or parameters.payloads)
    if not is_checked or solved.problem.calibrated_rows is not None:
        return ()
    found = []
    for frame in model.wrist_sensors:
        names = component_names(frame)
        alike = np.full((len(names), len(names)), ALIKE)
        np.fill_diagonal(alike, 1.0)
        factors, covariance = _factors_beside(solved, names, alike)
        weights = np.linalg.solve(covariance, np.ones(len(names)))
        factor, std = float(weights @ factors / weights.sum()), float(weights.sum() ** -0.5)
        if factor > 0 and abs(np.log(factor)) > max(CERTAIN * std / factor, RELEVANT):
            found.append(
                f"the wrench at {frame} reads {1 / factor:.3g} ± {std / factor**2:.1g} "
                f"{Alarm.WRIST_SENSOR}, so the mass beyond {frame} is wrong, or those "
                "of the arm are: check the sensor's gain and unit, torque constants and gear "
                "ratios, or compare both with a known load"
            )
    return tuple(found)


def _unlike(solved: SolvedProblem) -> _Unlike | None:
    """Return which joints' efforts differ from those of the others; None if none do."""
    count = len(solved.problem.parameters)
    names, found = solved.problem.sensor_names, solved.posterior
    gains: FloatArray = found.mean[count:]
    deviations = found.deviation_factor[count:] / np.abs(gains)[:, None]
    relative = np.linalg.norm(deviations, axis=1)
    logs = np.log(np.abs(gains))
    # The factor that most joints with well-known factors have is taken as right.
    known = CERTAIN * relative < PLAUSIBLE
    if not known.any():
        return None
    apart = np.abs(logs[:, None] - logs)
    is_alike = apart < np.maximum(CERTAIN * np.hypot(relative[:, None], relative), RELEVANT)
    is_alike &= known & known[:, None]
    usual = is_alike[np.lexsort([relative, -is_alike.sum(axis=1)])[0]]
    right = float(np.average(logs[usual], weights=relative[usual] ** -2))
    change = right - logs
    is_unlike = known & (np.abs(change) > np.maximum(CERTAIN * relative, RELEVANT))
    if not is_unlike.any():
        return None
    are_plausible = bool(np.all(np.abs(change[is_unlike]) <= np.log(LARGEST)))
    # That half of the factors agree to a few percent is no chance: these are right, unless some
    # efforts are currents, as those of equal drives agree as well.
    ratios = CERTAIN * np.linalg.norm(deviations[:, None] - deviations, axis=2)
    agree = (apart < ratios) & (ratios < RELEVANT)
    alike = int(np.max(agree[np.ix_(usual, usual)].sum(axis=1))) + 1
    return _Unlike(
        {
            name.rpartition("/")[0]: float(one)
            for name, one, unlike in zip(names, np.exp(change), is_unlike, strict=True)
            if unlike
        },
        alike > 1
        and 2 * alike >= int(known.sum())
        and (are_plausible or GAINS[0] < np.exp(right) < GAINS[1]),
        are_plausible,
    )
