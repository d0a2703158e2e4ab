"""Bodies of a model file: assembled into moving links, and updated from identified links.

URDF and MJCF share this assembly, so both formats give the same tree. A body welded to its
parent becomes a frame of the parent's link and adds its inertia. A body with several joints
gets virtual links between them.

An identified link is divided among its welded bodies again. The data determine only their sum,
so the file's own division is kept as far as possible.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import ModelError
from symbid_ros.model.frames import Frame, with_radii_of_balls
from symbid_ros.model.inertia import is_consistent, pseudo_inertia, transform_phi
from symbid_ros.model.tree import Joint, Link, Mimic, RobotModel

# Changes below this share of a link's largest parameters are rounding.
ROUNDING = 1e-12
# Share of the largest possible part that the other bodies keep when one body cannot take the
# whole change. A share of 1 would leave that body on the boundary of physical consistency.
_KEPT = 0.9


@dataclass(frozen=True)
class BodyJoint:
    """A joint of a body: ``axis`` and ``anchor`` (3,) in the body's frame.

    ``mimic`` is the name of the joint that it follows, with multiplier and offset. ``sensor`` is
    that of :class:`symbid_ros.model.tree.Joint`.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    axis: FloatArray
    anchor: FloatArray
    reference: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    effort: float = np.inf
    damping: float = 0.0
    friction_loss: float = 0.0
    armature: float = 0.0
    mimic: tuple[str, float, float] | None = None
    sensor: str = ""
    speed: float = np.inf
    stiffness: float = 0.0
    spring_reference: float = 0.0


