"""MJCF from anybody: includes, files and sizes, checked before MuJoCo sees anything of it."""

import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from symbid_ros.errors import ModelError
from symbid_ros.model.xml_file import LARGEST, MAX_ELEMENTS, Element, read_bytes, read_xml

# Bodies and joints cost MuJoCo's compiler time and memory with their square.
MAX_BODIES = 2_000
MAX_JOINTS = 1_000

# Elements that load code or other models, or stand for bodies that are not written out.
_REFUSED = {
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
    *("damping", "frictionloss", "armature", "ref"),
}
# Of an asset, a compiler setting or a skin: names of files and folders.
_FILES = {"file", "fileup", "filedown", "fileleft", "fileright", "filefront", "fileback"}

MAX_MESH_BYTES = 64 << 20  # of all meshes that decide inertias

# What is left out is listed, not what is kept: MuJoCo is to refuse what it does not know.
_NO_SECTIONS = {
    *("size", "visual", "statistic", "custom", "contact", "deformable", "equality", "tendon"),
    *("sensor", "keyframe"),
}
_NO_PARTS = {
    "default": {"material", "camera", "light", "pair", "equality", "tendon"},
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
        When a file cannot be read, an include leaves the model's folder or comes twice, an
        element would load code or another model, a number is not finite or absurd, or the
        model is larger than the limits.
    """
    root = read_xml(path)
    if root.tag != "mujoco":
        raise ModelError(f"{path}: the root element is <{root.tag}>, an MJCF has <mujoco>")
    _expand(root, path.parent, path.parent, {path.resolve()})
    for element in elements(root):
        if element.tag in _REFUSED and element is not root:
            raise ModelError(
                f"{element.place}: <{element.tag}>: {_REFUSED[element.tag]}; remove it"
            )
        for key, value in element.items():
            if key not in _NAMES:
                _check_numbers(element, key, value)
    for tag, limit in (("", MAX_ELEMENTS), ("body", MAX_BODIES), ("joint", MAX_JOINTS)):
        if _count(root, tag) > limit:
            what = {"": "elements", "body": "bodies", "joint": "joints"}[tag]
            raise ModelError(f"{path}: more than {limit} {what}, the limit; reduce the model")
    return root


def inside(folder: Path, name: str, element: Element) -> Path:
    """Return the path of a file that ``element`` names, which must lie in ``folder``.

    Raises
    ------
    ModelError
        When it lies elsewhere, symbolic links followed.
    """
    try:
        target, home = (folder / name).resolve(), folder.resolve()
        if target.is_relative_to(home):
            return target
    except (OSError, ValueError, RuntimeError):
        # A name too long, with a NUL, or of links that go round.
        pass
    raise ModelError(
        f"{element.place}: {name!r} is not in the model's folder {folder}; copy it there and name "
        "it by a relative path"
    )


def included_file(element: Element, folder: Path, here: Path) -> Path:
    """Return the file that is included: MuJoCo looks beside the model, then beside ``here``.

    Raises
    ------
    ModelError
        When it lies outside the model's ``folder``.
    """
    name = element.get("file", "")
    file = inside(folder, name, element)
    if os.path.isfile(file):  # also of names that are none
        return file
    return inside(folder, os.path.relpath(here / name, folder), element)


def require_files_inside(path: Path) -> None:
    """Refuse an MJCF that names files outside its own folder, before all of it is compiled.

    Raises
    ------
    ModelError
        As :func:`read_mjcf`, or when a mesh, texture or height field lies elsewhere.
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
            inside(path.parent, str(Path(folders.get(own, common)) / name), element)


def elements(root: Element) -> Iterator[Element]:
    """Walk through a tree in the file's order."""
    for element in root.iter():
        assert isinstance(element, Element)
        yield element


def _expand(parent: Element, folder: Path, here: Path, seen: set[Path]) -> None:
    """Put the content of included files where they are included."""
    for child in list(parent):
        assert isinstance(child, Element)
        if child.tag != "include":
            _expand(child, folder, here, seen)
            continue
        file = included_file(child, folder, here)
        if file in seen:
            raise ModelError(f"{child.place}: {file} is included twice; include it once")
        seen.add(file)
        included = read_xml(file)
        _expand(included, folder, file.parent, seen)
        position = list(parent).index(child)
        parent[position : position + 1] = list(included)


def _check_numbers(element: Element, key: str, value: str) -> None:
    limit = LARGEST if key in _BOUNDED else sys.float_info.max
    for word in value.split():
        try:
            # MuJoCo also reads the hexadecimal numbers of C.
            number = float.fromhex(word) if "0x" in word.lower() else float(word)
        except ValueError:
            continue  # a word, or MuJoCo says what is wrong with it
        except OverflowError:
            number = np.inf
        if not abs(number) <= limit:
            raise ModelError(
                f'{element.place}: <{element.tag}> has {key}="{word}"; give a finite number of '
                "a robot's size"
            )
        if key == "mass" and number < 0:
            raise ModelError(f'{element.place}: <{element.tag}> has mass="{word}"; give 0 or more')


def _count(element: ET.Element, tag: str) -> int:
    """Return how many elements of a kind (all for "") there are once copies are made."""
    own = int(tag in ("", element.tag))
    below = sum(_count(child, tag) for child in element)
    if element.tag == "replicate":
        with suppress(ValueError):  # MuJoCo says what is wrong with it
            below *= max(int(element.get("count", "1")), 1)
    return own + below


@dataclass(frozen=True)
class BareMjcf:
    """What MuJoCo gets to compile.

    Attributes
    ----------
    text : str
        MJCF, the start tag of one element on each line.
    places : tuple of str
        For each line, where that element is in the user's files.
    meshes : dict of str to bytes
        The files that the text names, so that MuJoCo opens none.
    """

    text: str
    places: tuple[str, ...]
    meshes: dict[str, bytes]

    def located(self, message: str) -> str:
        """Return MuJoCo's message with its line numbers as places in the user's files."""
        return re.sub(r"line (\d+)", self._place, " ".join(message.split()))

    def _place(self, match: re.Match[str]) -> str:
        line = int(match[1])
        return self.places[line - 1] if 0 < line <= len(self.places) else match[0]


def bare_mjcf(root: Element, folder: Path) -> BareMjcf:
    """Reduce a model to its moving bodies, without what is only seen, touched or controlled.

    Shapes stay where a body takes its inertia from them, and their meshes with them: a
    mesh that decides nothing need not exist.

    Parameters
    ----------
    root : Element
        As :func:`read_mjcf` returns it.
    folder : Path
        The model's.

    Raises
    ------
    ModelError
        When a mesh that a body takes its inertia from is missing, too large, of another
        format or outside ``folder``.
    """
    compiler = {key: value for part in root.iterfind("compiler") for key, value in part.items()}
    reducer = _Reducer(compiler.get("inertiafromgeom") == "true")
    bare = Element(root.tag, root.attrib)
    bare.file, bare.line = root.file, root.line
    for section in root:
        if section.tag not in _NO_SECTIONS:
            bare.append(reducer.section(section))
    meshes = _take_meshes(bare, folder, compiler)
    # The range of a muscle is found by simulating it, for as long as the file demands.
    no_ranges = Element("lengthrange", mode="none")
    bare.insert(0, Element("compiler"))
    bare[0].append(no_ranges)
    lines: list[str] = []
    places: list[str] = []
    _write(bare, lines, places)
    return BareMjcf("\n".join(lines), tuple(places), meshes)


class _Reducer:
    """Copies the parts of a model that decide its tree and its inertias."""

    def __init__(self, inertia_from_shapes: bool) -> None:
        self._inertia_from_shapes = inertia_from_shapes

    def section(self, section: ET.Element) -> Element:
        copy = _copied(section)
        if section.tag == "compiler":
            for key in _FOLDERS:
                copy.attrib.pop(key, None)
        elif section.tag == "option":
            copy.attrib = {key: value for key, value in section.items() if key == "gravity"}
        elif section.tag == "actuator":
            copy.extend(_copied(drive) for drive in section if "joint" in drive.attrib)
        else:
            self._copy_parts(section, copy, _NO_PARTS.get(section.tag, set()))
        return copy

    def _copy_parts(self, source: ET.Element, copy: Element, left_out: set[str]) -> None:
        for child in source:
            if child.tag in left_out:
                continue
            below = _copied(child)
            # Looks, which name materials that are not there.
            below.attrib.pop("material", None)
            copy.append(below)
            if child.tag == "body":
                left_out_below = {"camera", "light"} | self._superfluous_shapes(child)
                self._copy_parts(child, below, left_out_below)
            else:
                self._copy_parts(child, below, left_out)

    def _superfluous_shapes(self, body: ET.Element) -> set[str]:
        stated = not self._inertia_from_shapes and _states_inertia(body)
        return {"geom"} if stated else set()


def _states_inertia(body: ET.Element) -> bool:
    return any(
        child.tag == "inertial" or (child.tag == "frame" and _states_inertia(child))
        for child in body
    )


def _take_meshes(bare: Element, folder: Path, compiler: dict[str, str]) -> dict[str, bytes]:
    """Read the meshes that shapes still name, and drop the others."""
    used = {shape.get("mesh") for shape in elements(bare) if shape.tag == "geom"}
    own = Path(compiler.get("meshdir", compiler.get("assetdir", "")))
    meshes: dict[str, bytes] = {}
    for section in bare.iterfind("asset"):
        for mesh in list(section):
            assert isinstance(mesh, Element)
            file = mesh.get("file")
            name = mesh.get("name", "" if file is None else Path(file).stem)
            if name not in used:
                section.remove(mesh)
            elif "builtin" in mesh.attrib:
                # Its size is a number in the file: a short line can keep MuJoCo busy for hours.
                raise ModelError(
                    f"{mesh.place}: a body takes its inertia from a built-in mesh; give that body "
                    "an <inertial>"
                )
            elif file is not None:
                within = Path(file).name if compiler.get("strippath") == "true" else file
                path = inside(folder, str(own / within), mesh)
                key = f"{len(meshes)}{path.suffix.lower()}"
                left = MAX_MESH_BYTES - sum(map(len, meshes.values()))
                meshes[key] = _mesh(path, left, mesh)
                mesh.set("name", name)
                mesh.set("file", key)
    return meshes


def _mesh(path: Path, limit: int, element: Element) -> bytes:
    if path.suffix.lower() not in _MESH_FORMATS:
        raise ModelError(f"{element.place}: {path} is no mesh; name a .stl, .obj or .msh file")
    try:
        return read_bytes(path, limit)
    except ModelError as error:
        raise ModelError(
            f"{element.place}: a body takes its inertia from this mesh; supply it or give that "
            f"body an <inertial> ({error})"
        ) from None


def _copied(element: ET.Element) -> Element:
    """Return the element without its children."""
    assert isinstance(element, Element)
    copy = Element(element.tag, element.attrib)
    copy.file, copy.line = element.file, element.line
    return copy


def _write(element: Element, lines: list[str], places: list[str]) -> None:
    attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.items())
    lines.append(f"<{element.tag}{attributes}>")
    places.append(element.place)
    for child in element:
        assert isinstance(child, Element)
        _write(child, lines, places)
    lines[-1] += f"</{element.tag}>"
