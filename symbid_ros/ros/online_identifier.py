"""The identifier's online half: topics in, an estimate that follows them out."""

import json
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

from symbid_ros.bags.container.blocks import Topic
from symbid_ros.bags.streams.selection import SelectedTopics
from symbid_ros.errors import SymbidError
from symbid_ros.offline.export import export_urdf, write_identification
from symbid_ros.online.beginning import Beginning
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.outcome import Outcome
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.health import HealthPublisher
from symbid_ros.ros.identifier_health import IdentifierHealth
from symbid_ros.ros.identifier_parameters import PARAMETERS, given_path, job_from
from symbid_ros.ros.intake import Intake
from symbid_ros.ros.notices import Notices
from symbid_ros.ros.parameters import ParameterError, watch
from symbid_ros.ros.sensor_topics import SensorTopics, resolved

POLL = 0.005  # s; far below what fills a queue
ANSWER_POLL = 0.1  # s
LOOK = 0.1  # s; between two looks at the graph while topics are waited for
PATIENCE = 2.0  # s; topics that are missing for longer are reported
LOOK_AGAIN = 1.0  # s; afterwards
# Whoever shows the robot loads it anew each time.
DESCRIPTION_PERIOD = 10.0  # s

Answer = tuple[bool, str]


class _Request:
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
        self._beginning = Beginning.of(job_from(values))
        self._parameters = self._beginning.problem.parameters
        memory: float = values["memory"]
        self._pace = Pace(memory or float("inf"), values["lag"], values["row_share"])
        self._out: Path | None = given_path(values["out"])
        self._period: float = values["solve_period"]
        self._sensors = SensorTopics(
            node,
            resolved(node, self._beginning.job.processing.topics),
            self._parameters.model.floating,
            values["settle"],
            values["queue_depth"],
        )
        self._requests: SimpleQueue[_Request] = SimpleQueue()
        self._ended = Event()
        self._is_enabled = True
        self._identification: OnlineIdentification | None = None
        self._selected: SelectedTopics | None = None
        self._intakes: tuple[tuple[Topic, Intake], ...] = ()
        self._topics = EstimateTopics(node, self._parameters)
        self._described = float("-inf")
        self._solves = 0
        self._health = IdentifierHealth()
        self._notices = Notices(node)
        self._refusal: dict[str, str] = {}
        for handler_name, work in (
            ("reset", self._reset),
            ("solve", self._solve_exactly),
            ("save", self._save),
        ):
            node.create_service(Trigger, f"~/{handler_name}", self._triggered(work))
        node.create_service(SetBool, "~/enable", self._enable)
        watch(node, PARAMETERS, self._adopt)
        self._publisher = HealthPublisher(node, self._health.look, self._parameters.model.name)

    def run(self, stop: Event) -> None:
        """Identify until stopped; then save, where a folder is named, and say what was done."""
        try:
            self._await_topics(stop)
            if self._identification is not None:
                self._follow(stop)
        finally:
            self._ended.set()
            if self._identification is not None:
                self._identification.close()

    def _await_topics(self, stop: Event) -> None:
        begun = time.monotonic()
        while not stop.is_set() and self._identification is None:
            self._look()
            missing = self._sensors.missing() | self._refusal
            if time.monotonic() - begun >= PATIENCE and self._identification is None:
                self._notices.update(missing)
            self._health.waiting(self._sensors.intakes, missing.values())
            self._answer_requests()
            stop.wait(LOOK)
        if self._identification is not None:
            self._notices.update({})

    def _look(self) -> None:
        """Look at the graph; begin where the topics of the robot are other than known so far."""
        selected = self._selection()
        if selected is None or selected == self._selected:
            return
        names = ", ".join(topic.name for topic in selected.all)
        if self._identification is not None:
            # Without a wrench that carries weight all that was learned is wrong.
            self._node.get_logger().warning(f"topics turned up late, begins anew with {names}")
            self._identification.close()
        self._identification = OnlineIdentification(self._beginning, selected, self._pace)
        self._intakes = tuple((topic, self._sensors.intakes[topic]) for topic in selected.all)
        self._selected = selected
        model = self._parameters.model.name
        self._node.get_logger().info(f"identifying {model} from {names}")

    def _selection(self) -> SelectedTopics | None:
        """Return the robot's topics once they are complete and unambiguous."""
        self._refusal = {}
        try:
            return self._sensors.look()
        except SymbidError as error:
            # Topics come and go: what cannot be used now may be in order later.
            self._refusal = {"topics": str(error)}
            return None

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
        while self._drain():  # what arrived before the signal
            pass
        self._finish()

    @property
    def _live(self) -> OnlineIdentification:
        """The identification, once there are topics."""
        if self._identification is None:
            raise ParameterError(
                "no sensor topics yet, nothing is known; start the robot's drivers first"
            )
        return self._identification

    def _drain(self) -> int:
        count = 0
        for topic, intake in self._intakes:
            for arrival in intake.arrivals():
                if self._is_enabled:
                    self._live.feed(topic, arrival.payload)
                count += 1
        return count

    def _solve(self, *, exactly: bool = False) -> Outcome | None:
        began = time.monotonic()
        try:
            outcome = self._live.solve(exactly=exactly)
        except SymbidError as error:
            self._health.refused(str(error))
            if exactly:
                raise
            return None
        self._health.solved(self._live, outcome, time.monotonic() - began)
        if outcome is not None:
            self._solves += 1
            self._publish(outcome, describe=exactly)
        return outcome

    def _publish(self, outcome: Outcome, *, describe: bool) -> None:
        estimate = outcome.found.estimate
        self._topics.publish(estimate, Time(nanoseconds=outcome.until).to_msg())
        now = time.monotonic()
        if describe or now - self._described >= DESCRIPTION_PERIOD:
            self._topics.describe(export_urdf(estimate, self._parameters))
            self._described = now

    def _solve_exactly(self) -> str:
        return _told(self._known())

    def _known(self) -> Outcome:
        self._drain_all()
        outcome = self._solve(exactly=True)
        if outcome is None:
            raise ParameterError("too little has come to tell anything; wait, or move the robot")
        return outcome

    def _drain_all(self) -> None:
        while self._drain():
            pass

    def _save(self) -> str:
        if self._out is None:
            raise ParameterError("parameter out: empty; start the identifier with -p out:=FOLDER")
        return self._write(self._known(), self._out)

    def _write(self, outcome: Outcome, out: Path) -> str:
        write_identification(outcome.found, self._parameters, out)
        return f"{_told(outcome)}, written to {out}"

    def _reset(self) -> str:
        self._live.reset()
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
        if self._out is not None and self._solves and (known := self._solve(exactly=True)):
            summary["saved"] = self._write(known, self._out)
        print(json.dumps(summary), flush=True)

    def _adopt(self, live: dict[str, Any]) -> None:
        self._period = live["solve_period"]
        # Blocks may be in work: the thread that identifies makes the change.
        self._requests.put(_Request(lambda: self._remember(live["memory"])))

    def _remember(self, memory: float) -> str:
        self._pace = replace(self._pace, memory=memory or float("inf"))
        if self._identification is not None:
            self._identification.set_memory(self._pace.memory)
        return f"memory is {memory:g} s" if memory else "data are never forgotten"

    def _triggered(
        self, work: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            request = _Request(work)
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

    def _next_request(self) -> _Request | None:
        try:
            return self._requests.get_nowait()
        except Empty:
            return None


def _told(outcome: Outcome) -> str:
    estimate = outcome.found.estimate
    count = 0 if estimate.determined is None else int(estimate.determined.sum())
    return f"{count} of {len(estimate.names)} parameters determined by {estimate.samples} rows"
