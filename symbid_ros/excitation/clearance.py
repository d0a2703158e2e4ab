"""Distances between the links of a robot, and to a floor, by MuJoCo.

The shapes are the collision shapes of the model file; meshes become their convex hulls. Only pairs
of links whose distance changes with the posture are of interest.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations

import mujoco
import numpy as np
from scipy.linalg import null_space
from scipy.spatial import ConvexHull, QhullError

from symbid_ros.arrays import FloatArray
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.visual_shapes import VisualShape, collision_shapes
from symbid_ros.report.link_meshes import mesh_vertices

FLOOR = -1  # in place of a link
# Distance over which the share that a pair uses of its clearance grows by one, m. Pairs that are
# farther apart than the margin and this distance do not count.
SCALE = 0.1
# Pairs closer than the margin in this share of random postures touch by design, such as the hulls
# of neighbours of neighbours.
ALWAYS = 0.8
# Of a mesh; a hull with so few differs by a millimetre, and its closest points are found faster.
HULL_VERTICES = 64
FLOOR_SIZE, THICKNESS = 20.0, 0.5  # m

Pair = tuple[int, int]
# Distance, the two geoms, and the segment (6,) between their closest points.
Closest = tuple[float, int, int, FloatArray]


@dataclass(frozen=True)
class _Geometry:
    """MuJoCo's model with shapes, its links' geoms, and the pairs of links to keep apart."""

    model: mujoco.MjModel
    geoms: dict[int, list[int]]


class Clearance:
    """The distances that a trajectory must keep.

    Parameters
    ----------
    robot : RobotModel
        With a fixed base.
    margin : float
        Smallest distance, m.
    postures : (N, J) float64
        Random postures, which tell the pairs of links that are always close.
    floor : float or None
        Height of a floor above the base's origin, against gravity, m; None for no floor.

    Attributes
    ----------
    remarks : tuple of str
        What is not checked, one sentence each.
    """

    def __init__(
        self, robot: RobotModel, margin: float, postures: FloatArray, floor: float | None = None
    ) -> None:
        self._robot, self.margin = robot, margin
        geometry, remarks = _with_shapes(robot, floor)
        self._model, self._data = geometry.model, mujoco.MjData(geometry.model)
        self._geoms = geometry.geoms
        self._addresses = [
            int(geometry.model.joint(joint.name).qposadr[0]) for joint in robot.joints
        ]
        self._radii = geometry.model.geom_rbound.copy()
        neighbours = {(joint.parent, index + 1) for index, joint in enumerate(robot.joints)}
        rigid = {pair for pair in combinations(sorted(self._geoms), 2) if self._is_rigid(pair)}
        self._set_pairs(
            pair
            for pair in combinations(sorted(self._geoms), 2)
            if pair not in neighbours and pair not in rigid
        )
        always = self._always_close(postures)
        self._set_pairs([pair for pair in self._pairs if pair not in always])
        if always:
            names = ", ".join(f"{self._name(a)} and {self._name(b)}" for a, b in sorted(always))
            remarks = (*remarks, f"distances of pairs that are always close: {names}")
        self.remarks = remarks

    @property
    def is_empty(self) -> bool:
        """Whether no two links with shapes have to be kept apart."""
        return not self._pairs

    def smallest(self, position: FloatArray) -> tuple[float, str]:
        """Return the smallest distance at postures (N, J), m, and the names of the two links.

        It is infinite if no pair comes closer than the margin and ``SCALE``.
        """
        smallest, names = np.inf, ""
        for posture in position:
            for index, (distance, *_) in self._closest(posture).items():
                if distance < smallest:
                    smallest = distance
                    names = " and ".join(map(self._name, self._pairs[index]))
        return smallest, names

    def usage(self, position: FloatArray) -> float:
        """Return the largest share of a clearance that postures (N, J) use; at most 1 is allowed.

        The share is 1 at the margin and grows by 1 for each ``SCALE`` below it.
        """
        distance, _ = self.smallest(position)
        return float(max(0.0, self._share(distance)))

    def shares(self, position: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield for each pair the share (N,) used at postures (N, J), and its slopes (N, J)."""
        count, pairs = len(position), len(self._pairs)
        shares = np.zeros((pairs, count))
        slopes = np.zeros((pairs, count, len(self._robot.joints)))
        for row, posture in enumerate(position):
            for index, closest in self._closest(posture).items():
                shares[index, row] = self._share(closest[0])
                slopes[index, row] = -self._slope(*closest) / SCALE
        for joint, mimic in self._robot.followers.items():
            slopes[..., mimic.leader] += mimic.multiplier * slopes[..., joint]
        yield from zip(shares, slopes, strict=True)

    def _share(self, distance: float) -> float:
        return 1.0 + (self.margin - distance) / SCALE

    def _name(self, link: int) -> str:
        return "floor" if link == FLOOR else self._robot.link_names[link]

    def _is_rigid(self, pair: Pair) -> bool:
        """Return whether no joint moves two links relative to each other."""
        ancestors = self._robot.ancestors
        one, other = (
            np.zeros(len(ancestors), dtype=bool) if link == FLOOR else ancestors[:, link]
            for link in pair
        )
        return bool(np.array_equal(one, other))

    def _place(self, posture: FloatArray) -> None:
        data = self._data
        data.qpos[self._addresses] = posture
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)

    def _set_pairs(self, pairs: Iterable[Pair]) -> None:
        """Set the pairs of links to compare, and list the pairs of their shapes."""
        self._pairs = list(pairs)
        listed = [
            (index, one, other)
            for index, pair in enumerate(self._pairs)
            for one in self._geoms[pair[0]]
            for other in self._geoms[pair[1]]
        ]
        self._shape_pairs = np.array(listed, dtype=np.int64).reshape(-1, 3)
        _, one, other = self._shape_pairs.T
        self._reach = self._radii[one] + self._radii[other] + self.margin + SCALE

    def _closest(self, posture: FloatArray) -> dict[int, Closest]:
        """Return the distance of each pair of links near each other, by its index."""
        self._place(posture)
        model, data = self._model, self._data
        _, one, other = self._shape_pairs.T
        gap = data.geom_xpos[one] - data.geom_xpos[other]
        near = np.flatnonzero(np.einsum("ij,ij->i", gap, gap) < self._reach**2)
        found: dict[int, Closest] = {}
        segment = np.zeros(6)
        for index, first, second in self._shape_pairs[near].tolist():
            smallest = found[index][0] if index in found else self.margin + SCALE
            distance = mujoco.mj_geomDistance(model, data, first, second, smallest, segment)
            if distance < smallest:
                found[index] = distance, first, second, segment.copy()
        return found

    def _slope(self, distance: float, one: int, other: int, segment: FloatArray) -> FloatArray:
        """Return the derivative (J,) of a distance by the positions of the joints."""
        if abs(distance) < 1e-9:
            return np.zeros(len(self._addresses))
        normal = (segment[3:] - segment[:3]) / distance
        slope = np.zeros(self._model.nv)
        jacobian = np.zeros((3, self._model.nv))
        for geom, point, sign in ((one, segment[:3], -1.0), (other, segment[3:], 1.0)):
            body = int(self._model.geom_bodyid[geom])
            mujoco.mj_jac(self._model, self._data, jacobian, None, point, body)
            slope += sign * (normal @ jacobian)
        return slope[self._addresses]

    def _always_close(self, postures: FloatArray) -> set[Pair]:
        counts = dict.fromkeys(self._pairs, 0)
        for posture in postures:
            for index, (distance, *_) in self._closest(posture).items():
                counts[self._pairs[index]] += distance < self.margin
        return {pair for pair, count in counts.items() if count > ALWAYS * len(postures)}


