"""Files of a result: estimate, information, data of the report, and the robot as URDF and MJCF."""

import logging
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import check_output_folder, staged, write_text
from symbid_ros.choices import JOINT_TERMS
from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import (
    SensorCalibration,
    load_calibration,
    load_deviation_factor,
    write_archive,
)
from symbid_ros.estimation.estimate import MODEL_FILES, Estimate
from symbid_ros.estimation.estimate_file import load_estimate, write_estimate
from symbid_ros.estimation.prior_file import load_prior
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.report_data import FILE_NAME as REPORT_DATA
from symbid_ros.model.export_mjcf import mjcf_files, replaced_values
from symbid_ros.model.export_urdf import unwritten, urdf_text
from symbid_ros.model.held_joints import with_held_joints, without_held_joints
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import sensor_frame, with_wrist_sensors
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.user_files import load_json

logger = logging.getLogger(__name__)

RESULT_FILES = *MODEL_FILES, "information.npz", "estimate.json", REPORT_DATA
# With identified joint placements.
CALIBRATED = "calibrated.urdf", "calibrated.xml"
# Joints or links that a warning names at most.
MOST_NAMED = 3


def check_output(parameters: ParameterSet, out: Path) -> None:
    """Check that the results can be written, before the work starts.

    Raises
    ------
    SymbidError
        When the folder is not writable or is a bag, or the robot cannot be expressed in one of the
        formats.
    """
    check_output_folder(out)
    _urdf(parameters, parameters.values)
    _mjcf(parameters, parameters.values, out)


def write_identification(
    found: Identification, parameters: ParameterSet, out: Path, *, kinematics: bool = False
) -> tuple[str, ...]:
    """Write the files of a result (``RESULT_FILES``) into a folder, together; return their names.

    The user's model file keeps everything but the inertial parameters, together with the files that
    it includes. The other format holds the kinematic tree only. Parameters that a format cannot
    express are logged, and listed at the top of such a tree. With ``kinematics``, the files
    ``CALIBRATED`` hold the same robot with the identified joint placements. ``MODEL_FILES`` keep
    those of the user's file, to which the identified placements are added in predictions.

    If a file cannot be written, the folder is left as it is, so that it never holds files of two
    results. All that can be written goes to a temporary folder.

    Raises
    ------
    EstimateError
        When a file could not be written; the message names the temporary folder and what it holds.
    """
    estimate = found.estimate
    of_model = replace(
        estimate,
        model_file=_model_file(parameters.model),
        base="floating" if parameters.model.floating else "fixed",
    )

    def outputs(place: Path) -> dict[str, Callable[[Path], object]]:
        """Return what writes each file of a result that will lie in a folder."""
        writers: dict[str, Callable[[Path], object]] = {
            "information.npz": lambda path: write_archive(
                path,
                found.observations,
                found.deviation_factor,
                found.calibration,
                found.correlation,
            ),
            "estimate.json": lambda path: write_estimate(path, of_model),
            "model.urdf": lambda path: write_text(path, export_urdf(estimate, parameters)),
            "model.xml": lambda path: _write_mjcf(path, export_mjcf(estimate, parameters, place)),
        }
        if found.report is not None:
            writers[REPORT_DATA] = found.report.write
        if kinematics:
            placed, before, (urdf, mjcf) = _placed(found, parameters), parameters.model, CALIBRATED
            writers |= {
                urdf: lambda path: write_text(path, export_urdf(estimate, placed, before)),
                mjcf: lambda path: _write_mjcf(
                    path, export_mjcf(estimate, placed, place, mjcf, before)
                ),
            }
        return writers

    try:
        with staged(out) as stage:
            failures = _write_all(outputs(out), stage, out)
            if failures:
                raise EstimateError(next(iter(failures.values())), "E522")
    except SymbidError as error:
        raise EstimateError(f"{error}; {_write_to_temporary_folder(outputs)}", "E522") from None
    _log_unwritten(parameters, estimate, out)
    if found.report is None:  # that of an earlier result does not belong to this one
        (out / REPORT_DATA).unlink(missing_ok=True)
    return tuple(sorted(outputs(out)))


def _model_file(model: RobotModel) -> str:
    """Return the name of the exported file that has the kinematics of the user's file."""
    try:
        return MODEL_FILES[is_mjcf(Path(model.source))]
    except SymbidError:  # the file has gone; estimate.json is written all the same
        return ""


def _write_mjcf(path: Path, files: Mapping[PurePosixPath, str]) -> None:
    for place, text in files.items():
        write_text(path.parent / place, text)


