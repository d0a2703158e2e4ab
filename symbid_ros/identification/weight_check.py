"""What the measured forces carry of the weight that is expected."""

import numpy as np

from symbid_ros.diagnosis.forces import MOST_LEFT
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet


def check_weight(rows: Information, parameters: ParameterSet, prior: Prior) -> None:
    """Refuse a floating robot whose measured forces do not carry it.

    Raises
    ------
    DataError
        When they miss what the prior expects by as much as the doctor calls unusable.
    """
    if not parameters.model.floating:
        return
    missing = missing_weight(rows, parameters, prior)
    if missing > MOST_LEFT:
        raise DataError(
            f"the wrenches measured differ by {100 * missing:.0f} % of the prior's weight from "
            "what the motion needs; publish the wrench of every contact, or go on all the same "
            "with unchecked"
        )


def missing_weight(rows: Information, parameters: ParameterSet, prior: Prior) -> float:
    """Return by how much a floating base's force rows miss what a prior expects, in weights."""
    moment = rows.residual_moment(prior.mean).diagonal() / max(rows.samples, 1)
    masses = parameters.link_phi(prior.mean)[:, 0]
    weight = np.linalg.norm(parameters.model.gravity) * masses.sum()
    return float(np.sqrt(moment[3:6].sum()) / weight)
