"""Load a robot from whichever description format the user has."""

from pathlib import Path

from symbid_ros.errors import ModelError
from symbid_ros.model.mjcf import load_mjcf
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.urdf import Base, load_urdf
from symbid_ros.model.xml_tree import read_xml


def load_model(path: Path, base: Base = "auto") -> RobotModel:
    """Load a URDF or an MJCF, told apart by the root element.

    Parameters
    ----------
    path : Path
        ``.urdf`` or ``.xml`` file.
    base : {"auto", "floating", "fixed"}
        Whether the base may move. An MJCF states that itself, by a free joint; "floating" and
        "fixed" must agree with it.

    Raises
    ------
    ModelError
        When the file cannot be read as either, or an MJCF contradicts ``base``.
    """
    if not is_mjcf(path):
        return load_urdf(path, base)
    model = load_mjcf(path)
    if base == "fixed" and model.floating:
        raise ModelError(
            f"{path}: its base has a free joint, so it is not fixed; remove that joint, or drop "
            "--base fixed"
        )
    if base == "floating" and not model.floating:
        raise ModelError(
            f"{path}: its base has no free joint, so it is fixed; add <freejoint/> to the base, "
            "or drop --base floating"
        )
    return model


def is_mjcf(path: Path) -> bool:
    """Tell an MJCF from a URDF (which may hold a <mujoco> extension of its own).

    Raises
    ------
    ModelError
        When the file is refused by :func:`symbid_ros.model.xml_tree.read_xml`.
    """
    return read_xml(path).tag == "mujoco"
