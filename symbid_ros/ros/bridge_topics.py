"""The topics that the simulated robot publishes."""

from collections.abc import Sequence
from threading import Event

from rclpy.node import Node

from symbid_ros.messages.layout import Columns
from symbid_ros.messages.types import clock_layout, fill_stamp
from symbid_ros.ros.endpoints import (
    await_acknowledgement,
    await_settled,
    message_class,
    reliable_qos,
)
from symbid_ros.ros.parameters import ParameterError, Values
from symbid_ros.simulation.recording import SimulatedTopic, sensor_topics, truth_topics
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator


class InstantPublisher:
    """Publishes one topic at every ``every``-th instant.

    Messages are bytes that are patched in place: a typed message takes about 0.1 ms to publish,
    patched bytes a fraction of that.
    """

    def __init__(self, node: Node, topic: SimulatedTopic, *, every: int, depth: int) -> None:
        self.publisher = node.create_publisher(
            message_class(topic.layout.msgtype), topic.name, reliable_qos(depth)
        )
        self.every, self.count = every, 0
        self._topic = topic
        self._record = topic.layout.records(1)
        self._columns = topic.layout.columns(self._record)

    def publish(self, step: int, instant: Instant) -> None:
        """Publish an instant if ``step`` is a multiple of ``every``."""
        if step % self.every:
            return
        self._topic.fill(self._columns, instant.stamp, instant)
        self.publisher.publish(self._record.tobytes())
        self.count += 1


def clock_topic() -> SimulatedTopic:
    """Return the topic ``/clock`` with simulated time."""

    def fill(columns: Columns, stamp: object, instant: Instant) -> None:
        fill_stamp(columns, instant.stamp, "clock")

    return SimulatedTopic("/clock", clock_layout(), fill)


class BridgeTopics:
    """Publishes instants on the topics of sensors, clock and ground truth.

    Raises
    ------
    ParameterError
        When a rate does not divide the simulation's.
    """

    def __init__(self, node: Node, robot: Simulator, values: Values) -> None:
        self._robot = robot
        depth = values["queue_depth"]
        self._sensors = [
            InstantPublisher(node, topic, every=topic.every, depth=depth)
            for topic in sensor_topics(robot)
        ]
        self._others = [
            InstantPublisher(node, topic, every=every, depth=depth)
            for rate, topics in (
                ("clock_rate", [clock_topic()]),
                ("ground_truth_rate", truth_topics(robot)),
            )
            if (every := self._steps_between(rate, values[rate]))
            for topic in topics
        ]

    @property
    def counts(self) -> dict[str, int]:
        """Number of published messages by topic."""
        entries = (*self._sensors, *self._others)
        return {entry.publisher.topic_name: entry.count for entry in entries}

    @property
    def has_feedback(self) -> bool:
        """Whether joint states and IMU data, which a controller needs, cover every instant."""
        return all(entry.every == 1 for entry in self._feedback)

    @property
    def feedback_subscribers(self) -> tuple[int, ...]:
        """Number of subscribers to the joint states and to the IMU data."""
        return _subscriber_counts(self._feedback)

    def publish(self, step: int, instant: Instant) -> None:
        """Publish an instant on each topic that is due at this step."""
        for entry in (*self._sensors, *self._others):
            entry.publish(step, instant)

    def republish_feedback(self, instant: Instant) -> None:
        """Publish joint states and IMU data of an instant again."""
        for entry in self._feedback:
            entry.publish(0, instant)

    def await_subscribers(self, stop: Event, least: int) -> None:
        """Wait until every sensor topic has ``least`` subscribers."""
        await_settled(
            lambda: tuple(max(0, count - least + 1) for count in _subscriber_counts(self._sensors)),
            stop,
            lambda: _subscriber_counts(self._others),
        )

    def await_acknowledgement(self, stop: Event) -> None:
        """Wait until reliable subscribers have received all messages."""
        await_acknowledgement((each.publisher for each in (*self._sensors, *self._others)), stop)

    @property
    def _feedback(self) -> list[InstantPublisher]:
        joint_states, imu, *_ = self._sensors
        return [joint_states, imu]

    def _steps_between(self, name: str, rate: float) -> int:
        """Return the number of steps between two messages; 0 for no messages."""
        if not rate:
            return 0
        every = 1e9 / (rate * self._robot.period_ns)
        if every < 1 or abs(every - round(every)) > 1e-6:
            highest = 1e9 / self._robot.period_ns
            raise ParameterError(
                f"parameter {name}: {rate:g} Hz does not divide the simulation rate; "
                f"give {highest:g} Hz divided by a whole number",
                "E803",
            )
        return round(every)


def _subscriber_counts(publishers: Sequence[InstantPublisher]) -> tuple[int, ...]:
    """Return the number of subscribers of each publisher."""
    return tuple(entry.publisher.get_subscription_count() for entry in publishers)
