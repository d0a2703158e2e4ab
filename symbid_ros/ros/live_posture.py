"""The posture of a running robot, from its joint states."""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from rclpy.node import Node

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.sensor_mapping import SensorMapping
from symbid_ros.messages.types import JOINT_STATE
from symbid_ros.model.tree import RobotModel
from symbid_ros.ros.parameters import options_from, parameters_of
from symbid_ros.ros.raw_subscription import DecodedSubscription
from symbid_ros.ros.sensor_topics import JOINTS

# Options by which joint states relate to the model; the identifier has parameters of these names.
OPTIONS = "joint_topic", "rename_joint", "flip_joint", "hold_joint"
POSTURE_PARAMETERS = tuple(one for one in parameters_of(LogOptions) if one.name in OPTIONS)
DEFAULTS = {one.name: one.default for one in parameters_of(LogOptions)}
LEAST_MOTION = 1e-3  # rad or m; smaller motions are not shown


class LivePosture:
    """Follows the joint states of a robot, whose joints may have other names than the model's.

    A joint that is neither published nor held is at zero.

    Parameters
    ----------
    node : Node
    model : RobotModel
    values : mapping of str to object
        Values of `POSTURE_PARAMETERS`.

    Raises
    ------
    OptionError
        If an entry of a parameter is invalid.
    """

    def __init__(self, node: Node, model: RobotModel, values: Mapping[str, Any]) -> None:
        options = options_from(LogOptions, DEFAULTS | {name: values[name] for name in OPTIONS})
        self._mapping, self._model = SensorMapping.of(options), model
        self._known = dict(self._mapping.held)
        self._newest: FloatArray | None = None
        self._subscriptions = [
            DecodedSubscription(node, topic, JOINT_STATE, 1)
            for topic in options.joint_topic or (JOINTS,)
        ]

    def read(self) -> bool:
        """Take the newest joint states and return whether the robot has moved."""
        heard = [self._read(each) for each in self._subscriptions]
        if not any(heard):
            return False
        position = np.array([[self._known.get(name, 0.0) for name in self._model.joint_names]])
        posture = self._model.apply_mimics(position)[0]
        before, self._newest = self._newest, posture
        return before is None or bool(np.abs(posture - before).max(initial=0.0) > LEAST_MOTION)

    @property
    def newest(self) -> FloatArray | None:
        """Joint positions (J,), rad (m), in the model's order; None before the first state."""
        return self._newest

    def _read(self, subscription: DecodedSubscription) -> bool:
        """Store the newest positions of a topic; return whether there are any."""
        newest = deque(subscription.take(), maxlen=1)
        if not newest:
            return False
        try:
            message = subscription.decode(newest[0])
        except DataError:
            return False
        recorded = message.layout.text.get("name", ())
        if not recorded or "position" not in (message.record.dtype.names or ()):
            return False
        names = [self._mapping.joints.get(name, name) for name in recorded]
        positions = map(float, np.ravel(message.record["position"]))
        found = {
            name: -position if name in self._mapping.flipped_joints else position
            for name, position in zip(names, positions, strict=False)
            if math.isfinite(position) and name in self._model.joint_names
        }
        self._known |= found
        return bool(found)
