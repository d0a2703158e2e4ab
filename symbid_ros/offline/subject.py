"""What can be evaluated: the folder of an identification, its estimate.json, a prior.json."""

import json
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import load_estimate
from symbid_ros.estimation.prior import load_prior
from symbid_ros.model.parameters import ParameterSet, terms_in
from symbid_ros.model.tree import RobotModel


def load_subject(path: Path, model: RobotModel) -> tuple[ParameterSet, FloatArray]:
    """Return the columns and the values (p,) of an estimate or a prior of ``model``.

    Raises
    ------
    EstimateError, PriorError
        When the file is missing, malformed or about another robot.
    """
    file = path / "estimate.json" if path.is_dir() else path
    if _is_prior(file):
        parameters = ParameterSet(model)
        return parameters, load_prior(file, parameters).mean
    estimate = load_estimate(file)
    parameters = ParameterSet(model, terms_in(estimate.names))
    if set(parameters.names) == set(estimate.names):
        order = [estimate.names.index(name) for name in parameters.names]
        return parameters, np.asarray(estimate.value[order])
    raise EstimateError(
        f"{file}: this estimate is of model {estimate.model!r} and its parameters are not those of "
        f"{model.source}; name the model it was identified with"
    )


def _is_prior(file: Path) -> bool:
    """Tell prior.json by its kind; whatever cannot be read is left to the estimate's reader."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and "kind" in document and "method" not in document
