"""The identifier's online half: topics in, an estimate that follows them out."""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any

from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.identification.export import check_output, export_urdf, write_identification
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.online.identification import OnlineEstimate, OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.ros.diagnostics import StatusPublisher
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.identifier_diagnostics import IdentifierDiagnostics
from symbid_ros.ros.identifier_parameters import (
    PARAMETERS,
    given_path,
    identify_options,
    log_options,
    model_of,
)
from symbid_ros.ros.node_logging import FaultReporter
from symbid_ros.ros.parameters import ParameterError, watch
from symbid_ros.ros.raw_subscription import RawSubscription
from symbid_ros.ros.sensor_topics import SensorTopics, resolve_topics

POLL = 0.005  # s; far below what fills a queue
FOREVER = 2**63 - 1  # ns
LONGEST_DRAIN = 1.0  # s; on a machine too slow for its topics the queues never end
# An estimate by all data takes so many times as long as one between. Asked to end, the node
# spends so long on it, s: launch ends by force what takes longer than a few seconds.
EXACT_COST = 4.0
SHUTDOWN_SOLVE_TIME = 1.5
ANSWER_POLL = 0.1  # s
LOOK = 0.1  # s; between two looks at the graph while topics are waited for
PATIENCE = 2.0  # s; topics that are missing for longer are reported
LOOK_AGAIN = 1.0  # s; afterwards
# Whoever shows the robot loads it anew each time.
DESCRIPTION_PERIOD = 10.0  # s

Answer = tuple[bool, str]


class _ServiceRequest:
    """What a service asks of the thread that identifies, and waits for."""

    def __init__(self, work: Callable[[], str]) -> None:
        self._work, self._done = work, Event()
        self._answer: Answer = (False, "the identifier stops")

    def perform(self) -> None:
        try:
            self._answer = (True, self._work())
        except (SymbidError, OSError) as error:
            self._answer = (False, str(error))
        self._done.set()

    def answer(self, ended: Event) -> Answer:
        # Asked while the node ends, or while its work fails, it would never be done.
        while not self._done.wait(ANSWER_POLL) and not ended.is_set():
            pass
        return self._answer


