"""What can be evaluated: the folder of an identification, its estimate.json, a prior.json."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.archive import load_deviation_factor
from symbid_ros.estimation.estimate import Estimate, load_estimate
from symbid_ros.estimation.prior import load_prior
from symbid_ros.model.parameters import ParameterSet, terms_in
from symbid_ros.model.tree import RobotModel
from symbid_ros.safe_yaml import load_json


@dataclass(frozen=True)
class Subject:
    """A robot's parameters, with what is known of how they were found.

    Attributes
    ----------
    parameters : ParameterSet
        The p columns.
    values : (p,) float64
        In SI units.
    estimate : Estimate or None
        Its parameters in the columns' order; None for a prior.
    deviation_factor : (p, r) float64 or None
        L of the posterior covariance L Lᵀ; None where no folder holds one.
    """

    parameters: ParameterSet
    values: FloatArray
    estimate: Estimate | None = None
    deviation_factor: FloatArray | None = None


def load_subject(path: Path, model: RobotModel) -> Subject:
    """Read an estimate or a prior of ``model``.

    Raises
    ------
    EstimateError, PriorError
        When the file is missing, malformed or about another robot.
    """
    file = path / "estimate.json" if path.is_dir() else path
    if _is_prior(file):
        parameters = ParameterSet(model)
        return Subject(parameters, load_prior(file, parameters).mean)
    estimate = load_estimate(file)
    # The file may be that of the true robot, whose friction the estimate need not know.
    parameters = ParameterSet(model, terms_in(estimate.names)).with_known_values(estimate.known)
    if set(parameters.names) != set(estimate.names):
        raise EstimateError(
            f"{file}: this estimate is of model {estimate.model!r} and its parameters are not "
            f"those of {model.source}; name the model it was identified with"
        )
    order = [estimate.names.index(name) for name in parameters.names]
    ordered = _ordered(estimate, order)
    archive = path / "information.npz"
    if not archive.is_file():
        return Subject(parameters, ordered.value, ordered)
    factor = load_deviation_factor(archive)
    if factor is not None:
        if factor.ndim != 2 or len(factor) != len(order):
            raise EstimateError(
                f"{archive}: its uncertainty is not of the {len(order)} parameters of {file.name}; "
                "identify the log again"
            )
        factor = factor[order]
    return Subject(parameters, ordered.value, ordered, factor)


def _ordered(estimate: Estimate, order: list[int]) -> Estimate:
    """Return the estimate with its parameters in another order."""
    return replace(
        estimate,
        names=tuple(estimate.names[i] for i in order),
        units=tuple(estimate.units[i] for i in order),
        value=np.asarray(estimate.value[order]),
        prior=np.asarray(estimate.prior[order]),
        std=None if estimate.std is None else np.asarray(estimate.std[order]),
        determined=None if estimate.determined is None else np.asarray(estimate.determined[order]),
    )


def _is_prior(file: Path) -> bool:
    """Tell prior.json by its kind; whatever cannot be read is left to the estimate's reader."""
    try:
        document = load_json(file)
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and "kind" in document and "method" not in document
