"""An estimate as files: estimate.json, information.npz and the robot in both formats."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic import check_writable, write_text
from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.identification import Identification


def check_output(parameters: ParameterSet, out: Path) -> None:
    """Refuse a folder or a robot that could not be written once the work is done.

    Raises
    ------
    SymbidError
        When the folder cannot be written to or the robot has no text in one of the formats.
    """
    check_writable(out)
    _urdf(parameters, parameters.values, "")
    _mjcf(parameters, parameters.values, out, "")


def write_identification(found: Identification, parameters: ParameterSet, out: Path) -> None:
    """Write estimate.json, information.npz, model.urdf and model.xml into a folder.

    The user's own file is carried over in its format; the other is a bare tree. A
    comment in both names the links that no mass density can realise: programs that check,
    such as MuJoCo, refuse to load those.

    No file waits for another: what fails does not cost the rest. The estimate and its information
    go to a temporary folder if this one has become unwritable.

    Raises
    ------
    EstimateError
        When a file could not be written; the message names it and what was saved.
    """
    estimate = found.estimate
    results: dict[str, Callable[[Path], object]] = {
        "information.npz": lambda path: write_archive(
            path, found.observations, found.deviation_factor
        ),
        "estimate.json": estimate.write,
    }
    models: dict[str, Callable[[Path], object]] = {
        "model.urdf": lambda path: write_text(path, export_urdf(estimate, parameters)),
        "model.xml": lambda path: write_text(path, export_mjcf(estimate, parameters, out)),
    }
    failures = _written(results | models, out)
    if not failures:
        return
    first = next(iter(failures.values()))
    saved = [name for name in (*results, *models) if name not in failures]
    told = f"{', '.join(saved)} written to {out}" if saved else ""
    if lost := {name: write for name, write in results.items() if name in failures}:
        told = ", ".join(filter(None, [told, _rescued(lost)]))
    raise EstimateError(f"{first}; {told}; not written: {', '.join(failures)}")


def _written(outputs: Mapping[str, Callable[[Path], object]], folder: Path) -> dict[str, str]:
    """Write files by their names, and return by name what went wrong with the others."""
    failures = {}
    for name, write in outputs.items():
        try:
            write(folder / name)
        except SymbidError as error:
            failures[name] = str(error)
        except Exception as error:  # a fault of ours in one format must not cost the other files
            failures[name] = f"{folder / name}: {type(error).__name__}: {error}"
    return failures


def _rescued(outputs: Mapping[str, Callable[[Path], object]]) -> str:
    """Write files into a new temporary folder, and return what was achieved."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="symbid_"))
    except OSError:
        return "no temporary folder is writable either"
    failures = _written(outputs, folder)
    saved = [name for name in outputs if name not in failures]
    return f"{', '.join(saved) or 'nothing'} written to {folder} instead"


def export_urdf(estimate: Estimate, parameters: ParameterSet) -> str:
    """Return the identified robot as URDF text, the user's own file if it is one."""
    return _urdf(parameters, estimate.value, _warning(estimate))


def export_mjcf(estimate: Estimate, parameters: ParameterSet, folder: Path) -> str:
    """Return the identified robot as MJCF text for ``folder``, the user's own file if it is one."""
    return _mjcf(parameters, estimate.value, folder, _warning(estimate))


def _urdf(parameters: ParameterSet, values: FloatArray, comment: str) -> str:
    source = Path(parameters.model.source)
    return urdf_text(parameters.apply(values), None if is_mjcf(source) else source, comment=comment)


def _mjcf(parameters: ParameterSet, values: FloatArray, folder: Path, comment: str) -> str:
    source = Path(parameters.model.source)
    return mjcf_text(
        parameters.apply(values), source if is_mjcf(source) else None, folder, comment=comment
    )


def _warning(estimate: Estimate) -> str:
    impossible = [link for link, possible in estimate.consistent.items() if not possible]
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""
