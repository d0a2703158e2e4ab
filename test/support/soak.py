"""All nodes at once among foreign traffic, for a while; then Ctrl-C.

    .venv/bin/python test/support/soak.py --duration 300

What the identifier has learnt must be what the same robot tells in a simulation without a graph,
and every node must end in time, with its files whole, while the traffic goes on.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from graph_probes import StatusProbe, call
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from symbid_ros.cli.processes import unused_domain
from symbid_ros.estimation.archive import load_archive
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.standing_controller import StandingController

BIN = Path(sys.executable).parent
SUPPORT = Path(__file__).parent
DEADLINE = 300.0  # s; only a hang takes longer
LAUNCH_PATIENCE = 4.0  # s; longest time to stop after Ctrl-C
FILES = {"estimate.json", "information.npz", "model.urdf", "model.xml"}
SENSORS = ("joint_states", "imu/data", "left_foot/wrench", "right_foot/wrench")
MOTION = {"scenario": "smooth", "moves": 500, "motion_seed": 3}
MODEL = config_file("symbitron.xml")


class Observer:
    """A node that calls the services of the others."""

    def __init__(self, domain: int, processes: "Processes") -> None:
        self._context, self._processes = Context(), processes
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("observer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def wait_until(self, condition: Callable[[], object], seconds: float = DEADLINE) -> None:
        """Spin until a condition holds; every node must keep running."""
        deadline = time.monotonic() + seconds
        while not condition():
            self._processes.require_running()
            assert time.monotonic() < deadline, "the condition did not come about"
            self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """Destroy the node."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


