"""The robot as simulated where it differs from its model file: friction and other lengths."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.friction import JointFriction

# The shortest MuJoCo allows at a period of 1 ms: Coulomb friction then either has its full value
# or stops the joint within the period. By default joints creep, at up to .1 rad/s here.
FRICTION_TIME_CONSTANT = 2e-3  # s


def variant_text(
    path: Path, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> str:
    """Return an MJCF file's text with other joints and lengths.

    Parameters
    ----------
    path : Path
        MJCF that MuJoCo compiles, bodies and joints in the file itself.
    friction : mapping of str to JointFriction
        By joint name.
    lengths : mapping of str to float
        By joint name: how much further from its parent's origin the joint's body lies, m. A
        body at its parent's origin stays there.

    Raises
    ------
    SimulationError
        When a joint is not in the file.
    """
    root = ET.parse(path, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    joints = {element.get("name"): element for element in root.iterfind("worldbody//joint")}
    missing = [name for name in (*friction, *lengths) if name not in joints]
    if missing:
        raise SimulationError(
            f"{path}: no joint {missing[0]} to change; name joints of the file's own worldbody"
        )
    for name, values in friction.items():
        for attribute, value in asdict(values).items():
            joints[name].set(attribute, repr(value))
        joints[name].set("solreffriction", f"{FRICTION_TIME_CONSTANT} 1")
    if friction:
        _integrate_explicitly(root)
    for body in root.iterfind("worldbody//body"):
        names = [joint.get("name") for joint in body.findall("joint")]
        _lengthen(body, sum(lengths.get(str(name), 0.0) for name in names))
    return ET.tostring(root, encoding="unicode") + "\n"


def _integrate_explicitly(root: ET.Element) -> None:
    # Damping taken implicitly would make the velocity's rate differ from the acceleration of
    # the equation of motion, by a per cent in the light joints: a log of two truths.
    option = root.find("option")
    if option is None:
        option = ET.SubElement(root, "option")
    option.set("integrator", "Euler")
    flag = option.find("flag")
    if flag is None:
        flag = ET.SubElement(option, "flag")
    flag.set("eulerdamp", "disable")


def _lengthen(body: ET.Element, amount: float) -> None:
    offset = np.array(body.get("pos", "0 0 0").split(), dtype=np.float64)
    length = float(np.linalg.norm(offset))
    if amount and length > 0.0:
        longer = offset * (1.0 + amount / length)
        body.set("pos", " ".join(repr(float(value)) for value in longer))
