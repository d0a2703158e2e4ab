"""Use the live estimate in a node of your own: print each link's mass whenever it changes.

ros2 run symbid_ros identifier --ros-args -p model:=robot.urdf     # or: -p bag:=[my_bag]
python examples/live_node.py L_thigh L_shank
"""

import sys

import rclpy
from geometry_msgs.msg import InertiaStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

# The identifier keeps its latest estimate for nodes that start later.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class MassPrinter(Node):
    """Prints the estimated masses of some links."""

    def __init__(self, links: list[str]) -> None:
        super().__init__("mass_printer")
        for link in links:
            topic = f"identifier/inertia/{link}"
            self.create_subscription(InertiaStamped, topic, self._print, LATCHED)

    def _print(self, message: InertiaStamped) -> None:
        inertia, link = message.inertia, message.header.frame_id
        com = f"({1e3 * inertia.com.x:.1f}, {1e3 * inertia.com.y:.1f}, {1e3 * inertia.com.z:.1f})"
        print(f"{link}: {inertia.m:.3f} kg, centre of mass {com} mm", flush=True)


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    try:
        rclpy.spin(MassPrinter(sys.argv[1:]))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
