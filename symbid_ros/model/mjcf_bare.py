"""An MJCF reduced to what identification needs: bodies, joints, inertias, sites and motors."""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from symbid_ros.errors import ModelError
from symbid_ros.model.mjcf_source import elements, inside
from symbid_ros.model.xml_tree import Element, read_bytes

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
        As :func:`symbid_ros.model.mjcf_source.read_mjcf` returns it.
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