class OnlineIdentifier:
    """Reads topics, solves every period, publishes, answers services, until stopped."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        self._beginning = InitialState.of(load_model(*model_of(values)), identify_options(values))
        self._parameters = self._beginning.problem.parameters
        memory: float = values["memory"]
        self._pace = Pace(memory or float("inf"), values["lag"], values["row_share"])
        self._out: Path | None = given_path(values["out"])
        if self._out is not None:
            check_output(self._parameters, self._out)
        self._period: float = values["solve_period"]
        self._sensors = SensorTopics(
            node,
            resolve_topics(node, TopicSelection.of(log_options(values)), sys.argv),
            self._parameters.model,
            values["settle"],
            values["queue_depth"],
        )
        self._requests: SimpleQueue[_ServiceRequest] = SimpleQueue()
        self._ended = Event()
        self._is_enabled = True
        self._identification: OnlineIdentification | None = None
        self._selected: SelectedTopics | None = None
        self._declined: set[str] = set()
        self._subscriptions: tuple[tuple[Topic, RawSubscription], ...] = ()
        self._topics = EstimateTopics(node, self._parameters)
        self._described = float("-inf")
        self._solves = 0
        self._newest: OnlineEstimate | None = None
        self._solve_time = 0.0  # s
        self._health = IdentifierDiagnostics()
        self._notices = FaultReporter(node)
        for handler_name, work in (
            ("reset", self._reset),
            ("solve", self._solve_exactly),
            ("save", self._save),
        ):
            node.create_service(Trigger, f"~/{handler_name}", self._triggered(work))
        node.create_service(SetBool, "~/enable", self._enable)
        watch(node, PARAMETERS, self._adopt)
        self._publisher = StatusPublisher(node, self._health.look, self._parameters.model.name)

    def run(self, stop: Event) -> None:
        """Identify until stopped; then save, where a folder is named, and say what was done.

        Raises
        ------
        EstimateError
            When it ends without an estimate.
        """
        try:
            self._await_topics(stop)
            if self._identification is not None:
                self._follow(stop)
        except BaseException:
            self._rescue()
            raise
        finally:
            self._ended.set()
            if self._identification is not None:
                self._identification.close()
        if not self._solves:
            raise EstimateError(f"it ends without an estimate: {self._health.obstacle}")

    def _await_topics(self, stop: Event) -> None:
        begun = time.monotonic()
        while not stop.is_set() and self._identification is None:
            self._look()
            missing = self._sensors.missing()
            if time.monotonic() - begun >= PATIENCE and self._identification is None:
                self._notices.update(missing)
            self._health.waiting(self._sensors.found, missing.values())
            self._answer_requests()
            stop.wait(LOOK)
        if self._identification is not None:
            self._notices.update({})

    def _look(self) -> None:
        """Look at the graph; begin once the robot's topics are there.

        Topics that turn up later are taken as well as long as there is no estimate to lose:
        without a wrench that carries weight there is none.
        """
        selected = self._sensors.look()
        if selected is None or selected == self._selected:
            return
        names = ", ".join(topic.name for topic in selected.all)
        if self._identification is not None:
            if self._newest is not None:
                self._decline(selected)
                return
            self._node.get_logger().warning(f"topics turned up late, begins anew with {names}")
            self._identification.close()
        self._identification = OnlineIdentification(self._beginning, selected, self._pace)
        self._subscriptions = self._sensors.subscriptions(selected)
        self._selected = selected
        model = self._parameters.model.name
        self._node.get_logger().info(f"identifying {model} from {names}")

    def _decline(self, selected: SelectedTopics) -> None:
        """Keep the streams; say once which others could be used."""
        used = () if self._selected is None else self._selected.all
        new = {topic.name for topic in selected.all if topic not in used} - self._declined
        if new:
            self._declined |= new
            self._node.get_logger().warning(
                f"{', '.join(sorted(new))} turned up late and is not used: that would forget what "
                "has been learnt; call ~/reset to begin anew with it"
            )
        self._sensors.release()

    def _follow(self, stop: Event) -> None:
        due = time.monotonic() + self._period
        looked = time.monotonic()
        while not stop.is_set():
            count = self._drain()
            self._live.advance()
            self._answer_requests()
            now = time.monotonic()
            if now - looked >= LOOK_AGAIN:
                self._look()
                for _, subscription in self._subscriptions:
                    subscription.match_publishers()
                looked = now
            if now >= due:
                faults = self._health.heard(self._live)
                if faults is not None:
                    self._notices.update(faults)
                if self._is_enabled and self._live.has_news:
                    self._solve()
                # A machine that cannot keep the pace needs time for the topics, too.
                spent = time.monotonic() - now
                due = max(due + self._period, now + 1.5 * spent)
            elif not count:
                time.sleep(POLL)
        self._drain_until(time.time_ns(), LONGEST_DRAIN)
        self._finish()

    @property
    def _live(self) -> OnlineIdentification:
        """The identification, once there are topics."""
        if self._identification is None:
            raise ParameterError(
                "no sensor topics yet, nothing is known; start the robot's drivers first"
            )
        return self._identification

    def _drain(self, until: int = FOREVER) -> int:
        """Take messages, a batch of each topic; return how many arrived up to a time, ns."""
        count = 0
        for topic, subscription in self._subscriptions:
            for message in subscription.take():
                if self._is_enabled:
                    self._live.feed(topic, message.payload)
                count += message.received <= until
        return count

    def _drain_until(self, until: int, longest: float = float("inf")) -> None:
        """Take what had arrived at a time, ns, while publishers go on; for so many s at most."""
        deadline = time.monotonic() + longest
        while self._drain(until) and time.monotonic() < deadline:
            pass

    def _solve(self, *, exactly: bool = False) -> OnlineEstimate | None:
        began = time.monotonic()
        try:
            outcome = self._live.solve(exactly=exactly)
        except SymbidError as error:
            self._health.refused(str(error))
            if exactly:
                raise
            return None
        spent = time.monotonic() - began
        self._health.solved(self._live, outcome, spent)
        if outcome is not None:
            self._solves += 1
            self._newest = outcome
            if not exactly:
                self._solve_time = spent
            self._publish(outcome, describe=exactly)
        return outcome

    def _publish(self, outcome: OnlineEstimate, *, describe: bool) -> None:
        estimate = outcome.found.estimate
        self._topics.publish(estimate, Time(nanoseconds=outcome.until).to_msg())
        now = time.monotonic()
        if describe or now - self._described >= DESCRIPTION_PERIOD:
            self._topics.describe(export_urdf(estimate, self._parameters))
            self._described = now

    def _solve_exactly(self) -> str:
        return _told(self._known())

    def _known(self) -> OnlineEstimate:
        self._drain_until(time.time_ns())
        outcome = self._solve(exactly=True)
        if outcome is None:
            raise ParameterError("too little has come to tell anything; wait, or move the robot")
        return outcome

    def _save(self) -> str:
        if self._out is None:
            raise ParameterError("parameter out: empty; start the identifier with -p out:=FOLDER")
        return self._write(self._known(), self._out)

    def _write(self, outcome: OnlineEstimate, out: Path) -> str:
        write_identification(outcome.found, self._parameters, out)
        return f"{_told(outcome)}, written to {out}"

    def _reset(self) -> str:
        self._live.reset()
        self._newest = None
        return "all but the prior is forgotten"

    def _finish(self) -> None:
        summary: dict[str, object] = {
            "received": {
                topic.name: buffer.received for topic, buffer in self._live.streams.buffers.items()
            },
            "missing": {
                topic.name: buffer.missing for topic, buffer in self._live.streams.buffers.items()
            },
            "solves": self._solves,
        }
        # There may be nothing left to save, as after a reset.
        if self._out is not None and self._solves and (known := self._last_known()):
            summary["saved"] = self._write(known, self._out)
        print(json.dumps(summary), flush=True)

    def _last_known(self) -> OnlineEstimate | None:
        """Return the estimate of an offline run, or the newest one if time is too short."""
        if self._newest is not None and EXACT_COST * self._solve_time > SHUTDOWN_SOLVE_TIME:
            self._node.get_logger().warning(
                "the machine is busy: the newest estimate is saved, not one by all data"
            )
            return self._newest
        try:
            return self._solve(exactly=True)
        except SymbidError as error:
            if self._newest is None:
                raise
            self._node.get_logger().warning(f"{error}; the estimate before that is saved")
            return self._newest

    def _rescue(self) -> None:
        """Save the newest estimate while an error is on its way to end the node."""
        if self._out is None or self._newest is None:
            return
        try:
            self._node.get_logger().error(self._write(self._newest, self._out))
        except Exception as error:
            self._node.get_logger().error(f"{self._out}: nothing could be saved: {error}")

    def _adopt(self, live: dict[str, Any]) -> None:
        self._period = live["solve_period"]
        # Blocks may be in work: the thread that identifies makes the change.
        self._requests.put(_ServiceRequest(lambda: self._remember(live["memory"])))

    def _remember(self, memory: float) -> str:
        self._pace = replace(self._pace, memory=memory or float("inf"))
        if self._identification is not None:
            self._identification.set_memory(self._pace.memory)
        return f"memory is {memory:g} s" if memory else "data are never forgotten"

    def _triggered(
        self, work: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            request = _ServiceRequest(work)
            self._requests.put(request)
            response.success, response.message = request.answer(self._ended)
            return response

        return serve

    def _enable(self, wanted: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._is_enabled = bool(wanted.data)
        self._health.enabled(self._is_enabled)
        response.success = True
        response.message = "identifying" if wanted.data else "messages pass unread"
        return response

    def _answer_requests(self) -> None:
        while (request := self._next_request()) is not None:
            request.perform()

    def _next_request(self) -> _ServiceRequest | None:
        try:
            return self._requests.get_nowait()
        except Empty:
            return None


def _told(outcome: OnlineEstimate) -> str:
    estimate = outcome.found.estimate
    count = 0 if estimate.determined is None else int(estimate.determined.sum())
    return f"{count} of {len(estimate.names)} parameters determined by {estimate.samples} rows"