@dataclass(frozen=True)
class Body:
    """A body of a model file: its pose in its parent, inertia, joints and fixed frames.

    ``parent`` is -1 for the root, whose pose and joints are ignored. ``phi`` (10,) is about
    the body's origin. ``frames`` maps names to (rotation, translation), and ``balls`` names of
    frames, or of a welded body itself, to the radius of a ball about their origin, m.
    """

    name: str
    parent: int
    rotation: FloatArray
    translation: FloatArray
    phi: FloatArray
    joints: tuple[BodyJoint, ...] = ()
    frames: dict[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    balls: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Carrier:
    """The link that carries a body, and the body's pose in it."""

    link: int
    rotation: FloatArray
    translation: FloatArray

    def place(self, rotation: FloatArray, translation: FloatArray) -> "_Carrier":
        return _Carrier(
            self.link, self.rotation @ rotation, self.rotation @ translation + self.translation
        )


class _Assembly:
    """Collects links, joints and frames body by body."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.names: list[str] = []
        self.phi: list[FloatArray] = []
        self.virtual: list[bool] = []
        self.joints: list[Joint] = []
        self.frames: dict[str, Frame] = {}

    def add_link(self, name: str, *, virtual: bool = False) -> int:
        self.names.append(name)
        self.phi.append(np.zeros(10))
        self.virtual.append(virtual)
        return len(self.names) - 1

    def add_frame(self, name: str, carrier: _Carrier, radius: float = 0.0) -> None:
        if name in self.frames:
            raise ModelError(
                f"{self.source}: frame name {name!r} is used twice; rename one", "E105"
            )
        pose = carrier.rotation, carrier.translation
        self.frames[name] = Frame(name, carrier.link, *pose, radius)

    def add_moving_body(self, body: Body, parent: _Carrier) -> _Carrier:
        placed = parent.place(body.rotation, body.translation)
        anchor = np.zeros(3)
        for count, joint in enumerate(body.joints, start=1):
            last = count == len(body.joints)
            offset = placed.rotation @ (joint.anchor - anchor)
            self.joints.append(
                Joint(
                    joint.name,
                    joint.kind,
                    placed.link,
                    placed.rotation,
                    placed.translation + offset,
                    joint.axis / np.linalg.norm(joint.axis),
                    joint.reference,
                    joint.lower,
                    joint.upper,
                    joint.effort,
                    joint.damping,
                    joint.friction_loss,
                    joint.armature,
                    sensor=joint.sensor,
                    speed=joint.speed,
                    stiffness=joint.stiffness,
                    spring_reference=joint.spring_reference,
                )
            )
            name = body.name if last else f"{body.name}:{joint.name}"
            link = self.add_link(name, virtual=not last)
            placed = _Carrier(link, np.eye(3), np.zeros(3))
            anchor = joint.anchor
        carrier = _Carrier(placed.link, np.eye(3), -anchor)
        if np.any(anchor):
            # The link's origin is on the joint axis, so the body's own frame is a separate frame.
            self.add_frame(body.name, carrier)
        return carrier


def assemble(
    name: str, bodies: Sequence[Body], *, floating: bool, gravity: FloatArray, source: str
) -> RobotModel:
    """Return the robot made of ``bodies``, which list parents before children.

    Raises
    ------
    ModelError
        When a name is used twice, an axis is zero or a number is not finite, or when a mimic
        joint has no leader.
    """
    assembly = _Assembly(source)
    carriers: list[_Carrier] = []
    for body in bodies:
        _check_finite(body, source)
        if body.parent < 0:
            carrier = _Carrier(assembly.add_link(body.name), np.eye(3), np.zeros(3))
        elif body.joints:
            carrier = assembly.add_moving_body(body, carriers[body.parent])
        else:
            carrier = carriers[body.parent].place(body.rotation, body.translation)
            assembly.add_frame(body.name, carrier, body.balls.get(body.name, 0.0))
        carriers.append(carrier)
        assembly.phi[carrier.link] = assembly.phi[carrier.link] + transform_phi(
            body.phi, carrier.rotation, carrier.translation
        )
        for frame, pose in body.frames.items():
            assembly.add_frame(frame, carrier.place(*pose), body.balls.get(frame, 0.0))
    followed = {joint.name: joint.mimic for body in bodies for joint in body.joints if joint.mimic}
    joints = _with_leaders(assembly.joints, followed, source)
    links = tuple(
        Link(*fields) for fields in zip(assembly.names, assembly.phi, assembly.virtual, strict=True)
    )
    frames = with_radii_of_balls(assembly.frames.values())
    return RobotModel(name, links, joints, frames, floating, gravity, source, tuple(bodies))


def _with_leaders(
    joints: Sequence[Joint], followed: Mapping[str, tuple[str, float, float]], source: str
) -> tuple[Joint, ...]:
    """Return the joints, each mimic joint bound to the leader at the end of its chain."""
    index = {joint.name: position for position, joint in enumerate(joints)}
    bound = []
    for joint in joints:
        multiplier, offset, leader, seen = 1.0, 0.0, joint.name, {joint.name}
        while leader in followed:
            follower = leader
            leader, gain, shift = followed[follower]
            offset += multiplier * shift
            multiplier *= gain
            if leader not in index or leader in seen:
                reason = "follows itself" if leader in seen else "is not a moving joint"
                raise ModelError(
                    f"{source}: joint {follower!r} mimics {leader!r}, which {reason}; name "
                    "another joint or remove <mimic>",
                    "E109",
                )
            seen.add(leader)
        if joint.name in followed:
            mimic = Mimic(index[leader], multiplier, offset)
            # A mimic joint has no motor of its own.
            bound.append(replace(joint, effort=0.0, mimic=mimic))
        else:
            bound.append(joint)
    return tuple(bound)


def _check_finite(body: Body, source: str) -> None:
    poses = [(body.rotation, body.translation), *body.frames.values()]
    numbers = [body.phi, *(array for pose in poses for array in pose)]
    for joint in body.joints:
        numbers += [joint.axis, joint.anchor]
        drive = joint.damping, joint.friction_loss, joint.armature
        numbers.append(np.array([*drive, joint.stiffness, joint.spring_reference]))
    if not all(np.all(np.isfinite(array)) for array in numbers):
        raise ModelError(f"{source}: body {body.name!r} has NaN or infinity; correct it", "E108")
    for joint in body.joints:
        if not np.any(joint.axis):
            raise ModelError(
                f"{source}: joint {joint.name!r} has a zero axis; give it a direction", "E108"
            )


@dataclass(frozen=True)
class Division:
    """How a link's parameters are divided among the bodies welded into it.

    Attributes
    ----------
    receiver : int
        The body that takes the change.
    phi : (10,) float64
        Its new parameters.
    kept : float
        Share of their mass that the other bodies keep, with their shape and centre of mass.
    """

    receiver: int
    phi: FloatArray
    kept: float


def divide(
    stated: FloatArray, total: FloatArray, *, first_can_carry: bool = True
) -> Division | None:
    """Divide ``total`` among welded bodies.

    The whole change goes to one body. This is the first, which the joint moves, or the heaviest
    if the first has no inertia in the file. The other bodies give up part of their mass only if
    that body would become physically inconsistent although the total is consistent.

    Parameters
    ----------
    stated : (B, 10) float64
        Parameters in the file, about the same point and in the same axes.
    total : (10,) float64
        New sum of all bodies.
    first_can_carry : bool
        Whether the first body can have mass. MJCF's world cannot.

    Returns
    -------
    Division or None
        None if the bodies add up to ``total`` to within rounding, or no body can take a change.
    """
    change = total - stated.sum(axis=0)
    receiver = _receiver(stated, first_can_carry)
    if receiver is None or is_rounding(change, total):
        return None
    phi = stated[receiver] + change
    others = np.delete(stated, receiver, axis=0).sum(axis=0)
    if _possible(phi) or not np.any(others) or not _possible(total):
        return Division(receiver, phi, 1.0)
    kept = _kept_share(others, stated.sum(axis=0), total)
    return Division(receiver, total - kept * others, kept)


def is_rounding(change: FloatArray, value: FloatArray) -> bool:
    """Return whether a change of φ (10,) is rounding, in mass, first moments and inertia."""
    return all(
        np.abs(change[part]).max() <= ROUNDING * np.abs(value[part]).max()
        for part in (slice(1), slice(1, 4), slice(4, None))
    )


def _receiver(stated: FloatArray, first_can_carry: bool) -> int | None:
    if first_can_carry and np.any(stated[0]):
        return 0
    heaviest = int(np.argmax(stated[:, 0]))
    if stated[heaviest, 0] > 0:
        return heaviest
    return 0 if first_can_carry else None


def _kept_share(others: FloatArray, stated: FloatArray, total: FloatArray) -> float:
    """Return the share of their mass that the other bodies keep, in [0, 1]."""
    # The largest s with J(total) - s J(others) ⪰ 0 is one over the largest generalised eigenvalue.
    whole = pseudo_inertia(total)
    root = np.linalg.cholesky(whole + 1e-9 * np.diag(np.diag(whole)))
    half = np.linalg.solve(root, pseudo_inertia(others))
    largest = float(np.linalg.eigvalsh(np.linalg.solve(root, half.T))[-1])
    possible = _KEPT / largest if largest > 0 else 1.0
    lighter = total[0] / stated[0] if stated[0] > 0 else 1.0
    return float(min(1.0, possible, lighter))


def _possible(phi: FloatArray) -> bool:
    return bool(phi[0] > 0) and is_consistent(phi)


def updated_bodies(
    model: RobotModel, stated: Mapping[str, FloatArray], *, rewrite: bool = False
) -> dict[str, FloatArray]:
    """Return the bodies whose parameters differ from those in the file.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    stated : mapping of str to (10,) float64
        φ of each body in the file, about its own origin. Bodies welded to a link are frames of
        ``model``.
    rewrite : bool
        Return all bodies that have inertia, changed or not.

    Returns
    -------
    dict of str to (10,) float64
        New φ of each body, about its own origin.
    """
    groups: dict[int, list[str]] = {}
    for name in stated:
        link = model.frame(name).link
        members = groups.setdefault(link, [])
        members.insert(0 if name == model.links[link].name else len(members), name)
    updated = {}
    for link, names in groups.items():
        frames = [model.frame(name) for name in names]
        total = model.links[link].phi
        before = np.array(
            [transform_phi(stated[f.name], f.rotation, f.translation) for f in frames]
        )
        division = divide(before, total, first_can_carry=names[0] != "world")
        kept = 1.0 if division is None else division.kept
        for position, frame in enumerate(frames):
            if division is not None and position == division.receiver:
                back = frame.rotation.T
                updated[frame.name] = transform_phi(division.phi, back, -back @ frame.translation)
            elif np.any(stated[frame.name]) and (rewrite or kept != 1.0):
                updated[frame.name] = kept * stated[frame.name]
    return updated
