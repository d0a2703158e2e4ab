"""The identifier: a bag in, an estimate on latched topics out."""

import sys
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from threadpoolctl import threadpool_limits

from symbid_ros.bags.selection import TopicSelection
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.parameters import joint_terms
from symbid_ros.offline.export import export_urdf, write_identification
from symbid_ros.offline.facts import Facts, PriorChoice
from symbid_ros.offline.job import Job, prepare
from symbid_ros.offline.problem import METHODS
from symbid_ros.offline.record import processing
from symbid_ros.ros import estimate_messages as messages
from symbid_ros.ros.messages import latched, reliable
from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.ros.process import run_node
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sensor_errors import parse_kinds

CUTOFF = LowPass().cutoff

PARAMETERS = (
    Parameter("bag", [""], "Bags to identify from, in sequence."),
    Parameter("model", "", "Robot model, URDF or MJCF."),
    Parameter(
        "base",
        "auto",
        "Whether a URDF's base may move.",
        choices=("auto", "floating", "fixed"),
    ),
    Parameter("prior", "", "prior.json; empty for the model's own values."),
    Parameter("prior_percent", 0.0, "Trust the model's values to ± this many %; 0: not given."),
    Parameter("prior_absolute", 0.0, "Trust the model's values to ± this, SI units; 0: not given."),
    Parameter(
        "method",
        "map_lmi",
        "Most probable of all possible robots, most probable, or truncated least squares.",
        choices=METHODS,
    ),
    Parameter("total_mass", 0.0, "What the whole robot weighs, kg; 0: unknown.", minimum=0.0),
    Parameter("total_mass_std", 0.05, "Standard deviation of total_mass, kg.", minimum=0.0),
    Parameter(
        "mirror",
        0.0,
        "How far left and right may differ, in standard deviations of the prior; 0: freely.",
        minimum=0.0,
    ),
    Parameter("tare", [""], "Bags recorded with nothing touching the wrench sensors."),
    Parameter("sensor_errors", "", "Sensor errors to identify: typical, or names with commas."),
    Parameter("information", "", "information.npz of an earlier run, to add its data."),
    Parameter(
        "filter",
        "weak",
        "Average the equation over windows, or filter the signals and take single instants.",
        choices=("weak", "butterworth", "savitzky_golay"),
    ),
    Parameter("window", 0.0, "Length of the windows, s; 0: chosen by the data.", minimum=0.0),
    Parameter("cutoff", CUTOFF, "Of the Butterworth filter, Hz; 0: no filter.", minimum=0.0),
    Parameter(
        "channels",
        "all",
        "Butterworth-filter all channels, or the thesis's choice of them.",
        choices=("all", "thesis"),
    ),
    Parameter(
        "rank",
        0,
        "Number of singular values to use; 0: chosen by the data, or on a bag.",
        minimum=0,
    ),
    Parameter("validate", "", "Bag on which to choose the number of singular values."),
    Parameter(
        "select_by",
        "gen_force",
        "Prediction error that chooses it.",
        choices=("gen_force", "torque", "com"),
    ),
    Parameter("friction", False, "Identify viscous and Coulomb friction as well."),
    Parameter(
        "armature", False, "Identify the drives' inertias, as the joints feel them, as well."
    ),
    Parameter("offset", False, "Identify a constant torque of every joint as well."),
    Parameter("joint_topic", "", "JointState topic of the bag; empty for joint_states."),
    Parameter("imu_topics", [""], "Imu topics of the bag; empty for all."),
    Parameter("wrench_topics", [""], "WrenchStamped topics of the bag; empty for all."),
    Parameter("out", "", "Folder for the estimate and the models; empty for none."),
)


