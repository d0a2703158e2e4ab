"""prior.json, read for the columns in use."""

from pathlib import Path

import numpy as np

from symbid_ros.errors import PriorError
from symbid_ros.estimation.prior import Prior, model_prior
from symbid_ros.model.parameters import TERMS, ParameterSet
from symbid_ros.model.xml_tree import LARGEST
from symbid_ros.safe_yaml import load_json

# The moment of inertia of a gram within a millimetre is 1e-9 kg m²; this is a billionth of it.
LEAST_STD = 1e-18


def load_prior(path: Path, parameters: ParameterSet) -> Prior:
    """Read prior.json and check that it belongs to the model.

    Of the joints' terms it may hold more or fewer than ``parameters``: those not in use are
    marginalised out, those that it lacks are as the model file has them, as in
    :func:`model_prior`.

    Raises
    ------
    PriorError
        When the file is missing, malformed, for another model, or no distribution.
    """
    try:
        document = load_json(path)
    except OSError as error:
        raise PriorError(f"{path}: cannot read it ({error.strerror}); check the path") from None
    except ValueError as error:
        raise PriorError(
            f"{path}: not a prior.json ({error}); write one with `symbid prior`"
        ) from None
    try:
        model, entries = document["model"], document["parameters"]
        values = {name: (float(e["value"]), float(e["std"])) for name, e in entries.items()}
        kind, seed = str(document["kind"]), document["seed"]
        rows = document.get("covariance_factor")
        factor = None if rows is None else np.array(rows, dtype=float)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise PriorError(
            f"{path}: not a prior.json ({reason}); write one with `symbid prior`"
        ) from None
    _check_belongs(path, model, values, parameters)
    _check_size(path, values)
    mean, std = np.array(list(values.values())).T
    try:
        read = Prior(model, kind, seed, tuple(values), mean, std, factor)
        return _for_columns(read, parameters)
    except PriorError as error:
        raise PriorError(f"{path}: {error}") from None


def _check_size(path: Path, values: dict[str, tuple[float, float]]) -> None:
    """Refuse numbers that are no robot's, whose squares would overflow or vanish."""
    for name, (value, std) in values.items():
        if abs(value) > LARGEST:
            raise PriorError(
                f"{path}: {name} has value {value:g}, no robot's; give at most {LARGEST:g} in SI "
                "units"
            )
        if value < 0 and name.endswith("/m"):
            raise PriorError(f"{path}: {name} has value {value:g}; give a mass of 0 kg or more")
        if 0 < std < LEAST_STD or std > LARGEST:
            raise PriorError(
                f"{path}: {name} has std {std:g}; give one from {LEAST_STD:g} to {LARGEST:g}, or "
                "drop --prior and give --prior-percent"
            )


def _for_columns(prior: Prior, parameters: ParameterSet) -> Prior:
    """Return the beliefs about ``parameters``, in their order."""
    names = parameters.names
    if prior.names == names:
        return prior
    own = model_prior(parameters)
    place = {name: index for index, name in enumerate(prior.names)}
    held = np.array([name in place for name in names])
    index = [place[name] for name in names if name in place]
    mean, std, factor = own.mean.copy(), own.std.copy(), None
    mean[held], std[held] = prior.mean[index], prior.std[index]
    if prior.factor is not None:
        # A Gaussian's marginal keeps the rows of a root of its covariance; QR makes the root
        # triangular again.
        root = np.zeros((len(names), len(prior.names) + len(names)))
        root[held, : len(prior.names)] = prior.factor[index]
        root[~held, len(prior.names) :] = np.diag(std)[~held]
        upper = np.linalg.qr(root.T, mode="r")
        factor = (upper * np.sign(np.diag(upper))[:, None]).T
    return Prior(prior.model, prior.kind, prior.seed, names, mean, std, factor)


def _check_belongs(
    path: Path, model: str, values: dict[str, tuple[float, float]], parameters: ParameterSet
) -> None:
    robot = parameters.model
    inertial = parameters.names[: parameters.inertial]
    missing = [name for name in inertial if name not in values]
    known = set(ParameterSet(robot, TERMS).names)
    unknown = [name for name in values if name not in known]
    if model != robot.name or missing or unknown:
        detail = f"the model calls itself {robot.name!r}"
        if missing:
            detail = f"it lacks {missing[0]}"
        elif unknown:
            detail = f"{unknown[0]} is unknown there"
        raise PriorError(
            f"{path}: this prior is for model {model!r}, not for {robot.source} ({detail}); draw "
            f"one with `symbid prior --model {robot.source}`"
        )
