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
        Whether the base may move; an MJCF says so itself and accepts only "auto".

    Raises
    ------
    ModelError
        When the file cannot be read as either.
    """
    if not is_mjcf(path):
        return load_urdf(path, base)
    if base != "auto":
        raise ModelError(f"{path}: an MJCF says itself whether its base floats; drop --base {base}")
    return load_mjcf(path)


def is_mjcf(path: Path) -> bool:
    """Tell an MJCF from a URDF (which may hold a <mujoco> extension of its own).

    Raises
    ------
    ModelError
        When the file is refused by :func:`symbid_ros.model.xml_tree.read_xml`.
    """
    return read_xml(path).tag == "mujoco"
