"""The node web_monitor: what an identifier currently knows, as a page in the browser."""

import math
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path
from threading import Event, Lock
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import Trigger

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.prior_file import load_prior
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.formatting import with_std
from symbid_ros.report.inertia_shapes import total_com
from symbid_ros.report.live_page import live_page
from symbid_ros.report.palette import CHANGED_COLOUR
from symbid_ros.report.robot_scene import (
    SHOWN_DEVIATIONS,
    base_poses,
    link_document,
    robot_scene,
    rounded,
    scene_link,
)
from symbid_ros.ros.endpoints import latched_qos, reliable_qos
from symbid_ros.ros.identifier_parameters import model_of
from symbid_ros.ros.live_posture import POSTURE_PARAMETERS, LivePosture
from symbid_ros.ros.monitor_messages import (
    AS_FLAGS,
    PublishedLink,
    RobotEstimate,
    StreamCounts,
    read_estimate,
    read_status,
)
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import construct, run_node
from symbid_ros.ros.web_server import LOOPBACK, Answer, WebServer

POLL = 0.2  # s; the picture follows the robot five times a second
STATUS_PERIOD = 5  # polls between two statuses
HISTORY = 600  # estimates that a page shows when it is opened
PATIENCE = 60.0  # s for the identifier's answer to a button
ACTIONS = "solve", "save", "reset"
PARAMETERS = (
    Parameter("identifier", "identifier", "Name of the node to watch."),
    Parameter("model", "", "Robot model of the identifier, URDF or MJCF."),
    Parameter(
        "base",
        "auto",
        "Base of a URDF; auto: floating, unless the root link is named 'world'.",
        choices=("auto", "floating", "fixed"),
    ),
    Parameter("prior", "", "The identifier's prior.json; empty: the values of the model."),
    *POSTURE_PARAMETERS,
    Parameter(
        "host",
        LOOPBACK,
        "Address to listen on. With any other than 127.0.0.1, other machines can open the page.",
    ),
    Parameter("port", 8377, "Port of the page; 0: any that is free.", minimum=0, maximum=65535),
    AS_FLAGS,
)


