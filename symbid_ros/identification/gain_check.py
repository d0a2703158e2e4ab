"""Finds efforts of an arm that have wrong factors, such as those of torque constants.

Links follow such errors in part: residuals stay small, and masses come out far off. With a factor
on each effort as a further unknown, both fit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class WrongFactors:
    """Efforts that have other factors than those of most joints.

    Attributes
    ----------
    joints : tuple of str
    factors : tuple of float
        Of each joint, from the torque to the reading.
    before, after : float
        Held-out error without and with factors, percent of the measured effort.
    """

    joints: tuple[str, ...]
    factors: tuple[float, ...]
    before: float
    after: float

    def are_explained(self, checked: HoldOut) -> bool:
        """Return whether a check with these joints' factors as unknowns is as good as with all."""
        after = checked.percent_after
        return after is not None and after <= _most(self.before)

    @property
    def alarm(self) -> str:
        """What is wrong."""
        named = ", ".join(
            f"{joint} reads {factor:.2g} times the torque"
            for joint, factor in zip(self.joints, self.factors, strict=True)
        )
        return (
            f"the efforts have wrong factors: relative to the other joints, {named}; with these, "
            f"the end of the log is predicted to {self.after:.2g} instead of {self.before:.2g} %; "
            "check torque constants and gear ratios"
        )

    @property
    def identified(self) -> str:
        """The alarm if the factors of these joints are identified."""
        return (
            f"{self.alarm}; the factors of these joints are identified, `drive_gain` none takes "
            "their efforts as they are"
        )

    @property
    def not_identified(self) -> str:
        """The alarm if they are not."""
        return (
            f"{self.alarm}, or let `drive_gain` all identify the factors, which leaves the scale "
            "of the masses open without a known payload"
        )


def wrong_factors(
    problem: LoadedProblem, checked: HoldOut, hold_out: Callable[[LoadedProblem], HoldOut]
) -> WrongFactors | None:
    """Return which efforts' factors explain a log better; None if none do.

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
        gained = problem.with_drive_gains(("all",))
        after = hold_out(gained).percent_after
    except SymbidError:
        return None
    unlike = _unlike(gained.solver)
    if after is None or after > _most(before) or not unlike:
        return None
    return WrongFactors(tuple(unlike), tuple(unlike.values()), before, after)


def _most(before: float) -> float:
    """Return the largest held-out error, percent, with which factors explain what was wrong."""
    return min(REMAINS * before, UNDERSTOOD)


def _is_candidate(problem: LoadedProblem) -> bool:
    """Return whether all forces of a log are efforts of an arm, whose terms the data chose."""
    options, parameters = problem.options, problem.parameters
    model = parameters.model
    return (
        options.finds_drive_gains
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


def _unlike(solver: Solver) -> dict[str, float]:
    """Return the joints whose efforts differ from those of the others, and the factors.

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
        return {}
    return {
        name.rpartition("/")[0]: float(one)
        for name, one, unlike in zip(names, np.exp(change), is_unlike, strict=True)
        if unlike
    }
