"""Write a robot as MJCF: the user's own file with new parameters, or a minimal tree."""

import os
import xml.etree.ElementTree as ET
from collections.abc import Container, Mapping
from pathlib import Path, PurePosixPath
from xml.sax.saxutils import quoteattr

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.bodies import updated_bodies
from symbid_ros.model.export_urdf import (
    NEGLIGIBLE,
    annotate,
    negative_terms,
    numbers,
    placement_changes,
    with_nonnegative_terms,
)
from symbid_ros.model.inertia import TINY_MASS, com_from_phi, is_consistent, nearest_consistent
from symbid_ros.model.mjcf import file_bodies
from symbid_ros.model.mjcf_source import included_file, read_mjcf
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.model.wrist_sensors import without_wrist_sensors
from symbid_ros.model.xml_file import Element, XmlEditor, as_element, is_editable, read_xml

# Compiler settings that change the inertias given in the file.
_OVERRIDES = ("balanceinertia", "boundinertia", "boundmass", "settotalmass")
_ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_FOLDERS = ("assetdir", "meshdir", "texturedir")
# Attributes of a joint element and the fields of Joint.
TERMS = {
    "damping": "damping",
    "frictionloss": "friction_loss",
    "armature": "armature",
    "stiffness": "stiffness",
}


def mjcf_text(
    model: RobotModel, source: Path | None = None, folder: Path = Path(), *, comment: str = ""
) -> str:
    """Return the main file of :func:`mjcf_files`."""
    return next(iter(mjcf_files(model, source, folder, comment=comment).values()))


def mjcf_files(
    model: RobotModel,
    source: Path | None = None,
    folder: Path = Path(),
    *,
    name: str = "model.xml",
    comment: str = "",
    before: RobotModel | None = None,
) -> dict[PurePosixPath, str]:
    """Return the robot as MJCF that MuJoCo compiles for any parameters.

    Parameters
    ----------
    model : RobotModel
        The robot to write. A physically inconsistent link is replaced by the nearest consistent
        one.
    source : Path, optional
        The MJCF that ``model`` was loaded from. Its inertias and joint terms are replaced, see
        :func:`updated_mjcf`. A minimal tree is written without it, or if its bodies come from
        <replicate>.
    folder : Path
        Where the files will be saved; relative mesh folders are adjusted to it.
    name : str
        Name of the main file.
    comment : str
        Comment at the top of a minimal tree; changed values (:func:`replaced_values`) are
        appended.
    before : RobotModel, optional
        The same robot with the kinematics of ``source``, if those of ``model`` differ. The poses of
        bodies are then replaced as well.

    Returns
    -------
    dict of PurePosixPath to str
        Paths in ``folder`` and texts: the main file first, then the included files.
    """
    possible = with_nonnegative_terms(model)
    if source is not None:
        files = updated_mjcf(possible, source, folder, name, before=before)
        if files is not None:
            return files
    root = _minimal_tree(without_wrist_sensors(possible))
    annotate(root, comment, *replaced_values(model))
    return {PurePosixPath(name): ET.tostring(root, encoding="unicode") + "\n"}


def replaced_values(model: RobotModel) -> tuple[str, ...]:
    """Return the values that are changed because MuJoCo rejects the robot's own."""
    moving = model.links[0 if model.floating else 1 :]
    massless = [link.name for link in moving if not link.virtual and not np.any(link.phi)]
    impossible = [link.name for link in model.links if not is_consistent(link.phi)]
    remarks = [
        f"without mass, written with {TINY_MASS:g} kg: {', '.join(massless)}" if massless else "",
        f"written as the nearest possible body: {', '.join(impossible)}" if impossible else "",
        negative_terms(model),
    ]
    return tuple(filter(None, remarks))


def _minimal_tree(model: RobotModel) -> ET.Element:
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
            element.append(_inertial(nearest_consistent(phi)))
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
            joint, leader = model.joints[index], model.joints[mimic.leader]
            # MuJoCo measures both positions from their references.
            shift = mimic.offset + mimic.multiplier * leader.reference - joint.reference
            ET.SubElement(
                equality,
                "joint",
                joint1=joint.name,
                joint2=leader.name,
                polycoef=numbers([shift, mimic.multiplier, 0, 0, 0]),
            )
    return root


