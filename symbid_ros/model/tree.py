"""A robot as a tree of links joined by revolute and prismatic joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import ModelError, OptionError
from symbid_ros.model.frames import Frame

if TYPE_CHECKING:
    from symbid_ros.model.bodies import Body

# Between a frame and the link that a wrench given in it acts on, if that is another one.
ON_LINK = "@"
STANDARD_GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Link:
    """A rigid link.

    Attributes
    ----------
    name : str
        Name of the link (URDF) or body (MJCF).
    phi : (10,) float64
        Inertial parameters about the link's origin, see :mod:`symbid_ros.model.inertia`.
    virtual : bool
        Whether the link is only a frame between two joints of one MJCF body, without parameters.
    """

    name: str
    phi: FloatArray
    virtual: bool = False


@dataclass(frozen=True)
class Mimic:
    """A joint that follows a leader: position = multiplier × the leader's + offset.

    Attributes
    ----------
    leader : int
        Index of the joint that it follows. A leader follows no other joint.
    multiplier, offset : float
        As in URDF's ``<mimic>``; the offset in rad or m.
    """

    leader: int
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint; joint k moves link k + 1.

    Attributes
    ----------
    name : str
        Joint name.
    kind : {"revolute", "prismatic"}
        A continuous joint is revolute.
    parent : int
        Index of the parent link, always smaller than the child's.
    rotation, translation : (3, 3) and (3,) float64
        Pose of the child's frame in the parent's where position equals ``reference``.
    axis : (3,) float64
        Unit vector in the child's frame.
    reference : float
        Position at which this pose holds, rad or m (MJCF ``ref``).
    lower, upper : float
        Position limits, infinite where the file sets none.
    effort : float
        Largest effort, Nm or N; zero for a passive joint, infinite where unknown.
    speed : float
        Largest speed, rad/s or m/s, infinite where unknown. MJCF has no such limit.
    damping, friction_loss, armature : float
        Viscous friction (Nm s/rad or N s/m), Coulomb friction (Nm or N) and the inertia of
        rotor and gear reflected to the joint (kg m² or kg), as given in the file.
    stiffness, spring_reference : float
        Of a spring beside the drive, Nm/rad or N/m, and the position in which it is relaxed, rad or
        m. Only an MJCF can have it.
    mimic : Mimic or None
        The joint that it follows. Its generalised force is added to its leader's.
    has_stops : bool
        Whether the ends of its range bear load in a log, which no sensor measures.
    sensor : str
        Frame of the wrist force/torque sensor of which this joint is one component, with a minus
        before it if the sensor reads the opposite wrench; empty for a joint that moves. See
        :mod:`symbid_ros.model.wrist_sensors`.
    """

    name: str
    kind: Literal["revolute", "prismatic"]
    parent: int
    rotation: FloatArray
    translation: FloatArray
    axis: FloatArray
    reference: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    effort: float = np.inf
    damping: float = 0.0
    friction_loss: float = 0.0
    armature: float = 0.0
    mimic: Mimic | None = None
    sensor: str = ""
    speed: float = np.inf
    stiffness: float = 0.0
    spring_reference: float = 0.0
    has_stops: bool = False


@dataclass(frozen=True)
class Contacts:
    """Frames at which unmeasured wrenches act, and the rows without these wrenches.

    See :mod:`symbid_ros.dynamics.unmeasured_contacts`.

    Attributes
    ----------
    names : tuple of str
        ``FRAME``, ``FRAME:point`` for a contact without moments, or ``FRAME:RADIUS`` for one at the
        bottom of a ball.
    frames : tuple of str
        The F frames.
    radii : (F,) float64
        Of the balls about their origins that touch the ground, m; zero elsewhere.
    components : (r,) int64
        Independent ones of the wrenches' 6 F components, angular first.
    damping : float
        ε, in units of the contact Jacobian.
    coordinates : (n - r,) int64
        Coordinates whose rows remain.
    loads : (F, n) bool
        Coordinates on which each contact acts.
    independent : Contacts or None
        The contacts with the independent rows alone, if dependent ones remain too: those of every
        coordinate.
    by_state : dict of tuple of bool to Contacts
        The contacts of each set of frames that touch something, filled as they occur.
    """

    names: tuple[str, ...]
    frames: tuple[str, ...]
    radii: FloatArray
    components: IntArray
    damping: float
    coordinates: IntArray
    loads: BoolArray
    independent: "Contacts | None" = None
    by_state: "dict[tuple[bool, ...], Contacts]" = field(
        default_factory=dict, repr=False, compare=False
    )

    @property
    def has_all_rows(self) -> bool:
        """Whether dependent rows remain too."""
        return self.independent is not None


