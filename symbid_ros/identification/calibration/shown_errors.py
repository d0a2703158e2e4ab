"""Finds sensor errors that a log shows, to identify them as well.

They are estimated from the rows, linearised about the estimate without them. They must exceed their
standard deviations by far, because other residuals, which are correlated, resemble them a little.
"""

import logging
from collections.abc import Iterable

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.alarms import SUSPICIOUS_WHITENESS
from symbid_ros.estimation.posterior import posterior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.calibration.extended_problem import POINT_CONVERGED, compliance_std
from symbid_ros.identification.rows.dataset import Dataset, observe
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.trial import training_part, with_plausible_prior
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import COMPLIANCE, IMU_BIAS, SensorErrors
from symbid_ros.signals.weak_form import ALL_WINDOWS, suitable_windows

logger = logging.getLogger(__name__)

# Least mean square of the compliances, in standard deviations. It is 2 on a simulated rigid xArm 7
# and 5.4 at most on four public logs of arms; joints that bend by a milliradian reach hundreds.
LEAST_SQUARE = 20.0
# The same of biases. It is 0.3 at most on logs of four simulated quadrupeds and the Symbitron
# without any, and 190 with biases of 0.01 m/s².
LEAST_BIAS = 4.0
# Whiteness of residuals in which nothing is left to explain. On logs of 2 s, biases far below those
# of any IMU exceed their deviations. Biases of 0.004 m/s² give a quadruped's residuals 1.2.
WHITE = 1.0
# Deviations by which no compliance may be negative: then something else acts like it.
IMPOSSIBLE = 3.0


def shows_compliance(solved: SolvedProblem, dataset: Dataset) -> bool:
    """Return whether a log of a robot with a fixed base shows joints that bend.

    The encoders are on the motors' side. A joint that bends under gravity looks like a wrong
    encoder offset and shifts first moments of links, while its residuals are small. ``solved`` has
    chosen joint terms and no sensor errors. The first three quarters of the log are used.
    """
    model = solved.problem.parameters.model
    if solved.problem.choice is None or model.floating or model.wrist_sensors or model.contacts:
        return False
    training = training_part(solved, dataset)
    first = next(iter(training), None)
    if first is None:
        return False
    errors = SensorErrors.of((COMPLIANCE,), model, first.wrench_frames, ())
    std = compliance_std(dataset.samples.effort)
    value, covariance = _estimated(solved, training, first.rate, errors, std)
    is_possible = np.all(value > -IMPOSSIBLE * np.sqrt(covariance.diagonal()))
    if not is_possible or _mean_square(value, covariance) < LEAST_SQUARE:
        return False
    logger.warning(
        "%s: joints bend under their efforts, so their compliance is identified as well; give "
        "`sensor_errors` none to take them as rigid",
        dataset.source,
    )
    return True


def shows_imu_bias(solved: SolvedProblem, dataset: Dataset) -> bool:
    """Return whether a log of a robot with foot sensors shows biases of its IMUs.

    A bias of 0.02 m/s² shifts first moments of links as a tilt of 0.1° does. ``solved`` has no
    sensor errors. The first three quarters of the log are used.
    """
    model = solved.problem.parameters.model
    if not model.floating or model.contacts or solved.whiteness <= WHITE:
        return False
    training = training_part(solved, dataset)
    first = next(iter(training), None)
    if first is None or not first.imu_frames:
        return False
    errors = SensorErrors.of((IMU_BIAS,), model, first.wrench_frames, first.imu_frames)
    value, covariance = _estimated(solved, training, first.rate, errors, errors.std)
    return _mean_square(value, covariance) > LEAST_BIAS


def biases_explain(biased: SolvedProblem, solved: SolvedProblem, dataset: Dataset) -> bool:
    """Return whether biases of IMUs explain what a log's residuals contained without them.

    Other errors of sensors resemble a bias a little, and are named by what they leave.
    """
    left, before = biased.whiteness - WHITE, solved.whiteness - WHITE
    if biased.whiteness >= SUSPICIOUS_WHITENESS and left > before / 2:
        return False
    logger.warning(
        "%s: the biases of its IMU are identified as well; give `sensor_errors` none to take its "
        "readings as unbiased",
        dataset.source,
    )
    return True


def _estimated(
    solved: SolvedProblem,
    training: Iterable[Segment],
    rate: float,
    errors: SensorErrors,
    std: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the sensor errors (r,) that a log of a rate, Hz, shows, and their covariance (r, r).

    ``std`` are their deviations before the log.
    """
    solved = with_plausible_prior(solved)
    parameters, prior = solved.problem.parameters, solved.posterior.prior
    count, nothing = len(parameters), np.zeros(len(errors))
    point = LinearizationPoint(solved.posterior.mean[:count], nothing)
    layout = RowLayout.of(parameters).extended(errors.names, errors.structure(parameters.model))
    window = suitable_windows(ALL_WINDOWS, rate)[-1]
    build = CalibratingRows(parameters, errors, point)
    (observations,) = observe(training, build, layout, (window,), ())
    prior = prior.extended(errors.names, nothing, std)
    found = posterior(observations, prior, tolerance=POINT_CONVERGED)
    factor = found.deviation_factor[count:]
    return found.mean[count:], factor @ factor.T


def _mean_square(value: FloatArray, covariance: FloatArray) -> float:
    """Return the mean square of errors (r,) in standard deviations."""
    return float(value @ np.linalg.solve(covariance, value)) / len(value)