class WebMonitor:
    """Subscribes to one identifier and shows it in browsers."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._identifier: str = node.resolve_topic_name(values["identifier"])
        self._as_flags: bool = values["as_flags"]
        model = load_model(*model_of(values))
        self._parameters = ParameterSet(model)
        given = values["prior"]
        self._prior = (
            load_prior(Path(given), self._parameters).mean if given else self._parameters.values
        )
        self._scene = robot_scene(self._parameters, _without_data(self._parameters, self._prior))
        self._posture = LivePosture(node, model, values)
        self._lock = Lock()
        self._estimate: RobotEstimate | None = None
        self._history: deque[dict[str, Any]] = deque(maxlen=HISTORY)
        self._statuses: dict[str, DiagnosticStatus] = {}
        self._changed = Event()
        node.create_subscription(
            DiagnosticArray, f"{self._identifier}/estimate", self._on_estimate, latched_qos()
        )
        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, reliable_qos(100)
        )
        self._clients = {
            name: node.create_client(Trigger, f"{self._identifier}/{name}") for name in ACTIONS
        }
        self._server = WebServer(
            values["host"],
            values["port"],
            lambda nonce: live_page(self._scene, nonce),
            self._greeting,
            {name: lambda name=name: self._call(name) for name in ACTIONS},  # type: ignore[misc]
        )
        # Only to the terminal: a log on /rosout would show the token to the whole graph.
        print(self._server.address, flush=True)

    def run(self, stop: Event) -> None:
        """Send news to the browsers until stopped."""
        polls = 0
        try:
            while not stop.wait(POLL):
                has_moved = self._posture.read()
                is_new = self._changed.is_set()
                self._changed.clear()
                if self._server.listeners and (has_moved or is_new):
                    self._server.publish("scene", self._scene_document())
                polls += 1
                if is_new or polls % STATUS_PERIOD == 0:
                    self._server.publish("status", self._status_document())
        finally:
            self._server.close()

    def _greeting(self) -> dict[str, object]:
        with self._lock:
            history = list(self._history)
        return {
            "history": history,
            "scene": self._scene_document(),
            "status": self._status_document(),
        }

    def _call(self, name: str) -> Answer:
        """Call a service of the identifier and return its answer."""
        client: Client = self._clients[name]
        if not client.service_is_ready():
            return False, f"{client.srv_name} is not available; start the identifier"
        answered = Event()
        future = client.call_async(Trigger.Request())
        future.add_done_callback(lambda _: answered.set())
        if not answered.wait(PATIENCE):
            client.remove_pending_request(future)
            return False, f"{client.srv_name} has not answered for {PATIENCE:.0f} s"
        answer = future.result()
        if answer.success and name == "reset":
            with self._lock:
                self._history.clear()
                self._estimate = None
            self._server.publish("reset", {})
            self._changed.set()
        return bool(answer.success), str(answer.message)

    def _on_estimate(self, message: DiagnosticArray) -> None:
        estimate = read_estimate(message)
        document = self._estimate_document(estimate)
        with self._lock:
            self._estimate = estimate
            self._history.append(document)
        self._server.publish("estimate", document)
        self._changed.set()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        prefix = f"{self._identifier}: "
        own = {
            status.name.removeprefix(prefix): status
            for status in message.status
            if status.name.startswith(prefix)
        }
        with self._lock:
            self._statuses |= own

    def _changed_links(self) -> set[str]:
        """Return the links that the identifier says have changed."""
        with self._lock:
            status = self._statuses.get("change")
        if status is None:
            return set()
        values = {entry.key: entry.value for entry in status.values}
        names = [values.get("link", ""), *values.get("link/alternatives", "").split(", ")]
        return set(filter(None, names))

    def _estimate_document(self, estimate: RobotEstimate) -> dict[str, Any]:
        """Return the masses of an estimate."""
        changed = self._changed_links()
        prior = dict(
            zip(
                self._parameters.link_names,
                self._parameters.link_phi(self._prior)[:, 0].tolist(),
                strict=True,
            )
        )
        return {
            "time": estimate.stamp * 1e-9,
            "links": [
                {
                    "name": link.name,
                    "mass": [_finite(link.phi[0]), _finite(link.std[0])],
                    "text": f"{with_std(_finite(link.phi[0]), _finite(link.std[0]))} kg",
                    "before_mass": prior[link.name],
                    "changed": link.name in changed,
                }
                for link in estimate.links
                if link.name in prior
            ],
        }

    def _scene_document(self) -> dict[str, Any]:
        """Return the links with their poses and newest inertias."""
        with self._lock:
            estimate = self._estimate
        published = {} if estimate is None else {link.name: link for link in estimate.links}
        rotations, positions = base_poses(self._parameters.model, self._posture.newest)
        changed = self._changed_links()
        prior = self._parameters.link_phi(self._prior)
        phi = prior.copy()
        links = []
        for index, own in enumerate(self._scene.links):
            shown, link = own, published.get(own.name)
            if link is not None and np.all(np.isfinite(link.phi)):
                phi[index] = link.phi
                shown = scene_link(
                    own.name, prior[index], link.phi, _covariance(link), link.determined
                )
            place = int(self._parameters.links[index])
            shown = replace(
                shown, parent=own.parent, rotation=rotations[place], position=positions[place]
            )
            document = link_document(shown)
            if own.name in changed:
                document["colour"] = CHANGED_COLOUR
            links.append(document)
        own_links = self._parameters.links
        poses = rotations[own_links], positions[own_links]
        return {
            "deviations": SHOWN_DEVIATIONS,
            "links": links,
            "com": {
                "before": rounded(total_com(prior, *poses)),
                "after": rounded(total_com(phi, *poses)),
            },
        }

    def _status_document(self) -> dict[str, Any]:
        with self._lock:
            statuses, estimate = dict(self._statuses), self._estimate
        status = read_status(statuses, as_flags=self._as_flags)
        parts = ["waiting for an estimate"]
        if estimate is not None:
            known = estimate.determined
            count = f"{known} of {estimate.parameters} single parameters determined"
            parts = [] if known is None else [count]
            for key, text in (("age", "{:.1f} s old"), ("samples", "{:.0f} rows")):
                if math.isfinite(number := status.number(key)):
                    parts.append(text.format(number))
        return {
            "state": ", ".join(parts),
            "alarms": list(status.warnings),
            "followed": status.followed,
            "streams": [_stream(stream) for stream in status.streams],
        }


def _without_data(parameters: ParameterSet, values: FloatArray) -> Estimate:
    """Return the prior as an estimate, for the page before the first one."""
    count = parameters.inertial
    return Estimate(
        method="",
        model=parameters.model.name,
        names=parameters.names[:count],
        units=parameters.units[:count],
        value=values[:count],
        prior=values[:count],
        std=None,
        determined=np.zeros(count, dtype=bool),
        rank=None,
        condition=0.0,
        samples=0,
        residual_rmse={},
        consistent={},
        inputs=(),
        software="",
    )


def _covariance(link: PublishedLink) -> FloatArray | None:
    """Return the covariance (10, 10) without correlations, which messages lack."""
    return np.diag(link.std**2) if np.all(np.isfinite(link.std)) else None


def _finite(number: float) -> float:
    return float(number) if math.isfinite(number) else 0.0


def _stream(stream: StreamCounts) -> str:
    rate = f" {stream.rate:.0f} Hz" if math.isfinite(stream.rate) else ""
    return ", ".join([f"{stream.topic}{rate}", *stream.counted_faults])


def main() -> int:
    """Run the node ``web_monitor`` and return its exit status."""
    return run_node(
        "web_monitor",
        lambda node, values, stop: construct(WebMonitor, node, values, stop).run(stop),
        purpose="Show an identifier's current estimate, and the robot in 3D, in the browser.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
