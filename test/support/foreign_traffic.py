"""Publishes the traffic of a full graph beside a robot, at a robot's rates.

Junk on every topic that the named nodes subscribe to, a camera's IMU, a second robot with frames of
the same names, and a lone publisher of joint states. Runs until SIGINT or SIGTERM.
"""

import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import cycle
from random import Random
from threading import Event
from typing import Any

import rclpy
from geometry_msgs.msg import WrenchStamped
from junk_messages import malformed
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu, JointState

from symbid_ros.ros.endpoints import message_class, reliable_qos

RATE = 100.0  # Hz, of each foreign topic
JUNK_RATE = 20.0  # Hz, of each topic of the robot
LOOK_PERIOD = 1.0  # s between two updates of the topics that the nodes subscribe to
JOINTS = [f"{side}_{joint}" for side in "LR" for joint in ("haa", "hfe", "kfe")]
ROBOT = {
    "joint_states": (JointState, ""),
    "imu/data": (Imu, "imu_link"),
    "left_foot/wrench": (WrenchStamped, "left_sole"),
    "right_foot/wrench": (WrenchStamped, "right_sole"),
}
FOREIGN = {
    "/camera/imu": (Imu, "camera_imu_optical_frame"),
    "/dummy/joint_states": (JointState, ""),
    **{f"/robot2/{name}": kind for name, kind in ROBOT.items()},
}


class Traffic:
    """Publishers of foreign topics."""

    def __init__(self, node: Node, victims: Sequence[str]) -> None:
        self._node, self._victims = node, frozenset(victims)
        self._foreign = [
            (node.create_publisher(kind, name, reliable_qos(10)), self._message(kind, frame))
            for name, (kind, frame) in FOREIGN.items()
        ]
        self._junk: dict[str, tuple[Publisher, Iterator[bytes]]] = {}
        self.sent: dict[str, int] = {}

    @staticmethod
    def _message(kind: type[Any], frame: str) -> Any:
        message = kind()
        message.header.frame_id = frame
        if kind is JointState:
            message.name = JOINTS
            message.position = message.velocity = message.effort = [0.1] * len(JOINTS)
        return message

    def look(self) -> None:
        """Create a publisher for every topic that a node subscribes to."""
        for name, kinds in self._node.get_topic_names_and_types():
            readers = self._node.get_subscriptions_info_by_topic(name)
            if name in self._junk or not any(each.node_name in self._victims for each in readers):
                continue
            kind = message_class(kinds[0])
            junk = malformed(serialize_message(self._valid(kind)), Random(name))
            publisher = self._node.create_publisher(kind, name, reliable_qos(10))
            self._junk[name], self.sent[name] = (publisher, junk), 0

    def _valid(self, kind: type[Any]) -> Any:
        return self._message(kind, "imu_link") if hasattr(kind(), "header") else kind()

    def publish_foreign(self) -> None:
        """Publish one message on each foreign topic."""
        stamp = self._node.get_clock().now().to_msg()
        for publisher, message in self._foreign:
            message.header.stamp = stamp
            publisher.publish(message)

    def publish_junk(self) -> None:
        """Publish one payload on each topic of the nodes."""
        for name, (publisher, junk) in self._junk.items():
            # The middleware itself rejects messages larger than a type without sequences.
            with suppress(RuntimeError):
                publisher.publish(next(junk))
                self.sent[name] += 1


def main(victims: Sequence[str]) -> None:
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("stranger")
    traffic = Traffic(node, victims)
    looked = float("-inf")
    for turn in cycle(range(round(RATE / JUNK_RATE))):
        if stop.is_set():
            break
        begun = time.monotonic()
        if begun - looked > LOOK_PERIOD:
            traffic.look()
            looked = begun
        traffic.publish_foreign()
        if not turn:
            traffic.publish_junk()
        time.sleep(max(0.0, begun + 1 / RATE - time.monotonic()))
    print(traffic.sent, flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1:])
