"""The latched topics that carry an estimate, in messages that any ROS tool can display."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Inertia, InertiaStamped, WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.messages.topics import topic_token
from symbid_ros.model.inertia import PARAMETERS, com_from_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.ros.endpoints import latched_qos
from symbid_ros.ros.reporting import OK, WARN, NodeStatus

# Step of a parameter for numerical derivatives of message fields, in its standard deviations.
STEP = 1e-4


def inertia_message(estimate: Estimate, link: str, stamp: Time) -> InertiaStamped:
    """Return a link's mass, centre of mass in the link's frame, and inertia about that centre."""
    return _inertia_stamped(_central(_of_link(estimate.value, estimate, link)), link, stamp)


def inertia_stddev_message(estimate: Estimate, link: str, stamp: Time) -> InertiaStamped:
    """Return the standard deviations of the same ten numbers; NaN for undetermined parameters.

    They are first-order approximations that treat the link's parameters as independent.
    """
    phi = _of_link(estimate.value, estimate, link)
    if estimate.std is None or estimate.determined is None:
        return _inertia_stamped(np.full(10, np.nan), link, stamp)
    std = _of_link(estimate.std, estimate, link)
    determined = _of_link(estimate.determined.astype(float), estimate, link) > 0
    centre = _central(phi)
    slopes = np.array([_central(phi + STEP * std * unit) - centre for unit in np.eye(10)]) / STEP
    deviation = np.sqrt(np.sum(slopes**2, axis=0))
    return _inertia_stamped(np.where(determined, deviation, np.nan), link, stamp)


def estimate_status(
    estimate: Estimate, alarms: Sequence[str], details: Mapping[str, object]
) -> NodeStatus:
    """Return the status of an estimate, with further key-value pairs."""
    impossible = estimate.impossible_links
    faults = [f"physically impossible: {', '.join(impossible)}"] if impossible else []
    values: dict[str, object] = {"method": estimate.method, "samples": estimate.samples}
    if estimate.determined is not None:
        count = int(estimate.determined.sum())
        values["determined"] = f"{count} of {estimate.identified}"
    faults += alarms
    if estimate.rank is not None:
        values["rank"] = estimate.rank
    values["condition"] = f"{estimate.condition:.6g}"
    return NodeStatus(
        "estimate",
        WARN if faults else OK,
        "; ".join(faults) or "estimate published",
        values | dict(details),
    )


def _of_link(values: FloatArray, estimate: Estimate, link: str) -> FloatArray:
    first = estimate.names.index(f"{link}/{PARAMETERS[0]}")
    return values[first : first + 10]


def _central(phi: FloatArray) -> FloatArray:
    """Return mass, centre of mass and inertia about it (10,) for parameters φ."""
    mass, com, inertia = com_from_phi(phi)
    return np.concatenate([[mass], com, inertia[np.triu_indices(3)]])


def _inertia_stamped(numbers: FloatArray, link: str, stamp: Time) -> InertiaStamped:
    message = InertiaStamped()
    message.header.stamp, message.header.frame_id = stamp, link
    mass, x, y, z, *tensor = map(float, numbers)
    inertia = Inertia(m=mass)
    inertia.com.x, inertia.com.y, inertia.com.z = x, y, z
    inertia.ixx, inertia.ixy, inertia.ixz, inertia.iyy, inertia.iyz, inertia.izz = tensor
    message.inertia = inertia
    return message


def estimate_message(
    estimate: Estimate, stamp: Time, names: Sequence[str] | None = None
) -> DiagnosticArray:
    """Return one status per link with all parameters and standard deviations, then joint terms.

    ``names`` are those of all parameters, also of terms that the data do not ask for, so that
    messages have the same keys at all times. Such a term is 0 with a standard deviation of 0.
    """
    message = DiagnosticArray()
    message.header.stamp = stamp
    groups: dict[str, list[str]] = {}
    for name in names or estimate.names:
        groups.setdefault(name.rsplit("/", 1)[0], []).append(name)
    place = {name: index for index, name in enumerate(estimate.names)}
    for name in estimate.fixed:
        place.pop(name)
    message.status = [_status(estimate, group, own, place) for group, own in groups.items()]
    return message


def _status(
    estimate: Estimate, group: str, names: Sequence[str], place: Mapping[str, int]
) -> DiagnosticStatus:
    status = DiagnosticStatus(name=group, hardware_id=estimate.model, level=DiagnosticStatus.OK)
    status.message = "physically possible"
    if group not in estimate.consistent:
        status.message = "joint terms"
    elif not estimate.consistent[group]:
        status.level = DiagnosticStatus.WARN
        status.message = "physically impossible: no mass density has these parameters"

    def add(key: str, numbers: FloatArray | BoolArray, index: int | None) -> None:
        number = numbers.dtype.type(0) if index is None else numbers[index]
        text = repr(float(number)) if numbers.dtype != bool else str(bool(number)).lower()
        status.values.append(KeyValue(key=key, value=text))

    for name in names:
        key, index = name.rsplit("/", 1)[1], place.get(name)
        add(key, estimate.value, index)
        if estimate.std is not None:
            add(f"{key}/std", estimate.std, index)
        if estimate.determined is not None:
            add(f"{key}/determined", estimate.determined, index)
    return status


def effort_residual_message(estimate: Estimate, stamp: Time) -> JointState:
    """Return the root mean square of each joint's effort residual, Nm or N."""
    message = JointState()
    message.header.stamp = stamp
    joints = {name: rmse for name, rmse in estimate.residual_rmse.items() if "base/" not in name}
    message.name, message.effort = list(joints), list(joints.values())
    # The definition allows empty arrays, but plotters index all of them by joint.
    message.position = message.velocity = [float("nan")] * len(joints)
    return message


