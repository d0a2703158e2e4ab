"""Recorded messages onto topics: in time or as fast as they are taken, paused and resumed."""

import time
from dataclasses import dataclass, field
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

POLL = 0.02  # s; how soon a pause, a restart or the end is noticed
GIVEN_UP = 60.0  # s; the middleware itself forgets a subscriber that has died after 20 s
CLOCK_TOPIC = RecordedTopic(name="/clock", msgtype=CLOCK, encoding=CDR, qos=())


def replay_profile(topic: RecordedTopic, depth: int, *, patient: bool) -> QoSProfile:
    """Return what to offer: reliable, which satisfies every subscriber, with a deep queue.

    Latched topics keep as many messages as all their recorded publishers together did: late
    subscribers get no more than they would have got.

    Parameters
    ----------
    topic : RecordedTopic
    depth : int
        Messages to keep for slow subscribers.
    patient : bool
        Whether to wait for them instead of overwriting the oldest message.
    """
    profile = reliable_qos(depth)
    latching = [offer for offer in topic.qos if offer.durability == "transient_local"]
    if latching:
        profile.durability = QoSDurabilityPolicy.TRANSIENT_LOCAL
        # A recorder learns neither history nor depth from discovery, and says so.
        if all(offer.history == "keep_last" and offer.depth > 0 for offer in latching):
            profile.depth = sum(offer.depth for offer in latching)
    elif patient:
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
        Ends all waiting.
    patient : bool
        Whether to wait for them instead of overwriting the oldest message.

    Attributes
    ----------
    publisher : Publisher
    count : int
        Messages published.
    """

    def __init__(
        self, node: Node, topic: RecordedTopic, depth: int, stop: Event, *, patient: bool
    ) -> None:
        profile = replay_profile(topic, depth, patient=patient)
        self.publisher = node.create_publisher(message_class(topic.msgtype), topic.name, profile)
        self.count = 0
        self._stop = stop
        self._is_patient = patient
        self._is_latched = profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL

    def publish(self, payload: bytes) -> None:
        """Publish one message; a patient publisher first waits for room."""
        deadline = None
        while not self._stop.is_set():
            try:
                self.publisher.publish(payload)
            except RuntimeError as error:
                if not self._is_patient:
                    raise
                # What rcl reports, after 0.1 s, while a queue that keeps all is full.
                deadline = deadline or time.monotonic() + GIVEN_UP
                if time.monotonic() > deadline:
                    raise SymbidError(
                        f"{self.publisher.topic_name}: no room for a message, a subscriber has "
                        f"taken nothing for {GIVEN_UP:g} s; end it, or set rate and lossless:=false"
                    ) from error
            else:
                self.count += 1
                break
        if self._is_patient and self._is_latched:
            self.await_acknowledgement()

    def await_acknowledgement(self) -> None:
        """Wait until every reliable subscriber has all messages, unless one takes none at all."""
        deadline = time.monotonic() + GIVEN_UP
        wait = self.publisher.wait_for_all_acked
        while not (self._stop.is_set() or wait(Duration(seconds=POLL))):
            if time.monotonic() > deadline:
                return


class ReplayClock:
    """``/clock`` at a fixed rate of log time.

    Parameters
    ----------
    publisher : ReplayPublisher
        Of ``/clock``.
    rate : float
        Messages per second of log time.

    Attributes
    ----------
    due : int
        Log time of the next message, nanoseconds.
    """

    def __init__(self, publisher: ReplayPublisher, rate: float) -> None:
        self.publisher = publisher
        self.due = 0
        self._period = round(1e9 / rate)
        self._last = -1
        self._record = clock_layout().records(1)
        self._columns = clock_layout().columns(self._record)

    def begin(self, log_time: int) -> None:
        """Start again from a log time in nanoseconds."""
        self.due, self._last = log_time, -1

    def tick(self, now: int) -> None:
        """Publish the time, nanoseconds, unless it stands still, and wait for the next turn."""
        self.due += self._period
        if now > self._last:
            fill_stamp(self._columns, now, "clock")
            self.publisher.publish(self._record.tobytes())
            self._last = now


@dataclass
class ReplayControls:
    """What the services ask of the player; they answer in the executor's thread.

    Attributes
    ----------
    paused, restarted : Event
        Set while the replay is to stand still, and until it has begun again.
    """

    node: Node
    paused: Event = field(default_factory=Event)
    restarted: Event = field(default_factory=Event)

    def __post_init__(self) -> None:
        self.node.create_service(SetBool, "~/pause", self._pause)
        self.node.create_service(Trigger, "~/restart", self._restart)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        (self.paused.set if request.data else self.paused.clear)()
        response.success, response.message = True, "paused" if request.data else "playing"
        return response

    def _restart(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.restarted.set()
        response.success, response.message = True, "begins again"
        return response


class ReplaySchedule:
    """When each message is due, on the monotonic clock.

    A ROS timer skips ticks: deadlines do not, and a late message does not delay the next.

    Parameters
    ----------
    rate : float
        Seconds of log time per second; 0 for no schedule at all.
    transport : ReplayControls
    stop : Event

    Attributes
    ----------
    lag, longest_lag : float
        How late the newest message was and the latest of all, seconds.
    """

    def __init__(self, rate: float, transport: ReplayControls, stop: Event) -> None:
        self.lag = self.longest_lag = 0.0
        self.rate = rate
        self._transport = transport
        self._stop = stop
        self._begin = self._origin = 0

    def begin(self, log_time: int) -> None:
        """Let a log time, nanoseconds, be due now."""
        self._origin, self._begin = log_time, time.monotonic_ns()

    def reach(self, log_time: int) -> bool:
        """Wait until a log time is due; return False if the replay ends or restarts instead."""
        transport, stop = self._transport, self._stop
        while not (stop.is_set() or transport.restarted.is_set()):
            if transport.paused.is_set():
                self._stand_still()
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

    def _stand_still(self) -> None:
        since = time.monotonic_ns()
        transport, stop = self._transport, self._stop
        while transport.paused.is_set() and not (stop.is_set() or transport.restarted.is_set()):
            stop.wait(POLL)
        self._begin += time.monotonic_ns() - since