def _log_unwritten(parameters: ParameterSet, estimate: Estimate, out: Path) -> None:
    """Warn about identified parameters that the model files cannot hold."""
    values = estimate.value.copy()
    if estimate.determined is not None and estimate.joint_terms is not None:
        # Terms that the data neither ask for nor exclude stay free without being known.
        terms = np.arange(len(values)) >= parameters.inertial
        values[terms & ~estimate.determined] = 0.0
    identified = without_held_joints(parameters.apply(values))
    lost: list[str] = [
        term
        for term, columns in parameters.term_columns.items()
        if JOINT_TERMS[term].field is None and np.any(values[columns])
    ]
    lost += [
        f"friction and armature of {coupling.label}"
        for coupling, columns in parameters.coupling_columns.items()
        if np.any(values[list(columns.values())])
    ]
    lost += [
        f"ripple of {ripple.label(parameters.model)}"
        for ripple, columns in parameters.ripple_columns.items()
        if np.any(values[columns])
    ]
    if lost:
        logger.warning(
            "%s: only estimate.json holds %s; efforts computed from model.urdf or model.xml leave "
            "this out",
            out,
            ", ".join(lost),
        )
    impossible = estimate.impossible_links
    kept = f"impossible bodies, which other programs may refuse: {', '.join(impossible)}"
    for name, remarks in (
        ("model.urdf", (*([kept] if impossible else []), *unwritten(identified))),
        ("model.xml", replaced_values(identified)),
    ):
        for remark in remarks:
            logger.warning("%s: %s", out / name, _shortened(remark))


def _shortened(remark: str) -> str:
    """Return a remark about many joints or links with the first of them; estimate.json has all."""
    what, _, found = remark.partition(": ")
    each = found.split(", ")
    more = f" and {len(each) - MOST_NAMED} more" if len(each) > MOST_NAMED else ""
    return f"{what}: {', '.join(each[:MOST_NAMED])}{more}"


def _write_all(
    outputs: Mapping[str, Callable[[Path], object]], folder: Path, named: Path
) -> dict[str, str]:
    """Write files and return the errors by file name; messages show ``named`` as the folder."""
    failures = {}
    for name, write in outputs.items():
        try:
            write(folder / name)
        except SymbidError as error:
            failures[name] = str(error).replace(str(folder), str(named))
        except Exception as error:  # a bug in one format must not lose the other files
            failures[name] = f"{named / name}: {type(error).__name__}: {error}"
    return failures


