"""What is known before a method is chosen, and the check of the measured weight."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.choices import Criterion
from symbid_ros.diagnosis.forces import MOST_LEFT
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.calibration import Calibrated
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import RowBuilder, equation_rows


@dataclass(frozen=True)
class Truncation:
    """How the number of singular values z is chosen: given, on a validation log, or by itself.

    Attributes
    ----------
    rank : int or None
        z.
    validation : tuple of Observations
        Of a log kept apart; the one with the training rows' window is used.
    criterion : {"gen_force", "torque", "com"}
        What to choose it by there.
    """

    rank: int | None = None
    validation: tuple[Observations, ...] = ()
    criterion: Criterion = "gen_force"


@dataclass(frozen=True)
class Problem:
    """Everything that is known before a method is chosen.

    Attributes
    ----------
    observations : tuple of Observations
        The data, for each length of window, shortest first.
    parameters : ParameterSet
        The robot's p columns.
    prior : Prior
        Of them, and of the errors of sensors whose columns follow.
    sensors : tuple of str
        Units of those errors.
    pseudo_measurements : PseudoMeasurements or None
        Weighing and symmetry of the robot.
    empirical : bool
        Whether the evidence sets the scale of the prior.
    longest : bool
        Whether only the longest window will do.
    inputs : tuple of str
        What to write down as the estimate's origin.
    has_wrenches : bool
        Whether the robot has wrench sensors.
    calibrated_rows : RowBuilder or None
        Builds rows in which sensor errors are unknowns, too; None where they are not.
    """

    observations: tuple[Observations, ...]
    parameters: ParameterSet
    prior: Prior
    sensors: tuple[str, ...] = ()
    pseudo_measurements: PseudoMeasurements | None = None
    empirical: bool = False
    longest: bool = False
    inputs: tuple[str, ...] = ()
    has_wrenches: bool = True
    calibrated_rows: RowBuilder | None = None

    @property
    def row_builder(self) -> RowBuilder:
        """Builds the rows of all unknowns."""
        return self.calibrated_rows or equation_rows(self.parameters)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors' errors."""
        return self.prior.names[len(self.parameters) :]

    def calibrated(self, found: Calibrated) -> "Problem":
        """Return the problem with errors of the log's sensors among the unknowns."""
        return replace(
            self,
            observations=found.observations,
            prior=found.prior,
            sensors=found.errors.units,
            pseudo_measurements=found.pseudo_measurements,
            longest=True,
            calibrated_rows=found.rows,
        )


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
