"""The topics on which the simulated robot appears."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import Event

from rclpy.node import Node
from rclpy.publisher import Publisher

from symbid_ros.messages.layout import Columns, Records
from symbid_ros.messages.types import clock_layout, fill_stamp
from symbid_ros.ros.endpoints import (
    await_acknowledgement,
    await_settled,
    message_class,
    reliable_qos,
)
from symbid_ros.ros.parameters import ParameterError, Values
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.topics import SimulatedTopic, sensor_topics, truth_topics


@dataclass
class InstantPublisher:
    """Publishes one topic every so many instants.

    Publishing typed messages costs some 0.1 ms each; the bytes of a record
    patched in place cost a fraction of that.
    """

    publisher: Publisher
    topic: SimulatedTopic
    every: int
    count: int = 0
    _record: Records = field(init=False)
    _columns: Columns = field(init=False)

    def __post_init__(self) -> None:
        self._record = self.topic.layout.records(1)
        self._columns = self.topic.layout.columns(self._record)

    @classmethod
    def create(
        cls, node: Node, topic: SimulatedTopic, *, every: int, depth: int
    ) -> "InstantPublisher":
        """Announce the topic on the node."""
        publisher = node.create_publisher(
            message_class(topic.layout.msgtype), topic.name, reliable_qos(depth)
        )
        return cls(publisher, topic, every)

    def publish(self, step: int, instant: Instant) -> None:
        """Publish the instant if it is this topic's turn."""
        if step % self.every:
            return
        self.topic.fill(self._columns, instant.stamp, instant)
        self.publisher.publish(self._record.tobytes())
        self.count += 1


def clock_topic() -> SimulatedTopic:
    """Return ``/clock``, simulated time."""

    def fill(columns: Columns, stamp: object, instant: Instant) -> None:
        fill_stamp(columns, instant.stamp, "clock")

    return SimulatedTopic("/clock", clock_layout(), fill)


class BridgeTopics:
    """Publishes instants on the topics of sensors, clock and truth.

    Parameters
    ----------
    node : Node
    robot : Simulator
        Any one with these sensors.
    values : mapping
        Of the node's parameters.

    Raises
    ------
    ParameterError
        When a rate does not divide the simulation's.
    """

    def __init__(self, node: Node, robot: Simulator, values: Values) -> None:
        self._robot = robot
        depth = values["queue_depth"]
        self._sensors = [
            InstantPublisher.create(node, topic, every=topic.every, depth=depth)
            for topic in sensor_topics(robot)
        ]
        self._others = [
            InstantPublisher.create(node, topic, every=every, depth=depth)
            for rate, topics in (
                ("clock_rate", [clock_topic()]),
                ("ground_truth_rate", truth_topics(robot)),
            )
            if (every := self._steps_between(rate, values[rate]))
            for topic in topics
        ]

    @property
    def counts(self) -> dict[str, int]:
        """Messages published by topic."""
        entries = (*self._sensors, *self._others)
        return {entry.publisher.topic_name: entry.count for entry in entries}

    @property
    def has_feedback(self) -> bool:
        """Whether joint states and IMU, which a controller needs, speak at every instant."""
        return all(entry.every == 1 for entry in self._feedback)

    @property
    def feedback_subscribers(self) -> tuple[int, ...]:
        """Number of subscribers to joint states and to the IMU."""
        return subscribers(self._feedback)

    def publish(self, step: int, instant: Instant) -> None:
        """Publish an instant on each topic whose turn it is."""
        for entry in (*self._sensors, *self._others):
            entry.publish(step, instant)

    def republish_feedback(self, instant: Instant) -> None:
        """Publish joint states and IMU of an instant once more."""
        for entry in self._feedback:
            entry.publish(0, instant)

    def await_subscribers(self, stop: Event, least: int) -> None:
        """Wait until every sensor has ``least`` subscribers."""
        await_subscribers(self._sensors, self._others, stop, least)

    def await_acknowledgement(self, stop: Event) -> None:
        """Give reliable subscribers time to fetch what is still on its way."""
        await_acknowledgement((each.publisher for each in (*self._sensors, *self._others)), stop)

    @property
    def _feedback(self) -> list[InstantPublisher]:
        joint_states, imu, *_ = self._sensors
        return [joint_states, imu]

    def _steps_between(self, name: str, rate: float) -> int:
        """Return how many steps lie between two messages, 0 for no message."""
        if not rate:
            return 0
        every = 1e9 / (rate * self._robot.period_ns)
        if every < 1 or abs(every - round(every)) > 1e-6:
            highest = 1e9 / self._robot.period_ns
            raise ParameterError(
                f"parameter {name}: {rate:g} does not divide the simulation's rate; "
                f"give {highest:g} divided by a whole number"
            )
        return round(every)


def await_subscribers(
    needed: Sequence[InstantPublisher],
    others: Sequence[InstantPublisher],
    stop: Event,
    least: int = 1,
) -> None:
    """Wait until every needed topic has ``least`` subscribers and no further one turns up."""
    await_settled(
        lambda: tuple(max(0, count - least + 1) for count in subscribers(needed)),
        stop,
        lambda: subscribers(others),
    )


def subscribers(publishers: Sequence[InstantPublisher]) -> tuple[int, ...]:
    """Return how many subscribers each has."""
    return tuple(entry.publisher.get_subscription_count() for entry in publishers)
