"""Files of a result: estimate.json, information.npz and the robot as URDF and MJCF."""

import logging
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import check_writable, staged, write_text
from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import load_deviation_factor, write_archive
from symbid_ros.estimation.estimate import Estimate, load_estimate
from symbid_ros.estimation.prior import load_prior
from symbid_ros.identification.solver import Identification
from symbid_ros.model.export_mjcf import mjcf_files, replaced_values
from symbid_ros.model.export_urdf import unwritten, urdf_text
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet, terms_in
from symbid_ros.model.tree import RobotModel
from symbid_ros.safe_yaml import load_json

logger = logging.getLogger(__name__)

RESULT_FILES = "model.urdf", "model.xml", "information.npz", "estimate.json"


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
    """Write estimate.json, information.npz, model.urdf and model.xml into a folder, together.

    The user's own file is carried over in its format, with the files that it includes; the
    other is a bare tree. What a format cannot say of the estimate is logged, and written at the
    top of a bare tree.

    A file that cannot be written does not cost the others. The estimate and its information
    go to a temporary folder if this one has become unwritable.

    Raises
    ------
    EstimateError
        When a file could not be written; the message names that file and those saved.
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
        "model.xml": lambda path: _write_mjcf(path, export_mjcf(estimate, parameters, out)),
    }
    outputs = results | models
    try:
        with staged(out) as stage:
            failures = _written(outputs, stage, out)
    except SymbidError as error:
        failures = dict.fromkeys(outputs, str(error))
    _report_unwritten(parameters.apply(estimate.value), out)
    if not failures:
        return
    first = next(iter(failures.values()))
    saved = [name for name in outputs if name not in failures]
    done = f"{', '.join(saved)} written to {out}" if saved else ""
    if lost := {name: write for name, write in results.items() if name in failures}:
        done = ", ".join(filter(None, [done, _rescued(lost)]))
    raise EstimateError(f"{first}; {done}; not written: {', '.join(failures)}")


def _write_mjcf(path: Path, files: Mapping[PurePosixPath, str]) -> None:
    for place, text in files.items():
        write_text(path.parent / place, text)


def _report_unwritten(identified: RobotModel, out: Path) -> None:
    for name, remarks in (
        ("model.urdf", unwritten(identified)),
        ("model.xml", replaced_values(identified)),
    ):
        for remark in remarks:
            logger.warning("%s: %s", out / name, remark)


def _written(
    outputs: Mapping[str, Callable[[Path], object]], folder: Path, named: Path
) -> dict[str, str]:
    """Write files, and return by name what went wrong; messages show ``named`` as the folder."""
    failures = {}
    for name, write in outputs.items():
        try:
            write(folder / name)
        except SymbidError as error:
            failures[name] = str(error).replace(str(folder), str(named))
        except Exception as error:  # a fault of ours in one format must not cost the other files
            failures[name] = f"{named / name}: {type(error).__name__}: {error}"
    return failures


def _rescued(outputs: Mapping[str, Callable[[Path], object]]) -> str:
    """Write files into a new temporary folder, and return what was achieved."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="symbid_"))
    except OSError:
        return "no temporary folder is writable either"
    failures = _written(outputs, folder, folder)
    saved = [name for name in outputs if name not in failures]
    return f"{', '.join(saved) or 'nothing'} written to {folder} instead"


def export_urdf(estimate: Estimate, parameters: ParameterSet) -> str:
    """Return the identified robot as URDF text, the user's own file if it is one."""
    return _urdf(parameters, estimate.value, _warning(estimate))


def export_mjcf(
    estimate: Estimate, parameters: ParameterSet, folder: Path
) -> dict[PurePosixPath, str]:
    """Return the identified robot as MJCF for ``folder``, the user's own files if they are MJCF."""
    return _mjcf(parameters, estimate.value, folder, _warning(estimate))


def _urdf(parameters: ParameterSet, values: FloatArray, comment: str) -> str:
    source = Path(parameters.model.source)
    return urdf_text(parameters.apply(values), None if is_mjcf(source) else source, comment=comment)


def _mjcf(
    parameters: ParameterSet, values: FloatArray, folder: Path, comment: str
) -> dict[PurePosixPath, str]:
    source = Path(parameters.model.source)
    return mjcf_files(
        parameters.apply(values), source if is_mjcf(source) else None, folder, comment=comment
    )


def _warning(estimate: Estimate) -> str:
    impossible = [link for link, possible in estimate.consistent.items() if not possible]
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""


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
