"""A still picture of a robot scene as SVG, for print and for browsers without scripts."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.report.inertia_shapes import BOX_EDGES, InertiaBox
from symbid_ros.report.link_meshes import LinkMesh, simplified
from symbid_ros.report.palette import BEFORE_COLOUR, link_colour, rgb
from symbid_ros.report.robot_scene import RobotScene, SceneLink

# The camera's direction, from the robot's front left and above.
AZIMUTH, ELEVATION = np.radians(40.0), np.radians(18.0)
WIDTH, HEIGHT = 1000, 800  # of the drawing
_MARGIN = 30
_LIGHT = np.array([-0.35, 0.5, 0.8])  # right, up, towards the camera
_DARKEST, _SHADES = 0.55, 6
_BUDGET, _LEAST_FACES = 5000, 80  # triangles of the whole robot, and of a link
# Boxes up to this many times the robot's size are shown whole, of others the part this far from it.
_WHOLE_BOX, _BOX_MARGIN = 2.0, 0.25
_RASTER = 4  # drawing units of a pixel when hidden triangles are removed


def camera_direction(up: FloatArray) -> FloatArray:
    """Return the unit vector (3,) from a robot to the camera, in the base's axes."""
    forward = np.array([1.0, 0.0, 0.0])
    if abs(forward @ up) > 0.9:
        forward = np.array([0.0, 1.0, 0.0])
    forward -= (forward @ up) * up
    forward /= np.linalg.norm(forward)
    level = np.cos(AZIMUTH) * forward + np.sin(AZIMUTH) * np.cross(up, forward)
    direction: FloatArray = np.cos(ELEVATION) * level + np.sin(ELEVATION) * up
    return direction


