"""Markers that show a live estimate in RViz and Foxglove, over the robot's description."""

import time
from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.rows.change_monitor import Change
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.report.inertia_shapes import (
    BOX_EDGES,
    InertiaBox,
    com_ellipsoid,
    inertia_box,
    link_covariance,
    total_com,
)
from symbid_ros.report.palette import (
    BEFORE_COLOUR,
    CHANGED_COLOUR,
    UNCERTAINTY_COLOUR,
    link_colour,
    rgb,
)
from symbid_ros.ros.endpoints import latched_qos

PERIOD = 0.5  # s between two messages at least
# Namespaces; a display can switch each of them off.
BOX, PRIOR_BOX = "inertia", "prior_inertia"
COM, UNCERTAINTY, TOTAL_COM, CHANGE = "com", "com_uncertainty", "total_com", "change"
DEVIATIONS = 2.0  # semi-axes of the ellipsoids, in standard deviations
BALL_COLOUR = "#111111"
_THINNEST = 1e-3  # m; viewers reject markers without a volume
_IDENTITY = np.eye(3)

Key = tuple[str, int]  # namespace and id


class InertiaMarkers:
    """Publishes the markers of an estimate on ``~/markers``.

    Markers are in the frames of the links, so that they move with the robot.

    Parameters
    ----------
    node : Node
        The identifier.
    parameters : ParameterSet
        The robot's parameters.
    frame_prefix : str
        Prefix of the frames on ``/tf``, such as ``robot1/``.
    """

    def __init__(self, node: Node, parameters: ParameterSet, frame_prefix: str = "") -> None:
        self._publisher = node.create_publisher(MarkerArray, "~/markers", latched_qos())
        self._parameters, self._prefix = parameters, frame_prefix
        self._size = ball_size(parameters)
        self._earlier: set[Key] = set()  # of all markers so far
        self._published = float("-inf")
        self._is_first = True

    def publish(
        self, estimate: Estimate, change: Change | None, posture: FloatArray | None
    ) -> None:
        """Publish the markers of an estimate, unless the last ones are younger than ``PERIOD``.

        Parameters
        ----------
        estimate : Estimate
            The newest estimate.
        change : Change or None
            A detected change; its links are highlighted.
        posture : (J,) float64 or None
            Joint positions, from which the robot's centre of mass follows.
        """
        now = time.monotonic()
        if now - self._published < PERIOD:
            return
        self._published = now
        com = None if posture is None else _robot_com(self._parameters, estimate, posture)
        self._send(robot_markers(self._parameters, estimate, change, com, self._size))

    def clear(self) -> None:
        """Delete all markers."""
        self._send(())
        self._published = float("-inf")

    def _send(self, markers: Iterable[Marker]) -> None:
        message = MarkerArray()
        if self._is_first:
            # Viewers may still show the markers of an earlier process.
            message.markers.append(Marker(action=Marker.DELETEALL))
            self._is_first = False
        shown = set()
        for marker in markers:
            marker.header.frame_id = self._prefix + marker.header.frame_id
            message.markers.append(marker)
            shown.add((marker.ns, marker.id))
        # Deletions are repeated, because a slow subscriber may miss a message.
        for namespace, number in sorted(self._earlier - shown):
            message.markers.append(Marker(ns=namespace, id=number, action=Marker.DELETE))
        self._earlier |= shown
        self._publisher.publish(message)


def ball_size(parameters: ParameterSet) -> float:
    """Return a diameter for centres of mass that suits the size of the robot, m."""
    model = parameters.model
    poses = link_poses(model, model.apply_mimics(np.zeros((1, len(model.joints)))))
    extent = float(np.linalg.norm(np.ptp(poses.position[0], axis=0)))
    return float(np.clip(0.025 * extent, 0.004, 0.05))


