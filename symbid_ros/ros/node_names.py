"""Prints a node name that no node of the ROS domain has, for commands that start nodes."""

import os
import sys
import time
from collections.abc import Collection
from itertools import count

import rclpy
from rclpy.signals import SignalHandlerOptions

from symbid_ros.ros.process import use_udp

DISCOVERY = 2.0  # s until running nodes are known
# On a busy machine, nodes that miss the first announcements answer those that follow every 3 s.
BUSY_DISCOVERY = 7.0  # s
POLL = 0.05  # s


def unused_name(name: str, used: Collection[str]) -> str:
    """Return a name, with a number behind it if it is in use."""
    names = (f"{name}_{number}" if number > 1 else name for number in count(1))
    return next(each for each in names if each not in used)


def discovery_time() -> float:
    """Return the time until running nodes are known, s; it is longer on a busy machine."""
    is_busy = os.getloadavg()[0] > (os.cpu_count() or 1)
    return BUSY_DISCOVERY if is_busy else DISCOVERY


def main() -> int:
    """Print an unused variant of a name in a namespace, both given as arguments.

    A third argument replaces the time, s, for which a node of that name is looked for.
    """
    name, namespace, *rest = sys.argv[1:]
    use_udp(os.environ, rclpy.get_rmw_implementation_identifier())
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"_unused_name_{os.getpid()}")
    used: set[str] = set()
    deadline = time.monotonic() + (float(rest[0]) if rest else discovery_time())
    while time.monotonic() < deadline:
        used |= {one for one, space in node.get_node_names_and_namespaces() if space == namespace}
        if name in used:  # others are found soon
            deadline = min(deadline, time.monotonic() + DISCOVERY)
        time.sleep(POLL)
    node.destroy_node()
    rclpy.try_shutdown()
    print(unused_name(name, used))
    return 0


if __name__ == "__main__":
    sys.exit(main())
