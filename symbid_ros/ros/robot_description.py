"""The robot's model from ``robot_description``: a parameter, or a latched topic."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from symbid_ros.errors import SymbidError
from symbid_ros.model.load import load_model
from symbid_ros.ros.messages import latched
from symbid_ros.ros.notices import Notices

TOPIC = "robot_description"
LOOK = 0.1  # s


@contextmanager
def with_model(node: Node, values: dict[str, Any], stop: Event) -> Iterator[dict[str, Any] | None]:
    """Provide parameter values in which ``model`` names a file.

    Where none is given, the text of the parameter ``robot_description`` is written to a temporary
    file, else that of the first usable message on the topic of that name. The file lasts as long
    as the context: exports are written into a copy of it.

    Parameters
    ----------
    node : Node
    values : dict
        Of the identifier's parameters; not changed.
    stop : Event
        Ends the wait for a message; None is provided then.

    Raises
    ------
    ModelError
        When the parameter's text is not a usable model.
    """
    if values["model"]:
        yield values
        return
    with tempfile.TemporaryDirectory(prefix="symbid_") as folder:
        file = Path(folder) / f"{TOPIC}.urdf"
        found: dict[str, Any] | None = values | {"model": str(file)}
        if values[TOPIC]:
            file.write_text(values[TOPIC])
        elif not _awaited(node, file, values["base"], stop):
            found = None
        yield found


def _awaited(node: Node, file: Path, base: Any, stop: Event) -> bool:
    """Write the first usable message to a file; return False when stopped before."""
    texts: SimpleQueue[str] = SimpleQueue()
    subscription = node.create_subscription(
        String, TOPIC, lambda message: texts.put(message.data), latched()
    )
    topic = subscription.topic_name
    notices = Notices(node)
    fault = (
        f"waiting for the robot's model on topic {topic} (std_msgs/msg/String, latched); start "
        "robot_state_publisher, or give -p model:=FILE"
    )
    try:
        while not stop.is_set():
            notices.update({topic: fault})
            try:
                text = texts.get(timeout=LOOK)
            except Empty:
                continue
            file.write_text(text)
            try:
                model = load_model(file, base)
            except SymbidError as error:
                fault = (
                    f"topic {topic}: no usable model ({error}); publish another, or give "
                    "-p model:=FILE"
                )
                notices = Notices(node)  # a new fault is reported at once
                continue
            node.get_logger().info(f"model {model.name} from topic {topic}")
            return True
    finally:
        node.destroy_subscription(subscription)
    return False
