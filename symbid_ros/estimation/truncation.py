"""The choice of z, the number of singular values: on data kept apart for it, or without any."""

from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.thesis import ScaledProblem

Criterion = Literal["gen_force", "torque", "com"]

GRAVITY = 9.81

# The error is flat over many z while noise in the regressor carries the parameters ever further
# off: among z that predict about equally well, the one that leaves most to the prior is the safest.
TOLERANCE = 1.5


def informative_rank(posterior: Posterior, rank: int) -> int:
    """Return the z for which no validation data are needed, at most ``rank``.

    It is the number of directions of which the data say more than the prior: singular values
    above one of rows whitened by their residuals and columns scaled by the prior's deviations.

    Raises
    ------
    EstimateError
        When the training data excite nothing.
    """
    if rank == 0:
        raise EstimateError("the log excites no parameter at all; record a motion")
    scaled = posterior.factor @ posterior.prior.covariance_factor()
    told = np.linalg.svd(scaled, compute_uv=False) ** 2 - 1
    return int(np.clip(np.sum(told > 1), 1, rank))


def select_rank(
    problem: ScaledProblem, validation: Information, criterion: Criterion = "gen_force"
) -> int:
    """Return the smallest z that predicts the validation data about as well as the best.

    "About as well" is an error of at most ``TOLERANCE`` times the least one.

    Parameters
    ----------
    problem : ScaledProblem
        The method's problem on the training data.
    validation : Information
        Rows of another record, ideally noise-free.
    criterion : {"gen_force", "torque", "com"}
        Root mean square of the prediction error of all coordinates, of the joints,
        or of the base's moment over the robot's weight: the distance by which the
        centre of mass would have to be wrong to explain it.

    Raises
    ------
    EstimateError
        When the training data excite nothing, or "com" is asked of a fixed base.
    """
    if problem.rank == 0:
        raise EstimateError("the log excites no parameter at all; record a motion")
    errors = prediction_errors(validation, problem.solutions(), criterion)
    return int(np.argmax(errors <= TOLERANCE * errors.min())) + 1


def prediction_errors(
    validation: Information, solutions: FloatArray, criterion: Criterion
) -> FloatArray:
    """Return the criterion (k,) for k parameter vectors (p, k)."""
    coordinates = validation.layout.coordinates
    floating = coordinates[0].startswith("base/")
    squares = np.array(
        [
            np.sum((factor[:, :-1] @ solutions[columns] - factor[:, -1:]) ** 2, axis=0)
            for factor, columns in (
                (validation.coordinate_factor(i), validation.layout.columns[i])
                for i in range(len(coordinates))
            )
        ]
    )
    if criterion == "gen_force":
        used = squares
    elif criterion == "torque":
        used = squares[6 * floating :]
    else:
        if not floating:
            raise EstimateError("z by centre of mass needs a floating base; select by torque")
        masses = [i for i, name in enumerate(validation.layout.parameters) if name.endswith("/m")]
        weight = GRAVITY * np.abs(solutions[masses].sum(axis=0))
        used = squares[:3] / np.maximum(weight, 1e-9) ** 2
    errors: FloatArray = np.sqrt(used.sum(axis=0) / max(validation.samples, 1))
    return errors
