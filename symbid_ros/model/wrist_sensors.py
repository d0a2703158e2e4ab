"""Wrist force/torque sensors: six joints at rest whose efforts are measured.

A sensor between two bodies measures the wrench that one exerts on the other, as an effort sensor
measures one component of it at a joint. Each sensor is therefore six joints about and along the
axes of its frame, at position zero. Their rows of the equation of motion state that the wrench
through the sensor moves the bodies beyond it, and those bodies become a link of their own.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import ModelError
from symbid_ros.model.bodies import Body, BodyJoint, assemble
from symbid_ros.model.fixed_frames import with_frames_of
from symbid_ros.model.frames import Frame
from symbid_ros.model.inertia import transform_phi
from symbid_ros.model.tree import Joint, RobotModel

# Components in the order of wrenches: angular part first.
COMPONENTS = tuple(f"{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz")


def component_names(frame: str) -> tuple[str, ...]:
    """Return the names of a sensor's six joints, which are coordinates of the robot."""
    return tuple(f"{frame}/{component}" for component in COMPONENTS)


def sensor_names(model: RobotModel) -> tuple[str, ...]:
    """Return ``FRAME:LINK`` or ``-FRAME:LINK`` of each wrist sensor of a robot."""
    return tuple(
        f"{model.joints[place.start].sensor}:{model.links[place.stop].name}"
        for place in model.wrist_sensors.values()
    )


def links_beyond(model: RobotModel, frame: str) -> list[int]:
    """Return the indices of the link behind a wrist sensor and of the links that move beyond it."""
    found = [model.wrist_sensors[frame].stop]
    for index, joint in enumerate(model.joints):
        if joint.parent in found:
            found.append(index + 1)
    return found


def sensor_frame(sensor: str) -> str:
    """Return the frame in ``FRAME``, ``FRAME:LINK`` or ``-FRAME:LINK``."""
    return sensor.removeprefix("-").partition(":")[0]


def reversed_sensor(sensor: str) -> str:
    """Return the name of the same sensor with the opposite sign."""
    return sensor[1:] if sensor.startswith("-") else f"-{sensor}"


def with_wrist_sensors(model: RobotModel, sensors: Sequence[str]) -> RobotModel:
    """Return a robot in which some wrench sensors are internal.

    Parameters
    ----------
    model : RobotModel
        Robot of a model file.
    sensors : sequence of str
        ``FRAME`` or ``FRAME:LINK`` of each sensor, with a minus before it if the sensor reads the
        wrench of the robot on the payload instead of that of the payload on the robot. FRAME is
        the frame of its messages, LINK the first link beyond it. Without LINK this is FRAME itself,
        if that is a link fixed to its parent, with everything that is fixed to it. At any other
        frame, and for a LINK that the model lacks, a link without inertia is added there.

    Returns
    -------
    RobotModel
        With a link for what lies beyond each sensor, whose origin is the sensor's. Its inertia is
        that of the file, and the inertia of the link before the sensor is smaller by the same
        amount.

    Raises
    ------
    ModelError
        When a frame or link is unknown, or the link is not attached to the frame's link.
    """
    frames = {sensor_frame(one) for one in sensors}
    if frames <= set(model.wrist_sensors):
        return model  # divided before
    if not model.bodies:
        raise ModelError(
            f"{model.name}: has no bodies of a model file, so `wrist_sensor` cannot divide its "
            "links; load the robot with load_model",
            "E120",
        )
    bodies = list(model.bodies)
    named: set[str] = set()
    for sensor in sensors:
        frame, _, link = sensor.removeprefix("-").partition(":")
        if frame in named:
            raise ModelError(
                f"{model.source}: `wrist_sensor` {frame} is given twice; give it once", "E120"
            )
        named.add(frame)
        _insert(bodies, model, frame, link, is_reversed=sensor.startswith("-"))
    divided = assemble(
        model.name, bodies, floating=model.floating, gravity=model.gravity, source=model.source
    )
    divided = replace(_with_values_of(divided, model), bodies=model.bodies)
    return with_frames_of(divided, model)


