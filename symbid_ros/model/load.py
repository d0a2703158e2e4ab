"""Load a robot from whichever description format the user has."""

from pathlib import Path

from symbid_ros.errors import ModelError
from symbid_ros.model.mjcf import load_mjcf
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.urdf import Base, load_urdf


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
    try:
        head = path.read_bytes()[:65536]
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read the model ({error.strerror}); check the path"
        ) from None
    if b"<mujoco" not in head or b"<robot" in head:
        return load_urdf(path, base)
    if base != "auto":
        raise ModelError(f"{path}: an MJCF says itself whether its base floats; drop --base {base}")
    return load_mjcf(path)
