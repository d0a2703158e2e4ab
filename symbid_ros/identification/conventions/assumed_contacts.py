"""Where a robot without wrench sensors seems to stand, if no option says so."""

import logging
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import TypeVar

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, link_poses
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.errors import ModelError
from symbid_ros.identification.conventions.contact_radii import with_fitted_radii
from symbid_ros.identification.log_reading import first_segments
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.model.frames import Frame, ball_around
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.alignment import warn_once
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import probed
from symbid_ros.signals.streams import Streams

Options = TypeVar("Options", bound=RobotOptions)

# Words of the frame of an end that touches the ground; other frames there are those of sensors.
FOOT_WORDS = re.compile(r"foot|feet|sole|toe|contact|paw|hoof|tip", re.IGNORECASE)
# Words of the parts of a leg.
LEG_WORDS = re.compile(
    r"foot|feet|sole|toe|paw|hoof|leg|hip|thigh|knee|calf|shank|shin|ankle|haa|hfe|kfe",
    re.IGNORECASE,
)
FEWEST_JOINTS = 2  # of a leg
# Ends of legs are this low, as a share of the robot's height above the lowest one, at this share
# of the instants at least.
LOW, OFTEN = 0.1, 0.1
# Ends of which a surface touches the ground are few: more have too many unknown wrenches.
FEW = 2
FEWEST = 2  # ends on which a robot stands: a lone one may belong to a drone's arm
# ns of the log that show whether there are wrench sensors, and that show the robot's postures.
SHORT, LONG = 1_000_000_000, 60_000_000_000
FIRST = 5  # slices, of which one has messages of all topics

logger = logging.getLogger(__name__)


def with_assumed_contacts(options: Options, robot: RobotModel, log: Log) -> Options:
    """Return options that name contacts if neither they nor a log's sensors do; log a warning.

    The first second of the log is read, or the first minute if there is no wrench sensor.
    """
    if options.contacts or options.wrist_sensors:
        return options
    return naming_contacts(options, assumed_contacts(robot, log), log.source)


def naming_contacts(options: Options, found: tuple[str, ...], source: str) -> Options:
    """Return options that name contacts of a log, and log a warning unless there is none."""
    if not found:
        return options
    logger.warning(
        "%s: no wrench sensor, so what acts on %s is taken as unknown; give `contact` %s if that "
        "is right, name the frames that touch something, or give `base` fixed if it is clamped",
        source,
        ", ".join(name.partition(":")[0] for name in found),
        ",".join(found),
    )
    return replace(options, contact=found)


def assumed_contacts(robot: RobotModel, log: Log) -> tuple[str, ...]:
    """Return where a floating robot without wrench sensors seems to stand, as `contact` names it.

    These are the contacts that have flags, otherwise the ends of the legs: of all ends of
    kinematic chains those that are the lowest, not necessarily at once. A contact that touches
    nothing costs rows, but does not bias them. There are none if there are wrench sensors, no
    efforts, or too many contacts.
    """
    if not robot.floating:
        return ()
    with warn_once(muted=True):
        frames = _standing_frames(robot, log)
    may_be_surfaces = len(frames) <= FEW and not all(robot.frame(one).radius for one in frames)
    for kind in ("", ":point") if may_be_surfaces else (":point",):
        try:
            found = with_contacts(robot, tuple(f"{frame}{kind}" for frame in frames)).contacts
        except ModelError:
            continue  # unknown wrenches of this kind would explain any motion
        if found is None:
            return ()
        with warn_once(muted=True):
            standing = first_segments(log, replace(robot, contacts=found), LONG)
        return with_fitted_radii(robot, found.names, standing)
    return ()


def _standing_frames(robot: RobotModel, log: Log) -> tuple[str, ...]:
    streams = _first_streams(log, SHORT)
    if streams is None or streams.wrenches or not np.isfinite(streams.joints.effort).any():
        return ()
    if streams.flags:
        return tuple(one.frame_id for one in streams.flags)
    return _lowest_ends(robot, first_segments(log, robot, LONG))


def _first_streams(log: Log, span: int) -> Streams | None:
    pieces = islice(log.slices(span, warn=False), FIRST)
    return next((one.streams for one in pieces if one.streams is not None), None)


def _lowest_ends(robot: RobotModel, segments: Sequence[Segment]) -> tuple[str, ...]:
    """Return the ends of chains that are often about as low as the lowest one."""
    ends = chain_ends(robot)
    if len(ends) < FEWEST:
        return ()
    often = np.zeros(len(ends))
    count = 0
    for samples in (probed(segment, robot) for segment in segments):
        poses = link_poses(robot, samples.position)
        force = samples.base_specific_force
        up = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
        height = np.einsum("tei,ti->te", end_positions(ends, poses), up)
        top = np.einsum("tli,ti->tl", poses.position, up).max(axis=1)
        lowest = height.min(axis=1)
        often += np.sum(height - lowest[:, None] < LOW * (top - lowest)[:, None], axis=0)
        count += len(samples)
    is_low = often > OFTEN * count
    low = tuple(end.name for end, touches in zip(ends, is_low.tolist(), strict=True) if touches)
    return low if len(low) >= FEWEST else ()


def chain_ends(robot: RobotModel) -> list[Frame]:
    """Return a frame at the end of each chain of joints.

    It is the farthest ball, or else frame, of those that are named like a foot, or else of all. A
    frame named like a foot may also mean the ball in which it lies.
    """
    carrying = {joint.parent for joint in robot.joints}
    ends = []
    for link in sorted(set(range(1, len(robot.link_names))) - carrying):
        frames = [frame for frame in robot.frames if frame.link == link]
        feet = [frame for frame in frames if FOOT_WORDS.search(frame.name)]
        own = robot.frame(robot.link_names[link])
        balls = [one for one in frames if one.radius]
        if feet:
            found = [ball_around(foot, robot.frames) for foot in feet]
            balls = [ball for ball in found if ball is not None]
        ends.append(max(balls or [*(feet or frames), own], key=_reach))
    return ends


def leg_ends(robot: RobotModel) -> tuple[str, ...]:
    """Return the ends of the chains of joints whose names are those of legs."""
    found = []
    for end in chain_ends(robot):
        chain = np.flatnonzero(robot.ancestors[:, end.link]).tolist()
        names = [robot.joint_names[joint] for joint in chain]
        names += [robot.link_names[joint + 1] for joint in chain]
        if len(chain) >= FEWEST_JOINTS and any(map(LEG_WORDS.search, [end.name, *names])):
            found.append(end.name)
    return tuple(found)


def _reach(frame: Frame) -> float:
    return float(np.linalg.norm(frame.translation))


def end_positions(ends: list[Frame], poses: LinkPoses) -> FloatArray:
    """Return the positions (N, E, 3) of frames in base axes."""
    return np.stack(
        [
            poses.position[:, end.link] + poses.rotation[:, end.link] @ end.translation
            for end in ends
        ],
        axis=1,
    )
