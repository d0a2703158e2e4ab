"""An estimate as files: estimate.json, information.npz and the robot in both formats."""

from pathlib import Path

from symbid_ros.atomic import staged, write_text
from symbid_ros.estimation.archive import write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.identification import Identification


def write_identification(found: Identification, parameters: ParameterSet, out: Path) -> None:
    """Write estimate.json, information.npz, model.urdf and model.xml into a folder, all or none.

    The user's own file is carried over in its format; the other is a bare tree. A
    comment in both names the links that no mass density can realise: programs that check,
    such as MuJoCo, refuse to load those.
    """
    estimate = found.estimate
    with staged(out) as stage:
        write_text(stage / "model.urdf", export_urdf(estimate, parameters))
        write_text(stage / "model.xml", export_mjcf(estimate, parameters, out))
        write_archive(stage / "information.npz", found.observations, found.deviation_factor)
        estimate.write(stage / "estimate.json")


def export_urdf(estimate: Estimate, parameters: ParameterSet) -> str:
    """Return the identified robot as URDF text, the user's own file if it is one."""
    source = Path(parameters.model.source)
    return urdf_text(
        parameters.apply(estimate.value),
        None if is_mjcf(source) else source,
        comment=_warning(estimate),
    )


def export_mjcf(estimate: Estimate, parameters: ParameterSet, folder: Path) -> str:
    """Return the identified robot as MJCF text for ``folder``, the user's own file if it is one."""
    source = Path(parameters.model.source)
    return mjcf_text(
        parameters.apply(estimate.value),
        source if is_mjcf(source) else None,
        folder,
        comment=_warning(estimate),
    )


def _warning(estimate: Estimate) -> str:
    impossible = [link for link, possible in estimate.consistent.items() if not possible]
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""