def robot_markers(
    parameters: ParameterSet,
    estimate: Estimate,
    change: Change | None,
    com: FloatArray | None,
    size: float,
) -> list[Marker]:
    """Return the markers of all links, with the link's index as id.

    Parameters
    ----------
    parameters : ParameterSet
        The robot's parameters, whose links come first in the estimate.
    estimate : Estimate
        The estimate.
    change : Change or None
        A detected change.
    com : (3,) float64 or None
        Centre of mass of the robot in the base's frame, m.
    size : float
        Diameter of the balls, m.
    """
    suspects = {} if change is None else {one.link: str(change) for one in change.links}
    markers = []
    for index, link in enumerate(parameters.link_names):
        for marker in _link_markers(estimate, index, suspects.get(link, ""), size):
            marker.header.frame_id = link
            marker.id = index
            markers.append(marker)
    if com is not None:
        marker = _marker(TOTAL_COM, Marker.SPHERE, com, np.full(3, 2 * size), BALL_COLOUR)
        marker.header.frame_id = parameters.model.links[0].name
        markers.append(marker)
    return markers


def _link_markers(estimate: Estimate, index: int, changed: str, size: float) -> list[Marker]:
    own = slice(10 * index, 10 * index + 10)
    phi = estimate.value[own]
    if phi[0] <= 0:
        return []
    determined = None if estimate.determined is None else int(estimate.determined[own].sum())
    colour = CHANGED_COLOUR if changed else link_colour(determined)
    com = com_from_phi(phi)[1]
    markers = [_marker(COM, Marker.SPHERE, com, np.full(3, size), BALL_COLOUR)]
    box, prior = inertia_box(phi), inertia_box(estimate.prior[own])
    if box is not None:
        opacity = 0.8 if changed else 0.45
        markers.append(
            _marker(
                BOX,
                Marker.CUBE,
                box.com,
                box.size,
                colour,
                opacity=opacity,
                rotation=box.rotation,
            )
        )
    if prior is not None:
        markers.append(_wireframe(prior))
    covariance = link_covariance(estimate, own.start)
    if covariance is not None:
        ellipsoid = com_ellipsoid(phi, covariance)
        markers.append(
            _marker(
                UNCERTAINTY,
                Marker.SPHERE,
                com,
                2 * DEVIATIONS * ellipsoid.std,
                UNCERTAINTY_COLOUR,
                opacity=0.5,
                rotation=ellipsoid.rotation,
            )
        )
    if changed:
        text = _marker(CHANGE, Marker.TEXT_VIEW_FACING, com, np.full(3, 3 * size), colour)
        text.text = changed
        markers.append(text)
    return markers


def _robot_com(parameters: ParameterSet, estimate: Estimate, posture: FloatArray) -> FloatArray:
    poses = link_poses(parameters.model, parameters.model.apply_mimics(posture[None]))
    phi, own = parameters.link_phi(estimate.value), parameters.links
    return total_com(phi, poses.rotation[0, own], poses.position[0, own])


def _wireframe(box: InertiaBox) -> Marker:
    marker = _marker(PRIOR_BOX, Marker.LINE_LIST, box.com, np.zeros(3), BEFORE_COLOUR)
    marker.pose = _pose(box.com, box.rotation)
    marker.scale = Vector3(x=max(0.01 * float(box.size.max()), _THINNEST))  # of the lines
    marker.points = _edges(tuple(map(tuple, box.own_corners.tolist())))
    return marker


@lru_cache(maxsize=128)  # boxes of the prior remain, and creating their points takes long
def _edges(corners: tuple[tuple[float, float, float], ...]) -> list[Point]:
    """Return the ends of a box's edges from its eight corners, m."""
    return [
        Point(x=x, y=y, z=z) for edge in BOX_EDGES for x, y, z in (corners[end] for end in edge)
    ]


def _marker(
    namespace: str,
    kind: int,
    position: FloatArray,
    size: FloatArray,
    colour: str,
    *,
    opacity: float = 1.0,
    rotation: FloatArray = _IDENTITY,
) -> Marker:
    """Return a marker of the size in m along its own axes.

    It has no stamp, so that viewers place it with the newest transform, and is placed again
    whenever its frame moves.
    """
    red, green, blue = rgb(colour)
    x, y, z = np.maximum(size, _THINNEST).tolist()
    return Marker(
        ns=namespace,
        type=kind,
        action=Marker.ADD,
        frame_locked=True,
        pose=_pose(position, rotation),
        scale=Vector3(x=x, y=y, z=z),
        color=ColorRGBA(r=red, g=green, b=blue, a=opacity),
    )


def _pose(position: FloatArray, rotation: FloatArray) -> Pose:
    x, y, z = position.tolist()
    w, i, j, k = quaternion_from_rotation(rotation).tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=i, y=j, z=k, w=w))
