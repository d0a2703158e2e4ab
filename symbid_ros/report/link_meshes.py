"""Triangles of each link for pictures: from the model file's shapes, or capsules."""

import io
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.visual_shapes import VisualShape, visual_shapes
from symbid_ros.user_files import MEBI, read_regular

# Triangles of the whole robot. More are not visible in a view as wide as a page.
BUDGET = 16_000
LEAST_FACES = 60  # of one mesh
MESH_FORMATS = {".stl", ".obj", ".dae", ".ply"}
MAX_MESH_BYTES = 64 * MEBI
# Parts of a mesh closer than this share of its size are joined before triangles are removed.
_JOINED = 1 / 400
_CARE = 3  # of the decimation, 0 to 10; at its default, 7, small links shrink by up to 20 %
_SECTIONS = 20  # of a circle
_THICKNESS = 0.12  # of a capsule between two joints, relative to its length

# Materials of COLLADA, of which one that is missing makes the parser drop its triangles.
_MATERIALS = re.compile(
    rb"<library_(effects|images|materials|cameras|lights)\b.*?</library_\1>"
    rb"|<bind_material\b.*?</bind_material>",
    re.DOTALL,
)

# Trimesh warns of textures that are missing, which are not used here.
logging.getLogger("trimesh").setLevel(logging.CRITICAL)


@dataclass(frozen=True)
class LinkMesh:
    """The triangles of a link.

    Attributes
    ----------
    link : int
        Index of the link.
    vertices : (V, 3) float64
        In the link's frame, m.
    faces : (F, 3) int64
        Indices of vertices, counterclockwise seen from outside.
    """

    link: int
    vertices: FloatArray
    faces: IntArray


@dataclass(frozen=True)
class LinkMeshes:
    """The triangles of a robot.

    Attributes
    ----------
    meshes : tuple of LinkMesh
        At most one for each link.
    remarks : tuple of str
        What could not be shown as the model file has it, one sentence each.
    """

    meshes: tuple[LinkMesh, ...]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class _Triangles:
    vertices: FloatArray
    faces: IntArray

    def placed(self, rotation: FloatArray, translation: FloatArray) -> "_Triangles":
        return _Triangles(self.vertices @ rotation.T + translation, self.faces)


class _UnreadableMeshError(Exception):
    """A mesh file that is too large, damaged or of an unknown format."""


def link_meshes(model: RobotModel, budget: int = BUDGET) -> LinkMeshes:
    """Return the triangles of all links.

    A link with mass but without readable shapes is shown as capsules between its joints.

    Parameters
    ----------
    model : RobotModel
        The robot.
    budget : int
        Approximate number of triangles of all links.
    """
    found = visual_shapes(model)
    remarks = list(found.remarks)
    parts: dict[int, list[_Triangles]] = {}
    unread: list[str] = []
    weights = _sizes(found.shapes)
    files: dict[Path, _Triangles] = {}
    for shape, weight in zip(found.shapes, weights / max(weights.sum(), 1e-12), strict=True):
        target = max(LEAST_FACES, round(budget * float(weight)))
        try:
            triangles = _triangles(shape, target, files)
        except _UnreadableMeshError as error:
            unread.append(str(error))
            continue
        parts.setdefault(shape.link, []).append(triangles.placed(shape.rotation, shape.translation))
    if unread:
        remarks.append(f"{len(unread)} meshes could not be read, for example {unread[0]}")
    for index, link in enumerate(model.links):
        if index not in parts and link.phi[0] > 0:
            parts[index] = _skeleton(model, index)
    meshes = tuple(_joined(index, parts[index]) for index in sorted(parts))
    return LinkMeshes(meshes, tuple(remarks))


def simplified(mesh: LinkMesh, faces: int) -> LinkMesh:
    """Return a link's mesh with at most about this number of triangles."""
    fewer = _decimated(_Triangles(mesh.vertices, mesh.faces), faces)
    return LinkMesh(mesh.link, fewer.vertices, fewer.faces)


def _sizes(shapes: Sequence[VisualShape]) -> FloatArray:
    """Return the weight of each shape's mesh in the budget: its file's size to a small power."""
    sizes = [0.0] * len(shapes)
    for index, shape in enumerate(shapes):
        if shape.file is not None:
            sizes[index] = float(shape.file.stat().st_size)
        elif shape.faces is not None:
            sizes[index] = 50.0 * len(shape.faces)
    weights: FloatArray = np.array(sizes) ** 0.4
    return weights


