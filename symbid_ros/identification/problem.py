"""An identification before a method is chosen: data, prior and pseudo-measurements."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Criterion
from symbid_ros.diagnosis.forces import MAX_UNEXPLAINED
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.signals.sampled_rows import RowBuilder
from symbid_ros.signals.weak_form import equation_rows

if TYPE_CHECKING:
    from symbid_ros.identification.terms.choice import TermChoice


@dataclass(frozen=True)
class Truncation:
    """How to choose the number of singular values z; without rank and validation, by information.

    Attributes
    ----------
    rank : int or None
        z, if given.
    validation : tuple of Observations
        Of a validation log; the one with the window length of the training rows is used.
    criterion : {"gen_force", "torque", "com"}
        Prediction error that is minimised on the validation log.
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
        The data for each window length, shortest first.
    parameters : ParameterSet
        The robot's p columns.
    prior : Prior
        Of the p parameters and of the sensor errors, whose columns follow.
    sensor_units : tuple of str
        Units of the sensor errors.
    pseudo_measurements : PseudoMeasurements or None
        Weighed mass and symmetry of the robot.
    is_empirical : bool
        Whether the evidence sets the scale of the prior.
    needs_longest_window : bool
        Whether only the longest window length may be used.
    inputs : tuple of str
        Input files, recorded in the estimate.
    calibrated_rows : CalibratingRows or None
        Builds rows with columns for sensor errors; None without these unknowns.
    stored : tuple of Observations or None
        The data with the columns of all candidate terms, for later runs; None if they are the same.
    choice : TermChoice or None
        The joint terms that the data asked for; None if the user named them.
    term_deviations : (p + s, k) float64 or None
        N: other sets of joint terms that explain the data as well add the covariance N Nᵀ.
    remarks : tuple of str
        What the log leaves open about the scale of efforts.
    alarms : tuple of str
        What contradicts the model besides the rows.
    allows_signed_drives : bool
        Whether armature and viscous friction may be negative where the data contradict positive
        ones.
    force_scale_std : float or None
        Relative deviation of the gain that all forces and efforts have in common, which enters all
        deviations. None: the usual one, which enters those of the masses.
    """

    observations: tuple[Observations, ...]
    parameters: ParameterSet
    prior: Prior
    sensor_units: tuple[str, ...] = ()
    pseudo_measurements: PseudoMeasurements | None = None
    is_empirical: bool = False
    needs_longest_window: bool = False
    inputs: tuple[str, ...] = ()
    calibrated_rows: CalibratingRows | None = None
    stored: tuple[Observations, ...] | None = None
    choice: "TermChoice | None" = None
    term_deviations: FloatArray | None = None
    remarks: tuple[str, ...] = ()
    alarms: tuple[str, ...] = ()
    allows_signed_drives: bool = False
    force_scale_std: float | None = None

    @property
    def data(self) -> tuple[Observations, ...]:
        """The data for later runs, with the columns of all candidate terms."""
        return self.stored or self.observations

    @property
    def row_builder(self) -> RowBuilder:
        """Builds the rows of all unknowns."""
        return self.calibrated_rows or equation_rows(self.parameters)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensor errors."""
        return self.prior.names[len(self.parameters) :]


def check_weight(
    rows: Information, parameters: ParameterSet, prior: Prior, cause: Callable[[], str]
) -> None:
    """Check that the measured forces carry the weight of a floating robot.

    ``cause`` returns what is wrong and how to correct it, if the check fails.

    Raises
    ------
    DataError
        When the error is as large as one that the doctor calls unusable.
    """
    if not parameters.model.floating or parameters.model.contacts is not None:
        return
    moment = rows.residual_moment(prior.mean).diagonal() / max(rows.samples, 1)
    masses = parameters.link_phi(prior.mean)[:, 0]
    weight = np.linalg.norm(parameters.model.gravity) * masses.sum()
    # RMS residual of the base's force rows, as a share of the prior's weight.
    missing = float(np.sqrt(moment[3:6].sum()) / weight)
    if missing > MAX_UNEXPLAINED:
        raise DataError(
            f"live topics: the measured wrenches differ from those that the motion needs by "
            f"{100 * missing:.0f} % of the robot's weight; {cause()}",
            "E513",
        )
