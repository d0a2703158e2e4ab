"""The identifier: topics or a bag in, an estimate on latched topics out."""

import sys
from collections.abc import Sequence
from threading import Event
from typing import Any

from rclpy.node import Node
from threadpoolctl import threadpool_limits

from symbid_ros.ros.identifier_parameters import PARAMETERS, is_online
from symbid_ros.ros.offline_identifier import OfflineIdentifier
from symbid_ros.ros.online_identifier import OnlineIdentifier
from symbid_ros.ros.process import built, run_node
from symbid_ros.ros.robot_description import with_model


def identify(node: Node, values: dict[str, Any], stop: Event) -> None:
    """Identify from what the parameters name until stopped."""
    with with_model(node, values, stop) as complete:
        if complete is None:
            return
        if is_online(complete):
            built(OnlineIdentifier, node, complete, stop).run(stop)
        else:
            built(OfflineIdentifier, node, complete, stop).run(stop)


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``identifier``."""
    threadpool_limits(1)
    sys.exit(
        run_node(
            "identifier",
            identify,
            args,
            purpose="Identify a robot's inertial parameters from topics or bags and publish them.",
            parameters=PARAMETERS,
        )
    )
