"""Prints the names of nodes in a namespace, for commands that start nodes."""

import os
import sys
import time

import rclpy
from rclpy.signals import SignalHandlerOptions

from symbid_ros.ros.process import use_udp

DISCOVERY = 2.0  # s until running nodes are known
# On a busy machine, nodes that miss the first announcements answer those that follow every 3 s.
BUSY_DISCOVERY = 7.0  # s
POLL = 0.05  # s


def discovery_time() -> float:
    """Return the time until running nodes are known, s; it is longer on a busy machine."""
    is_busy = os.getloadavg()[0] > (os.cpu_count() or 1)
    return BUSY_DISCOVERY if is_busy else DISCOVERY


def main() -> int:
    """Print the names of nodes in a namespace, one a line.

    Arguments are the name of the node that is looked for, and the namespace. A third one replaces
    the time, s, for which it is looked for.
    """
    name, namespace, *rest = sys.argv[1:]
    use_udp(os.environ, rclpy.get_rmw_implementation_identifier())
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(f"_node_names_{os.getpid()}")
    used: set[str] = set()
    deadline = time.monotonic() + (float(rest[0]) if rest else discovery_time())
    while time.monotonic() < deadline:
        used |= {one for one, space in node.get_node_names_and_namespaces() if space == namespace}
        if name in used:  # others are found soon
            deadline = min(deadline, time.monotonic() + DISCOVERY)
        time.sleep(POLL)
    node.destroy_node()
    rclpy.try_shutdown()
    print("\n".join(sorted(used)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
