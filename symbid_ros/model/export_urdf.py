"""Write a robot as URDF: into the user's own file, or as a bare tree."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.rotation import rpy_from_rotation
from symbid_ros.model.tree import Joint, RobotModel

# urdfdom demands numbers for effort and velocity and does not read "inf".
_UNLIMITED = 1e9


def urdf_text(model: RobotModel, source: Path | None = None, *, comment: str = "") -> str:
    """Return the robot as URDF text.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    source : Path, optional
        The URDF that ``model`` was loaded from. Everything in it but the inertias and
        changed joint friction is kept. A link welded to another lends its inertia to the
        link that moves, so its own ``<inertial>`` is taken out. Without it a bare tree
        is written.
    comment : str
        What to say at the top of the file; negative friction, which is written as zero,
        and armature, for which a URDF has no place, are added to it.
    """
    model, negative = without_negative_terms(model)
    armature = [f"{j.name} {j.armature:.6g}" for j in model.joints if j.armature != 0.0]
    unwritten = f"armature, not part of a URDF: {', '.join(armature)}" if armature else ""
    robot = _bare(model) if source is None else _patched(model, source)
    annotate(robot, comment, negative, unwritten)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _patched(model: RobotModel, source: Path) -> ET.Element:
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    robot = ET.parse(source, parser).getroot()
    index = {link.name: link for link in model.links}
    for element in robot.findall("link"):
        name = element.get("name", "")
        for old in element.findall("inertial"):
            element.remove(old)
        if name in index and np.any(index[name].phi):
            element.insert(0, _inertial(index[name].phi))
    joints = {joint.name: joint for joint in model.joints}
    for element in robot.findall("joint"):
        name = element.get("name", "")
        if name in joints:
            _set_dynamics(element, joints[name])
    return robot


def _set_dynamics(element: ET.Element, joint: Joint) -> None:
    """Write the joint's friction where the element says otherwise; silence means zero."""
    dynamics = element.find("dynamics")
    for key, value in (("damping", joint.damping), ("friction", joint.friction_loss)):
        stated = 0.0 if dynamics is None else float(dynamics.get(key, "0"))
        if value != stated:
            if dynamics is None:
                dynamics = ET.SubElement(element, "dynamics")
            dynamics.set(key, repr(float(value)))


def _bare(model: RobotModel) -> ET.Element:
    robot = ET.Element("robot", name=model.name)
    fixed_world = not model.floating and model.links[0].name != "world"
    if fixed_world:
        ET.SubElement(robot, "link", name="world")
        rotation = _rotation_of_gravity(model.gravity)
        _fixed_joint(robot, "world", model.links[0].name, rotation, np.zeros(3))
    for link in model.links:
        element = ET.SubElement(robot, "link", name=link.name)
        if np.any(link.phi):
            element.append(_inertial(link.phi))
    for index, joint in enumerate(model.joints):
        _joint(robot, model, joint, model.links[index + 1].name)
    for frame in model.frames:
        if frame.name not in model.link_names:
            ET.SubElement(robot, "link", name=frame.name)
            parent = model.links[frame.link].name
            _fixed_joint(robot, parent, frame.name, frame.rotation, frame.translation)
    return robot


def _rotation_of_gravity(gravity: FloatArray) -> FloatArray:
    """Return the base's rotation in a z-up world, given gravity in the base's axes."""
    up = -gravity / np.linalg.norm(gravity)
    if up[2] > 1 - 1e-15:
        return np.eye(3)
    side = np.eye(3)[np.argmin(np.abs(up))]
    forward = side - up * (side @ up)
    forward /= np.linalg.norm(forward)
    return np.array([forward, np.cross(up, forward), up])


def _joint(robot: ET.Element, model: RobotModel, joint: Joint, child: str) -> None:
    bounded = np.isfinite([joint.lower, joint.upper]).all()
    kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
    # A URDF joint is zero where the file's pose holds, so a reference is folded into the pose.
    translation = joint.translation
    if joint.kind == "prismatic":
        translation = translation - joint.reference * (joint.rotation @ joint.axis)
    element = ET.SubElement(robot, "joint", name=joint.name, type=kind)
    _origin(element, _at_zero(joint), translation)
    ET.SubElement(element, "parent", link=model.links[joint.parent].name)
    ET.SubElement(element, "child", link=child)
    ET.SubElement(element, "axis", xyz=numbers(joint.axis))
    limit = ET.SubElement(element, "limit")
    if kind != "continuous":
        limit.set("lower", repr(float(joint.lower)))
        limit.set("upper", repr(float(joint.upper)))
    limit.set("effort", repr(min(float(joint.effort), _UNLIMITED)))
    limit.set("velocity", repr(_UNLIMITED))
    _set_dynamics(element, joint)


def _at_zero(joint: Joint) -> FloatArray:
    if joint.kind == "prismatic" or joint.reference == 0.0:
        return joint.rotation
    x, y, z = joint.axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    s, c = np.sin(-joint.reference), np.cos(-joint.reference)
    turn = c * np.eye(3) + s * cross + (1 - c) * np.outer(joint.axis, joint.axis)
    rotation: FloatArray = joint.rotation @ turn
    return rotation


def _fixed_joint(
    robot: ET.Element, parent: str, child: str, rotation: FloatArray, translation: FloatArray
) -> None:
    element = ET.SubElement(robot, "joint", name=f"{child}_fixed", type="fixed")
    _origin(element, rotation, translation)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)


def _origin(element: ET.Element, rotation: FloatArray, translation: FloatArray) -> None:
    ET.SubElement(
        element, "origin", xyz=numbers(translation), rpy=numbers(rpy_from_rotation(rotation))
    )


def _inertial(phi: FloatArray) -> ET.Element:
    mass, com, inertia = com_from_phi(phi)
    element = ET.Element("inertial")
    ET.SubElement(element, "origin", xyz=numbers(com), rpy="0 0 0")
    ET.SubElement(element, "mass", value=repr(mass))
    products = {
        f"i{a}{b}": repr(float(inertia["xyz".index(a), "xyz".index(b)]))
        for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")
    }
    ET.SubElement(element, "inertia", products)
    return element


def without_negative_terms(model: RobotModel) -> tuple[RobotModel, str]:
    """Return the robot with negative joint terms set to zero, and what to say of them.

    Noise may turn a small friction or armature negative. Such a joint feeds a simulation
    energy until it diverges.
    """
    joints, remarks = [], []
    for joint in model.joints:
        terms = {
            "damping": joint.damping,
            "friction": joint.friction_loss,
            "armature": joint.armature,
        }
        remarks += [f"{joint.name} {k} {value:.6g}" for k, value in terms.items() if value < 0]
        damping, friction_loss, armature = (max(value, 0.0) for value in terms.values())
        joints.append(
            replace(joint, damping=damping, friction_loss=friction_loss, armature=armature)
        )
    remark = f"negative, written as zero: {', '.join(remarks)}" if remarks else ""
    return replace(model, joints=tuple(joints)), remark


def annotate(root: ET.Element, *comments: str) -> None:
    """Lay the XML out for reading, with the comments (if any) as its first child."""
    comment = "; ".join(filter(None, comments))
    if comment:
        root.insert(0, ET.Comment(f" {comment.replace('--', '- -')} "))
    ET.indent(root)


def numbers(values: Iterable[float]) -> str:
    """Return numbers as XML text that reads back to the same bits."""
    return " ".join(repr(float(value)) for value in values)