def _with_shapes(robot: RobotModel, floor: float | None) -> tuple[_Geometry, tuple[str, ...]]:
    """Return MuJoCo's model of a robot with its collision shapes, and what could not be read."""
    found = collision_shapes(robot)
    spec = mujoco.MjSpec.from_string(mjcf_text(robot))
    bodies = {body.name: body for body in spec.bodies}
    names: dict[int, list[str]] = {}
    unread = 0
    for number, shape in enumerate(found.shapes):
        link = robot.links[shape.link].name
        body = bodies.get(link, spec.worldbody if shape.link == 0 else None)
        name = f"shape_{number}"
        if body is None or not _add_shape(spec, body, shape, name):
            unread += 1
            continue
        names.setdefault(shape.link, []).append(name)
    if floor is not None:
        up = -robot.gravity / np.linalg.norm(robot.gravity)
        _add_floor(spec, up, floor)
        names[FLOOR] = ["floor"]
    model = spec.compile()
    remarks = list(found.remarks)
    if unread:
        remarks.append(f"{unread} collision shapes that cannot be read")
    bare = [
        robot.links[index].name
        for index in range(1, len(robot.links))
        if index not in names and robot.links[index].phi[0] > 0
    ]
    if bare:
        remarks.append(f"links without collision shapes: {', '.join(bare)}")
    geoms = {link: [model.geom(name).id for name in each] for link, each in names.items()}
    return _Geometry(model, geoms), tuple(remarks)