def _triangles(shape: VisualShape, target: int, files: dict[Path, _Triangles]) -> _Triangles:
    """Return a shape in its own frame; ``files`` holds the meshes read so far."""
    size = shape.size
    if shape.kind == "mesh":
        if shape.file is not None:
            if shape.file not in files:
                files[shape.file] = _read_mesh(shape.file)
            mesh = files[shape.file]
        elif shape.vertices is not None and shape.faces is not None:
            mesh = _Triangles(shape.vertices, shape.faces)
        else:
            raise _UnreadableMeshError("a mesh without triangles")
        mesh = _Triangles(mesh.vertices * size, mesh.faces)
        return _decimated(mesh, target)
    if shape.kind == "box":
        solid = trimesh.creation.box(extents=size)
    elif shape.kind == "cylinder":
        solid = trimesh.creation.cylinder(size[0] / 2, height=size[2], sections=_SECTIONS)
    elif shape.kind == "capsule":
        return _capsule(float(size[0]) / 2, float(size[2] - size[0]))
    else:
        solid = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
        solid.vertices *= size
    return _Triangles(np.array(solid.vertices), np.array(solid.faces))


def _capsule(radius: float, length: float) -> _Triangles:
    """Return a capsule along z around the origin; ``length`` is that of its cylinder."""
    solid = trimesh.creation.capsule(height=length, radius=radius, count=[_SECTIONS, 10])
    # Where it starts along z has changed between versions of trimesh.
    vertices = np.array(solid.vertices)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return _Triangles(vertices, np.array(solid.faces))


def mesh_vertices(file: Path) -> FloatArray | None:
    """Return the vertices (V, 3) of a mesh file, m; None if it cannot be read."""
    try:
        return _read_mesh(file).vertices
    except _UnreadableMeshError:
        return None


def _read_mesh(file: Path) -> _Triangles:
    """Return the triangles of a mesh file, in m if the file states its unit."""
    kind = file.suffix.lower()
    if kind not in MESH_FORMATS:
        raise _UnreadableMeshError(f"{file}: {kind} is not among {', '.join(sorted(MESH_FORMATS))}")
    try:
        scene = _parsed(read_regular(file, MAX_MESH_BYTES), kind)
        mesh = scene.to_mesh()
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        vertices, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces)
    except Exception as error:  # parsers of damaged files raise errors of all kinds
        raise _UnreadableMeshError(f"{file}: {type(error).__name__}: {error}") from None
    if not len(faces) or not np.all(np.isfinite(vertices)):
        raise _UnreadableMeshError(f"{file}: it has no triangles")
    return _Triangles(_unit(scene.units) * vertices, faces)


def _parsed(content: bytes, kind: str) -> Any:
    """Return the ``trimesh.Scene`` in a file's content; no file that it names is opened."""
    if kind == ".dae":
        if b"<!DOCTYPE" in content:  # its entities may expand without end
            raise ValueError("it has a <!DOCTYPE>")
        content = _MATERIALS.sub(b"", content)
    return trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], resolver=None)


def _unit(units: str | None) -> float:
    """Return the length in m of a unit such as ``0.0254 * meters``, which only COLLADA states."""
    try:
        return float((units or "").partition("*")[0])
    except ValueError:
        return 1.0


def _decimated(mesh: _Triangles, target: int) -> _Triangles:
    """Return a mesh with at most about ``target`` triangles."""
    if len(mesh.faces) <= target:
        return mesh
    size = float(np.ptp(mesh.vertices, axis=0).max())
    step = size * _JOINED
    joined = _clustered(mesh, step)
    if len(joined.faces) > target:
        vertices, faces = fast_simplification.simplify(
            joined.vertices.astype(np.float32),
            joined.faces.astype(np.int32),
            target_count=target,
            agg=_CARE,
        )
        joined = _Triangles(vertices.astype(np.float64), faces.astype(np.int64))
    # Edges of many small parts cannot be removed one by one.
    while len(joined.faces) > 1.5 * target and step < size / 4:
        step *= 1.5
        joined = _clustered(joined, step)
    return joined


def _clustered(mesh: _Triangles, step: float) -> _Triangles:
    """Return the mesh with all vertices in a cube of ``step`` m merged into one."""
    cells = np.round((mesh.vertices - mesh.vertices.min(axis=0)) / step).astype(np.int64)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    faces = cell.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (a != c)]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return _Triangles(mesh.vertices[first], faces[np.sort(kept)])


def _skeleton(model: RobotModel, index: int) -> list[_Triangles]:
    """Return capsules from a link's origin to its joints; to its centre of mass at the end."""
    _, com, _ = com_from_phi(model.links[index].phi)
    ends = [joint.translation for joint in model.joints if joint.parent == index]
    reach = [float(np.linalg.norm(end)) for end in ends]
    if not ends or max(reach) < 1e-3:
        ends, reach = [2 * com], [2 * float(np.linalg.norm(com))]
    radius = max(_THICKNESS * max(reach) / 2, 0.005)
    capsules = []
    for end, length in zip(ends, reach, strict=True):
        capsule = _capsule(radius, length)
        direction = end / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
        capsules.append(capsule.placed(_along(direction), end / 2))
    return capsules


def _along(direction: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) whose z axis is a unit vector."""
    side = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(side, direction)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def _joined(link: int, parts: Sequence[_Triangles]) -> LinkMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return LinkMesh(link, np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
