"""The monitor: what an identifier knows now, in the terminal."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Lock
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rich.console import Console

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SymbidError
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.ros.messages import latched, reliable
from symbid_ros.ros.monitor_display import Screen, View
from symbid_ros.ros.monitor_messages import (
    LinkEstimate,
    RobotEstimate,
    read_estimate,
    read_health,
)
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import run_node

POLL = 0.1  # s
REFRESH = 1.0  # s; how long the silence has lasted counts on without a message

PARAMETERS = (
    Parameter("identifier", "identifier", "Name of the node to watch."),
    Parameter("truth", "", "True model, URDF or MJCF, to show the errors; empty for none."),
    Parameter("estimates", 0, "End after so many estimates; 0: when stopped.", minimum=0),
    Parameter(
        "timeout", 0.0, "Fail after so many seconds without an estimate; 0: never.", minimum=0.0
    ),
)


class Monitor:
    """Listens to one identifier and shows what it says."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._identifier: str = node.resolve_topic_name(values["identifier"])
        self._truth = _truth(values["truth"])
        self._wanted: int = values["estimates"]
        self._timeout: float = values["timeout"]
        self._lock = Lock()
        self._changed = Event()
        self._estimate: RobotEstimate | None = None
        self._first: dict[str, LinkEstimate] = {}
        self._count = 0
        self._statuses: dict[str, DiagnosticStatus] = {}
        self._estimated = self._heard = time.monotonic()
        node.create_subscription(
            DiagnosticArray, f"{self._identifier}/estimate", self._take_estimate, latched()
        )
        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take_diagnostics, reliable(100)
        )

    def run(self, stop: Event) -> None:
        """Show until stopped or until all estimates that were wanted have come."""
        shown = 0.0
        with Screen(Console(highlight=False)) as screen:
            while not stop.wait(POLL) and not self._is_done():
                now = time.monotonic()
                if self._changed.is_set() or now - shown >= REFRESH:
                    self._changed.clear()
                    screen.show(self._view(now))
                    shown = now
            screen.show(self._view(time.monotonic()))

    def _is_done(self) -> bool:
        with self._lock:
            silence = time.monotonic() - self._estimated
            if self._timeout and silence > self._timeout:
                raise SymbidError(
                    f"{self._identifier}/estimate: nothing for {silence:.0f} s; check that the "
                    "node runs, its name and ROS_DOMAIN_ID"
                )
            return 0 < self._wanted <= self._count

    def _view(self, now: float) -> View:
        with self._lock:
            return View(
                identifier=self._identifier,
                estimate=self._estimate,
                first=dict(self._first),
                health=read_health(self._statuses),
                silence=now - self._heard,
                truth=self._truth,
            )

    def _take_estimate(self, message: DiagnosticArray) -> None:
        estimate = read_estimate(message)
        with self._lock:
            self._estimate = estimate
            self._estimated = time.monotonic()
            self._count += 1
            for link in estimate.links:
                self._first.setdefault(link.name, link)
        self._changed.set()

    def _take_diagnostics(self, message: DiagnosticArray) -> None:
        prefix = f"{self._identifier}: "
        own = {
            status.name.removeprefix(prefix): status
            for status in message.status
            if status.name.startswith(prefix)
        }
        if own:
            with self._lock:
                self._statuses |= own
                self._heard = time.monotonic()
            self._changed.set()


def _truth(path: str) -> dict[str, FloatArray]:
    if not path:
        return {}
    parameters = ParameterSet(load_model(Path(path)))
    phi = parameters.values.reshape(-1, 10)
    return dict(zip(parameters.link_names, phi, strict=True))


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``monitor``."""
    sys.exit(
        run_node(
            "monitor",
            lambda node, values, stop: Monitor(node, values).run(stop),
            args,
            purpose="Show in the terminal what an identifier knows now.",
            parameters=PARAMETERS,
        )
    )