def _insert(
    bodies: list[Body], model: RobotModel, frame: str, link: str, *, is_reversed: bool
) -> None:
    """Put the joints of one sensor before the first body beyond it."""
    mount = model.frame(frame, "wrist_sensor")
    names = [body.name for body in bodies]
    if not link:
        is_fixed_link = frame in names and not bodies[names.index(frame)].joints
        link = frame if is_fixed_link and bodies[names.index(frame)].parent >= 0 else ""
    link = link or f"{frame}_payload"
    if link not in names:
        carrier = model.links[mount.link].name
        if carrier not in names or link in {one.name for one in model.frames}:
            raise ModelError(
                f"{model.source}: `wrist_sensor` {frame}:{link} names a frame, not a link; name "
                "the first link beyond the sensor",
                "E120",
            )
        pose = _relative(model.frame(carrier), mount)
        bodies.append(Body(link, names.index(carrier), *pose, np.zeros(10)))
        names.append(link)
        axes, anchor = np.eye(3), np.zeros(3)
    else:
        own = model.frame(link)
        if own.link != mount.link or bodies[names.index(link)].parent < 0:
            raise ModelError(
                f"{model.source}: `wrist_sensor` {frame}:{link}: link {link} is not attached to "
                f"{model.links[mount.link].name}, which carries {frame}; name the first link "
                "beyond the sensor",
                "E120",
            )
        axes, anchor = _relative(own, mount)
    joints = tuple(
        BodyJoint(
            name,
            "revolute" if index < 3 else "prismatic",
            -axes[:, index % 3] if is_reversed else axes[:, index % 3],
            anchor,
            lower=0.0,
            upper=0.0,
            effort=0.0,
            sensor=f"-{frame}" if is_reversed else frame,
        )
        for index, name in enumerate(component_names(frame))
    )
    index = names.index(link)
    bodies[index] = replace(bodies[index], joints=(*bodies[index].joints, *joints))


def _relative(a: Frame, b: Frame) -> tuple[FloatArray, FloatArray]:
    """Return the rotation and translation of b in a, both fixed to one link."""
    return a.rotation.T @ b.rotation, a.rotation.T @ (b.translation - a.translation)


def _with_values_of(divided: RobotModel, model: RobotModel) -> RobotModel:
    """Return the divided robot with the inertias and joints of ``model`` where they changed."""
    read = assemble(
        model.name,
        model.bodies,
        floating=model.floating,
        gravity=model.gravity,
        source=model.source,
    )
    change = dict(zip(model.link_names, model.phi - read.phi, strict=True))
    phi = np.array([link.phi + change.get(link.name, np.zeros(10)) for link in divided.links])
    joints = {joint.name: joint for joint in model.joints}
    values = tuple(
        joint
        if joint.sensor
        else replace(
            joint,
            effort=joints[joint.name].effort,
            damping=joints[joint.name].damping,
            friction_loss=joints[joint.name].friction_loss,
            armature=joints[joint.name].armature,
            stiffness=joints[joint.name].stiffness,
        )
        for joint in divided.joints
    )
    return replace(divided.with_phi(phi), joints=values)


@dataclass(frozen=True)
class _Place:
    """A link's link in the robot without sensors, and its pose there."""

    link: int
    rotation: FloatArray
    translation: FloatArray


def without_wrist_sensors(model: RobotModel, kept: Container[str] = ()) -> RobotModel:
    """Return the robot as one rigid link on both sides of each sensor.

    Parameters
    ----------
    model : RobotModel
        Robot of :func:`with_wrist_sensors`.
    kept : container of str
        Sensors whose first link beyond is one of these are left as they are.
    """
    removed = {
        index
        for place in model.wrist_sensors.values()
        if model.links[place.stop].name not in kept
        for index in range(place.start, place.stop)
    }
    if not removed:
        return model
    places = [_Place(0, np.eye(3), np.zeros(3))]
    links = [model.links[0]]
    joints: list[Joint] = []
    index_of: dict[int, int] = {}
    frames = list(model.frames)
    for index, joint in enumerate(model.joints):
        before, link = places[joint.parent], model.links[index + 1]
        rotation = before.rotation @ joint.rotation
        translation = before.rotation @ joint.translation + before.translation
        if index in removed:
            places.append(_Place(before.link, rotation, translation))
            carrier = links[before.link]
            phi = carrier.phi + transform_phi(link.phi, rotation, translation)
            if carrier.virtual and not link.virtual:  # the sensor carried the whole body
                links[before.link] = replace(link, phi=phi)
                continue
            links[before.link] = replace(carrier, phi=phi)
            # A body whose origin is not the sensor's has a frame of its own.
            if not link.virtual and all(one.name != link.name for one in frames):
                frames.append(Frame(link.name, index + 1, np.eye(3), np.zeros(3)))
            continue
        index_of[index] = len(joints)
        joints.append(
            replace(joint, parent=before.link, rotation=rotation, translation=translation)
        )
        links.append(link)
        places.append(_Place(len(links) - 1, np.eye(3), np.zeros(3)))
    bound = tuple(
        joint
        if joint.mimic is None
        else replace(joint, mimic=replace(joint.mimic, leader=index_of[joint.mimic.leader]))
        for joint in joints
    )
    return replace(
        model,
        links=tuple(links),
        joints=bound,
        frames=tuple(sorted((_moved(one, places[one.link]) for one in frames), key=_name)),
    )


def _moved(frame: Frame, place: _Place) -> Frame:
    return replace(
        frame,
        link=place.link,
        rotation=place.rotation @ frame.rotation,
        translation=place.rotation @ frame.translation + place.translation,
    )


def _name(frame: Frame) -> str:
    return frame.name
