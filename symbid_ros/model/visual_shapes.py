"""The shapes of a model file, to see or to collide: primitives and meshes fixed to links."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote, urlsplit

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import ModelError
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.mjcf import body_names, compile_with_shapes
from symbid_ros.model.rotation import rotation_from_quaternion
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.urdf import UrdfReader
from symbid_ros.model.xml_file import Element, as_element, place, read_xml

# Environment variables with folders of packages, and where in these folders packages are.
PACKAGE_PATHS = {"AMENT_PREFIX_PATH": "share", "ROS_PACKAGE_PATH": ""}
_UNIT = np.ones(3)

ShapeKind = Literal["box", "cylinder", "sphere", "capsule", "mesh"]


@dataclass(frozen=True)
class VisualShape:
    """A visible shape of a link.

    Attributes
    ----------
    link : int
        Index of the link that carries it.
    kind : {"box", "cylinder", "sphere", "capsule", "mesh"}
    rotation, translation : (3, 3) and (3,) float64
        Pose of the shape in the link's frame. Cylinders and capsules are along its z axis.
    size : (3,) float64
        Diameters or edge lengths along the shape's axes, m; of a mesh its scale. The hemispheres of
        a capsule are included.
    file : Path or None
        File of a mesh.
    vertices, faces : (V, 3) float64 and (F, 3) int64, or None
        Triangles of a mesh that has been read.
    """

    link: int
    kind: ShapeKind
    rotation: FloatArray
    translation: FloatArray
    size: FloatArray
    file: Path | None = None
    vertices: FloatArray | None = None
    faces: IntArray | None = None


@dataclass(frozen=True)
class VisualShapes:
    """The shapes of a robot.

    Attributes
    ----------
    shapes : tuple of VisualShape
    remarks : tuple of str
        Which shapes the file names but could not be found, one sentence each.
    """

    shapes: tuple[VisualShape, ...] = ()
    remarks: tuple[str, ...] = ()


def visual_shapes(model: RobotModel) -> VisualShapes:
    """Return the shapes that the robot's model file shows.

    The collision shapes of links without a visual are taken. Shapes only serve pictures, so a file
    that cannot be read gives none, and a remark.
    """
    return _shapes(model, collision=False)


def collision_shapes(model: RobotModel) -> VisualShapes:
    """Return the shapes with which links of the model file touch each other and the world."""
    return _shapes(model, collision=True)


def _shapes(model: RobotModel, *, collision: bool) -> VisualShapes:
    path = Path(model.source)
    try:
        read = _mjcf_shapes if is_mjcf(path) else _urdf_shapes
        return read(model, path, collision=collision)
    except ModelError as error:
        return VisualShapes(remarks=(str(error),))


def _urdf_shapes(model: RobotModel, path: Path, *, collision: bool) -> VisualShapes:
    robot = read_xml(path)
    reader = UrdfReader(str(path), robot)
    known = {frame.name for frame in model.frames} | set(model.link_names)
    shapes: list[VisualShape] = []
    missing: list[str] = []
    for name, link in reader.links.items():
        if name not in known:  # the root link "world" of a fixed robot
            continue
        frame = model.frame(name)
        visuals = [] if collision else link.findall("visual")
        for visual in visuals or link.findall("collision"):
            rotation, translation = reader.pose(visual)
            geometry = visual.find("geometry")
            for element in () if geometry is None else map(as_element, geometry):
                found = _urdf_shape(element, path)
                if found is None:
                    missing.append(element.get("filename", element.tag))
                    continue
                kind, size, file = found
                shapes.append(
                    VisualShape(
                        frame.link,
                        kind,
                        frame.rotation @ rotation,
                        frame.rotation @ translation + frame.translation,
                        size,
                        file,
                    )
                )
    if not missing:
        return VisualShapes(tuple(shapes))
    remark = (
        f"{len(missing)} of {len(missing) + len(shapes)} shapes were not found, for example "
        f"{missing[0]}; add the folder of its package to ROS_PACKAGE_PATH"
    )
    return VisualShapes(tuple(shapes), (remark,))


def _urdf_shape(element: Element, model: Path) -> tuple[ShapeKind, FloatArray, Path | None] | None:
    """Return the kind, size and file of a child of <geometry>; None if its file is missing."""
    if element.tag == "box":
        return "box", _numbers(element, "size", 3), None
    if element.tag == "sphere":
        return "sphere", 2 * np.repeat(_numbers(element, "radius", 1), 3), None
    if element.tag in ("cylinder", "capsule"):
        width = 2 * _numbers(element, "radius", 1)
        length = _numbers(element, "length", 1)
        if element.tag == "cylinder":
            return "cylinder", np.concatenate([width, width, length]), None
        return "capsule", np.concatenate([width, width, length + width]), None
    if element.tag == "mesh":
        file = resolve_mesh(element.get("filename", ""), model)
        scale = _numbers(element, "scale", 3) if "scale" in element.attrib else _UNIT
        return None if file is None else ("mesh", scale, file)
    return None


def _numbers(element: Element, key: str, count: int) -> FloatArray:
    try:
        numbers = np.array([float(word) for word in element.get(key, "").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.all(np.isfinite(numbers)):
        raise ModelError(
            f"{place(element)}: <{element.tag}> needs {key} with {count} numbers", "E108"
        )
    return numbers


def resolve_mesh(name: str, model: Path) -> Path | None:
    """Return the file that a URDF's mesh ``filename`` means, or None if there is none.

    ``package://PACKAGE/…`` is looked for in the folders of ``AMENT_PREFIX_PATH`` and
    ``ROS_PACKAGE_PATH``, then in all folders above the model file. Other names are paths, relative
    to the model file.
    """
    try:
        parts = urlsplit(name)
    except ValueError:
        return None
    inside = Path(unquote(parts.path).lstrip("/"))
    if parts.scheme in ("package", "model"):
        candidates = [folder / inside for folder in _package_folders(parts.netloc, model)]
    elif parts.scheme == "file":
        candidates = [Path("/") / inside]
    else:
        candidates = [model.parent / name]
    # os.path.isfile is False for names that no file can have, where Path.is_file may raise.
    return next((path for path in candidates if os.path.isfile(path)), None)


def _package_folders(package: str, model: Path) -> Iterator[Path]:
    for variable, share in PACKAGE_PATHS.items():
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            yield Path(folder) / share / package
            if Path(folder).name == package:
                yield Path(folder)
    for above in model.resolve().parents:
        if above.name == package:
            yield above
        yield above / package


# MuJoCo's types of shapes with a volume.
_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = range(2, 8)
_KINDS: dict[int, ShapeKind] = {
    _SPHERE: "sphere",
    _CAPSULE: "capsule",
    _ELLIPSOID: "sphere",
    _CYLINDER: "cylinder",
    _BOX: "box",
    _MESH: "mesh",
}


def _mjcf_shapes(model: RobotModel, path: Path, *, collision: bool) -> VisualShapes:
    m = compile_with_shapes(path)
    names = body_names(m)
    known = {frame.name for frame in model.frames} | set(model.link_names)
    rotations = rotation_from_quaternion(np.array(m.geom_quat).reshape(-1, 4))
    is_visual = (np.array(m.geom_contype) == 0) & (np.array(m.geom_conaffinity) == 0)
    bodies = np.array(m.geom_bodyid)
    shapes = []
    for geom in range(m.ngeom):
        body, kind = int(bodies[geom]), int(m.geom_type[geom])
        wanted = not collision and bool(np.any(is_visual[bodies == body]))
        if names[body] not in known or kind not in _KINDS:
            continue
        if (wanted or collision) and is_visual[geom] != wanted:
            continue
        frame = model.frame(names[body])
        vertices, faces = _mjcf_mesh(m, int(m.geom_dataid[geom])) if kind == _MESH else (None, None)
        shapes.append(
            VisualShape(
                frame.link,
                _KINDS[kind],
                frame.rotation @ rotations[geom],
                frame.rotation @ m.geom_pos[geom] + frame.translation,
                _mjcf_size(kind, np.array(m.geom_size[geom])),
                None,
                vertices,
                faces,
            )
        )
    return VisualShapes(tuple(shapes))


def _mjcf_size(kind: int, half: FloatArray) -> FloatArray:
    """Return the diameters of a shape from MuJoCo's half sizes."""
    if kind == _MESH:
        return _UNIT
    if kind == _SPHERE:
        return 2 * np.repeat(half[:1], 3)
    if kind in (_CAPSULE, _CYLINDER):
        ends = half[0] if kind == _CAPSULE else 0.0
        return 2 * np.array([half[0], half[0], half[1] + ends])
    return 2 * half


def _mjcf_mesh(m: Any, mesh: int) -> tuple[FloatArray, IntArray]:
    first, count = m.mesh_vertadr[mesh], m.mesh_vertnum[mesh]
    face, faces = m.mesh_faceadr[mesh], m.mesh_facenum[mesh]
    return (
        np.array(m.mesh_vert[first : first + count], dtype=np.float64),
        np.array(m.mesh_face[face : face + faces], dtype=np.int64),
    )
