"""Who stands on force plates in world axes, and which frame of the robot a pose tracks.

The force at a foot acts along a line through the foot. A wrench (m; f) about the tracked frame's
origin passes a point x in its axes at the distance ‖m - x × f‖ / ‖f‖.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.identification.conventions.assumed_contacts import chain_ends, end_positions
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.streams import Streams, WrenchStream

# Share of the largest force above which something stands on a plate.
LOADED = 0.2
# The line of a force passes its foot, which has a length, within this distance, m, and any other
# foot at more than twice the distance.
NEAR, APART = 0.15, 2.0
MOST_INSTANTS = 500  # that are looked at


@dataclass(frozen=True)
class PlateContacts:
    """What stands on plates.

    Attributes
    ----------
    tracked : str
        Frame of the robot that the pose seems to track.
    links : dict of str to str
        Links or frames that stand on plates, by topic; those that the log does not show are left
        out.
    """

    tracked: str
    links: dict[str, str]


def find_plate_contacts(
    robot: RobotModel, streams: Streams, topics: Sequence[str], tracked: Sequence[str]
) -> PlateContacts:
    """Find what stands on plates.

    Parameters
    ----------
    robot : RobotModel
    streams : Streams
        Of its log, with the wrenches in the axes of the tracked frame, about its origin.
    topics : sequence of str
        Topics of the plates.
    tracked : sequence of str
        Frames that the pose may track, the most likely one first.
    """
    ends = chain_ends(robot)
    plates = [one for one in streams.wrenches if one.topic in topics and _loaded(one).any()]
    if not ends or not plates:
        return PlateContacts(tracked[0], {})
    # (F, P, E): frames, plates and ends.
    distances = np.array(
        [np.stack(_distances(robot, streams, one, tracked), axis=0) for one in plates]
    ).swapaxes(0, 1)
    passing = distances.min(axis=2).sum(axis=1)
    best = int(np.argmin(passing))
    if APART * passing[best] > passing[0]:
        best = 0
    links = {}
    for plate, each in zip(plates, distances[best], strict=True):
        first, *others = np.argsort(each).tolist()
        others_are_far = not others or each[others[0]] > APART * each[first]
        if each[first] < NEAR and others_are_far:
            links[plate.topic] = ends[first].name
    return PlateContacts(tracked[best], links)


def _loaded(plate: WrenchStream) -> FloatArray:
    """Return which messages (N,) show that something stands on a plate."""
    size = np.linalg.norm(plate.force, axis=1)
    return np.asarray(size > LOADED * size.max(initial=0.0))


def _distances(
    robot: RobotModel, streams: Streams, plate: WrenchStream, tracked: Sequence[str]
) -> list[FloatArray]:
    """Return the median distances (E,) of a plate's force from the ends, for each tracked frame."""
    index = np.flatnonzero(_loaded(plate))
    index = index[:: 1 + len(index) // MOST_INSTANTS]
    joints = streams.joints
    position = np.zeros((len(index), len(robot.joints)))
    for column, name in enumerate(robot.joint_names):
        if name in joints.names:
            recorded = joints.position[:, joints.names.index(name)]
            position[:, column] = np.interp(plate.stamp[index], joints.stamp, recorded)
    ends = end_positions(chain_ends(robot), link_poses(robot, robot.apply_mimics(position)))
    force, moment = plate.force[index, None], plate.torque[index, None]
    found = []
    for name in tracked:
        frame = robot.frame(name)
        at = (ends - frame.translation) @ frame.rotation
        arm = np.linalg.norm(moment - np.cross(at, force), axis=2) / np.linalg.norm(force, axis=2)
        found.append(np.median(arm, axis=0))
    return found
