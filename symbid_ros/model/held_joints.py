"""Joints that a log lacks: the links on both sides of such a joint are one rigid link.

No motion tells these links apart, so a robot with many joints that are not recorded, such as those
of its fingers, would have many parameters that no row of the equation of motion shows.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.model.bodies import divide
from symbid_ros.model.frames import Frame
from symbid_ros.model.inertia import transform_phi
from symbid_ros.model.tree import HeldJoints, Joint, Link, RobotModel

# Fields of a joint that an identification changes.
_IDENTIFIED = "damping", "friction_loss", "armature", "stiffness", "spring_reference"


def with_held_joints(model: RobotModel, positions: Mapping[str, float]) -> RobotModel:
    """Return a robot in which some joints do not move.

    Parameters
    ----------
    model : RobotModel
        A robot without wrist sensors and unmeasured contacts.
    positions : mapping of str to float
        Where the joints are held, rad (m). Joints that follow one of these are held too.

    Returns
    -------
    RobotModel
        With the remaining joints. A link beyond held joints is part of the link that carries it,
        and a frame with its name remains.
    """
    if not positions:
        return model
    held, angles = _held(model, positions)
    places = _placements(model, held, angles)
    links: list[Link] = []
    index_of: dict[int, int] = {}
    for index, link in enumerate(model.links):
        root, rotation, translation = places[index]
        if root == index:
            index_of[index] = len(links)
            links.append(link)
        else:
            carrier = links[index_of[root]]
            phi = carrier.phi + transform_phi(link.phi, rotation, translation)
            is_virtual = carrier.virtual and link.virtual
            links[index_of[root]] = replace(carrier, phi=phi, virtual=is_virtual)

    def moved(frame: Frame) -> Frame:
        root, rotation, translation = places[frame.link]
        return replace(
            frame,
            link=index_of[root],
            rotation=rotation @ frame.rotation,
            translation=rotation @ frame.translation + translation,
        )

    new_joint = {old: new for new, old in enumerate(np.flatnonzero(~held).tolist())}
    joints = []
    for index in new_joint:
        joint = model.joints[index]
        root, rotation, translation = places[joint.parent]
        mimic = joint.mimic
        if mimic is not None:
            mimic = replace(mimic, leader=new_joint[mimic.leader])
        joints.append(
            replace(
                joint,
                parent=index_of[root],
                rotation=rotation @ joint.rotation,
                translation=rotation @ joint.translation + translation,
                mimic=mimic,
            )
        )
    welded = [
        Frame(link.name, index, np.eye(3), np.zeros(3))
        for index, link in enumerate(model.links)
        if places[index][0] != index and not link.virtual
    ]
    known = {frame.name for frame in model.frames}
    frames = [*model.frames, *(one for one in welded if one.name not in known)]
    return replace(
        model,
        links=tuple(links),
        joints=tuple(joints),
        frames=tuple(sorted(map(moved, frames), key=lambda one: one.name)),
        held=HeldJoints(dict(positions), model),
    )


def held_positions(model: RobotModel) -> dict[str, float]:
    """Return the joints of a robot's file that are held, and their positions, rad (m)."""
    return {} if model.held is None else dict(model.held.positions)


def without_held_joints(model: RobotModel) -> RobotModel:
    """Return a robot of :func:`with_held_joints` with all joints of its file.

    The change of a link's parameters is divided among the links that are parts of it, as that of a
    link of the file is among bodies welded to it.
    """
    if model.held is None:
        return model
    robot, positions = model.held.robot, model.held.positions
    held, angles = _held(robot, positions)
    places = _placements(robot, held, angles)
    phi, joints = robot.phi.copy(), list(robot.joints)
    found = {link.name: link.phi for link in model.links}
    for root, link in enumerate(robot.links):
        parts = [index for index, place in enumerate(places) if place[0] == root]
        if not parts:
            continue
        poses = [places[index][1:] for index in parts]
        stated = np.array(
            [
                transform_phi(robot.phi[index], *pose)
                for index, pose in zip(parts, poses, strict=True)
            ]
        )
        division = divide(stated, found[link.name])
        if division is None:
            continue
        for number, (index, (rotation, translation)) in enumerate(zip(parts, poses, strict=True)):
            if number == division.receiver:
                back = rotation.T
                phi[index] = transform_phi(division.phi, back, -back @ translation)
            else:
                phi[index] = division.kept * phi[index]
    moving = {joint.name: joint for joint in model.joints}
    for index, joint in enumerate(joints):
        if joint.name in moving:
            values = {name: getattr(moving[joint.name], name) for name in _IDENTIFIED}
            joints[index] = replace(joint, **values)
    return replace(robot.with_phi(phi), joints=tuple(joints))


def _held(model: RobotModel, positions: Mapping[str, float]) -> tuple[BoolArray, FloatArray]:
    """Return which joints (J,) are held, and the positions (J,) of these."""
    held = np.isin(model.joint_names, list(positions))
    for joint, mimic in model.followers.items():
        held[joint] = held[mimic.leader]
    angles = np.array([[positions.get(name, 0.0) for name in model.joint_names]])
    return held, model.apply_mimics(angles)[0]


def _placements(
    model: RobotModel, held: BoolArray, angles: FloatArray
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Return for each link the link that carries it rigidly, and its pose in that one."""
    places = [(0, np.eye(3), np.zeros(3))]
    for index, joint in enumerate(model.joints):
        if not held[index]:
            places.append((index + 1, np.eye(3), np.zeros(3)))
            continue
        root, rotation, translation = places[joint.parent]
        turn, shift = _pose(joint, float(angles[index]))
        places.append((root, rotation @ turn, rotation @ shift + translation))
    return places


def _pose(joint: Joint, position: float) -> tuple[FloatArray, FloatArray]:
    """Return the pose of a joint's link in the link before it."""
    change = (position - joint.reference) * joint.axis
    if joint.kind == "prismatic":
        return joint.rotation, joint.translation + joint.rotation @ change
    return joint.rotation @ Rotation.from_rotvec(change).as_matrix(), joint.translation
