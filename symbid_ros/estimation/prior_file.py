"""prior.json: the file of a prior, written and read."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.atomic_write import write_text
from symbid_ros.choices import TERMS
from symbid_ros.errors import PriorError
from symbid_ros.estimation.prior import Prior
from symbid_ros.json_documents import versioned
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.xml_file import LARGEST
from symbid_ros.user_files import load_json

# A billionth of the moment of inertia of a gram within a millimetre, 1e-9 kg m².
LEAST_STD = 1e-18


def write_prior(path: Path, prior: Prior) -> None:
    """Write prior.json.

    Raises
    ------
    PriorError
        When a mass is negative, which :func:`load_prior` rejects.
    """
    for name, value in zip(prior.names, prior.mean, strict=True):
        if name.endswith("/m") and value < 0:
            raise PriorError(
                f"{path}: not written, as {name} came out as {value:.3g} kg; choose another "
                "seed or a smaller half-width",
                "E407",
            )
    parameters = {
        name: {"value": float(value), "std": float(std)}
        for name, value, std in zip(prior.names, prior.mean, prior.std, strict=True)
    }
    document: dict[str, object] = {
        "model": prior.model,
        "kind": prior.kind,
        "seed": prior.seed,
        "parameters": parameters,
    }
    if prior.factor is not None:
        document["covariance_factor"] = prior.factor.tolist()
    write_text(path, json.dumps(versioned("prior", document), indent=1) + "\n")


def load_prior(source: Path | Mapping[str, Any], parameters: ParameterSet) -> Prior:
    """Read prior.json, or a mapping with what it holds, and check that it belongs to the model.

    A mapping needs the key ``parameters`` alone. There may be more or fewer joint terms than those
    of ``parameters``. Terms not in use are marginalised, and missing terms are those of
    :func:`model_prior`.

    Raises
    ------
    PriorError
        When the file is missing or malformed, belongs to another model or is not a distribution.
    """
    if isinstance(source, Path):
        path, document = str(source), _read(source)
    elif not isinstance(source, Mapping):
        raise PriorError(
            f"prior is a {type(source).__name__}; give the path of a prior.json, or a mapping",
            "E402",
        )
    else:
        path = "prior"
        document = {"model": parameters.model.name, "kind": "given", "seed": None, **source}
    try:
        model, entries = document["model"], document["parameters"]
        values = {name: (float(e["value"]), float(e["std"])) for name, e in entries.items()}
        kind, seed = str(document["kind"]), document["seed"]
        rows = document.get("covariance_factor")
        factor = None if rows is None else np.array(rows, dtype=float)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise PriorError(
            f"{path}: not a prior.json ({reason}); write one with `symbid prior`", "E402"
        ) from None
    _check_belongs(path, model, values, parameters)
    _check_size(path, values)
    mean, std = np.array(list(values.values())).T
    try:
        read = Prior(model, kind, seed, tuple(values), mean, std, factor)
        return read.for_columns(parameters)
    except PriorError as error:
        raise PriorError(f"{path}: {error}", error.code) from None


def _read(path: Path) -> Any:
    try:
        return load_json(path)
    except OSError as error:
        raise PriorError(
            f"{path}: cannot read it ({error.strerror}); check the path", "E401"
        ) from None
    except ValueError as error:
        raise PriorError(
            f"{path}: not a prior.json ({error}); write one with `symbid prior`", "E402"
        ) from None


def _check_size(path: str, values: dict[str, tuple[float, float]]) -> None:
    """Reject values outside a robot's range, whose squares would overflow or underflow."""
    for name, (value, std) in values.items():
        if abs(value) > LARGEST:
            raise PriorError(
                f"{path}: {name} has value {value:g}, outside a robot's range; give at most "
                f"{LARGEST:g} in SI units",
                "E404",
            )
        if value < 0 and name.endswith("/m"):
            raise PriorError(
                f"{path}: {name} has value {value:g}; give a mass of 0 kg or more", "E404"
            )
        if 0 < std < LEAST_STD or std > LARGEST:
            raise PriorError(
                f"{path}: {name} has std {std:g}; give one from {LEAST_STD:g} to {LARGEST:g}, or "
                "drop `prior` and give `prior_percent`",
                "E404",
            )


def _check_belongs(
    path: str, model: str, values: dict[str, tuple[float, float]], parameters: ParameterSet
) -> None:
    robot = parameters.model
    inertial = parameters.names[: parameters.inertial]
    missing = [name for name in inertial if name not in values]
    known = set(ParameterSet(robot, TERMS).names)
    unknown = [name for name in values if name not in known]
    if model != robot.name or missing or unknown:
        detail = f"the name of that model is {robot.name!r}"
        if missing:
            detail = f"the prior lacks {missing[0]}"
        elif unknown:
            detail = f"that model has no {unknown[0]}"
        raise PriorError(
            f"{path}: this prior is for model {model!r}, not for {robot.source} ({detail}); draw "
            f"one with `symbid prior --model {robot.source}`",
            "E403",
        )