@dataclass(frozen=True)
class HeldJoints:
    """Joints that count as rigid, see :mod:`symbid_ros.model.held_joints`.

    Attributes
    ----------
    positions : mapping of str to float
        Where they are held, rad (m).
    robot : RobotModel
        The robot in which they move.
    """

    positions: Mapping[str, float]
    robot: "RobotModel"


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Kinematics and inertias of any robot that is a tree of links.

    Attributes
    ----------
    name : str
        Robot name of the file.
    links : tuple of Link
        Link 0 is the base; parents come before children.
    joints : tuple of Joint
        Joint k connects ``joints[k].parent`` to link k + 1.
    frames : tuple of Frame
        Fixed frames, sorted by name.
    floating : bool
        Whether the base is free to move.
    gravity : (3,) float64
        Gravity in m/s²: in world axes for a floating base, in base axes for a fixed one.
    source : str
        Path of the model file, for messages.
    bodies : tuple of Body
        Bodies of the model file, of which the links are made; empty for a robot without a file.
    contacts : Contacts or None
        Contacts without a wrench sensor; None if every contact has one.
    held : HeldJoints or None
        Joints of the model file that are not among ``joints``; None if there are none.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    frames: tuple[Frame, ...]
    floating: bool
    gravity: FloatArray
    source: str
    bodies: "tuple[Body, ...]" = field(default=(), repr=False, compare=False)
    contacts: Contacts | None = None
    held: HeldJoints | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Reject duplicate names of links and joints."""
        for kind, names in (("link", self.link_names), ("joint", self.joint_names)):
            if len(set(names)) != len(names):
                twice = sorted({name for name in names if names.count(name) > 1})
                raise ModelError(
                    f"{self.source}: {kind} name {twice[0]!r} is used twice; rename one", "E105"
                )

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links, base first."""
        return tuple(link.name for link in self.links)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in column order."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def followers(self) -> dict[int, Mimic]:
        """The joints that follow others, by index."""
        return {k: joint.mimic for k, joint in enumerate(self.joints) if joint.mimic is not None}

    @cached_property
    def wrist_sensors(self) -> dict[str, slice]:
        """Indices of the six joints of each wrist force/torque sensor, by its frame."""
        first: dict[str, int] = {}
        for index, joint in enumerate(self.joints):
            if joint.sensor:
                first.setdefault(joint.sensor.removeprefix("-"), index)
        return {frame: slice(index, index + 6) for frame, index in first.items()}

    @cached_property
    def moving_joints(self) -> tuple[int, ...]:
        """Indices of the joints that are not components of a wrist sensor."""
        return tuple(index for index, joint in enumerate(self.joints) if not joint.sensor)

    @cached_property
    def measured_joint_names(self) -> tuple[str, ...]:
        """Names of the joints that a log must contain: those that move and have no leader."""
        return tuple(
            joint.name for joint in self.joints if joint.mimic is None and not joint.sensor
        )

    @cached_property
    def prismatic_joint_names(self) -> tuple[str, ...]:
        """Names of the joints whose positions are lengths."""
        return tuple(
            joint.name for joint in self.joints if joint.kind == "prismatic" and not joint.sensor
        )

    def apply_mimics(self, values: FloatArray, *, rates: bool = False) -> FloatArray:
        """Return joint positions (N, J), or rates, with those of mimic joints computed.

        The joints of wrist sensors are at rest at zero.
        """
        if not self.followers and not self.wrist_sensors:
            return values
        complete = values.copy()
        for place in self.wrist_sensors.values():
            complete[:, place] = 0.0
        for joint, mimic in self.followers.items():
            offset = 0.0 if rates else mimic.offset
            complete[:, joint] = mimic.multiplier * values[:, mimic.leader] + offset
        return complete

    def fold_followers(self, force: FloatArray) -> None:
        """Add the forces of mimic joints to their leaders (virtual work), in place.

        Parameters
        ----------
        force : (N, n, ...) float64
            Rows of the n coordinates. The rows of mimic joints become zero.
        """
        first = 6 * self.floating
        for joint, mimic in self.followers.items():
            force[:, first + mimic.leader] += mimic.multiplier * force[:, first + joint]
            force[:, first + joint] = 0.0

    @cached_property
    def ancestors(self) -> BoolArray:
        """(J, L) whether joint j lies between the base and link l, δ_j(l) of Eq. 10."""
        table = np.zeros((len(self.joints), len(self.links)), dtype=bool)
        for index, joint in enumerate(self.joints):
            table[:, index + 1] = table[:, joint.parent]
            table[index, index + 1] = True
        return table

    @property
    def dof(self) -> int:
        """Number of coordinates n: six of a floating base, then the joints."""
        return 6 * self.floating + len(self.joints)

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the n coordinates: base moment and force, then the joints."""
        base = [f"base/{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz"]
        return (*(base if self.floating else []), *self.joint_names)

    @property
    def coordinate_units(self) -> tuple[str, ...]:
        """Units of the n generalised forces, Nm or N."""
        base = ["Nm", "Nm", "Nm", "N", "N", "N"]
        joints = ("N" if joint.kind == "prismatic" else "Nm" for joint in self.joints)
        return (*(base if self.floating else []), *joints)

    def frame(self, name: str, option: str = "") -> Frame:
        """Return a frame by its name. The name of a link means the link's own frame.

        Of ``FRAME@LINK``, for a wrench in FRAME on LINK, it is FRAME. An error names the option
        that gives the name, or else the messages of a sensor.

        Raises
        ------
        ModelError
            When neither a frame nor a link has that name.
        """
        if ON_LINK in name and name not in {frame.name for frame in self.frames}:
            name = name.rpartition(ON_LINK)[0]
        for frame in self.frames:
            if frame.name == name:
                return frame
        if name in self.link_names:
            return Frame(name, self.link_names.index(name), np.eye(3), np.zeros(3))
        inside = {
            self.link_names[joint + 1]
            for own in self.wrist_sensors.values()
            for joint in range(own.start, own.stop - 1)
        }
        links = [link for link in self.link_names if link not in inside]
        known = ", ".join([*(frame.name for frame in self.frames), *links])
        if option:
            raise ModelError(
                f"`{option}`: {self.source} has no frame or link {name!r}; give one of {known}",
                "E116",
            )
        raise ModelError(
            f"{self.source}: no frame or link {name!r}; add it to the model or remap the "
            f"header.frame_id to one of: {known}",
            "E116",
        )

    def loaded_link(self, name: str) -> int:
        """Return the index of the link that a wrench given in a frame, or ``FRAME@LINK``, acts on.

        Raises
        ------
        ModelError
            When the robot has no frame or link of that name.
        """
        _, on, link = name.rpartition(ON_LINK)
        is_frame = any(frame.name == name for frame in self.frames)
        return self.frame(link if on and not is_frame else name).link

    @property
    def has_mass(self) -> bool:
        """Whether any moving link has a mass, which models for visualisation lack."""
        return any(link.phi[0] > 0 for link in self.links[0 if self.floating else 1 :])

    def require_mass(self) -> None:
        """Raise an error if no moving link has a mass.

        Raises
        ------
        ModelError
            When none has one.
        """
        if not self.has_mass:
            raise ModelError(
                f"{self.source}: the model has no mass; give each moving link an <inertial>", "E123"
            )

    def with_phi(self, phi: FloatArray) -> "RobotModel":
        """Return the same robot with the inertias (L, 10) of ``phi``."""
        links = tuple(replace(link, phi=row) for link, row in zip(self.links, phi, strict=True))
        return replace(self, links=links)

    def with_force_only(self, sensors: Sequence[str]) -> "RobotModel":
        """Return the same robot of which some wrench sensors measure forces alone.

        Parameters
        ----------
        sensors : sequence of str
            ``FRAME:RADIUS`` with the radius of the ball about the frame's origin at whose lowest
            point the force acts, m, or ``FRAME`` for that of the model.

        Raises
        ------
        ModelError
            When the robot has no such frame, no ball about its origin, or it is a moving link's.
        """
        below = {}
        for name, _, radius in (one.partition(":") for one in sensors):
            frame = self.frame(name, "force_only")
            below[frame.name] = float(radius) if radius else frame.radius
            if frame.name in self.link_names:
                raise ModelError(
                    f"{self.source}: `force_only`: {name} is a moving link; add a frame at the "
                    "centre of its ball to the model, and name that",
                    "E124",
                )
            if not (radius or frame.radius):
                raise ModelError(
                    f"{self.source}: `force_only`: no ball is about the origin of {name}; give "
                    f"{name}:RADIUS (m), or the frame at the centre of the foot's ball",
                    "E124",
                )
        frames = (replace(one, below=below.get(one.name, one.below)) for one in self.frames)
        return replace(self, frames=tuple(frames))

    def with_end_stops(self, joints: Sequence[str]) -> "RobotModel":
        """Return the same robot of which some joints lean on the ends of their ranges.

        Raises
        ------
        ModelError
            When the robot has no such joint, or the joint has no end.
        """
        for name in joints:
            joint = next((one for one in self.joints if one.name == name), None)
            if joint is None or not (np.isfinite(joint.lower) or np.isfinite(joint.upper)):
                raise ModelError(
                    f"{self.source}: `end_stops`: {name} is no joint with a limited range; name "
                    "joints that have limits in the model",
                    "E125",
                )
        found = (replace(one, has_stops=one.name in joints) for one in self.joints)
        return replace(self, joints=tuple(found)) if joints else self

    @property
    def force_only(self) -> tuple[str, ...]:
        """The wrench sensors that measure forces alone, as :meth:`with_force_only` takes them."""
        return tuple(f"{one.name}:{one.below:.6g}" for one in self.frames if one.below)

    @cached_property
    def end_stops(self) -> tuple[str, ...]:
        """Joints that lean on the ends of their ranges."""
        return tuple(joint.name for joint in self.joints if joint.has_stops)

    def with_gravity(self, direction: Sequence[float] | None) -> "RobotModel":
        """Return the same robot on which gravity points in another direction (3,), in base axes.

        It stays as it is if there is none.

        Raises
        ------
        OptionError
            When the base floats.
        """
        if direction is None:
            return self
        if self.floating:
            raise OptionError(
                "`gravity` is that of a fixed base; the IMU of a floating base measures it: leave "
                "`gravity` out, or give `base` fixed",
                "E503",
            )
        unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
        return replace(self, gravity=np.linalg.norm(self.gravity) * unit)

    @cached_property
    def phi(self) -> FloatArray:
        """(L, 10) inertial parameters of all links."""
        return np.array([link.phi for link in self.links])

    @property
    def inertial_parameters(self) -> FloatArray:
        """(p,) inertial parameters of the links that a file can give mass, base first.

        A body of an MJCF with several joints is a chain of links, of which the last has mass.
        """
        return np.concatenate([link.phi for link in self.links if not link.virtual])