def _add_body(elements: dict[int, ET.Element], model: RobotModel, chain: list[int]) -> ET.Element:
    """Add the body that the joints ``chain`` move: one joint, or several via virtual links."""
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
        if joint.stiffness and joint.spring_reference:
            element.set("springref", repr(float(joint.spring_reference)))
    return body


def _body_name(model: RobotModel, index: int) -> str:
    """Return the link's name, or another one if it is MJCF's reserved name ``world``."""
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


def updated_mjcf(
    model: RobotModel,
    source: Path,
    folder: Path,
    name: str,
    *,
    in_place: bool = False,
    before: RobotModel | None = None,
) -> dict[PurePosixPath, str] | None:
    """Return the user's MJCF with the robot's inertias and joint terms, as files for ``folder``.

    Every other byte stays, except compiler settings: those that would change inertias are
    removed, and folders of meshes and textures become relative to ``folder``.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    source : Path
        The MJCF that ``model`` was loaded from.
    folder : Path
        Where the files will be saved.
    name : str
        Name of the main file there.
    in_place : bool
        Whether the texts will replace ``source`` and its included files.
    before : RobotModel, optional
        As of :func:`mjcf_files`.

    Returns
    -------
    dict of PurePosixPath to str, or None
        The main file first, then the included files at the same relative paths as in
        ``source``. None if a body has no element in a file, as below <replicate>, if a file is in
        UTF-16, or if a body to move is in a <frame> or has several joints.
    """
    root = read_mjcf(source)
    elements = [as_element(body) for body in root.iterfind("worldbody//body")]
    inertias, robot, stated_robot = file_bodies(source)
    names = list(inertias)
    model = without_wrist_sensors(model, kept=names)
    named = [element.get("name", body) for element, body in zip(elements, names, strict=False)]
    if len(elements) != len(names) or named != names:
        return None
    files = _Files(source)
    if not all(is_editable(path) for path in files.editors):
        return None
    overridden = _compiler_overrides(root)
    bodies = dict(zip(names, elements, strict=True))
    stated = {name: inertias.get(name, np.zeros(10)) for name in robot}
    updated = updated_bodies(model, stated, rewrite=overridden)
    if folder.resolve() != source.parent.resolve() and not in_place:
        # A model elsewhere is read without the meshes of bodies that state no inertia.
        bare = {name: phi for name, phi in inertias.items() if _needs_mesh(bodies[name])}
        updated = bare | updated
    for body, phi in updated.items():
        inertial = bodies[body].find("inertial")
        if inertial is None and bodies[body].find("frame//inertial") is not None:
            return None
        _set_inertial(files, bodies[body], nearest_consistent(phi) if np.any(phi) else phi)
    if before is not None and not _move_bodies(files, root, bodies, (before, model)):
        return None
    # An element may inherit its terms from a class, so MuJoCo's values are compared.
    stated_joints = {joint.name: joint for joint in stated_robot.joints}
    after = {joint.name: joint for joint in model.joints}
    for element in root.iterfind("worldbody//joint"):
        joint = element.get("name", "")
        if joint in after:
            _set_terms(files, as_element(element), stated_joints[joint], after[joint])
    _adjust_compilers(files, root, folder)
    return files.texts(folder, name, in_place=in_place)


