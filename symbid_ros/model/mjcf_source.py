"""An MJCF as XML: includes expanded, contents checked, and reduced for MuJoCo's compiler."""

import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np

from symbid_ros.errors import ModelError
from symbid_ros.model.xml_file import (
    LARGEST,
    MAX_ELEMENTS,
    Element,
    as_element,
    read_bytes,
    read_xml,
)

# MuJoCo's compiler needs time and memory quadratic in bodies and joints.
MAX_BODIES = 2_000
MAX_JOINTS = 1_000

# Elements that load code or other models, or that generate bodies.
_REJECTED = {
    "plugin": "plugins are not loaded",
    "extension": "plugins are not loaded",
    "attach": "other models are not loaded",
    "model": "other models are not loaded",
    "composite": "bodies must be written out",
    "flexcomp": "bodies must be written out",
}
_NAMES = {"name", "class", "childclass", "joint", "body", "site", "geom", "mesh", "file", "model"}
_BOUNDED = {
    *("pos", "mass", "diaginertia", "fullinertia", "size", "fromto", "density"),
    *("damping", "frictionloss", "armature", "ref", "stiffness", "springref"),
}
# Attributes of assets, compiler settings and skins that name files or folders.
_FILES = {"file", "fileup", "filedown", "fileleft", "fileright", "filefront", "fileback"}

MAX_MESH_BYTES = 64 << 20  # of all meshes that determine inertias

# Only omitted elements are listed, so that MuJoCo rejects unknown ones.
_OMITTED_SECTIONS = {
    *("size", "visual", "statistic", "custom", "contact", "deformable", "tendon", "sensor"),
    "keyframe",
}
_OMITTED_PARTS = {
    "default": {"material", "camera", "light", "pair", "tendon"},
    "asset": {"texture", "material", "hfield", "skin"},
    "worldbody": {"camera", "light", "geom"},
}
_MESH_FORMATS = (".stl", ".obj", ".msh")
_FOLDERS = ("assetdir", "meshdir", "texturedir", "strippath")


def read_mjcf(path: Path) -> Element:
    """Return the root of an MJCF with its includes in place.

    Raises
    ------
    ModelError
        When a file cannot be read, an include is outside the model's folder or repeated, an
        element would load code or another model, a number is not finite or outside a robot's
        range, or the model exceeds a limit.
    """
    root = read_xml(path)
    if root.tag != "mujoco":
        raise ModelError(f"{path}: the root element is <{root.tag}>, an MJCF has <mujoco>", "E104")
    _expand(root, path.parent, path.parent, {path.resolve()})
    for element in elements(root):
        if element.tag in _REJECTED and element is not root:
            raise ModelError(
                f"{element.place}: <{element.tag}>: {_REJECTED[element.tag]}; remove it", "E111"
            )
        for key, value in element.items():
            if key not in _NAMES:
                _check_numbers(element, key, value)
    for tag, limit in (("", MAX_ELEMENTS), ("body", MAX_BODIES), ("joint", MAX_JOINTS)):
        if _count(root, tag) > limit:
            what = {"": "elements", "body": "bodies", "joint": "joints"}[tag]
            raise ModelError(
                f"{path}: more than {limit} {what}, the limit; reduce the model", "E102"
            )
    return root


def resolve_inside(folder: Path, name: str, element: Element) -> Path:
    """Return the path of a file that ``element`` names, which must be inside ``folder``.

    Raises
    ------
    ModelError
        When the file is elsewhere after resolving symbolic links.
    """
    try:
        target, home = (folder / name).resolve(), folder.resolve()
        if target.is_relative_to(home):
            return target
    except (OSError, ValueError, RuntimeError):
        # The name is too long, contains NUL or is a loop of symbolic links.
        pass
    raise ModelError(
        f"{element.place}: {name!r} is not in the model's folder {folder}; copy it there and name "
        "it by a relative path",
        "E110",
    )


def included_file(element: Element, folder: Path, here: Path) -> Path:
    """Return the included file: MuJoCo looks beside the model, then beside ``here``.

    Raises
    ------
    ModelError
        When the file is outside the model's ``folder``.
    """
    name = element.get("file", "")
    file = resolve_inside(folder, name, element)
    if os.path.isfile(file):  # unlike Path.is_file, False for an invalid name
        return file
    return resolve_inside(folder, os.path.relpath(here / name, folder), element)


