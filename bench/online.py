"""Bridge, recorder and online identifier together: lost messages, processor time and latency.

The three run as processes in a private domain, the robot at 1 kHz in real time. Printed are

- messages published, recorded and used for identification, which include those before a tare;
- the identifier's processor time in each second, as a share of one core;
- the age of the estimate: the time between its newest data and the robot's clock.

    .venv/bin/python bench/online.py [--minutes 5] [--solve-period 1.0]

With ``--sensor-errors`` the sensors have typical systematic errors, other ones for each seed. The
robot hangs for a tare first and is weighed, and the identifier estimates the errors as well. The
error of the centre of mass along the motion is that of the first estimate from 60 s of data.

    .venv/bin/python bench/online.py --sensor-errors 500 501 502 --minutes 1
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
from std_srvs.srv import Trigger

from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator

MODEL = config_file("symbitron.xml")
WARM_UP = 5.0  # s
MOVES_PER_MINUTE = 30
LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
JUDGED = 60.0  # s of data in the estimate that is compared with the truth
WEIGHED = {"total_mass": 41.05, "total_mass_std": 0.02}
STEP = 20  # of the samples of the true motion


class OnlineMonitor:
    """Measures the age of the estimates and the identifier's processor time."""

    def __init__(self, node: Node, pid: int) -> None:
        self._pid = pid
        self._clock = self._newest = 0.0
        self.ages: list[float] = []
        self.judged: dict[str, float] = {}
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
        if self._newest >= JUDGED and not self.judged:
            self.judged = {
                f"{status.name}/{entry.key}": float(entry.value)
                for status in message.status
                for entry in status.values
                if "/" not in entry.key
            }

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
    parser.add_argument("--sensor-errors", type=int, nargs="*", metavar="SEED", default=())
    arguments = parser.parse_args()
    moves = max(1, round(MOVES_PER_MINUTE * arguments.minutes))
    for seed in arguments.sensor_errors or (None,):
        motion: dict[str, Any] = {"moves": moves}
        if seed is not None:
            motion |= {"motion_seed": seed, "errors": "typical", "error_seed": seed}
            motion["noise_seed"] = seed
        seconds = Simulator(SimulateOptions("smooth", **motion)).steps * 1e-3
        named = "" if seed is None else f", sensor errors of seed {seed}"
        print(f"{moves} moves, {seconds:.0f} s, {os.cpu_count()} cores{named}", flush=True)
        with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
            run(Path(folder), graph, motion, arguments.solve_period)


def run(folder: Path, graph: dict[str, str], motion: dict[str, Any], period: float) -> None:
    """Start the nodes, monitor them until the motion ends and print the results."""
    # Threads do not speed up matrices of this size, but their processor time would count.
    environment = graph | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    os.environ.update(graph)
    bag = {"bag": f"{folder}/bag"}
    identify: dict[str, Any] = {"model": str(MODEL), "solve_period": period}
    has_errors = "errors" in motion
    if has_errors:
        prior = draw_prior(ParameterSet(load_model(MODEL)), "percent", 25.0, motion["error_seed"])
        write_prior(folder / "prior.json", prior)
        identify |= WEIGHED | {"prior": f"{folder}/prior.json", "sensor_errors": ["typical"]}
        # Without the wrench of the hook, which only the tare has.
        identify["wrench_topic"] = ["/left_foot/wrench", "/right_foot/wrench"]
    else:
        identify["prior_percent"] = 25.0
    rclpy.init()
    node = Node("bench")
    with NodeProcess("identifier", identify, environment, folder / "i.log") as identifier:
        if has_errors:
            hang = motion | {"scenario": "tare", "noise_seed": motion["noise_seed"] + 1}
            take_tare(node, hang, environment, folder / "t.log")
        with NodeProcess("recorder", bag, environment, folder / "r.log") as recorder:
            play = motion | {"wait_for_subscribers": True, "subscribers": 2}
            with NodeProcess("mujoco_bridge", play, environment, folder / "b.log") as bridge:
                monitor = monitor_until_end(node, identifier, bridge)
                played = bridge.finish()
            recorded = recorder.finish(stop=True)
        identified = identifier.finish(stop=True)
    node.destroy_node()
    rclpy.try_shutdown()
    report(monitor, played, recorded, identified)
    if has_errors:
        print(f"centre of mass after {JUDGED:g} s: wrong by {com_error(monitor, folder):.2f} mm")


def take_tare(node: Node, hang: dict[str, Any], environment: dict[str, str], log: Path) -> None:
    """Let the robot hang, tell the identifier that its feet are unloaded, and discard the data."""
    with NodeProcess("mujoco_bridge", hang, environment, log) as bridge:
        print("tare:", call(node, "identifier/tare", bridge))
        bridge.finish()
    print("then:", call(node, "identifier/reset"))


def call(node: Node, service: str, bridge: NodeProcess | None = None) -> str:
    """Call a service until it succeeds, and return its answer."""
    client = node.create_client(Trigger, service)
    while True:
        if client.wait_for_service(0.5):
            answer = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(node, answer)
            if answer.result().success:
                return str(answer.result().message)
        if bridge is not None and not bridge.running:
            raise SystemExit(f"{service}: {answer.result().message}")


def monitor_until_end(node: Node, identifier: NodeProcess, bridge: NodeProcess) -> OnlineMonitor:
    """Monitor the identifier until the bridge ends."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    monitor = OnlineMonitor(node, identifier.pid)
    while bridge.running:
        executor.spin_once(timeout_sec=0.05)
        monitor.measure()
    executor.shutdown()
    return monitor


def com_error(monitor: OnlineMonitor, folder: Path) -> float:
    """Return the RMS error of the centre of mass along the recorded motion, mm."""
    model = load_model(MODEL)
    parameters = ParameterSet(model)
    value = np.array([monitor.judged[name] for name in parameters.names])
    motion = read_true_motion([folder / "bag"], model)[::STEP]
    found = evaluate(parameters, {"it": value}, parameters.values, motion)["it"]
    return found.com_position_rmse_mm


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
    mean = 100 * float(np.mean(monitor.shares))
    print(f"{identified['solves']} estimates, mean share of a core {mean:.3g} %")


if __name__ == "__main__":
    main()
