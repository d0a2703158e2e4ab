"""Write a robot as MJCF: into the user's own file, or as a bare tree."""

import xml.etree.ElementTree as ET
from collections.abc import Container
from pathlib import Path, PurePosixPath

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.export_urdf import annotate, negative_terms, numbers, with_possible_terms
from symbid_ros.model.inertia import TINY_MASS, com_from_phi, is_consistent, nearest_possible
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.update_mjcf import TERMS, full_inertia, updated_mjcf


def mjcf_text(
    model: RobotModel, source: Path | None = None, folder: Path = Path(), *, comment: str = ""
) -> str:
    """Return the robot as MJCF text; of several files, the main one.

    The parameters are those of :func:`mjcf_files`.
    """
    return next(iter(mjcf_files(model, source, folder, comment=comment).values()))


def mjcf_files(
    model: RobotModel,
    source: Path | None = None,
    folder: Path = Path(),
    *,
    name: str = "model.xml",
    comment: str = "",
) -> dict[PurePosixPath, str]:
    """Return the robot as MJCF, which MuJoCo compiles whatever the parameters are.

    Parameters
    ----------
    model : RobotModel
        The robot to write. Of a link that no mass density can realise, the nearest that one
        can is written.
    source : Path, optional
        The MJCF that ``model`` was loaded from, of which inertias and joint terms are
        replaced, see :func:`symbid_ros.model.update_mjcf.updated_mjcf`. Without it, or if its
        bodies come from <replicate>, a bare tree is written.
    folder : Path
        Where the files will be saved, so that relative mesh folders still hold.
    name : str
        What the main file will be called.
    comment : str
        What to say at the top of a bare tree; what was written otherwise than identified
        (:func:`replaced_values`) is added to it.

    Returns
    -------
    dict of PurePosixPath to str
        Places in ``folder`` and texts, the main file first, then those that it includes.
    """
    possible = with_possible_terms(model)
    if source is not None:
        files = updated_mjcf(possible, source, folder, name)
        if files is not None:
            return files
    root = _bare(possible)
    annotate(root, comment, *replaced_values(model))
    return {PurePosixPath(name): ET.tostring(root, encoding="unicode") + "\n"}


def replaced_values(model: RobotModel) -> tuple[str, ...]:
    """Return what an MJCF says otherwise than the robot, because MuJoCo refuses the truth."""
    moving = model.links[0 if model.floating else 1 :]
    massless = [link.name for link in moving if not link.virtual and not np.any(link.phi)]
    impossible = [link.name for link in model.links if not is_consistent(link.phi)]
    remarks = [
        f"without mass, written with {TINY_MASS:g} kg: {', '.join(massless)}" if massless else "",
        f"written as the nearest possible body: {', '.join(impossible)}" if impossible else "",
        negative_terms(model),
    ]
    return tuple(filter(None, remarks))


def _bare(model: RobotModel) -> ET.Element:
    root = ET.Element("mujoco", model=model.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(root, "option", gravity=numbers(model.gravity))
    world = ET.SubElement(root, "worldbody")
    on_world = not model.floating and model.links[0].name == "world"
    base = _body_name(model, 0)
    elements = {0: world if on_world else ET.SubElement(world, "body", name=base)}
    if model.floating:
        name = _unused(f"{base}_free", model.joint_names)
        ET.SubElement(elements[0], "freejoint", name=name)
    pending: list[int] = []
    for index in range(len(model.joints)):
        pending.append(index)
        if not model.links[index + 1].virtual:
            elements[index + 1] = _add_body(elements, model, pending)
            pending = []
    for index, element in elements.items():
        phi = model.links[index].phi
        moves = index > 0 or model.floating
        if element is not world and (moves or np.any(phi)):
            element.append(_inertial(nearest_possible(phi)))
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
    if model.followers:
        equality = ET.SubElement(root, "equality")
        for index, mimic in model.followers.items():
            joint, master = model.joints[index], model.joints[mimic.master]
            # MuJoCo counts both positions from their references.
            shift = mimic.offset + mimic.multiplier * master.reference - joint.reference
            ET.SubElement(
                equality,
                "joint",
                joint1=joint.name,
                joint2=master.name,
                polycoef=numbers([shift, mimic.multiplier, 0, 0, 0]),
            )
    return root


def _add_body(elements: dict[int, ET.Element], model: RobotModel, chain: list[int]) -> ET.Element:
    """Add the body moved by the joints ``chain``: one, or several through virtual links."""
    joints = [model.joints[index] for index in chain]
    shifts = np.array([joint.translation for joint in joints[1:]]).reshape(-1, 3)
    first = joints[0]
    body = ET.SubElement(elements[first.parent], "body", name=_body_name(model, chain[-1] + 1))
    _pose(body, first.rotation, first.translation + first.rotation @ shifts.sum(axis=0))
    for position, joint in enumerate(joints):
        kind = "hinge" if joint.kind == "revolute" else "slide"
        element = ET.SubElement(body, "joint", name=joint.name, type=kind)
        element.set("axis", numbers(joint.axis))
        element.set("pos", numbers(-shifts[position:].sum(axis=0)))
        element.set("ref", repr(float(joint.reference)))
        if np.isfinite([joint.lower, joint.upper]).all():
            element.set("range", numbers([joint.lower, joint.upper]))
        for key, field in TERMS.items():
            if value := getattr(joint, field):
                element.set(key, repr(float(value)))
    return body


def _body_name(model: RobotModel, index: int) -> str:
    """Return the link's name, unless it is the one that MJCF keeps for its world."""
    name = model.links[index].name
    return _unused("world_link", model.link_names) if name == "world" else name


def _unused(name: str, taken: Container[str]) -> str:
    while name in taken:
        name += "_"
    return name


def _pose(element: ET.Element, rotation: FloatArray, translation: FloatArray) -> None:
    element.set("pos", numbers(translation))
    element.set("quat", numbers(quaternion_from_rotation(rotation)))


def _inertial(phi: FloatArray) -> ET.Element:
    mass, com, inertia = com_from_phi(phi)
    element = ET.Element("inertial", mass=repr(mass), pos=numbers(com))
    element.set("fullinertia", full_inertia(inertia))
    return element