class _Files:
    """Editors of the main file and its includes."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self.editors: dict[Path, XmlEditor] = {}
        self._includes: list[tuple[Element, Path]] = []
        self._add(source)

    def _add(self, path: Path) -> None:
        self.editors[path] = XmlEditor(path)
        for element in read_xml(path).iter("include"):
            include = as_element(element)
            file = included_file(include, self.source.parent, path.parent)
            self._includes.append((include, file))
            self._add(file)

    def editor(self, element: Element) -> XmlEditor:
        return self.editors[element.file]

    def texts(self, folder: Path, name: str, *, in_place: bool) -> dict[PurePosixPath, str]:
        """Return the edited texts by path in ``folder``, the main file first."""
        home = self.source.parent.resolve()
        places = {self.source: PurePosixPath(name)}
        for _, file in self._includes:
            place = PurePosixPath(file.relative_to(home).as_posix())
            # Replace neither another output nor one of the user's own files.
            while not in_place and (
                place in places.values() or (folder / place).resolve() in self.editors
            ):
                place = place.with_stem(f"{place.stem}_identified")
            places[file] = place
        for include, file in self._includes:
            if PurePosixPath(include.get("file", "")) != places[file]:
                self.editor(include).set(include, "file", str(places[file]))
        return {place: self.editors[file].text() for file, place in places.items()}


def _needs_mesh(body: Element) -> bool:
    """Return whether a body has an inertia from meshes."""
    own = [body, *body.findall("frame")]
    if any(part.find("inertial") is not None for part in own):
        return False
    return any("mesh" in shape.attrib for part in own for shape in part.findall("geom"))


def _compiler_overrides(root: Element) -> bool:
    """Return whether compiler settings replace the inertias given in the file."""
    return any(
        compiler.get("inertiafromgeom") == "true"
        or any(key in compiler.attrib for key in _OVERRIDES)
        for compiler in root.iterfind("compiler")
    )


def _set_inertial(files: _Files, body: Element, phi: FloatArray) -> None:
    if not np.any(phi):  # of a body that only shows something
        files.editor(body).insert(body, '<inertial mass="0" pos="0 0 0" diaginertia="0 0 0"/>')
        return
    mass, com, inertia = com_from_phi(phi)
    values = {
        "mass": repr(mass),
        "pos": numbers(com),
        "fullinertia": full_inertia(inertia),
    }
    editor, found = files.editor(body), body.find("inertial")
    if found is None:
        attributes = "".join(f' {key}="{value}"' for key, value in values.items())
        editor.insert(body, f"<inertial{attributes}/>")
        return
    inertial = as_element(found)
    for key in ("diaginertia", *_ORIENTATIONS):
        editor.drop(inertial, key)
    for key, value in values.items():
        editor.set(inertial, key, value)


def full_inertia(inertia: FloatArray) -> str:
    """Return a (3, 3) inertia as MJCF's fullinertia: xx, yy, zz, xy, xz, yz."""
    return numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


def _move_bodies(
    files: _Files,
    root: Element,
    bodies: Mapping[str, Element],
    robots: tuple[RobotModel, RobotModel],
) -> bool:
    """Move bodies as joints' frames move between two robots; return whether that was possible."""
    before, after = robots
    changes = placement_changes(before, after)
    in_frames = {body for frame in root.iter("frame") for body in frame.iter("body")}
    poses = {body.name: body for body in before.bodies}
    for name, element in bodies.items():
        joints = poses[name].joints if name in poses else ()
        moved = [joint for joint in joints if joint.name in changes]
        if not moved:
            continue
        if len(joints) > 1 or element in in_frames:
            return False
        rotation, translation = changes[moved[0].name]
        pose, anchor = poses[name], moved[0].anchor
        for key in _ORIENTATIONS:
            files.editor(element).drop(element, key)
        turn = pose.rotation @ rotation
        place = pose.translation + pose.rotation @ (anchor + translation - rotation @ anchor)
        files.editor(element).set(element, "pos", numbers(place))
        files.editor(element).set(element, "quat", numbers(quaternion_from_rotation(turn)))
    return True


def _set_terms(files: _Files, element: Element, before: Joint, after: Joint) -> None:
    """Write those joint terms that differ from MuJoCo's values."""
    for key, field in TERMS.items():
        old, new = getattr(before, field), getattr(after, field)
        if old != new and max(old, new) > NEGLIGIBLE:
            files.editor(element).set(element, key, repr(float(new)))


def _adjust_compilers(files: _Files, root: Element, folder: Path) -> None:
    """Remove compiler settings that change inertias, and adjust folders to ``folder``."""
    compilers = [as_element(compiler) for compiler in root.iterfind("compiler")]
    home = files.source.parent.resolve()
    moved = folder.resolve() != home
    named = False
    for compiler in compilers:
        editor = files.editor(compiler)
        for override in _OVERRIDES:
            editor.drop(compiler, override)
        if compiler.get("inertiafromgeom") == "true":
            editor.set(compiler, "inertiafromgeom", "auto")
        for key in _FOLDERS:
            if key in compiler.attrib:
                named = True
                if moved:
                    place = os.path.relpath(home / compiler.get(key, ""), folder.resolve())
                    editor.set(compiler, key, place)
    if moved and not named and root.find("asset//*[@file]") is not None:
        place = os.path.relpath(home, folder.resolve())
        main = [compiler for compiler in compilers if compiler.file == files.source]
        if main:
            files.editor(main[0]).set(main[0], "assetdir", place)
        else:
            files.editor(root).insert(root, f"<compiler assetdir={quoteattr(place)}/>")
