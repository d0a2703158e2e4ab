"""An estimate as files: estimate.json, information.npz and the robot in both formats."""

import logging
from pathlib import Path, PurePosixPath

from symbid_ros.atomic import staged, write_text
from symbid_ros.estimation.archive import write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.export_mjcf import mjcf_files, replaced_values
from symbid_ros.model.export_urdf import unwritten, urdf_text
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.identification import Identification

logger = logging.getLogger(__name__)

RESULT_FILES = "model.urdf", "model.xml", "information.npz", "estimate.json"


def write_identification(found: Identification, parameters: ParameterSet, out: Path) -> None:
    """Write estimate.json, information.npz, model.urdf and model.xml into a folder, all or none.

    The user's own file is carried over in its format, with the files that it includes; the
    other is a bare tree. What a format cannot say of the estimate is logged, and written at the
    top of a bare tree.
    """
    estimate = found.estimate
    with staged(out) as stage:
        write_text(stage / "model.urdf", export_urdf(estimate, parameters))
        for place, text in export_mjcf(estimate, parameters, out).items():
            write_text(stage / place, text)
        write_archive(stage / "information.npz", found.observations, found.deviation_factor)
        estimate.write(stage / "estimate.json")
    identified = parameters.apply(estimate.value)
    for name, remarks in (
        ("model.urdf", unwritten(identified)),
        ("model.xml", replaced_values(identified)),
    ):
        for remark in remarks:
            logger.warning("%s: %s", out / name, remark)


def export_urdf(estimate: Estimate, parameters: ParameterSet) -> str:
    """Return the identified robot as URDF text, the user's own file if it is one."""
    source = Path(parameters.model.source)
    return urdf_text(
        parameters.apply(estimate.value),
        None if is_mjcf(source) else source,
        comment=_warning(estimate),
    )


def export_mjcf(
    estimate: Estimate, parameters: ParameterSet, folder: Path
) -> dict[PurePosixPath, str]:
    """Return the identified robot as MJCF for ``folder``, the user's own files if they are MJCF."""
    source = Path(parameters.model.source)
    return mjcf_files(
        parameters.apply(estimate.value),
        source if is_mjcf(source) else None,
        folder,
        comment=_warning(estimate),
    )


def _warning(estimate: Estimate) -> str:
    impossible = [link for link, possible in estimate.consistent.items() if not possible]
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""
