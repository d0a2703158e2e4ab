"""Bridge, recorder and online identifier together: lost messages, processor time and latency.

The three run as processes in a private domain, the robot at 1 kHz in real time. Printed are

- messages published, recorded and used for identification;
- the identifier's processor time in each second, as a share of one core;
- the age of the estimate: the time between its newest data and the robot's clock.

    .venv/bin/python bench/online.py [--minutes 5] [--solve-period 1.0]
"""

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from process_usage import processor_seconds
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator

WARM_UP = 5.0  # s
MOVES_PER_MINUTE = 30
LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class OnlineMonitor:
    """Measures the age of the estimates and the identifier's processor time."""

    def __init__(self, node: Node, pid: int) -> None:
        self._pid = pid
        self._clock = self._newest = 0.0
        self.ages: list[float] = []
        self.shares: list[float] = []
        self._used, self._measured = processor_seconds(pid), time.monotonic()
        node.create_subscription(Clock, "/clock", self._tick, qos_profile_sensor_data)
        node.create_subscription(DiagnosticArray, "identifier/estimate", self._estimate, LATCHED)

    def _tick(self, message: Clock) -> None:
        self._clock = message.clock.sec + 1e-9 * message.clock.nanosec
        if self._newest and self._clock > WARM_UP:
            self.ages.append(self._clock - self._newest)

    def _estimate(self, message: DiagnosticArray) -> None:
        self._newest = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def measure(self) -> None:
        """Store the processor time of the last second, once it is complete."""
        now = time.monotonic()
        if now - self._measured >= 1.0:
            used = processor_seconds(self._pid)
            if self._clock > WARM_UP:
                self.shares.append((used - self._used) / (now - self._measured))
            self._used, self._measured = used, now


def main() -> None:
    """Run the three nodes and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--solve-period", type=float, default=1.0)
    arguments = parser.parse_args()
    moves = max(1, round(MOVES_PER_MINUTE * arguments.minutes))
    seconds = Simulator(SimulateOptions("smooth", moves=moves)).steps * 1e-3
    print(f"{moves} moves, {seconds:.0f} s, {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
        run(Path(folder), graph, moves, arguments.solve_period)


def run(folder: Path, graph: dict[str, str], moves: int, period: float) -> None:
    """Start the nodes, monitor them until the motion ends and print the results."""
    # Threads do not speed up matrices of this size, but their processor time would count.
    environment = graph | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    os.environ.update(graph)
    model, bag = str(config_file("symbitron.xml")), {"bag": f"{folder}/bag"}
    identify = {"model": model, "prior_percent": 25.0, "solve_period": period}
    with (
        NodeProcess("recorder", bag, environment, folder / "r.log") as recorder,
        NodeProcess("identifier", identify, environment, folder / "i.log") as identifier,
    ):
        play = {"moves": moves, "wait_for_subscribers": True, "subscribers": 2}
        with NodeProcess("mujoco_bridge", play, environment, folder / "b.log") as bridge:
            monitor = monitor_until_end(identifier, bridge)
            played = bridge.finish()
        recorded = recorder.finish(stop=True)
        identified = identifier.finish(stop=True)
    report(monitor, played, recorded, identified)


def monitor_until_end(identifier: NodeProcess, bridge: NodeProcess) -> OnlineMonitor:
    """Monitor the identifier until the bridge ends."""
    rclpy.init()
    node = Node("bench")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    monitor = OnlineMonitor(node, identifier.pid)
    while bridge.running:
        executor.spin_once(timeout_sec=0.05)
        monitor.measure()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return monitor


def report(
    monitor: OnlineMonitor,
    played: dict[str, Any],
    recorded: dict[str, Any],
    identified: dict[str, Any],
) -> None:
    """Print the results."""
    late = 100 * played["late_steps"] / played["steps"]
    print(f"bridge: real-time factor {played['real_time_factor']:.3f}, {late:.1f} % of steps late")
    print(f"{'topic':<22} {'published':>10} {'recorded':>10} {'identified':>10} {'missing':>8}")
    for topic, received in identified["received"].items():
        kept, missing = recorded["recorded"][topic], identified["missing"][topic]
        published = played["published"][topic]
        print(f"{topic:<22} {published:>10} {kept:>10} {received:>10} {missing:>8}")
    for name, values, unit in (
        ("identifier's share of a core", 100 * np.array(monitor.shares), "%"),
        ("age of the estimate", np.array(monitor.ages), "s"),
    ):
        middle, high, top = np.percentile(values, [50, 95, 100])
        print(
            f"{name}: median {middle:.3g} {unit}, p95 {high:.3g} {unit}, maximum {top:.3g} {unit}"
        )
    print(f"{identified['solves']} estimates")


if __name__ == "__main__":
    main()