def _add_shape(spec: mujoco.MjSpec, body: object, shape: VisualShape, name: str) -> bool:
    """Add a shape to a body; return whether it could be read."""
    ball = mujoco.mjtGeom.mjGEOM_SPHERE  # exact, unlike an ellipsoid
    kinds = {
        "box": (mujoco.mjtGeom.mjGEOM_BOX, shape.size / 2),
        "sphere": (
            ball if np.ptp(shape.size) == 0 else mujoco.mjtGeom.mjGEOM_ELLIPSOID,
            shape.size / 2,
        ),
        "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, [shape.size[0] / 2, shape.size[2] / 2, 0]),
        "capsule": (
            mujoco.mjtGeom.mjGEOM_CAPSULE,
            [shape.size[0] / 2, (shape.size[2] - shape.size[0]) / 2, 0],
        ),
    }
    common = {
        "name": name,
        "pos": shape.translation,
        "quat": quaternion_from_rotation(shape.rotation),
        "mass": 0.0,
        "contype": 0,
        "conaffinity": 0,
    }
    if shape.kind != "mesh":
        kind, size = kinds[shape.kind]
        body.add_geom(type=kind, size=size, **common)  # type: ignore[attr-defined]
        return True
    vertices = shape.vertices if shape.file is None else mesh_vertices(shape.file)
    if vertices is None:
        return False
    try:
        hull = ConvexHull(vertices * shape.size)
    except (QhullError, ValueError):  # flat or too few points
        return False
    placed = hull.points[hull.vertices] @ shape.rotation.T + shape.translation
    # MuJoCo moves a mesh to its centre of mass and turns it; the geom's pose accounts for that.
    spec.add_mesh(
        name=name,
        uservert=placed.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        maxhullvert=HULL_VERTICES,
    )
    common |= {"pos": [0, 0, 0], "quat": [1, 0, 0, 0]}
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **common)  # type: ignore[attr-defined]
    return True


def _add_floor(spec: mujoco.MjSpec, up: FloatArray, height: float) -> None:
    """Add a thick plate whose upper side is at a height along the direction ``up`` (3,)."""
    sides = null_space(up[None])
    sides[:, 0] *= np.sign(np.linalg.det(np.column_stack([sides, up])))
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[FLOOR_SIZE / 2, FLOOR_SIZE / 2, THICKNESS / 2],
        pos=(height - THICKNESS / 2) * up,
        quat=quaternion_from_rotation(np.column_stack([sides, up])),
    )