def _write_to_temporary_folder(
    outputs: Callable[[Path], Mapping[str, Callable[[Path], object]]],
) -> str:
    """Write files into a new temporary folder and return a description of the result."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="symbid_"))
    except OSError:
        return "no temporary folder is writable either"
    failures = _write_all(outputs(folder), folder, folder)
    saved = [name for name in outputs(folder) if name not in failures]
    if not saved:
        shutil.rmtree(folder, ignore_errors=True)
        return "no file could be written to a temporary folder either"
    lost = f"; not written: {', '.join(failures)}" if failures else ""
    return f"{', '.join(saved)} written to {folder} instead{lost}"


def _placed(found: Identification, parameters: ParameterSet) -> ParameterSet:
    """Return the parameters with the joint placements that were identified, if any."""
    if not isinstance(found.rows, CalibratingRows):
        return parameters
    return found.rows.errors.placed(parameters, found.unknowns[len(parameters) :])


def export_urdf(
    estimate: Estimate, parameters: ParameterSet, before: RobotModel | None = None
) -> str:
    """Return the identified robot as URDF, based on the user's file if that is a URDF.

    ``before`` has the joint placements of that file, if those of the parameters differ.
    """
    return _urdf(parameters, estimate.value, _warning(estimate), before)


def export_mjcf(
    estimate: Estimate,
    parameters: ParameterSet,
    folder: Path,
    name: str = MODEL_FILES[1],
    before: RobotModel | None = None,
) -> dict[PurePosixPath, str]:
    """Return the identified robot as MJCF for ``folder``, based on the user's files if MJCF.

    ``before`` has the joint placements of those files, if those of the parameters differ.
    """
    return _mjcf(parameters, estimate.value, folder, _warning(estimate), name, before=before)


def _urdf(
    parameters: ParameterSet,
    values: FloatArray,
    comment: str = "",
    before: RobotModel | None = None,
) -> str:
    source = Path(parameters.model.source)
    return urdf_text(
        without_held_joints(parameters.apply(values)),
        None if is_mjcf(source) else source,
        comment=comment,
        before=before,
    )


def _mjcf(
    parameters: ParameterSet,
    values: FloatArray,
    folder: Path,
    comment: str = "",
    name: str = MODEL_FILES[1],
    *,
    before: RobotModel | None = None,
) -> dict[PurePosixPath, str]:
    source = Path(parameters.model.source)
    return mjcf_files(
        without_held_joints(parameters.apply(values)),
        source if is_mjcf(source) else None,
        folder,
        name=name,
        comment=comment,
        before=before,
    )


def _warning(estimate: Estimate) -> str:
    impossible = estimate.impossible_links
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""


@dataclass(frozen=True)
class EstimatedModel:
    """A robot's parameters as read from files, with their estimate and covariance if available.

    Attributes
    ----------
    parameters : ParameterSet
        The p columns.
    values : (p,) float64
        SI units.
    estimate : Estimate or None
        With parameters in the order of the columns; None for a prior.
    deviation_factor : (p, r) float64 or None
        L of the posterior covariance L Lᵀ; None if there is none.
    calibration : SensorCalibration or None
        None without identified sensor errors.
    """

    parameters: ParameterSet
    values: FloatArray
    estimate: Estimate | None = None
    deviation_factor: FloatArray | None = None
    calibration: SensorCalibration | None = None


def load_estimated_model(path: Path, model: RobotModel) -> EstimatedModel:
    """Read the folder of an identification, an estimate.json or a prior.json.

    Raises
    ------
    EstimateError, PriorError
        When a file is missing, malformed or of another robot.
    """
    file = path / "estimate.json" if path.is_dir() else path
    if _is_prior(file):
        parameters = ParameterSet(model)
        return EstimatedModel(parameters, load_prior(file, parameters).mean)
    estimate = load_estimate(file)
    _require_sensor_frames(file, estimate, model)
    model = with_held_joints(model, estimate.held_joints)
    model = with_wrist_sensors(model, estimate.wrist_sensors)
    if estimate.gravity is not None and not model.floating:
        model = replace(model, gravity=np.array(estimate.gravity))
    _require_links(file, estimate, model)
    # The model may be the true robot, with friction that the estimate does not have.
    parameters = estimate.parameters_of(model)
    if set(parameters.names) != set(estimate.names):
        raise EstimateError(
            f"{file}: its parameters, of model {estimate.model!r}, are not those of "
            f"{model.source}; give the model it was identified with",
            "E512",
        )
    order = [estimate.names.index(name) for name in parameters.names]
    ordered = _ordered(estimate, order)
    archive = path / "information.npz"
    if not archive.is_file():
        return EstimatedModel(parameters, ordered.value, ordered)
    factor = load_deviation_factor(archive)
    if factor is not None:
        if factor.ndim != 2 or len(factor) != len(order):
            raise EstimateError(
                f"{archive}: its covariance does not belong to the {len(order)} parameters of "
                f"{file.name}; identify the log again",
                "E523",
            )
        factor = factor[order]
    calibration = load_calibration(archive)
    if calibration is not None:
        calibration = _calibration_in_order(calibration, order, estimate, factor, archive)
    return EstimatedModel(parameters, ordered.value, ordered, factor, calibration)


def _require_sensor_frames(file: Path, estimate: Estimate, model: RobotModel) -> None:
    """Raise an error if a model lacks a wrist sensor's frame, which the identified log had."""
    known = {*(frame.name for frame in model.frames), *model.link_names}
    for frame in map(sensor_frame, estimate.wrist_sensors):
        if frame not in known:
            raise EstimateError(
                f"{file}: {model.source} has no frame {frame} of its wrist sensor, which "
                "/tf_static of the identified log fixed; add it to the robot's model file as a "
                "link with a fixed joint, and identify again with that file",
                "E116",
            )


def _require_links(file: Path, estimate: Estimate, model: RobotModel) -> None:
    """Check that the links of an estimate are those of a model, before its joints are looked up."""
    masses = (
        {name for name in names if name.endswith("/m")}
        for names in (estimate.names, ParameterSet(model).names)
    )
    if differing := set.symmetric_difference(*masses):
        link = min(differing).removesuffix("/m")
        raise EstimateError(
            f"{model.source} is not the robot of {file}: only one of them has the link {link!r}; "
            "give the model that was identified",
            "E512",
        )


def _calibration_in_order(
    calibration: SensorCalibration,
    order: list[int],
    estimate: Estimate,
    factor: FloatArray | None,
    archive: Path,
) -> SensorCalibration:
    """Return the calibration with the robot's parameters in another order."""
    count = 0 if estimate.verdict is None else len(estimate.verdict.sensors)
    size = 0 if factor is None else factor.shape[1]
    if calibration.factor.shape != (count, size) or len(calibration.linearization) != (
        len(order) + count
    ):
        raise EstimateError(
            f"{archive}: its sensor errors are not those of estimate.json; identify the log again",
            "E523",
        )
    point = calibration.linearization
    return SensorCalibration(
        calibration.factor, np.concatenate([point[: len(order)][order], point[len(order) :]])
    )


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
    """Return whether a file is a prior; an unreadable file fails later, as an estimate."""
    try:
        document = load_json(file)
    except (OSError, ValueError):
        return False
    return isinstance(document, dict) and "kind" in document and "method" not in document
