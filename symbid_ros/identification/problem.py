"""What is known before a method is chosen, and which methods there are."""

from dataclasses import dataclass, replace

from symbid_ros.choices import Criterion
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
