"""Transforms of ``/tf_static`` messages."""

from collections.abc import Iterator

import numpy as np

from symbid_ros.messages.layout import typestore
from symbid_ros.messages.limits import MAX_MESSAGE
from symbid_ros.messages.topics import Topic
from symbid_ros.model.fixed_frames import FixedTransform, transform_of_quaternion

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
TF_STATIC = "tf_static"


def is_static(topic: Topic) -> bool:
    """Return whether a topic holds the transforms of fixed frames."""
    return topic.msgtype == TF_MESSAGE and topic.name.rsplit("/", 1)[-1] == TF_STATIC


def static_transforms(payload: bytes) -> Iterator[FixedTransform]:
    """Yield the transforms in a serialised message; of an invalid one those that are valid."""
    if len(payload) > MAX_MESSAGE:
        return
    try:
        message = typestore().deserialize_cdr(payload, TF_MESSAGE)
    except Exception:
        return
    for one in message.transforms:  # type: ignore[attr-defined]
        q, p = one.transform.rotation, one.transform.translation
        found = transform_of_quaternion(
            one.header.frame_id.removeprefix("/"),
            one.child_frame_id.removeprefix("/"),
            np.array([q.x, q.y, q.z, q.w]),
            np.array([p.x, p.y, p.z]),
        )
        if found is not None:
            yield found
