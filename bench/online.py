"""Bridge, recorder and online identifier together: what is lost, what it costs, how old it is.

The three run as processes on a private domain, the robot at 1 kHz in real time. Printed are

- messages published, recorded and identified from;
- the identifier's processor time in every second, as a share of one core;
- the age of the estimate: how far its newest data lie behind the robot's clock, at all times.

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
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.simulator import Simulator

WARM_UP = 5.0  # s
MOVES_PER_MINUTE = 30
TICKS = os.sysconf("SC_CLK_TCK")
LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class Watch:
    """Reads the clock and the estimates' stamps, and the identifier's processor time."""

    def __init__(self, node: Node, pid: int) -> None:
        self._pid = pid
        self._clock = self._until = 0.0
        self.ages: list[float] = []
        self.shares: list[float] = []
        self._used, self._looked = self._seconds(), time.monotonic()
        node.create_subscription(Clock, "/clock", self._tick, qos_profile_sensor_data)
        node.create_subscription(DiagnosticArray, "identifier/estimate", self._estimate, LATCHED)

    def _tick(self, message: Clock) -> None:
        self._clock = message.clock.sec + 1e-9 * message.clock.nanosec
        if self._until and self._clock > WARM_UP:
            self.ages.append(self._clock - self._until)

    def _estimate(self, message: DiagnosticArray) -> None:
        self._until = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def look(self) -> None:
        """Take the processor time of the second that has passed, once it has."""
        now = time.monotonic()
        if now - self._looked >= 1.0:
            used = self._seconds()
            if self._clock > WARM_UP:
                self.shares.append((used - self._used) / (now - self._looked))
            self._used, self._looked = used, now

    def _seconds(self) -> float:
        fields = Path(f"/proc/{self._pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / TICKS


def main() -> None:
    """Run the three nodes and print what they did."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--solve-period", type=float, default=1.0)
    asked = parser.parse_args()
    moves = max(1, round(MOVES_PER_MINUTE * asked.minutes))
    seconds = Simulator("smooth", moves=moves).steps * 1e-3
    print(f"{moves} moves, {seconds:.0f} s, {os.cpu_count()} cores")
    with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
        run(Path(folder), graph, moves, asked.solve_period)


def run(folder: Path, graph: dict[str, str], moves: int, period: float) -> None:
    """Start the nodes, watch them to the motion's end and print the figures."""
    # Python matrices of this size gain nothing from threads, which would only be counted.
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
            watch = watched(identifier, bridge)
            played = bridge.finish()
        recorded = recorder.finish(stop=True)
        identified = identifier.finish(stop=True)
    report(watch, played, recorded, identified)


def watched(identifier: NodeProcess, bridge: NodeProcess) -> Watch:
    """Watch the identifier until the bridge has ended."""
    rclpy.init()
    node = Node("bench")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    watch = Watch(node, identifier.pid)
    while bridge.running:
        executor.spin_once(timeout_sec=0.05)
        watch.look()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    return watch


def report(
    watch: Watch, played: dict[str, Any], recorded: dict[str, Any], identified: dict[str, Any]
) -> None:
    """Print the figures."""
    late = 100 * played["late_steps"] / played["steps"]
    print(f"bridge: real-time factor {played['real_time_factor']:.3f}, {late:.1f} % of steps late")
    print(f"{'topic':<22} {'published':>10} {'recorded':>10} {'identified':>10} {'missing':>8}")
    for topic, received in identified["received"].items():
        kept, missing = recorded["recorded"][topic], identified["missing"][topic]
        published = played["published"][topic]
        print(f"{topic:<22} {published:>10} {kept:>10} {received:>10} {missing:>8}")
    for name, values, unit in (
        ("identifier's share of a core", 100 * np.array(watch.shares), "%"),
        ("age of the estimate", np.array(watch.ages), "s"),
    ):
        middle, high, top = np.percentile(values, [50, 95, 100])
        print(f"{name}: median {middle:.3g} {unit}, p95 {high:.3g} {unit}, most {top:.3g} {unit}")
    print(f"{identified['solves']} estimates")


if __name__ == "__main__":
    main()
