"""The node identifier: from topics or bags to an estimate on latched topics."""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String
from threadpoolctl import threadpool_limits

from symbid_ros.atomic_write import require_no_files
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.provenance import command_line
from symbid_ros.identification.pipeline import identify_problem
from symbid_ros.identification.result_files import (
    CALIBRATED,
    RESULT_FILES,
    export_urdf,
    write_identification,
)
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.ros.endpoints import latched_qos
from symbid_ros.ros.estimate_topics import EstimateTopics, estimate_status
from symbid_ros.ros.identifier_parameters import (
    PARAMETERS,
    given_path,
    given_texts,
    identify_options,
    is_online,
    log_options,
    model_of,
)
from symbid_ros.ros.online_identifier import OnlineIdentifier
from symbid_ros.ros.process import construct, run_node
from symbid_ros.ros.reporting import FaultReporter, StatusPublisher
from symbid_ros.shutdown import interruptible

TOPIC = "robot_description"
POLL = 0.1  # s


@contextmanager
def model_file(node: Node, values: dict[str, Any], stop: Event) -> Iterator[dict[str, Any] | None]:
    """Yield parameter values whose ``model`` names a file.

    Without a model, a temporary file gets the text of the parameter ``robot_description``, or of
    the first valid message on the topic of that name. The file exists as long as the context,
    because exported models are edited copies of it. If ``stop`` ends the wait for a message, the
    context yields None.
    """
    if values["model"]:
        yield values
        return
    with tempfile.TemporaryDirectory(prefix="symbid_") as folder:
        file = Path(folder) / f"{TOPIC}.urdf"
        complete: dict[str, Any] | None = values | {"model": str(file)}
        if values[TOPIC]:
            file.write_text(values[TOPIC])
        elif not _receive_model(node, file, values["base"], stop):
            complete = None
        yield complete


def _receive_model(node: Node, file: Path, base: Any, stop: Event) -> bool:
    """Write the first valid message to a file; return False if stopped before."""
    texts: SimpleQueue[str] = SimpleQueue()
    subscription = node.create_subscription(
        String, TOPIC, lambda message: texts.put(message.data), latched_qos()
    )
    topic = subscription.topic_name
    reporter = FaultReporter(node)
    fault = (
        f"waiting for the robot's model on topic {topic} (std_msgs/msg/String, latched); start "
        "robot_state_publisher, or give -p model:=FILE"
    )
    try:
        while not stop.is_set():
            reporter.update({topic: fault})
            try:
                text = texts.get(timeout=POLL)
            except Empty:
                continue
            file.write_text(text)
            try:
                model = load_model(file, base)
            except SymbidError as error:
                fault = (
                    f"topic {topic}: invalid model ({error}); publish a valid one, or give "
                    "-p model:=FILE"
                )
                reporter = FaultReporter(node)  # reports the new fault at once
                continue
            node.get_logger().info(f"model {model.name} from topic {topic}")
            return True
    finally:
        node.destroy_subscription(subscription)
    return False


def identify_bags(node: Node, values: dict[str, Any], stop: Event) -> None:
    """Identify bags, and keep the estimate on its topics until stopped."""
    model, base = model_of(values)
    bags = tuple(map(Path, given_texts(values["bag"])))
    out = given_path(values["out"])
    with interruptible(stop):  # long bags take minutes
        options, log = identify_options(values), log_options(values)
        request = BagRequest(bags, model, options, log, base).completed()
        problem, found = identify_problem(request.load(out))
        found = request.attributed(found, command_line())
    estimate = found.estimate
    if out is not None:
        kinematics = problem.options.export_kinematics
        write_identification(found, problem.parameters, out, kinematics=kinematics)
    topics = EstimateTopics(node, problem.parameters)
    topics.publish(estimate, node.get_clock().now().to_msg())
    topics.describe(export_urdf(estimate, problem.parameters))
    node.get_logger().info(
        f"estimate of {estimate.model} by {estimate.method}: {estimate.samples} rows per coordinate"
    )
    verdict = estimate.verdict
    for alarm in found.alarms:
        node.get_logger().warning(f"alarm: {alarm}")
    details = {} if verdict is None else {"window": f"{verdict.window:g}"}
    StatusPublisher(
        node, lambda: [estimate_status(estimate, found.alarms, details)], estimate.model
    )
    stop.wait()


def identify(node: Node, values: dict[str, Any], stop: Event) -> None:
    """Identify from the bags or topics that the parameters name, until stopped."""
    if (out := given_path(values["out"])) is not None:
        require_no_files(out, (*RESULT_FILES, *CALIBRATED), overwrite=values["overwrite"])
    with model_file(node, values, stop) as complete:
        if complete is None:
            return
        if is_online(complete):
            construct(OnlineIdentifier, node, complete, stop).run(stop)
        else:
            identify_bags(node, complete, stop)


def main() -> int:
    """Run the node ``identifier`` and return its exit status."""
    threadpool_limits(1)
    return run_node(
        "identifier",
        identify,
        purpose="Identify a robot's inertial parameters from topics or bags and publish them.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
