"""Write a robot as MJCF: into the user's own file, or as a bare tree."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.export_urdf import annotate, numbers, without_negative_terms
from symbid_ros.model.inertia import com_from_phi, transform_phi
from symbid_ros.model.mjcf import load_mjcf
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import Joint, RobotModel

_COMPILER_OVERRIDES = ("balanceinertia", "boundinertia", "boundmass", "settotalmass")
# Attributes of a joint element and the joint's fields.
_TERMS = {"damping": "damping", "frictionloss": "friction_loss", "armature": "armature"}


def mjcf_text(
    model: RobotModel, source: Path | None = None, folder: Path = Path(), *, comment: str = ""
) -> str:
    """Return the robot as MJCF text.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    source : Path, optional
        The MJCF that ``model`` was loaded from. Everything in it but the inertias and
        changed joint terms is kept. A body welded to another lends its inertia to the body
        that moves. Without it, or when it includes other files, a bare tree is written.
    folder : Path
        Where the text will be saved, so that relative mesh folders still hold.
    comment : str
        What to say at the top of the file; negative friction and armature, which are
        written as zero, are added to it.
    """
    model, negative = without_negative_terms(model)
    root = None if source is None else _patched(model, source, folder)
    if root is None:
        root = _bare(model)
    annotate(root, comment, negative)
    return ET.tostring(root, encoding="unicode") + "\n"


def _patched(model: RobotModel, source: Path, folder: Path) -> ET.Element | None:
    parser = ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))
    root = ET.parse(source, parser).getroot()
    if root.find(".//include") is not None:
        return None
    phi = dict(zip(model.link_names, model.phi, strict=True))
    frames = {frame.name: frame for frame in model.frames}
    for body in root.iterfind("worldbody//body"):
        name = body.get("name", "")
        if name in phi:
            _set_inertial(body, _phi_in_body(model, name))
        elif name in frames:
            _set_inertial(body, np.zeros(10))
    # An element may inherit its terms from a class, so what the file says is what MuJoCo reads.
    stated = {joint.name: joint for joint in load_mjcf(source).joints}
    joints = {joint.name: joint for joint in model.joints}
    for element in root.iterfind("worldbody//joint"):
        name = element.get("name", "")
        if name in joints:
            _set_terms(element, joints[name], stated[name])
    _settle_compiler(root, source, folder)
    return root


def _phi_in_body(model: RobotModel, name: str) -> FloatArray:
    """Return φ about the body's own origin, which a joint anchor moves off the link's."""
    phi = model.phi[model.link_names.index(name)]
    frame = model.frame(name)
    return transform_phi(phi, frame.rotation.T, -frame.rotation.T @ frame.translation)


def _set_inertial(body: ET.Element, phi: FloatArray) -> None:
    for old in body.findall("inertial"):
        body.remove(old)
    if np.any(phi) or body.find("geom") is not None:
        body.insert(0, _inertial(phi))


def _set_terms(element: ET.Element, joint: Joint, stated: Joint | None = None) -> None:
    """Write the joint's terms that differ from the stated ones; silence means zero."""
    for key, field in _TERMS.items():
        value = getattr(joint, field)
        if value != (0.0 if stated is None else getattr(stated, field)):
            element.set(key, repr(float(value)))


def _settle_compiler(root: ET.Element, source: Path, folder: Path) -> None:
    """Keep the compiler from changing inertias, and find the files that it names."""
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ET.Element("compiler")
        root.insert(0, compiler)
    for override in _COMPILER_OVERRIDES:
        compiler.attrib.pop(override, None)
    if compiler.get("inertiafromgeom") == "true":
        compiler.set("inertiafromgeom", "auto")
    directories = [key for key in ("assetdir", "meshdir", "texturedir") if key in compiler.attrib]
    if root.find("asset//*[@file]") is not None and not directories:
        directories = ["assetdir"]
    for key in directories:
        target = source.parent / compiler.get(key, "")
        compiler.set(key, os.path.relpath(target.resolve(), folder.resolve()))


def _bare(model: RobotModel) -> ET.Element:
    root = ET.Element("mujoco", model=model.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=numbers(model.gravity))
    world = ET.SubElement(root, "worldbody")
    on_world = not model.floating and model.links[0].name == "world"
    elements = {0: world if on_world else ET.SubElement(world, "body", name=model.links[0].name)}
    if model.floating:
        ET.SubElement(elements[0], "freejoint", name=f"{model.links[0].name}_free")
    pending: list[int] = []
    for index in range(len(model.joints)):
        pending.append(index)
        if not model.links[index + 1].virtual:
            elements[index + 1] = _add_body(elements, model, pending)
            pending = []
    for index, element in elements.items():
        if element is not world and np.any(model.links[index].phi):
            element.append(_inertial(model.links[index].phi))
    for frame in model.frames:
        if frame.name not in model.link_names:
            _pose(
                ET.SubElement(elements[frame.link], "site", name=frame.name),
                frame.rotation,
                frame.translation,
            )
    motors = ET.SubElement(root, "actuator")
    for joint in model.joints:
        if joint.effort > 0:
            motor = ET.SubElement(motors, "motor", name=joint.name, joint=joint.name)
            if np.isfinite(joint.effort):
                motor.set("ctrlrange", numbers([-joint.effort, joint.effort]))
    return root


def _add_body(elements: dict[int, ET.Element], model: RobotModel, chain: list[int]) -> ET.Element:
    """Add the body moved by the joints ``chain``: one, or several through virtual links."""
    joints = [model.joints[index] for index in chain]
    shifts = np.array([joint.translation for joint in joints[1:]]).reshape(-1, 3)
    first = joints[0]
    body = ET.SubElement(elements[first.parent], "body", name=model.links[chain[-1] + 1].name)
    _pose(body, first.rotation, first.translation + first.rotation @ shifts.sum(axis=0))
    for position, joint in enumerate(joints):
        kind = "hinge" if joint.kind == "revolute" else "slide"
        element = ET.SubElement(body, "joint", name=joint.name, type=kind)
        element.set("axis", numbers(joint.axis))
        element.set("pos", numbers(-shifts[position:].sum(axis=0)))
        element.set("ref", repr(float(joint.reference)))
        if np.isfinite([joint.lower, joint.upper]).all():
            element.set("range", numbers([joint.lower, joint.upper]))
        _set_terms(element, joint)
    return body


def _pose(element: ET.Element, rotation: FloatArray, translation: FloatArray) -> None:
    element.set("pos", numbers(translation))
    element.set("quat", numbers(quaternion_from_rotation(rotation)))


def _inertial(phi: FloatArray) -> ET.Element:
    mass, com, inertia = com_from_phi(phi)
    element = ET.Element("inertial", mass=repr(mass), pos=numbers(com))
    element.set("fullinertia", numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]))
    return element
