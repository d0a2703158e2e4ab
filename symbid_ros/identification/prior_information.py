"""What is known of a robot and its sensors beside the log."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.constraints import mirror_rows, total_mass_row
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior, absolute_model_prior, load_prior, model_prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_errors import KINDS

# Of a weighing, kg, unless it is given: that of a good platform scale.
WEIGHING_STD = 0.05

# A weighing further from the prior's total mass than this many deviations contradicts it.
CONTRADICTION = 6.0


@dataclass(frozen=True)
class PriorChoice:
    """Where the prior comes from; with none of these, the model and the evidence.

    Attributes
    ----------
    file : Path or None
        prior.json.
    percent, absolute : float or None
        Half-width around the model file's values, in % or in SI units.
    """

    file: Path | None = None
    percent: float | None = None
    absolute: float | None = None

    @property
    def empirical(self) -> bool:
        """Whether the evidence sets the prior's scale."""
        return self.file is None and self.percent is None and self.absolute is None

    def load(self, parameters: ParameterSet) -> Prior:
        """Return the prior.

        Raises
        ------
        PriorError, EstimateError
            When the file does not serve, or more than one source is named.
        """
        if sum(source is not None for source in (self.file, self.percent, self.absolute)) > 1:
            raise EstimateError("give one of --prior, --prior-percent and --prior-absolute")
        if self.file is not None:
            return load_prior(self.file, parameters)
        if self.absolute is not None:
            return absolute_model_prior(parameters, self.absolute)
        if self.percent is not None:
            return model_prior(parameters, self.percent)
        return model_prior(parameters)


def weighing(mass: float | None, std: float | None) -> tuple[float, float] | None:
    """Return a total mass and its standard deviation, kg, from what was given of them.

    Raises
    ------
    EstimateError
        When there is a deviation of nothing.
    """
    if mass is None:
        if std is not None:
            raise EstimateError("--total-mass-std is of no use without --total-mass; give both")
        return None
    return mass, WEIGHING_STD if std is None else std


@dataclass(frozen=True)
class Facts:
    """What is known beside the log and the prior.

    Attributes
    ----------
    total_mass : (float, float) or None
        Of the whole robot and its standard deviation, kg.
    mirror : float or None
        How unlike left and right links may be, in standard deviations of the prior.
    tare : tuple of Path
        Bags recorded with nothing touching the wrench sensors.
    sensor_errors : tuple of str
        Which errors of the sensors are unknowns too.
    """

    total_mass: tuple[float, float] | None = None
    mirror: float | None = None
    tare: tuple[Path, ...] = ()
    sensor_errors: tuple[str, ...] = ()

    @property
    def kinds(self) -> tuple[str, ...]:
        """The sensor errors to identify: all of them where there is a tare, unless named."""
        return self.sensor_errors or (KINDS if self.tare else ())

    @property
    def rows_wanted(self) -> bool:
        """Whether anything is known that is a row of its own."""
        return self.total_mass is not None or self.mirror is not None

    def rows(self, parameters: ParameterSet, prior: Prior) -> PseudoMeasurements | None:
        """Return what is known of the robot as rows.

        Raises
        ------
        EstimateError
            When a weighing is none, or contradicts the prior.
        """
        rows, targets = [], []
        if self.total_mass is not None:
            mass, std = self.total_mass
            row, target = total_mass_row(parameters, mass, std)
            expected = row @ prior.mean * std
            spread = np.hypot(np.linalg.norm(row @ prior.covariance_factor()) * std, std)
            if abs(mass - expected) > CONTRADICTION * spread:
                raise EstimateError(
                    f"a total mass of {mass:g} kg contradicts the prior, whose links weigh "
                    f"{expected:.3g} ± {spread:.2g} kg together; check --total-mass and the model"
                )
            rows.append(row[None])
            targets.append(np.array([target]))
        if self.mirror is not None:
            tied, zero = mirror_rows(parameters, prior.std, self.mirror)
            rows.append(tied)
            targets.append(zero)
        return PseudoMeasurements(np.concatenate(rows), np.concatenate(targets)) if rows else None