def job_from(values: dict[str, Any]) -> Job:
    """Return the job that the node's parameters ask for.

    Raises
    ------
    ParameterError
        When no bag or no model is named.
    """
    bags = _given(values["bag"])
    if not bags or not values["model"]:
        missing = "model" if bags else "bag"
        raise ParameterError(f"parameter {missing}: empty; give -p {missing}:=PATH")
    topics = TopicSelection(
        joints=values["joint_topic"] or None,
        imus=_given(values["imu_topics"]) or None,
        wrenches=_given(values["wrench_topics"]) or None,
    )
    window, mass, mirror = values["window"], values["total_mass"], values["mirror"]
    # A parameter always has a value: its default counts as not given.
    cutoff = None if values["cutoff"] == CUTOFF else values["cutoff"]
    channels = None if values["channels"] == "all" else values["channels"]
    return Job(
        bags=tuple(map(Path, bags)),
        model=Path(values["model"]),
        base=values["base"],
        prior=PriorChoice(
            _path(values["prior"]),
            values["prior_percent"] or None,
            values["prior_absolute"] or None,
        ),
        method=values["method"],
        terms=joint_terms(values["friction"], values["armature"], values["offset"]),
        processing=processing(values["filter"], window or None, cutoff, channels, topics),
        facts=Facts(
            total_mass=(mass, values["total_mass_std"]) if mass else None,
            mirror=mirror or None,
            tare=tuple(map(Path, _given(values["tare"]))),
            sensor_errors=parse_kinds(errors) if (errors := values["sensor_errors"]) else (),
        ),
        information=_path(values["information"]),
        rank=values["rank"] or None,
        validation=_path(values["validate"]),
        criterion=values["select_by"],
    )


class Identifier:
    """Solves a job and keeps its result on the topics until stopped."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        self._job = job_from(values)
        self._out = _path(values["out"])
        # Latched publishers must outlive the call that made them, or their data goes with them.
        self._publishers: list[Any] = []

    def run(self, stop: Event) -> None:
        """Identify, publish, and say once a second that the estimate stands."""
        prepared = prepare(self._job)
        found = prepared.solve(self._job.method)
        estimate = found.estimate
        if self._out is not None:
            write_identification(found, prepared.parameters, self._out)
        base = prepared.parameters.model.links[0].name
        self._publish(estimate, base, export_urdf(estimate, prepared.parameters))
        self._node.get_logger().info(
            f"estimate of {estimate.model} by {estimate.method}: {estimate.samples} rows per "
            "coordinate"
        )
        diagnostics = self._node.create_publisher(DiagnosticArray, "/diagnostics", reliable(10))
        while not stop.is_set():
            now = self._node.get_clock().now().to_msg()
            name = self._node.get_fully_qualified_name()
            diagnostics.publish(messages.health_message(estimate, name, now))
            stop.wait(1.0)

    def _publish(self, estimate: Estimate, base: str, robot: str) -> None:
        now = self._node.get_clock().now().to_msg()
        for link in estimate.consistent:
            token = messages.topic_token(link)
            inertia = messages.inertia_message(estimate, link, now)
            deviation = messages.inertia_stddev_message(estimate, link, now)
            self._latch(InertiaStamped, f"~/inertia/{token}", inertia)
            self._latch(InertiaStamped, f"~/inertia_stddev/{token}", deviation)
        self._latch(DiagnosticArray, "~/estimate", messages.estimate_message(estimate, now))
        residual = messages.effort_residual_message(estimate, now)
        self._latch(JointState, "~/effort_residual", residual)
        wrench = messages.wrench_residual_message(estimate, base, now)
        if wrench is not None:
            self._latch(WrenchStamped, "~/wrench_residual", wrench)
        self._latch(String, "~/robot_description", String(data=robot))

    def _latch(self, kind: type[Any], topic: str, message: Any) -> None:
        publisher = self._node.create_publisher(kind, topic, latched())
        publisher.publish(message)
        self._publishers.append(publisher)


def _given(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names that say something: ROS has no typed empty list, so [""] stands for it."""
    return tuple(name for name in names if name)


def _path(value: str) -> Path | None:
    return Path(value) if value else None


def main(args: Sequence[str] | None = None) -> None:
    """Run the node ``identifier``."""
    threadpool_limits(1)
    sys.exit(
        run_node(
            "identifier",
            lambda node, values, stop: Identifier(node, values).run(stop),
            args,
            purpose="Identify a robot's inertial parameters from bags and publish them, latched.",
            parameters=PARAMETERS,
        )
    )
