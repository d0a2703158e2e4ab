"""Finds joints that bend under their efforts, with encoders on the motors' side.

A joint that bends under gravity looks like a wrong encoder offset and shifts first moments of
links, while its residuals are small. The compliances of all joints are estimated from the rows,
linearised about the estimate with rigid joints. They must exceed their standard deviations by far,
because other residuals, which are correlated, resemble compliance a little.
"""

import logging

import numpy as np

from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.calibration import POINT_CONVERGED, compliance_std
from symbid_ros.identification.candidate_trial import training_part, with_plausible_prior
from symbid_ros.identification.dataset import Dataset, observe
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.sensor_errors import COMPLIANCE, SensorErrors
from symbid_ros.signals.weak_form import ALL_WINDOWS, suitable_windows

logger = logging.getLogger(__name__)

# Least mean square of the compliances, in standard deviations. It is 2 on a simulated rigid xArm 7
# and 5.4 at most on four public logs of arms; joints that bend by a milliradian reach hundreds.
LEAST_SQUARE = 20.0
# Deviations by which no compliance may be negative: then something else acts like it.
IMPOSSIBLE = 3.0


def shows_compliance(solved: SolvedProblem, dataset: Dataset) -> bool:
    """Return whether a log of a robot with a fixed base shows joints that bend.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log, with chosen joint terms and without sensor errors.
    dataset : Dataset
        The log, of which the first three quarters are used.
    """
    problem, parameters = solved.problem, solved.problem.parameters
    model = parameters.model
    if problem.choice is None or model.floating or model.wrist_sensors or model.contacts:
        return False
    training = list(training_part(solved, dataset))
    if not training:
        return False
    solved = with_plausible_prior(solved)
    count, prior = len(parameters), solved.posterior.prior
    errors = SensorErrors.of((COMPLIANCE,), model, training[0].wrench_frames, ())
    nothing = np.zeros(len(errors))
    build = CalibratingRows(
        parameters, errors, LinearizationPoint(solved.posterior.mean[:count], nothing)
    )
    layout = RowLayout.of(parameters).extended(errors.names, errors.structure(model))
    window = suitable_windows(ALL_WINDOWS, training[0].rate)[-1]
    (observations,) = observe(training, build, layout, (window,), ())
    prior = prior.extended(errors.names, nothing, compliance_std(dataset.samples.effort))
    found = posterior(observations, prior, tolerance=POINT_CONVERGED)
    value, factor = found.mean[count:], found.deviation_factor[count:]
    covariance = factor @ factor.T
    square = float(value @ np.linalg.solve(covariance, value)) / len(value)
    is_possible = np.all(value > -IMPOSSIBLE * np.sqrt(covariance.diagonal()))
    if not is_possible or square < LEAST_SQUARE:
        return False
    logger.warning(
        "%s: joints bend under their efforts, so their compliance is identified as well; give "
        "`sensor_errors` none to take them as rigid",
        dataset.source,
    )
    return True
