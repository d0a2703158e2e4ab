"""Publishers, clock, schedule and services of a replay."""

import time
from threading import Event

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger

from symbid_ros.bags import RecordedTopic
from symbid_ros.errors import SymbidError
from symbid_ros.messages.layout import CDR
from symbid_ros.messages.types import CLOCK, clock_layout, fill_stamp
from symbid_ros.ros.endpoints import message_class, reliable_qos

POLL = 0.02  # s; longest delay until a pause, a restart or a stop is noticed
TIMEOUT = 60.0  # s for a slow subscriber; the middleware drops a dead one after 20 s
CLOCK_TOPIC = RecordedTopic(name="/clock", msgtype=CLOCK, encoding=CDR, qos=())


def replay_qos(topic: RecordedTopic, depth: int, *, lossless: bool) -> QoSProfile:
    """Return the QoS profile of a publisher: reliable, which is compatible with any subscriber.

    A latched topic keeps as many messages as all its recorded publishers together, so that a late
    subscriber gets what it would have got at the time of recording.
    """
    profile = reliable_qos(depth)
    latching = [offer for offer in topic.qos if offer.durability == "transient_local"]
    if latching:
        profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        # A recorder learns neither history nor depth from discovery, and records "unknown".
        if all(offer.history == "keep_last" and offer.depth > 0 for offer in latching):
            profile.depth = sum(offer.depth for offer in latching)
    elif lossless:
        profile.history = QoSHistoryPolicy.KEEP_ALL
    return profile


class ReplayPublisher:
    """Publishes serialised messages of one topic.

    Parameters
    ----------
    node : Node
    topic : RecordedTopic
    depth : int
        Messages to keep for slow subscribers.
    stop : Event
        Ends every wait.
    lossless : bool
        Whether to wait for slow subscribers instead of overwriting the oldest message.

    Attributes
    ----------
    publisher : Publisher
    count : int
        Number of published messages.
    """

    def __init__(
        self, node: Node, topic: RecordedTopic, depth: int, stop: Event, *, lossless: bool
    ) -> None:
        profile = replay_qos(topic, depth, lossless=lossless)
        self.publisher = node.create_publisher(message_class(topic.msgtype), topic.name, profile)
        self.count = 0
        self._stop = stop
        self._is_lossless = lossless
        self._is_latched = profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL

    def publish(self, payload: bytes) -> None:
        """Publish one message; if lossless, first wait for space in the queue."""
        deadline = None
        while not self._stop.is_set():
            try:
                self.publisher.publish(payload)
            except RuntimeError as error:
                if not self._is_lossless:
                    raise
                # rcl raises this after 0.1 s while a queue that keeps all messages is full.
                deadline = deadline or time.monotonic() + TIMEOUT
                if time.monotonic() > deadline:
                    raise SymbidError(
                        f"{self.publisher.topic_name}: the queue is full, a subscriber has taken "
                        f"nothing for {TIMEOUT:g} s; stop it, or set rate and lossless:=false",
                        "E806",
                    ) from error
            else:
                self.count += 1
                break
        if self._is_lossless and self._is_latched:
            self.await_acknowledgement()

    def await_acknowledgement(self) -> None:
        """Wait until every reliable subscriber has received all messages, at most `TIMEOUT` s."""
        deadline = time.monotonic() + TIMEOUT
        wait = self.publisher.wait_for_all_acked
        while not (self._stop.is_set() or wait(Duration(seconds=POLL))):
            if time.monotonic() > deadline:
                return


class ReplayClock:
    """Publishes ``/clock`` at a fixed rate, in messages per second of log time."""

    def __init__(self, publisher: ReplayPublisher, rate: float) -> None:
        self.publisher = publisher
        self.due = 0  # log time of the next message, ns
        self._period = round(1e9 / rate)
        self._last = -1
        self._record = clock_layout().records(1)
        self._columns = clock_layout().columns(self._record)

    def begin(self, log_time: int) -> None:
        """Restart from a log time, ns."""
        self.due, self._last = log_time, -1

    def tick(self, now: int) -> None:
        """Publish the time, ns, unless it has not advanced, and set the next due time."""
        self.due += self._period
        if now > self._last:
            fill_stamp(self._columns, now, "clock")
            self.publisher.publish(self._record.tobytes())
            self._last = now


class ReplayControls:
    """The services pause and restart; they answer in the executor's thread."""

    def __init__(self, node: Node) -> None:
        self.paused = Event()
        self.restarted = Event()  # from a request to restart until the replay has restarted
        node.create_service(SetBool, "~/pause", self._pause)
        node.create_service(Trigger, "~/restart", self._restart)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        (self.paused.set if request.data else self.paused.clear)()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _restart(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.restarted.set()
        response.success, response.message = True, "the replay restarts"
        return response


class ReplaySchedule:
    """Waits until each message is due, on the monotonic clock.

    Due times do not depend on earlier messages, so a late message does not delay the next one.

    Attributes
    ----------
    rate : float
        Seconds of log time per second; 0: every message is due at once.
    lag, longest_lag : float
        Delay of the newest message, and the longest delay so far, s.
    """

    def __init__(self, rate: float, controls: ReplayControls, stop: Event) -> None:
        self.lag = self.longest_lag = 0.0
        self.rate = rate
        self._controls = controls
        self._stop = stop
        self._begin = self._origin = 0

    def begin(self, log_time: int) -> None:
        """Make a log time, ns, due now."""
        self._origin, self._begin = log_time, time.monotonic_ns()

    def reach(self, log_time: int) -> bool:
        """Wait until a log time is due; return False if the replay stops or restarts first."""
        controls, stop = self._controls, self._stop
        while not (stop.is_set() or controls.restarted.is_set()):
            if controls.paused.is_set():
                self._wait_while_paused()
                continue
            if not self.rate:
                return True
            due = self._begin + (log_time - self._origin) / self.rate
            ahead = (due - time.monotonic_ns()) / 1e9
            if ahead <= 0:
                self.lag = -ahead
                self.longest_lag = max(self.longest_lag, self.lag)
                return True
            stop.wait(min(ahead, POLL))
        return False

    def _wait_while_paused(self) -> None:
        since = time.monotonic_ns()
        controls, stop = self._controls, self._stop
        while controls.paused.is_set() and not (stop.is_set() or controls.restarted.is_set()):
            stop.wait(POLL)
        self._begin += time.monotonic_ns() - since
