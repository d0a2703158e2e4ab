"""Checks whether the efforts of an arm have wrong factors, such as those of torque constants.

Links follow such errors in part: residuals stay small, and masses come out far off. With a factor
on each effort as a further unknown, both fit.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.effort_columns import EffortColumns
from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.calibration import error_layout
from symbid_ros.identification.drive_gains import named_joints
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.solver import Solver
from symbid_ros.signals.sensor_errors import DRIVE_GAIN, SensorErrors

# Prior deviation of the factors, and their least mean square in deviations. It is .2 to 3.5 on
# simulated arms with right efforts.
PLAUSIBLE, LEAST_SQUARE = 0.2, 5.0
# Most of the held-out error that remains with the factors: its share, and its size in percent.
# Above that, something else is wrong, which factors follow.
REMAINS, UNDERSTOOD = 0.85, 10.0
# A factor is named if it differs from the usual one by these, in deviations and as a share. Units
# differ by more than the largest ratio; the checks of the log find them.
CERTAIN, RELEVANT, LARGEST = 3.0, 0.05, 3.0


def gain_alarm(
    problem: LoadedProblem, checked: HoldOut, hold_out: Callable[[LoadedProblem], HoldOut]
) -> str | None:
    """Return an alarm if factors of the efforts explain a log better; None if they do not.

    Parameters
    ----------
    problem : LoadedProblem
    checked : HoldOut
        Its check on the end of the log.
    hold_out : callable
        Returns this check of another problem of the log.
    """
    before = checked.percent_after
    if before is None or not _is_candidate(problem) or _square(problem.solver) < LEAST_SQUARE:
        return None
    try:
        options = replace(problem.options, drive_gain=("all",))
        gained = problem.with_prior(problem.prior, options)
        after = hold_out(gained).percent_after
    except SymbidError:
        return None
    named = _unlike(gained.solver)
    if after is None or after > min(REMAINS * before, UNDERSTOOD) or not named:
        return None
    return (
        f"the efforts have wrong factors: relative to the other joints, {named}; with these, the "
        f"end of the log is predicted to {after:.2g} instead of {before:.2g} %; check torque "
        "constants and gear ratios, or let `drive_gain` all identify the factors, which leaves the "
        "scale of the masses open without a known payload"
    )


def _is_candidate(problem: LoadedProblem) -> bool:
    """Return whether all forces of a log are efforts of an arm, whose terms the data chose."""
    options, parameters = problem.options, problem.parameters
    model = parameters.model
    return (
        options.searches
        and not options.has_further_unknowns
        and not (model.floating or model.contacts or model.wrist_sensors or parameters.payloads)
        and problem.solver.problem.calibrated_rows is None
        and len(named_joints(("all",), model)) > 1
    )


def _square(solver: Solver) -> float:
    """Return the mean square of the factors' errors, in deviations, about an estimate."""
    problem, phi = solver.problem, solver.posterior.mean
    parameters, joints = problem.parameters, named_joints(("all",), problem.parameters.model)
    errors = SensorErrors.of((DRIVE_GAIN,), parameters.model, (), (), joints)
    rows = EffortColumns(error_layout(parameters, errors), len(joints)).beside(solver.chosen, phi)
    ones = np.ones(len(joints))
    prior = solver.posterior.prior.extended(errors.names, ones, PLAUSIBLE * ones)
    wide = replace(
        problem, prior=prior, is_empirical=False, pseudo_measurements=None, term_deviations=None
    )
    found = Solver.approximate(
        wide, rows, np.append(phi, ones), is_coupled=solver.chosen.is_coupled
    ).posterior
    covariance = found.deviation_factor[len(phi) :] @ found.deviation_factor[len(phi) :].T
    error = found.mean[len(phi) :] - 1
    return float(error @ np.linalg.solve(covariance, error)) / len(error)


def _unlike(solver: Solver) -> str:
    """Return the joints whose efforts differ from those of the others, and by how much.

    It is empty if some factors are implausible.
    """
    count = len(solver.problem.parameters)
    names, found = solver.problem.sensor_names, solver.posterior
    gains: FloatArray = found.mean[count:]
    relative = np.linalg.norm(found.deviation_factor[count:], axis=1) / np.abs(gains)
    logs = np.log(np.abs(gains))
    # The factor that most joints have is taken as right.
    apart = np.abs(logs[:, None] - logs)
    is_alike = apart < np.maximum(CERTAIN * np.hypot(relative[:, None], relative), RELEVANT)
    usual = is_alike[np.lexsort([relative, -is_alike.sum(axis=1)])[0]]
    change = np.average(logs[usual], weights=relative[usual] ** -2) - logs
    is_unlike = np.abs(change) > np.maximum(CERTAIN * relative, RELEVANT)
    if np.any(np.abs(change[is_unlike]) > np.log(LARGEST)):
        return ""
    return ", ".join(
        f"{name.rpartition('/')[0]} reads {one:.2g} times the torque"
        for name, one, unlike in zip(names, np.exp(change), is_unlike, strict=True)
        if unlike
    )
