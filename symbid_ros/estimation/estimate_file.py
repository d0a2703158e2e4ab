"""estimate.json: the file of an estimate, written and read."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from symbid_ros.atomic_write import write_text
from symbid_ros.choices import CHANNELS, FILTERS
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import MODEL_FILES, Estimate, HoldOut, RowSettings
from symbid_ros.estimation.provenance import InputFile, Provenance
from symbid_ros.estimation.unexplained import UnexplainedForce
from symbid_ros.estimation.verdict import EstimatedQuantity, Verdict
from symbid_ros.json_documents import VERSIONS, versioned, with_keys
from symbid_ros.user_files import load_json

Read = TypeVar("Read")

# Fields and their keys in the file, with units; earlier releases wrote the fields' names.
_ROWS = {"window": "window_s", "cutoff": "cutoff_hz", "rate": "rate_hz"}
_HOLDOUT = {"seconds": "duration_s"}
_VERDICT = {"window": "window_s", "gain": "gain_bits", "link_gain": "link_gain_bits"}


def estimate_document(estimate: Estimate) -> dict[str, object]:
    """Return the content of estimate.json; values that the method cannot give are None."""
    count = len(estimate.names)
    stds = [None] * count if estimate.std is None else estimate.std.tolist()
    verdicts = [None] * count if estimate.determined is None else estimate.determined.tolist()
    values, priors = estimate.value.tolist(), estimate.prior.tolist()
    document = {
        "method": estimate.method,
        "model": estimate.model,
        "parameters": {
            name: {
                "value": values[i],
                "std": stds[i],
                "prior": priors[i],
                "unit": estimate.units[i],
                "determined": verdicts[i],
            }
            for i, name in enumerate(estimate.names)
        },
        "rank": estimate.rank,
        "condition": estimate.condition,
        "samples": estimate.samples,
        "residual_rmse": estimate.residual_rmse,
        "consistent": estimate.consistent,
        "inputs": list(estimate.inputs),
        "software": estimate.software,
        "verdict": _entry(estimate.verdict, _VERDICT),
        "known": estimate.known,
        "rows": _entry(estimate.rows, _ROWS),
        "model_file": estimate.model_file,
        "base": estimate.base,
        "row_std": estimate.row_std,
        "holdout": _entry(estimate.holdout, _HOLDOUT),
        "joint_terms": estimate.joint_terms,
        "remarks": list(estimate.remarks),
        "wrist_sensors": list(estimate.wrist_sensors),
        "load_reference": estimate.load_reference,
        "changes_ns": [list(one) for one in estimate.courses],
        "contacts": list(estimate.contacts),
        "force_only": list(estimate.force_only),
        "end_stops": list(estimate.end_stops),
        "gravity": None if estimate.gravity is None else list(estimate.gravity),
        "held_joints": estimate.held_joints,
        "provenance": _entry(estimate.provenance),
    }
    return versioned("estimate", document)


def write_estimate(path: Path, estimate: Estimate) -> None:
    """Write estimate.json atomically."""
    write_text(path, json.dumps(estimate_document(estimate), indent=1) + "\n")


def _entry(value: Any, keys: Mapping[str, str] = MappingProxyType({})) -> dict[str, Any] | None:
    return None if value is None else with_keys(asdict(value), keys)


def load_estimate(path: Path) -> Estimate:
    """Read estimate.json.

    Raises
    ------
    EstimateError
        When the file is missing or is not an estimate.
    """
    try:
        document = load_json(path)
    except OSError as error:
        fault = f"{path}: cannot read it ({error.strerror}); check the path"
        folder = path.parent
        if path.name == "estimate.json" and not path.exists():
            found = "a file" if folder.exists() else "no such folder"
            fault = (
                f"{folder}: not a result of `symbid identify`, "
                f"{f'there is no {path.name}' if folder.is_dir() else found}; give the folder that "
                "it wrote"
            )
        raise EstimateError(fault, "E401") from None
    except ValueError as error:
        raise EstimateError(
            f"{path}: not an estimate.json ({error}); write one with `symbid identify`", "E409"
        ) from None
    _require_readable_version(path, document)
    try:
        entries = list(document["parameters"].values())
        stds = [entry["std"] for entry in entries]
        verdicts = [entry["determined"] for entry in entries]
        estimate = Estimate(
            method=document["method"],
            model=document["model"],
            names=tuple(document["parameters"]),
            units=tuple(entry["unit"] for entry in entries),
            value=np.array([entry["value"] for entry in entries], dtype=float),
            prior=np.array([entry["prior"] for entry in entries], dtype=float),
            std=None if None in stds else np.array(stds, dtype=float),
            determined=None if None in verdicts else np.array(verdicts, dtype=bool),
            rank=document["rank"],
            condition=document["condition"],
            samples=document["samples"],
            residual_rmse=document["residual_rmse"],
            consistent=document["consistent"],
            inputs=tuple(document["inputs"]),
            software=document["software"],
            verdict=_optional(_verdict, document["verdict"]),
            known=_numbers(document, "known"),
            rows=_optional(_rows, document.get("rows")),
            model_file=_one_of(document.get("model_file", ""), ("", *MODEL_FILES)),
            base=_one_of(document.get("base", ""), ("", "floating", "fixed")),
            row_std=_numbers(document, "row_std"),
            holdout=_optional(_holdout, document.get("holdout")),
            joint_terms=_optional(_joint_terms, document.get("joint_terms")),
            remarks=tuple(document.get("remarks", ())),
            wrist_sensors=tuple(map(str, document.get("wrist_sensors", ()))),
            load_reference=_numbers(document, "load_reference"),
            courses=tuple((int(a), int(b)) for a, b in document.get("changes_ns", ())),
            contacts=tuple(map(str, document.get("contacts", ()))),
            force_only=tuple(map(str, document.get("force_only", ()))),
            end_stops=tuple(map(str, document.get("end_stops", ()))),
            gravity=_optional(_vector, document.get("gravity")),
            held_joints=_numbers(document, "held_joints"),
            provenance=_optional(_provenance, document.get("provenance")),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise EstimateError(
            f"{path}: not an estimate.json ({type(error).__name__}: {error}); write one with "
            "`symbid identify`",
            "E409",
        ) from None
    for kind, numbers in (("value", estimate.value), ("prior", estimate.prior)):
        if not np.all(np.isfinite(numbers)):
            name = estimate.names[int(np.argmin(np.isfinite(numbers)))]
            raise EstimateError(
                f"{path}: {kind} of {name} is not finite; identify the log again", "E409"
            )
    return estimate


def _require_readable_version(path: Path, document: Any) -> None:
    """Raise an error for a file of a later release, whose keys may have another meaning."""
    version = document.get("schema_version", 0) if isinstance(document, dict) else 0
    known = VERSIONS["estimate"]
    if isinstance(version, int) and version > known:
        raise EstimateError(
            f"{path}: schema_version {version} is of a later release, this one reads up to "
            f"{known}; update symbid_ros",
            "E475",
        )


def _optional(read: Callable[[Any], Read], value: Any) -> Read | None:
    return None if value is None else read(value)


def _provenance(document: dict[str, Any]) -> Provenance:
    inputs = tuple(InputFile(**one) for one in document["inputs"])
    if not isinstance(document["options"], dict):
        raise TypeError("the provenance's options are not a mapping")
    return Provenance(**(document | {"inputs": inputs}))


def _with_field_names(document: dict[str, Any], keys: Mapping[str, str]) -> dict[str, Any]:
    return with_keys(document, {key: name for name, key in keys.items()})


def _rows(document: dict[str, Any]) -> RowSettings:
    document = _with_field_names(document, _ROWS)
    values = document["window"], document["cutoff"], document.get("rate")
    numbers = [one for one in values if one is not None]
    if any(isinstance(one, bool) or not 0 <= one < np.inf for one in numbers):
        raise ValueError("rows has a window, cutoff or rate that is negative or not finite")
    _one_of(document["filter"], FILTERS)
    _one_of(document["channels"], (None, *CHANNELS))
    return RowSettings(**document)


def _one_of(value: Any, allowed: Sequence[Any]) -> Any:
    if value not in allowed:
        raise ValueError(f"{value!r} is not one of {', '.join(map(repr, allowed))}")
    return value


def _numbers(document: dict[str, Any], name: str) -> dict[str, float]:
    numbers = {key: float(value) for key, value in document.get(name, {}).items()}
    if not np.all(np.isfinite(list(numbers.values()))):
        raise ValueError(f"{name} has a number that is not finite")
    return numbers


def _vector(values: Sequence[Any]) -> tuple[float, ...]:
    vector = tuple(float(one) for one in values)
    if len(vector) != 3 or not np.all(np.isfinite(vector)):
        raise ValueError("gravity is not a vector of three numbers")
    return vector


def _holdout(document: dict[str, Any]) -> HoldOut:
    document = _with_field_names(document, _HOLDOUT)
    coordinates = {
        name: (float(before), float(after))
        for name, (before, after) in document["coordinates"].items()
    }
    return HoldOut(**(document | {"coordinates": coordinates}))


def _joint_terms(document: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    return {joint: tuple(map(str, terms)) for joint, terms in document.items()}


def _verdict(document: dict[str, Any]) -> Verdict:
    document = _with_field_names(document, _VERDICT)
    lists = {name: tuple(document[name]) for name in ("alarms", "directions")}
    quantities = {
        name: tuple(EstimatedQuantity(**entry) for entry in document[name])
        for name in ("base", "sensors")
    }
    # Earlier versions did not write the unexplained forces.
    unexplained = tuple(UnexplainedForce(**one) for one in document.get("unexplained", ()))
    return Verdict(**(document | lists | quantities | {"unexplained": unexplained}))