def wrench_residual_message(estimate: Estimate, base: str, stamp: Time) -> WrenchStamped:
    """Return the root mean square of a floating base's wrench residual.

    NaN where unmeasured contacts leave no row of that coordinate.
    """
    residual = estimate.residual_rmse
    message = WrenchStamped()
    message.header.stamp, message.header.frame_id = stamp, base
    for axis in "xyz":
        setattr(message.wrench.torque, axis, residual.get(f"base/moment_{axis}", np.nan))
        setattr(message.wrench.force, axis, residual.get(f"base/force_{axis}", np.nan))
    return message


class EstimateTopics:
    """Latched publishers of an estimate; the topics' names are private to the node."""

    def __init__(self, node: Node, parameters: ParameterSet) -> None:
        def publisher(kind: type[Any], topic: str) -> Publisher:
            return node.create_publisher(kind, f"~/{topic}", latched_qos())

        model, self._names = parameters.model, parameters.names
        self._base = model.links[0].name
        self._inertia, self._inertia_stddev = (
            {
                link: publisher(InertiaStamped, f"{name}/{topic_token(link)}")
                for link in parameters.link_names
            }
            for name in ("inertia", "inertia_stddev")
        )
        self._estimate = publisher(DiagnosticArray, "estimate")
        self._effort_residual = publisher(JointState, "effort_residual")
        self._wrench_residual = (
            publisher(WrenchStamped, "wrench_residual") if model.floating else None
        )
        self._robot = publisher(String, "robot_description")

    def publish(self, estimate: Estimate, stamp: Time) -> None:
        """Publish all but the robot description; ``stamp`` is that of the newest data."""
        for link, publisher in self._inertia.items():
            publisher.publish(inertia_message(estimate, link, stamp))
        for link, publisher in self._inertia_stddev.items():
            publisher.publish(inertia_stddev_message(estimate, link, stamp))
        self._effort_residual.publish(effort_residual_message(estimate, stamp))
        if self._wrench_residual is not None:
            self._wrench_residual.publish(wrench_residual_message(estimate, self._base, stamp))
        self._estimate.publish(estimate_message(estimate, stamp, self._names))

    def describe(self, urdf: str) -> None:
        """Publish the robot description with the identified parameters."""
        # Comments that are not UTF-8 were read as surrogates, which a message cannot contain.
        self._robot.publish(String(data=urdf.encode(errors="replace").decode()))
