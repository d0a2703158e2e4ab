"""The balance controller takes identified models from topics, and only those it can trust."""

import itertools
import json
import signal
from dataclasses import replace

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph_probes import RELIABLE, StatusProbe

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.ros.endpoints import latched_qos
from symbid_ros.ros.estimate_topics import estimate_message
from symbid_ros.ros.model_source import ModelSource
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.standing_controller import StandingController

MODEL = "/balance_controller: model"


class Identifier:
    """Publishes estimates and statuses as the identifier does."""

    def __init__(self, graph) -> None:
        self._parameters = ParameterSet(load_model(config_file("symbitron.xml")))
        self._stamp = 0
        self._estimate = graph.node.create_publisher(
            DiagnosticArray, "/identifier/estimate", latched_qos()
        )
        self._diagnostics = graph.node.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        publishers = self._estimate, self._diagnostics
        graph.wait_until(lambda: all(each.get_subscription_count() for each in publishers))

    def publish_nothing(self) -> None:
        """Publish an estimate without links, which another program may do under the same name."""
        self._estimate.publish(DiagnosticArray())
        self._publish_status()

    def publish(self, factor: float, std: float, alarm: str = "", impossible: str = "") -> None:
        """Publish an estimate of the true robot times a factor, and then the status."""
        parameters = self._parameters
        value = factor * parameters.values
        if impossible:
            value[parameters.names.index(f"{impossible}/Ixx")] = -1.0
        count = len(parameters)
        estimate = Estimate(
            method="map_lmi",
            model="symbitron",
            names=tuple(parameters.names),
            units=("",) * count,
            value=value,
            prior=parameters.values,
            std=np.full(count, std),
            determined=np.ones(count, dtype=bool),
            rank=None,
            condition=1.0,
            samples=10,
            residual_rmse={},
            consistent={link: link != impossible for link in parameters.link_names},
            inputs=(),
            software="",
        )
        self._stamp += 1
        self._estimate.publish(estimate_message(estimate, Time(sec=self._stamp)))
        self._publish_status(alarm)

    def _publish_status(self, alarm: str = "") -> None:
        level = DiagnosticStatus.WARN if alarm else DiagnosticStatus.OK
        status = DiagnosticStatus(name="/identifier: estimate", level=level, message=alarm)
        self._diagnostics.publish(DiagnosticArray(status=[status]))


class Watched:
    """A controller in this process, whose time goes on when asked, and the source of its models."""

    def __init__(self, graph) -> None:
        self._graph = graph
        self.controller = StandingController()
        self._instants = iter(Simulator(SimulateOptions()))
        self.go_on(20)
        self.source = ModelSource(graph.node, self.controller, 0.1)

    def go_on(self, steps: int) -> None:
        for instant in itertools.islice(self._instants, steps):
            self.controller.torques(instant)

    def expect(self, message: str, **counts: int) -> None:
        """Wait for a status."""

        def has_come() -> bool:
            self.source.update()
            status = self.source.status()
            return message in status.message and all(
                status.values[name] == count for name, count in counts.items()
            )

        self._graph.wait_until(has_come)


def test_models_are_accepted_refused_and_withdrawn(graph) -> None:
    watched = Watched(graph)
    identifier = Identifier(graph)
    assert watched.source.status().message == "model of the file"
    identifier.publish(0.9, 0.1, alarm="residuals are not white noise")
    watched.expect("the newest is not used: alarm: residuals", refused=1)
    identifier.publish(0.9, 0.1, impossible="R_thigh")
    watched.expect("physically impossible: R_thigh", refused=2)
    identifier.publish(3.0, 0.1)
    watched.expect("more than 10 % of its", refused=3, accepted=0)
    assert not watched.controller.is_changing
    identifier.publish(0.9, 0.1)
    watched.expect("identified until 4.000 s", accepted=1)
    assert watched.controller.is_changing
    # An alarm while it takes over.
    identifier.publish(0.9, 0.05, alarm="R_thigh has changed")
    watched.expect("model of the file", withdrawn=1)
    # After an alarm the next model may be known worse.
    watched.go_on(1100)
    assert not watched.controller.is_changing
    identifier.publish(0.9, 0.2)
    watched.expect("identified until 6.000 s", accepted=2, withdrawn=1)


def test_estimates_without_links_are_ignored(graph) -> None:
    watched, statuses = Watched(graph), StatusProbe(graph)
    identifier = Identifier(graph)
    identifier.publish_nothing()
    graph.wait_until(lambda: statuses.received)
    watched.source.update()
    identifier.publish(0.9, 0.1)
    watched.expect("identified until 1.000 s", accepted=1, refused=0)


def test_only_known_links_are_taken(graph) -> None:
    watched = Watched(graph)
    identifier = Identifier(graph)
    parameters = identifier._parameters
    other = replace(parameters.model.links[0], name="tail")
    model = replace(parameters.model, links=(other, *parameters.model.links[1:]))
    identifier._parameters = ParameterSet(model)
    identifier.publish(1.0, 0.1)
    watched.expect("no body tail", refused=1)


def test_a_standing_robot_uses_the_model_if_asked(graph) -> None:
    statuses = StatusProbe(graph)
    bridge = graph.start("mujoco_bridge", command_source="topic", command_timeout=60.0)
    controller = graph.start("balance_controller", model_source="identifier")
    graph.wait_until(lambda: statuses.message("/balance_controller: control").startswith("meas"))
    Identifier(graph).publish(0.9, 0.1)
    graph.wait_until(lambda: statuses.message(MODEL) == "identified until 1.000 s")
    assert statuses.count(MODEL, "accepted") == 1
    answered = statuses.count("/balance_controller: control", "answered")
    graph.wait_until(
        lambda: statuses.count("/balance_controller: control", "answered") > answered + 1500
    )
    for process in (controller, bridge):
        process.send(signal.SIGINT)
    assert (controller.ended().status, (end := bridge.ended()).status) == (0, 0)
    assert json.loads(end.out)["commands"]["falls"] == 0