class Processes:
    """The nodes, each with its own log."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, environment
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, command: Sequence[object]) -> None:
        """Start a process."""
        with (
            (self._folder / f"{name}.out").open("wb") as out,
            (self._folder / f"{name}.err").open("wb") as err,
        ):
            self._running[name] = subprocess.Popen(
                [str(word) for word in command],
                env=self._environment,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )

    def node(self, name: str, **parameters: object) -> None:
        """Start one of the nodes."""
        words = ["--ros-args"]
        for key, value in parameters.items():
            words += ["-p", f"{key}:={json.dumps(value, default=str)}"]
        self.start(name, [BIN / name, *words])

    def require_running(self) -> None:
        """Fail with the output of a node that has ended."""
        for name, process in self._running.items():
            assert process.poll() is None, f"{name} ended: {self.said(name)[-3000:]}"

    def said(self, name: str) -> str:
        """Return what a process has written to stderr."""
        return (self._folder / f"{name}.err").read_text(errors="replace")

    def told(self, name: str) -> dict[str, Any]:
        """Return the summary that an ended node has printed."""
        lines = (self._folder / f"{name}.out").read_text().splitlines()
        summary: dict[str, Any] = json.loads(lines[-1])
        return summary

    def interrupt(self, names: Sequence[str]) -> dict[str, tuple[float, int]]:
        """Send SIGINT to all at once, as launch does; return seconds and status of each."""
        begun, ended = time.monotonic(), {}
        for name in names:
            self._running[name].send_signal(signal.SIGINT)
        while len(ended) < len(names):
            for name in names:
                status = self._running[name].poll()
                if status is not None and name not in ended:
                    ended[name] = time.monotonic() - begun, status
            assert time.monotonic() - begun < DEADLINE, f"{set(names) - set(ended)} do not end"
            time.sleep(0.005)
        for name in names:
            del self._running[name]
        return ended

    def close(self) -> None:
        """Kill the remaining processes."""
        for process in self._running.values():
            process.kill()
            process.wait()


class ClosedLoop(Simulator):
    """The robot and its controller without topics between them."""

    def __init__(self, steps: int) -> None:
        super().__init__(SimulateOptions(**MOTION), is_commanded=True)
        self.steps = steps
        self._brain = StandingController(**MOTION)
        self._before: Instant | None = None

    def step(self, torques: None = None) -> Instant:
        """Answer the previous instant and take a step."""
        before = self._before
        self._before = super().step(None if before is None else self._brain.torques(before))
        return self._before


@dataclass(frozen=True)
class Soak:
    """Results of a soak test.

    Attributes
    ----------
    steps : int
        Simulated instants until the result was saved.
    endings : dict of str to (float, int)
        Time from Ctrl-C to the end of each node, s, and its exit status.
    dropped : dict of str to int
        Messages that the identifier dropped, by topic.
    largest_difference : float
        Largest difference from the result of an undisturbed run, in standard deviations.
    """

    steps: int
    endings: dict[str, tuple[float, int]]
    dropped: dict[str, int]
    largest_difference: float

    def __str__(self) -> str:
        """Return one line for each result."""
        ends = ", ".join(f"{name} {seconds:.2f} s" for name, (seconds, _) in self.endings.items())
        return "\n".join(
            [
                f"{self.steps} instants",
                f"dropped: {self.dropped}",
                f"largest difference: {self.largest_difference:.1e} standard deviations",
                f"ended after: {ends}",
            ]
        )


NODES = ("identifier", "recorder", "monitor", "balance_controller", "mujoco_bridge")


def soak(duration: float, folder: Path) -> Soak:
    """Run all nodes among foreign traffic for ``duration`` simulated seconds."""
    with unused_domain() as domain:
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "log"),
            "PYTHONPATH": str(SUPPORT),
        }
        processes = Processes(folder, environment)
        observer = Observer(domain, processes)
        try:
            return _soaked(duration, folder, processes, observer)
        finally:
            processes.close()
            observer.close()


def _soaked(duration: float, folder: Path, processes: Processes, observer: Observer) -> Soak:
    health = StatusProbe(observer)
    processes.start("stranger", [sys.executable, SUPPORT / "foreign_traffic.py", *NODES])
    observer.wait_until(lambda: "stranger" in observer.node.get_node_names())
    out, bag = folder / "out", folder / "bag"
    processes.node("identifier", model=MODEL, prior_percent=25.0, out=out, use_sim_time=True)
    processes.node("recorder", bag=bag, topics=SENSORS, use_sim_time=True)
    processes.node("monitor", use_sim_time=True)
    processes.node("balance_controller", **MOTION, use_sim_time=True)
    processes.node(
        "mujoco_bridge",
        **MOTION,
        command_source="topic",
        command_timeout=60.0,
        wait_for_subscribers=True,
        subscribers=2,  # recorder and identifier
    )
    simulation, streams = "/mujoco_bridge: simulation", "/identifier: streams"
    # Simulated time: a busy machine is slower than the robot.
    observer.wait_until(
        lambda: health.count(simulation, "steps") > 1000 * duration, 10 * duration + DEADLINE
    )

    assert call(observer, SetBool, "/mujoco_bridge/pause", data=True).success
    observer.wait_until(lambda: health.message(simulation) == "paused")
    steps = health.count(simulation, "steps")
    received = "/joint_states/received"
    observer.wait_until(lambda: health.count(streams, received) == steps)
    dropped = {name: health.count(streams, f"/{name}/dropped") for name in SENSORS}
    saved = call(observer, Trigger, "/identifier/save")
    assert saved.success, saved.message
    shutil.copytree(out, folder / "saved")
    assert call(observer, SetBool, "/mujoco_bridge/pause", data=False).success
    observer.wait_until(lambda: health.count(simulation, "steps") > steps)

    endings = processes.interrupt(NODES)
    processes.interrupt(["stranger"])
    for name, (_, status) in endings.items():
        assert status == 0, f"{name}: status {status}: {processes.said(name)[-3000:]}"
        assert "Traceback" not in processes.said(name), processes.said(name)
    assert {path.name for path in out.iterdir()} == FILES
    load_archive(out / "information.npz")
    commands = processes.told("mujoco_bridge")["commands"]
    assert (commands["starts"], commands["falls"], commands["timeouts"]) == (1, 0, 0)
    assert commands["rejected/malformed"] > 0
    assert processes.told("balance_controller")["unusable"] > 0
    assert all(dropped.values())
    return Soak(steps, endings, dropped, _difference(folder / "saved", steps, folder))


def _difference(saved: Path, steps: int, folder: Path) -> float:
    """Return the largest difference from the result of the same motion without a graph."""
    record(ClosedLoop(steps), folder / "undisturbed")
    expected = folder / "expected"
    command = [
        *(BIN / "symbid", "identify", folder / "undisturbed", "--model", MODEL),
        *("--prior-percent", "25", "--no-holdout", "--out", expected),
    ]
    ended = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, timeout=DEADLINE
    )
    assert ended.returncode in (0, 1), ended.stderr  # 1: alarms, as of a short log
    pairs = zip(*(load_archive(one / "information.npz") for one in (saved, expected)), strict=True)
    for one, other in pairs:
        assert (one.window, one.rows.samples) == (other.window, other.rows.samples)
    found, wanted = (
        json.loads((one / "estimate.json").read_text())["parameters"] for one in (saved, expected)
    )
    # Joint terms that the data did not ask for are fixed: their deviation is zero.
    for name, entry in wanted.items():
        assert found[name]["std"] > 0 or found[name] == entry, (name, found[name], entry)
    scaled = [
        abs(found[name]["value"] - entry["value"]) / entry["std"]
        for name, entry in wanted.items()
        if entry["std"] > 0
    ]
    return float(np.max(scaled))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=300.0, help="simulated seconds")
    duration = parser.parse_args().duration
    with tempfile.TemporaryDirectory() as folder:
        found = soak(duration, Path(folder))
    print(found)
    late = [name for name, (seconds, _) in found.endings.items() if seconds > LAUNCH_PATIENCE]
    if late:
        print(f"not ended within {LAUNCH_PATIENCE:g} s: {', '.join(late)}")
    if found.largest_difference > 1e-6:
        print("the result is not that of the undisturbed run")
    return int(bool(late) or found.largest_difference > 1e-6)


if __name__ == "__main__":
    sys.exit(main())