def require_files_inside(path: Path) -> None:
    """Reject an MJCF that names files outside its own folder.

    Raises
    ------
    ModelError
        See :func:`read_mjcf`; also when a mesh, texture or height field is elsewhere.
    """
    root = read_mjcf(path)
    folders = {
        key: value
        for compiler in root.iterfind("compiler")
        for key, value in compiler.items()
        if key in ("assetdir", "meshdir", "texturedir")
    }
    common = folders.get("assetdir", "")
    for element in elements(root):
        own = {"mesh": "meshdir", "skin": "meshdir", "texture": "texturedir"}.get(element.tag, "")
        for key in _FILES & set(element.keys()):
            name = element.get(key, "")
            resolve_inside(path.parent, str(Path(folders.get(own, common)) / name), element)


def elements(root: Element) -> Iterator[Element]:
    """Return the elements of a tree in file order."""
    return map(as_element, root.iter())


def _expand(parent: Element, folder: Path, here: Path, seen: set[Path]) -> None:
    """Replace each <include> by the content of its file."""
    for child in map(as_element, list(parent)):
        if child.tag != "include":
            _expand(child, folder, here, seen)
            continue
        file = included_file(child, folder, here)
        if file in seen:
            raise ModelError(f"{child.place}: {file} is included twice; include it once", "E110")
        seen.add(file)
        included = read_xml(file)
        _expand(included, folder, file.parent, seen)
        position = list(parent).index(child)
        parent[position : position + 1] = list(included)


def _check_numbers(element: Element, key: str, value: str) -> None:
    limit = LARGEST if key in _BOUNDED else sys.float_info.max
    for word in value.split():
        try:
            # MuJoCo also reads hexadecimal numbers as C does.
            number = float.fromhex(word) if "0x" in word.lower() else float(word)
        except ValueError:
            continue  # a keyword, or an error that MuJoCo reports
        except OverflowError:
            number = np.inf
        if not abs(number) <= limit:
            raise ModelError(
                f'{element.place}: <{element.tag}> has {key}="{word}"; give a finite number in a '
                "robot's range",
                "E108",
            )
        if key == "mass" and number < 0:
            raise ModelError(
                f'{element.place}: <{element.tag}> has mass="{word}"; give 0 or more', "E108"
            )


def _count(element: ET.Element, tag: str) -> int:
    """Return the number of elements with a tag ("" for all), copies of <replicate> included."""
    own = int(tag in ("", element.tag))
    below = sum(_count(child, tag) for child in element)
    if element.tag == "replicate":
        with suppress(ValueError):  # MuJoCo reports an invalid count
            below *= max(int(element.get("count", "1")), 1)
    return own + below


@dataclass(frozen=True)
class ReducedMjcf:
    """The input of MuJoCo's compiler.

    Attributes
    ----------
    text : str
        MJCF with one start tag per line.
    places : tuple of str
        For each line, the element's place in the user's files.
    meshes : dict of str to bytes
        Contents of the files that the text names, so that MuJoCo opens no file.
    """

    text: str
    places: tuple[str, ...]
    meshes: dict[str, bytes]

    def located(self, message: str) -> str:
        """Return MuJoCo's message with line numbers replaced by places in the user's files."""
        return re.sub(r"line (\d+)", self._place, " ".join(message.split()))

    def _place(self, match: re.Match[str]) -> str:
        line = int(match[1])
        return self.places[line - 1] if 0 < line <= len(self.places) else match[0]


# Which shapes of bodies stay that state their inertia: those without a mesh, which may be missing.
Shapes = Literal["none", "simple", "all"]


def reduced_mjcf(root: Element, folder: Path, shapes: Shapes = "none") -> ReducedMjcf:
    """Reduce a model to bodies, joints and their equalities, inertias, sites, motors, some shapes.

    Shapes and their meshes always stay where a body takes its inertia from them.

    Parameters
    ----------
    root : Element
        Result of :func:`read_mjcf`.
    folder : Path
        Folder of the model.
    shapes : {"none", "simple", "all"}
        Which shapes stay of bodies that state their inertia; ``simple`` ones have no mesh.

    Raises
    ------
    ModelError
        When a mesh that determines an inertia is missing, too large, of another format or
        outside ``folder``.
    """
    compiler = {key: value for part in root.iterfind("compiler") for key, value in part.items()}
    kept = "all" if compiler.get("inertiafromgeom") == "true" else shapes
    reduced = _copied(root)
    reduced.extend(_section(one, kept) for one in root if one.tag not in _OMITTED_SECTIONS)
    meshes = _read_meshes(reduced, folder, compiler)
    # MuJoCo finds the range of a muscle by simulation, which may take arbitrarily long.
    no_ranges = Element("lengthrange", mode="none")
    reduced.insert(0, Element("compiler"))
    reduced[0].append(no_ranges)
    lines: list[str] = []
    places: list[str] = []
    _write(reduced, lines, places)
    return ReducedMjcf("\n".join(lines), tuple(places), meshes)


