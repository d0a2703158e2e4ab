"""What is known before the data: the prior, the weighed mass, left and right alike."""

import numpy as np

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.constraints import mirror_rows, total_mass_row
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior, absolute_model_prior, load_prior, model_prior
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.parameters import ParameterSet

# A weighing this many standard deviations from the prior's mass is an error, not news.
CONTRADICTION = 6.0


def prior_of(options: IdentifyOptions, parameters: ParameterSet) -> Prior:
    """Return the prior that the options choose.

    Raises
    ------
    PriorError
        When the file of the prior is invalid or belongs to another robot.
    """
    if options.prior is not None:
        return load_prior(options.prior, parameters)
    if options.prior_absolute is not None:
        return absolute_model_prior(parameters, options.prior_absolute)
    if options.prior_percent is not None:
        return model_prior(parameters, options.prior_percent)
    return model_prior(parameters)


def known_rows(
    options: IdentifyOptions, parameters: ParameterSet, prior: Prior
) -> PseudoMeasurements | None:
    """Return the weighed mass and the symmetry of left and right as pseudo-measurements.

    Raises
    ------
    EstimateError
        When the weighing contradicts the prior.
    """
    rows, targets = [], []
    if options.weighing is not None:
        mass, std = options.weighing
        row, target = total_mass_row(parameters, mass, std)
        expected = row @ prior.mean * std
        spread = np.hypot(np.linalg.norm(row @ prior.covariance_factor()) * std, std)
        if abs(mass - expected) > CONTRADICTION * spread:
            raise EstimateError(
                f"a total mass of {mass:g} kg contradicts the prior, whose links weigh "
                f"{expected:.3g} ± {spread:.2g} kg together; check `total_mass` and the model",
                "E504",
            )
        rows.append(row[None])
        targets.append(np.array([target]))
    if options.mirror is not None:
        tied, zero = mirror_rows(parameters, prior.std, options.mirror)
        rows.append(tied)
        targets.append(zero)
    return PseudoMeasurements(np.concatenate(rows), np.concatenate(targets)) if rows else None
