"""Write a robot as URDF: the user's own file with new parameters, or a minimal tree."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.model.bodies import ROUNDING, updated_bodies
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.rotation import rpy_from_rotation
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.model.urdf import UNLIMITED, UrdfReader
from symbid_ros.model.wrist_sensors import without_wrist_sensors
from symbid_ros.model.xml_file import XmlEditor, as_element, is_editable, read_xml

# SI units; a solver returns friction and armature this small instead of zero.
NEGLIGIBLE = 1e-9
# Names of joint terms for users, and the fields of Joint.
TERMS = {
    "damping": "damping",
    "friction": "friction_loss",
    "armature": "armature",
    "stiffness": "stiffness",
}
# Those that a URDF cannot hold.
UNWRITTEN = "armature", "stiffness"


def urdf_text(
    model: RobotModel,
    source: Path | None = None,
    *,
    comment: str = "",
    before: RobotModel | None = None,
) -> str:
    """Return the robot as URDF text.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    source : Path, optional
        The URDF that ``model`` was loaded from. Only changed numbers of ``<inertial>`` and
        ``<dynamics>`` are replaced. A minimal tree is written without it, or if it is in UTF-16.
    comment : str
        Comment at the top of a minimal tree; values that a URDF cannot hold (:func:`unwritten`)
        are appended.
    before : RobotModel, optional
        The same robot with the kinematics of ``source``, if those of ``model`` differ. The origins
        of joints are then replaced as well.
    """
    if source is not None and is_editable(source):
        return _updated(with_nonnegative_terms(model), source, before or model)
    robot = _minimal_tree(without_wrist_sensors(with_nonnegative_terms(model)))
    annotate(robot, comment, *unwritten(model))
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def unwritten(model: RobotModel) -> tuple[str, ...]:
    """Return the values that a URDF cannot hold: negative friction, armature and springs."""
    lists = []
    for field in UNWRITTEN:
        values = [(joint.name, getattr(joint, field)) for joint in model.joints]
        if some := [f"{name} {value:.6g}" for name, value in values if abs(value) > NEGLIGIBLE]:
            lists.append(f"{field}, not part of a URDF: {', '.join(some)}")
    return tuple(filter(None, (negative_terms(model, without=UNWRITTEN), *lists)))


def _updated(model: RobotModel, source: Path, before: RobotModel) -> str:
    root, editor = read_xml(source), XmlEditor(source)
    reader = UrdfReader(str(source), root)
    changes = placement_changes(before, model)
    model = without_wrist_sensors(model, kept=reader.links)
    names = {*model.link_names, *(frame.name for frame in model.frames)}
    stated = {name: reader.phi(name) for name in reader.links if name in names}
    for name, phi in updated_bodies(model, stated).items():
        _set_inertial(editor, reader, name, phi)
    joints = {joint.name: joint for joint in model.joints}
    for element in reader.joints:
        name = element.get("name", "")
        if name in joints:
            _set_friction(editor, element, joints[name])
        if name in changes:
            _set_origin(editor, element, reader.pose(element), changes[name])
    return editor.text()


def placement_changes(
    before: RobotModel, after: RobotModel
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return rotation and translation of each moved joint's frame in its frame before."""
    changes = {}
    stated = {joint.name: joint for joint in before.joints}
    for other in after.joints:
        one = stated[other.name]
        if np.any(one.rotation != other.rotation) or np.any(one.translation != other.translation):
            moved = one.rotation.T @ (other.translation - one.translation)
            changes[one.name] = (one.rotation.T @ other.rotation, moved)
    return changes


def _set_origin(
    editor: XmlEditor,
    element: ET.Element,
    pose: tuple[FloatArray, FloatArray],
    change: tuple[FloatArray, FloatArray],
) -> None:
    """Write the origin of a joint, of which ``pose`` is the one in the file."""
    values = {"xyz": pose[1] + pose[0] @ change[1], "rpy": rpy_from_rotation(pose[0] @ change[0])}
    origin = element.find("origin")
    if origin is None:
        markup = "".join(f' {key}="{numbers(value)}"' for key, value in values.items())
        editor.insert(as_element(element), f"<origin{markup}/>")
        return
    for key, value in values.items():
        editor.set_numbers(as_element(origin), key, value.tolist(), ROUNDING)


def _set_inertial(editor: XmlEditor, reader: UrdfReader, name: str, phi: FloatArray) -> None:
    """Write φ (about the link's origin) in the axes of the link's <inertial>."""
    link = reader.links[name]
    inertial = link.find("inertial")
    if inertial is None:
        editor.insert(as_element(link), *_lines(_inertial(phi)))
        return
    rotation, _ = reader.pose(inertial)
    mass, com, central = com_from_phi(phi)
    central = rotation.T @ central @ rotation
    origin = inertial.find("origin")
    if origin is not None:
        editor.set_numbers(as_element(origin), "xyz", com.tolist(), _rounding(com))
    elif np.any(com):
        editor.insert(as_element(inertial), f'<origin xyz="{numbers(com)}"/>')
    editor.set_numbers(as_element(inertial.find("mass")), "value", [mass], ROUNDING * abs(mass))
    inertia = as_element(inertial.find("inertia"))
    for key, value in _products(central).items():
        editor.set_numbers(inertia, key, [value], _rounding(central))


def _rounding(values: FloatArray) -> float:
    return float(ROUNDING * np.abs(values).max())


