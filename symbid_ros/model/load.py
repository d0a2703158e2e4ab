"""Load a robot model from a URDF or an MJCF."""

import logging
import xml.etree.ElementTree as ET
from contextlib import suppress
from pathlib import Path

import numpy as np

from symbid_ros.choices import BASES, Base
from symbid_ros.errors import DataError, ModelError, OptionError
from symbid_ros.model.inertia import ball_density
from symbid_ros.model.mjcf import load_mjcf
from symbid_ros.model.mjcf_source import read_mjcf
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.urdf import load_urdf
from symbid_ros.model.xml_file import as_element, read_xml
from symbid_ros.user_files import as_path

DENSEST = 2.3e4  # kg/m³, of osmium; half of a robot's links have 2e3 at most

logger = logging.getLogger(__name__)


def load_model(path: str | Path, base: Base = "auto") -> RobotModel:
    """Load a URDF or an MJCF; the root element decides which one it is.

    Elements that the equation of motion ignores and moving links without mass are logged.

    Parameters
    ----------
    path : str or Path
        ``.urdf`` or ``.xml`` file.
    base : {"auto", "floating", "fixed"}
        Whether the base may move. An MJCF says so by a free joint, which "floating" needs and
        "fixed" welds. "auto" takes the base of a URDF as floating unless its root is named
        ``world``. A floating joint below a massless ``world`` carries a base that floats.

    Returns
    -------
    RobotModel
        Joints, links and frames; masses in kg, lengths in m, angles in rad.

    Raises
    ------
    ModelError
        When the file is not a valid URDF or MJCF, or the base of an MJCF has no free joint
        although ``base`` is "floating".
    OptionError
        When ``base`` is none of these.
    DataError
        When ``path`` is not a path.
    """
    if base not in BASES:
        raise OptionError(f"base is {base!r}; choose from {', '.join(BASES)}", "E501")
    path = as_path("the model file", path)
    if not is_mjcf(path):
        model = load_urdf(path, base)
    else:
        model = load_mjcf(path, base)
        if base == "floating" and not model.floating:
            raise ModelError(
                f"{path}: its base has no free joint, so it is fixed; add <freejoint/> to the "
                "base, or drop `base` floating",
                "E115",
            )
        _report_ignored(path, model)
    _report_massless(model, is_base_known=base != "auto")
    _report_density(model)
    return model


def load_identified_model(path: Path, base: Base) -> RobotModel:
    """Load a model file of a result, whose masses may be negative if its method allows that.

    Raises
    ------
    ModelError
        As :func:`load_model`.
    """
    return load_model(path, base) if is_mjcf(path) else load_urdf(path, base, is_identified=True)


def as_model(robot: RobotModel | str | Path) -> RobotModel:
    """Return a robot, which may be given by the path of its file."""
    if isinstance(robot, RobotModel):
        return robot
    if isinstance(robot, str | Path):
        return load_model(robot)
    raise DataError(
        "robot must be a RobotModel (see symbid_ros.load_model) or the path of its file, not "
        f"{type(robot).__name__}",
        "E511",
    )


def _report_ignored(path: Path, model: RobotModel) -> None:
    """Log what MuJoCo simulates and the equation of motion lacks."""
    root = read_mjcf(path)
    joints = [joint for body in model.bodies for joint in body.joints]
    mimics = [{joint.name, joint.mimic[0]} for joint in joints if joint.mimic is not None]
    found = {tag: root.findall(f"{tag}/*") for tag in ("equality", "tendon")}
    found["equality"] = [
        one
        for one in found["equality"]
        if one.tag != "joint" or {one.get("joint1"), one.get("joint2")} not in mimics
    ]
    names = [each.get("name", f"<{each.tag}>") for group in found.values() for each in group]
    if names:
        follows = [
            f"{model.joint_names[joint]} follows {model.joint_names[mimic.leader]}"
            for joint, mimic in model.followers.items()
        ]
        tags = " and ".join(f"<{tag}>" for tag, group in found.items() if group)
        logger.warning(
            "%s: %s are ignored: %s; the joints are assumed to move independently%s",
            path,
            tags,
            ", ".join(names),
            f", except that {', '.join(follows)}" if follows else "",
        )
    bodies = [one for one in root.iter("body") if _is_above_zero(one, "gravcomp")]
    if bodies:
        logger.warning(
            "%s: gravcomp is ignored: %s; the motors are assumed to carry these bodies",
            path,
            ", ".join(each.get("name", "a body without a name") for each in bodies),
        )
    options = root.findall("option")
    media = [
        key for key in ("density", "viscosity") if any(_is_above_zero(one, key) for one in options)
    ]
    if media:
        logger.warning(
            "%s: %s of <option> is ignored; the robot is assumed to move in a vacuum",
            path,
            " and ".join(media),
        )
    if any(flag.get("gravity") == "disable" for flag in root.findall("option/flag")):
        logger.warning(
            '%s: <flag gravity="disable"/> is ignored: gravity is assumed to act on the robot; '
            'write <option gravity="0 0 0"/> if none does',
            path,
        )


def _is_above_zero(element: ET.Element, key: str) -> bool:
    with suppress(ValueError):  # MuJoCo reports it where it reads the attribute
        return float(element.get(key, "0")) > 0
    return False


def _report_massless(model: RobotModel, *, is_base_known: bool) -> None:
    # The log of an arm may yet tell that its base is fixed.
    first = 0 if model.floating and is_base_known else 1
    names = [
        link.name
        for link in model.links[first:]
        if not link.virtual and link.phi[0] == 0 and not np.any(link.phi)
    ]
    if names and model.has_mass:  # require_mass refuses others where inertias are needed
        logger.warning(
            "%s: %s no mass; give each an <inertial>, or fix its joint",
            model.source,
            f"link {names[0]} moves but has"
            if len(names) == 1
            else f"links {', '.join(names)} move but have",
        )


def _report_density(model: RobotModel) -> None:
    """Log that most links are denser than any body, as those whose masses are in grams."""
    found = [ball_density(link.phi) for link in model.links if link.phi[0] > 0]
    middle = float(np.median(found)) if found else 0.0
    if DENSEST < middle < np.inf:
        logger.warning(
            "%s: half of its links are denser than %.2g kg/m³: masses may be in g, or inertias in "
            "another unit; give kg and kg m²",
            model.source,
            middle,
        )


def model_files(path: Path) -> tuple[Path, ...]:
    """Return a model's file and those that it includes; the first alone if it cannot be read."""
    try:
        if not is_mjcf(path):
            return (path,)
        elements = read_mjcf(path).iter()
    except ModelError:
        return (path,)
    included = {as_element(one).file for one in elements} - {path}
    home = path.parent.resolve()
    return path, *(path.parent / file.relative_to(home) for file in sorted(included))


def is_mjcf(path: Path) -> bool:
    """Return whether a file is an MJCF. A URDF may contain a <mujoco> extension.

    Raises
    ------
    ModelError
        See :func:`symbid_ros.model.xml_file.read_xml`.
    """
    return read_xml(path).tag == "mujoco"
