"""Markers of an estimate, received by a subscriber, against MuJoCo and the estimate's numbers."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from drawn_estimates import drawn_estimate
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from symbid_ros.estimation.change import LinkChange
from symbid_ros.identification.rows.change_monitor import Change
from symbid_ros.model.load import load_model
from symbid_ros.model.rotation import rotation_from_xyzw
from symbid_ros.package_paths import config_file
from symbid_ros.ros import inertia_markers
from symbid_ros.ros.endpoints import latched_qos
from symbid_ros.ros.inertia_markers import InertiaMarkers

FILE = config_file("symbitron.xml")
PREFIX = "robot1/"
THIGH = LinkChange("L_thigh", 50.0, 50.0, np.array([2.0, *np.zeros(9)]), np.full(10, 0.1))


@pytest.fixture(scope="module")
def drawn():
    return drawn_estimate(load_model(FILE))


class Viewer:
    """What a viewer shows after each message: markers by namespace and id."""

    def __init__(self, graph: Any) -> None:
        self.messages: list[MarkerArray] = []
        self.shown: dict[tuple[str, int], Marker] = {("stale", 7): Marker()}
        graph.node.create_subscription(
            MarkerArray, "/identifier/markers", self._receive, latched_qos()
        )

    def _receive(self, message: MarkerArray) -> None:
        self.messages.append(message)
        for marker in message.markers:
            if marker.action == Marker.DELETEALL:
                self.shown.clear()
            elif marker.action == Marker.DELETE:
                self.shown.pop((marker.ns, marker.id), None)
            else:
                self.shown[marker.ns, marker.id] = marker

    def of(self, namespace: str) -> dict[int, Marker]:
        return {number: one for (ns, number), one in self.shown.items() if ns == namespace}


@pytest.fixture
def markers(graph, drawn, monkeypatch) -> Iterator[InertiaMarkers]:
    monkeypatch.setattr(inertia_markers, "PERIOD", 0.0)
    node = Node("identifier", context=graph.node.context)
    yield InertiaMarkers(node, drawn[0], PREFIX)
    node.destroy_node()


@pytest.fixture
def viewer(graph) -> Viewer:
    return Viewer(graph)


def receive(graph, viewer: Viewer, count: int) -> None:
    graph.wait_until(lambda: len(viewer.messages) >= count)


def vector(point: Any) -> np.ndarray:
    return np.array([point.x, point.y, point.z])


def rotation(pose: Any) -> np.ndarray:
    turned = pose.orientation
    return rotation_from_xyzw(np.array([turned.x, turned.y, turned.z, turned.w]))


def test_boxes_and_centres_are_those_of_mujoco(graph, markers, viewer, drawn) -> None:
    parameters, estimate = drawn
    posture = np.random.default_rng(5).uniform(-0.5, 0.5, len(parameters.model.joints))
    markers.publish(estimate, None, posture)
    receive(graph, viewer, 1)
    m = mujoco.MjModel.from_xml_path(str(FILE))
    data = mujoco.MjData(m)
    data.qpos[7:] = posture
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    boxes, balls = viewer.of("inertia"), viewer.of("com")
    assert set(boxes) == set(balls) == set(range(len(parameters.link_names)))
    for number, name in enumerate(parameters.link_names):
        body, box = m.body(name).id, boxes[number]
        assert box.header.frame_id == PREFIX + name
        assert (box.header.stamp.sec, box.header.stamp.nanosec) == (0, 0)
        assert box.type == Marker.CUBE
        assert box.frame_locked
        np.testing.assert_allclose(vector(box.pose.position), m.body_ipos[body], atol=1e-9)
        np.testing.assert_allclose(
            vector(balls[number].pose.position), m.body_ipos[body], atol=1e-9
        )
        # m (b² + c²)/12 about the box's axes, turned to the link's, is the inertia.
        squares = vector(box.scale) ** 2
        moments = m.body_mass[body] * (squares.sum() - squares) / 12
        turned = rotation(box.pose)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, m.body_iquat[body])
        axes = axes.reshape(3, 3)
        np.testing.assert_allclose(
            turned @ np.diag(moments) @ turned.T,
            axes @ np.diag(m.body_inertia[body]) @ axes.T,
            atol=1e-9,
        )
    base = m.body(parameters.link_names[0]).id
    com = data.xmat[base].reshape(3, 3).T @ (data.subtree_com[base] - data.xpos[base])
    (total,) = viewer.of("total_com").values()
    assert total.header.frame_id == PREFIX + parameters.link_names[0]
    np.testing.assert_allclose(vector(total.pose.position), com, atol=1e-9)


def test_every_marker_can_be_drawn(graph, markers, viewer, drawn) -> None:
    markers.publish(drawn[1], Change(0, (THIGH,)), np.zeros(len(drawn[0].model.joints)))
    receive(graph, viewer, 1)
    assert viewer.messages[0].markers[0].action == Marker.DELETEALL
    assert ("stale", 7) not in viewer.shown
    assert {namespace for namespace, _ in viewer.shown} == {
        *("inertia", "prior_inertia", "com", "com_uncertainty", "total_com", "change")
    }
    for marker in viewer.shown.values():
        turned = marker.pose.orientation
        norm = np.hypot(np.hypot(turned.x, turned.y), np.hypot(turned.z, turned.w))
        assert norm == pytest.approx(1.0)
        assert 0 < marker.color.a <= 1
        size = [marker.scale.x] if marker.type == Marker.LINE_LIST else vector(marker.scale)
        assert np.all(np.array(size) > 0)
        assert len(marker.points) == (24 if marker.type == Marker.LINE_LIST else 0)


def test_a_changed_link_is_highlighted_and_named_until_it_is_over(
    graph, markers, viewer, drawn
) -> None:
    parameters, estimate = drawn
    place = parameters.link_names.index("L_thigh")
    markers.publish(estimate, None, None)
    receive(graph, viewer, 1)
    markers.publish(estimate, Change(0, (THIGH,)), None)
    receive(graph, viewer, 2)
    colour = viewer.of("inertia")[place].color
    assert (colour.r, colour.b) == pytest.approx((0xD5 / 255, 0.0))
    others = {one.color.r for number, one in viewer.of("inertia").items() if number != place}
    assert colour.r not in others
    (text,) = viewer.of("change").values()
    assert text.text.startswith("L_thigh has changed")
    markers.publish(estimate, None, None)
    receive(graph, viewer, 3)
    assert viewer.of("change") == {}


def test_what_an_estimate_lacks_is_deleted(graph, markers, viewer, drawn) -> None:
    parameters, estimate = drawn
    markers.publish(estimate, None, None)
    receive(graph, viewer, 1)
    value = estimate.value.copy()
    value[4] = -1.0  # Ixx of the base: no rigid body
    value[10] = -1.0  # mass of the next link
    markers.publish(replace(estimate, value=value), None, None)
    receive(graph, viewer, 2)
    links = set(range(len(parameters.link_names)))
    assert set(viewer.of("inertia")) == links - {0, 1}
    assert set(viewer.of("com")) == links - {1}
    markers.clear()
    receive(graph, viewer, 3)
    assert viewer.shown == {}


def test_a_late_subscriber_sees_the_newest_markers(graph, markers, drawn) -> None:
    markers.publish(drawn[1], None, None)
    markers.publish(drawn[1], None, None)
    late = Viewer(graph)
    receive(graph, late, 1)
    assert len(late.of("inertia")) == len(drawn[0].link_names)


def test_messages_keep_their_distance(graph, drawn, viewer) -> None:
    node = Node("identifier", context=graph.node.context)
    quick = InertiaMarkers(node, drawn[0])
    for _ in range(5):
        quick.publish(drawn[1], None, None)
    quick.clear()  # not delayed
    graph.wait_until(lambda: viewer.messages and not viewer.of("com"))
    assert len(viewer.messages) <= 2
    node.destroy_node()