def _set_friction(editor: XmlEditor, element: ET.Element, joint: Joint) -> None:
    """Write the joint's friction where it differs from the file; a missing value is zero."""
    dynamics = element.find("dynamics")
    values = {"damping": joint.damping, "friction": joint.friction_loss}
    if dynamics is None:
        markup = "".join(f' {key}="{float(value)!r}"' for key, value in values.items() if value)
        if markup:
            editor.insert(as_element(element), f"<dynamics{markup}/>", last=True)
        return
    for key, value in values.items():
        if value or float(dynamics.get(key, "0")) > NEGLIGIBLE:
            editor.set_numbers(as_element(dynamics), key, [value], 0.0)


def _lines(element: ET.Element) -> list[str]:
    """Return the lines of an element, indented by two spaces."""
    ET.indent(element)
    return ET.tostring(element, encoding="unicode").splitlines()


def _minimal_tree(model: RobotModel) -> ET.Element:
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
    """Return the base's rotation in a z-up world from gravity in base axes."""
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
    # URDF has no reference position, so it is folded into the pose.
    translation = joint.translation
    if joint.kind == "prismatic":
        translation = translation - joint.reference * (joint.rotation @ joint.axis)
    parent = model.links[joint.parent].name
    element = _joint_element(
        robot, joint.name, kind, (parent, child), (_rotation_at_zero(joint), translation)
    )
    ET.SubElement(element, "axis", xyz=numbers(joint.axis))
    limit = ET.SubElement(element, "limit")
    if kind != "continuous":
        limit.set("lower", repr(max(float(joint.lower), -UNLIMITED)))
        limit.set("upper", repr(min(float(joint.upper), UNLIMITED)))
    limit.set("effort", repr(min(float(joint.effort), UNLIMITED)))
    limit.set("velocity", repr(UNLIMITED))
    terms = {"damping": joint.damping, "friction": joint.friction_loss}
    stated = {key: repr(float(value)) for key, value in terms.items() if value}
    if stated:
        ET.SubElement(element, "dynamics", stated)
    if (mimic := joint.mimic) is not None:
        ET.SubElement(
            element,
            "mimic",
            joint=model.joints[mimic.leader].name,
            multiplier=repr(mimic.multiplier),
            offset=repr(mimic.offset),
        )


def _rotation_at_zero(joint: Joint) -> FloatArray:
    if joint.kind == "prismatic" or joint.reference == 0.0:
        return joint.rotation
    rotation: FloatArray = (
        joint.rotation @ Rotation.from_rotvec(-joint.reference * joint.axis).as_matrix()
    )
    return rotation


def _fixed_joint(
    robot: ET.Element, parent: str, child: str, rotation: FloatArray, translation: FloatArray
) -> None:
    _joint_element(robot, f"{child}_fixed", "fixed", (parent, child), (rotation, translation))


def _joint_element(
    robot: ET.Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    pose: tuple[FloatArray, FloatArray],
) -> ET.Element:
    """Add a joint between a parent and a child link, at a rotation and translation."""
    element = ET.SubElement(robot, "joint", name=name, type=kind)
    rpy = rpy_from_rotation(pose[0])
    ET.SubElement(element, "origin", xyz=numbers(pose[1]), rpy=numbers(rpy))
    ET.SubElement(element, "parent", link=links[0])
    ET.SubElement(element, "child", link=links[1])
    return element


def _inertial(phi: FloatArray) -> ET.Element:
    mass, com, inertia = com_from_phi(phi)
    element = ET.Element("inertial")
    ET.SubElement(element, "origin", xyz=numbers(com), rpy="0 0 0")
    ET.SubElement(element, "mass", value=repr(mass))
    products = {key: repr(float(value)) for key, value in _products(inertia).items()}
    ET.SubElement(element, "inertia", products)
    return element


def _products(inertia: FloatArray) -> dict[str, float]:
    rows, columns = np.triu_indices(3)
    return {f"i{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i, j in zip(rows, columns, strict=True)}


def with_nonnegative_terms(model: RobotModel) -> RobotModel:
    """Return the robot with negative and negligible joint terms set to zero.

    Noise may make a small friction or armature negative. In a simulation such a joint adds
    energy until the simulation diverges.
    """
    joints = []
    for joint in model.joints:
        terms = {field: getattr(joint, field) for field in TERMS.values()}
        zeros: dict[str, Any] = {
            field: 0.0 for field, value in terms.items() if not value > NEGLIGIBLE
        }
        joints.append(replace(joint, **zeros))
    return replace(model, joints=tuple(joints))


def negative_terms(model: RobotModel, *, without: Collection[str] = ()) -> str:
    """Return which joint terms are negative and written as zero; empty if there is none.

    Fields of ``without`` are not written at all.
    """
    found = [
        f"{joint.name} {name} {value:.6g}"
        for joint in model.joints
        for name, field in TERMS.items()
        if field not in without and (value := getattr(joint, field)) < -NEGLIGIBLE
    ]
    return f"negative, written as zero: {', '.join(found)}" if found else ""


def annotate(root: ET.Element, *comments: str) -> None:
    """Indent the XML and insert the comments, if any, as its first child."""
    comment = "; ".join(filter(None, comments))
    if comment:
        root.insert(0, ET.Comment(f" {comment.replace('--', '- -')} "))
    ET.indent(root)


def numbers(values: Iterable[float]) -> str:
    """Return numbers as XML text that reads back to the same bits (repr)."""
    return " ".join(repr(float(value)) for value in values)