def _section(section: ET.Element, shapes: Shapes) -> Element:
    """Return the parts of a section that determine the tree and the inertias."""
    copy = _copied(section)
    if section.tag == "compiler":
        for key in _FOLDERS:
            copy.attrib.pop(key, None)
    elif section.tag == "option":
        copy.attrib = {key: value for key, value in section.items() if key == "gravity"}
    elif section.tag == "actuator":
        copy.extend(_copied(drive) for drive in section if "joint" in drive.attrib)
    elif section.tag == "equality":
        copy.extend(_copied(one) for one in section if one.tag == "joint")
    else:
        _copy_parts(section, copy, _OMITTED_PARTS.get(section.tag, set()), shapes)
    return copy


def _copy_parts(
    source: ET.Element, copy: Element, left_out: set[str], shapes: Shapes, *, simple: bool = False
) -> None:
    """Copy the children of an element, of its shapes only ``simple`` ones if that is given."""
    for child in source:
        if child.tag in left_out or (simple and child.tag == "geom" and "mesh" in child.attrib):
            continue
        below = _copied(child)
        # Materials are omitted, so references to them must go.
        below.attrib.pop("material", None)
        copy.append(below)
        if child.tag == "body":
            has_inertia = shapes != "all" and _states_inertia(child)
            no_shapes = has_inertia and shapes == "none"
            left_out_below = {"camera", "light", *(["geom"] if no_shapes else [])}
            _copy_parts(child, below, left_out_below, shapes, simple=has_inertia)
        else:
            _copy_parts(child, below, left_out, shapes, simple=simple)


def _states_inertia(body: ET.Element) -> bool:
    return any(
        child.tag == "inertial" or (child.tag == "frame" and _states_inertia(child))
        for child in body
    )


def _read_meshes(reduced: Element, folder: Path, compiler: dict[str, str]) -> dict[str, bytes]:
    """Read the meshes that the remaining shapes name, and remove the others."""
    used = {shape.get("mesh") for shape in elements(reduced) if shape.tag == "geom"}
    own = Path(compiler.get("meshdir", compiler.get("assetdir", "")))
    meshes: dict[str, bytes] = {}
    for section in reduced.iterfind("asset"):
        for mesh in map(as_element, list(section)):
            file = mesh.get("file")
            name = mesh.get("name", "" if file is None else Path(file).stem)
            if name not in used:
                section.remove(mesh)
            elif "builtin" in mesh.attrib:
                # Its resolution is a number in the file, which can keep MuJoCo busy for hours.
                raise ModelError(
                    f"{mesh.place}: a body takes its inertia from a built-in mesh; give that body "
                    "an <inertial>",
                    "E111",
                )
            elif file is not None:
                within = Path(file).name if compiler.get("strippath") == "true" else file
                path = resolve_inside(folder, str(own / within), mesh)
                key = f"{len(meshes)}{path.suffix.lower()}"
                left = MAX_MESH_BYTES - sum(map(len, meshes.values()))
                meshes[key] = _mesh(path, left, mesh)
                mesh.set("name", name)
                mesh.set("file", key)
    return meshes


def _mesh(path: Path, limit: int, element: Element) -> bytes:
    if path.suffix.lower() not in _MESH_FORMATS:
        raise ModelError(
            f"{element.place}: {path} is not a mesh; name a .stl, .obj or .msh file", "E112"
        )
    try:
        return read_bytes(path, limit)
    except ModelError as error:
        raise ModelError(
            f"{element.place}: a body takes its inertia from this mesh; supply it or give that "
            f"body an <inertial> ({error})",
            "E112",
        ) from None


def _copied(element: ET.Element) -> Element:
    """Return a copy of the element without its children."""
    copy, original = Element(element.tag, element.attrib), as_element(element)
    copy.file, copy.line = original.file, original.line
    return copy


def _write(element: Element, lines: list[str], places: list[str]) -> None:
    attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.items())
    lines.append(f"<{element.tag}{attributes}>")
    places.append(element.place)
    for child in map(as_element, element):
        _write(child, lines, places)
    lines[-1] += f"</{element.tag}>"