@dataclass(frozen=True)
class _Camera:
    """An orthographic view: rows of ``axes`` point right, up and towards the camera."""

    axes: FloatArray
    centre: FloatArray
    scale: float
    columns: tuple[int, int]  # left edge and width of the drawing that are used

    @classmethod
    def around(cls, points: FloatArray, up: FloatArray) -> "_Camera":
        towards = camera_direction(up)
        right = np.cross(up, towards)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(towards, right), towards])
        seen = points @ axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * _MARGIN
        scale = float(np.min(room / np.maximum(high[:2] - low[:2], 1e-6)))
        used = min(WIDTH, int((high[0] - low[0]) * scale) + 6 * _MARGIN)
        return cls(axes, (low + high) / 2, scale, ((WIDTH - used) // 2, used))

    def project(self, points: FloatArray) -> FloatArray:
        """Return drawing coordinates and the depth (..., 3), larger towards the camera."""
        seen = (points @ self.axes.T - self.centre) * self.scale
        placed: FloatArray = seen * [1, -1, 1] + [WIDTH / 2, HEIGHT / 2, 0]
        return placed


def still_picture(scene: RobotScene) -> str:
    """Return the scene as an SVG element that takes its text colour from the page."""
    total = sum(len(mesh.faces) for mesh in scene.meshes)
    meshes = [
        simplified(mesh, max(_LEAST_FACES, len(mesh.faces) * _BUDGET // total))
        for mesh in scene.meshes
    ]
    corners = [
        mesh.vertices @ scene.links[mesh.link].rotation.T + scene.links[mesh.link].position
        for mesh in meshes
    ]
    boxes = [
        _corners(link, box) for link in scene.links for box in (link.before, link.after) if box
    ]
    camera = _Camera.around(_framed(corners, boxes), scene.up)
    left, width = camera.columns
    label = f"{scene.name}: links, inertia boxes and centres of mass"
    return "".join(
        [
            f'<svg class="robot-picture" viewBox="{left} 0 {width} {HEIGHT}" role="img" '
            f'aria-label="{escape(label, quote=True)}" xmlns="http://www.w3.org/2000/svg" '
            'fill="none" stroke-linejoin="round">',
            *_bodies(scene, meshes, corners, camera),
            *_overlays(scene, camera),
            "</svg>",
        ]
    )


def _framed(links: Sequence[FloatArray], boxes: Sequence[FloatArray]) -> FloatArray:
    """Return the points (N, 3) that the picture shows: links, and boxes as far as they are near.

    Boxes much larger than the robot, which impossible inertias have, do not shrink it.
    """
    if not links:
        return np.concatenate([*boxes, np.zeros((1, 3))])
    points = np.concatenate(links)
    low, high = points.min(axis=0), points.max(axis=0)
    size = float((high - low).max())
    margin = _BOX_MARGIN * size
    shown = [
        box
        if np.ptp(box, axis=0).max() <= _WHOLE_BOX * size
        else np.clip(box, low - margin, high + margin)
        for box in boxes
    ]
    return np.concatenate([points, *shown])


def _bodies(
    scene: RobotScene,
    meshes: Sequence[LinkMesh],
    vertices: Sequence[FloatArray],
    camera: _Camera,
) -> list[str]:
    """Return the visible triangles from back to front, filled by link and shade."""
    points, fills, shades = [], [], []
    for mesh, placed in zip(meshes, vertices, strict=True):
        triangles = camera.project(placed)[mesh.faces]
        edges = placed[mesh.faces]
        normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
        sizes = np.linalg.norm(normals, axis=1)
        solid = sizes > 0
        facing = (normals[solid] / sizes[solid, None]) @ camera.axes.T
        # Meshes of doubtful orientation are common, so both sides are lit.
        facing *= np.where(facing[:, 2:] < 0, -1.0, 1.0)
        light = np.clip(facing @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
        points.append(triangles[solid])
        shades.append(np.round(light * (_SHADES - 1)).astype(np.int64))
        fills.append(np.full(int(solid.sum()), mesh.link))
    if not points:
        return []
    triangles, fill, shade = map(np.concatenate, (points, fills, shades))
    shown = np.flatnonzero(_visible(triangles))
    order = shown[np.argsort(triangles[shown, :, 2].mean(axis=1), kind="stable")]
    parts, colour, path = [], "", ""
    for index in order:
        own = _shaded(link_colour(scene.links[fill[index]].determined), int(shade[index]))
        if own != colour:
            parts.append(_filled(colour, path))
            colour, path = own, ""
        path += _outline(triangles[index, :, :2])
    return [*parts, _filled(colour, path)]


def _filled(colour: str, path: str) -> str:
    # The stroke covers the seams between triangles.
    return f'<path fill="{colour}" stroke="{colour}" d="{path}"/>' if path else ""


def _outline(corners: FloatArray) -> str:
    (x, y), *others = np.round(corners).astype(int).tolist()
    path = f"M{x} {y}"
    for right, down in others:
        path += f"l{right - x} {down - y}"
        x, y = right, down
    return f"{path}z"


def _shaded(colour: str, shade: int) -> str:
    share = _DARKEST + (1 - _DARKEST) * shade / (_SHADES - 1)
    return "#" + bytes(round(255 * share * part) for part in rgb(colour)).hex()


def _visible(triangles: FloatArray) -> BoolArray:
    """Return which triangles (F, 3, 3) are in front at their centre or elsewhere."""
    depth = np.full((HEIGHT // _RASTER + 2, WIDTH // _RASTER + 2), -np.inf)
    owner: IntArray = np.full(depth.shape, -1)
    rows, columns = depth.shape
    scaled = triangles / [_RASTER, _RASTER, 1]
    for index, ((ax, ay, az), (bx, by, bz), (cx, cy, cz)) in enumerate(scaled.tolist()):
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        left, right = max(int(min(ax, bx, cx)), 0), min(int(max(ax, bx, cx)) + 2, columns)
        top, bottom = max(int(min(ay, by, cy)), 0), min(int(max(ay, by, cy)) + 2, rows)
        if area == 0 or left >= right or top >= bottom:
            continue
        x, y = np.arange(left, right), np.arange(top, bottom)[:, None]
        beta = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        gamma = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
        z = az + beta * (bz - az) + gamma * (cz - az)
        near = depth[top:bottom, left:right]
        front = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (z > near)
        near[front] = z[front]
        owner[top:bottom, left:right][front] = index
    visible = np.zeros(len(triangles), dtype=bool)
    visible[owner[owner >= 0]] = True
    # Triangles smaller than a pixel may own none.
    centre = scaled.mean(axis=1)
    column, row = (
        np.clip(np.round(centre[:, axis]).astype(int), 0, size - 1)
        for axis, size in ((0, columns), (1, rows))
    )
    visible |= centre[:, 2] >= depth[row, column] - 1
    return visible


def _corners(link: SceneLink, box: InertiaBox) -> FloatArray:
    corners: FloatArray = box.corners @ link.rotation.T + link.position
    return corners


def _overlays(scene: RobotScene, camera: _Camera) -> list[str]:
    """Return boxes and centres of mass, drawn over the links."""
    parts = []
    for link in scene.links:
        for box, style in (
            (link.before, f'stroke="{BEFORE_COLOUR}" stroke-dasharray="7 5" stroke-width="2"'),
            (link.after, 'stroke="currentColor" stroke-width="2.2"'),
        ):
            if box is not None:
                seen = np.round(camera.project(_corners(link, box))[:, :2]).astype(int)
                lines = "".join(
                    f"M{seen[a, 0]} {seen[a, 1]}L{seen[b, 0]} {seen[b, 1]}" for a, b in BOX_EDGES
                )
                parts.append(f'<path {style} d="{lines}"/>')
    for link in scene.links:
        for com, style in (
            (link.com_before, f'stroke="{BEFORE_COLOUR}" stroke-width="2.5"'),
            (link.com_after, 'fill="currentColor" stroke="#fff" stroke-width="1.5"'),
        ):
            if com is not None:
                x, y, _ = camera.project(link.rotation @ com + link.position)
                parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="6" {style}/>')
    for total, ink in ((scene.com_before, BEFORE_COLOUR), (scene.com_after, "#111")):
        x, y, _ = (round(float(number)) for number in camera.project(total))
        parts.append(
            f'<circle cx="{x}" cy="{y}" r="15" fill="#fff" stroke="{ink}" stroke-width="2.5"/>'
            f'<path fill="{ink}" d="M{x} {y}v-15a15 15 0 0 1 15 15zv15a15 15 0 0 1 -15 -15z"/>'
        )
    return parts
