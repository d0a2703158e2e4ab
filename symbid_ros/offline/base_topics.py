"""Topics that tell how a robot touches its environment: flags of contacts, poses, odometry."""

import re
from collections.abc import Sequence

from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import BOOL, ODOMETRY, POSE
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.name_matching import most_similar

# Words of a topic of contact flags, one of which its name must contain.
CONTACT_WORDS = re.compile(r"contact|touch|stance|ground", re.IGNORECASE)


def contact_flags(topics: Sequence[Topic], robot: RobotModel) -> dict[str, str]:
    """Return the frames of contacts by the Bool topics that are about them.

    Topics whose name resembles no frame, or the same frame as another, are left out.
    """
    sensors = [frame.name for frame in robot.frames]
    known = [*sensors, *robot.link_names]
    found: dict[str, str] = {}
    for topic in sorted(topics, key=lambda one: one.name):
        if topic.msgtype != BOOL or not CONTACT_WORDS.search(topic.name):
            continue
        name = CONTACT_WORDS.sub("", topic.name)
        frame = most_similar(name, "", sensors) or most_similar(name, "", known)
        if frame is not None and frame not in found.values():
            found[topic.name] = frame
    return found


def pose_topics(topics: Sequence[Topic]) -> list[str]:
    """Return the topics of poses alone, as motion capture publishes them."""
    return sorted(topic.name for topic in topics if topic.msgtype == POSE)


def odometry_topics(topics: Sequence[Topic]) -> list[str]:
    """Return the topics of poses with velocities, as wheeled bases publish them."""
    return sorted(topic.name for topic in topics if topic.msgtype == ODOMETRY)
