"""Checks that the joints, frames and topics in options are those of the log or of the model.

A misspelt name would otherwise have no effect.
"""

import logging
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from symbid_ros.errors import OptionError
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.model.tree import RobotModel

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelNames:
    """Names of a robot model.

    Attributes
    ----------
    source : str
        File of the model.
    joints, frames : tuple of str
        Joints, and frames and links.
    """

    source: str
    joints: tuple[str, ...]
    frames: tuple[str, ...]

    @classmethod
    def of(cls, model: RobotModel) -> "ModelNames":
        """Return the names of a model."""
        joints = tuple(joint.name for joint in model.joints if not joint.sensor)
        frames = [frame.name for frame in model.frames]
        return cls(model.source, joints, tuple(dict.fromkeys([*frames, *model.link_names])))


@dataclass
class RecordedNames:
    """Names in the messages of a log, before any is renamed.

    Attributes
    ----------
    source : str
        Name of the log.
    joints, frames, wrenches : set of str
        Joints, frames of sensors and of ``/tf_static``, and topics of wrenches.
    """

    source: str
    joints: set[str] = field(default_factory=set)
    frames: set[str] = field(default_factory=set)
    wrenches: set[str] = field(default_factory=set)


@dataclass(frozen=True)
class _NamesOf:
    """Names that an option uses, and those that exist.

    Attributes
    ----------
    option, kind : str
        The option, and what it names.
    used, known : collection of str
    place : str
        What has the known names, and the verb.
    """

    option: str
    kind: str
    used: Collection[str]
    known: Collection[str]
    place: str

    def faults(self) -> Iterator[str]:
        """Yield a message for each name that does not exist."""
        names = ", ".join(self.known)
        advice = f"give one of {names}" if names else "leave the option out"
        for name in self.used:
            if name not in self.known:
                yield f"`{self.option}`: {self.place} {self.kind} {name!r}; {advice}"


def check_names(
    mapping: SensorMapping,
    model: ModelNames | None,
    recorded: RecordedNames,
    held: Collection[str] | None,
    logged: set[str],
) -> None:
    """Refuse names in options that neither a log nor the model has.

    A robot file may name what another log of the robot has. Such names are reported by a warning if
    the model cannot have them, and joints to hold may be recorded.

    Parameters
    ----------
    mapping : SensorMapping
    model : ModelNames, optional
        None if no model is given.
    recorded : RecordedNames
    held : collection of str, optional
        Joints that the log lacks; None if they are unknown.
    logged : set of str
        Warnings that are not logged again.

    Raises
    ------
    OptionError
        When a name is unknown, or a joint to hold is recorded.
    """
    joints = sorted({mapping.joints.get(name, name) for name in recorded.joints})
    frames = sorted({mapping.frame(name) for name in recorded.frames})
    groups = list(_of_log(mapping, recorded))
    if model is None:
        groups += _of_log_or_model(mapping, joints, frames, f"{recorded.source} has no")
    else:
        for group in _of_model(mapping, model, joints, frames, recorded):
            for fault in group.faults():
                raise OptionError(fault, "E501")
    for group in groups:
        for fault in group.faults():
            if group.option not in mapping.of_robot:
                raise OptionError(fault, "E501")
            if fault not in logged:
                logged.add(fault)
                logger.warning("%s", fault)
    if held is not None and "hold_joint" not in mapping.of_robot:
        for name in mapping.held:
            if name in joints and name not in held:
                raise OptionError(
                    f"`hold_joint` {name} has no effect: {recorded.source} has its positions; "
                    "leave it out",
                    "E503",
                )


def check_model_names(mapping: SensorMapping, model: ModelNames, *, has_poses: bool) -> None:
    """Refuse names in options that a model lacks, while the messages are not known yet.

    Beside poses, sensors may have frames of the world, which the model lacks.

    Raises
    ------
    OptionError
        When a name is unknown.
    """
    frames = (
        {*mapping.flipped, *mapping.rotations, *mapping.frames.values()} if has_poses else set()
    )
    for group in _of_model(mapping, model, [], frames, RecordedNames("", frames=frames)):
        for fault in group.faults():
            raise OptionError(fault, "E501")


def _of_log(mapping: SensorMapping, recorded: RecordedNames) -> Iterator[_NamesOf]:
    """Yield the names that only messages can have."""
    prefix, place = mapping.frame_prefix, f"{recorded.source} has no"
    joints, frames = sorted(recorded.joints), sorted(recorded.frames)
    bare = [name.removeprefix(prefix) for name in frames]
    yield _NamesOf("rename_joint", "joint", mapping.joints, joints, place)
    yield _NamesOf(
        "rename_frame", "frame", mapping.frames, list(dict.fromkeys(bare + frames)), place
    )
    if prefix and not any(name.startswith(prefix) for name in frames):
        of_frames = f"{recorded.source}, with frames {', '.join(frames) or 'none'}, has no"
        yield _NamesOf("frame_prefix", "frame with the prefix", (prefix,), (), of_frames)
    yield _NamesOf("plate_link", "topic", mapping.plate_links, sorted(recorded.wrenches), place)


def _of_model(
    mapping: SensorMapping,
    model: ModelNames,
    joints: Collection[str],
    frames: Collection[str],
    recorded: RecordedNames,
) -> Iterator[_NamesOf]:
    """Yield the names that the model must have, or the log with joints and frames as renamed."""
    place = f"{model.source} has no"
    yield _NamesOf("rename_joint", "joint", mapping.joints.values(), model.joints, place)
    tracked = (mapping.tracked,) if mapping.tracked else ()
    links = mapping.plate_links.values()
    yield _NamesOf("plate_link", "frame or link", links, model.frames, place)
    all_frames = tuple(dict.fromkeys([*model.frames, *frames]))
    # A frame of the log may be renamed to another one, such as that of the world.
    goals = tuple(dict.fromkeys([*model.frames, *sorted(recorded.frames)]))
    yield _NamesOf("pose_frame", "frame or link", tracked, all_frames, place)
    all_joints = tuple(dict.fromkeys([*model.joints, *joints]))
    both = f"neither {model.source} nor {log} has a" if (log := recorded.source) else place
    yield _NamesOf("rename_frame", "frame or link", mapping.frames.values(), goals, both)
    yield from _of_log_or_model(mapping, all_joints, all_frames, both)


def _of_log_or_model(
    mapping: SensorMapping, joints: Collection[str], frames: Collection[str], place: str
) -> Iterator[_NamesOf]:
    """Yield the names, as renamed, that the log or the model may have."""
    yield _NamesOf("hold_joint", "joint", mapping.held, joints, place)
    yield _NamesOf("flip_joint", "joint", sorted(mapping.flipped_joints), joints, place)
    yield _NamesOf("position_scale", "joint", mapping.position_scale, joints, place)
    yield _NamesOf("effort_scale", "joint", mapping.effort_scale, joints, place)
    yield _NamesOf("flip_wrench", "frame or link", sorted(mapping.flipped), frames, place)
    yield _NamesOf("rotate_imu", "frame or link", mapping.rotations, frames, place)
