"""Online identification: from sensor topics to an estimate that is updated every period."""

import json
import logging
import sys
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import SetBool, Trigger

from symbid_ros.atomic_write import check_output_file
from symbid_ros.bags import bag_log
from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.provenance import Provenance, command_line
from symbid_ros.identification.calibration.tares import Tare, read_tare
from symbid_ros.identification.conventions.assumed_contacts import naming_contacts
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.result_files import check_output, export_urdf, write_identification
from symbid_ros.learning.candidate import RobotUncertainty, candidate_model, robot_uncertainty
from symbid_ros.learning.model_file import read_model, write_model
from symbid_ros.messages.name_check import ModelNames, check_model_names
from symbid_ros.messages.topics import SelectedTopics, TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.tree import RobotModel
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState, unused_live
from symbid_ros.online.tare import TareRecording
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.identifier_diagnostics import IdentifierDiagnostics
from symbid_ros.ros.identifier_parameters import (
    PARAMETERS,
    given_path,
    identify_options,
    log_options,
    model_of,
)
from symbid_ros.ros.inertia_markers import InertiaMarkers
from symbid_ros.ros.monitor_messages import TOO_EARLY_TO_FIT
from symbid_ros.ros.parameters import ParameterError, watch
from symbid_ros.ros.raw_subscription import MessageReceiver
from symbid_ros.ros.reporting import FaultReporter, StatusPublisher, collected_warnings
from symbid_ros.ros.sensor_topics import SensorTopics, resolve_topics
from symbid_ros.ros.service_requests import ServiceRequests

logger = logging.getLogger(__name__)

POLL = 0.01  # s; queues take far longer to fill
FOREVER = 2**63 - 1  # ns
LONGEST_DRAIN = 1.0  # s of reading at the end, or `save_time` if that is longer
# Cost of an exact estimate, relative to the estimates in between.
EXACT_COST = 4.0
RECENT_SOLVES = 5  # of which the shortest counts: choosing windows and joint terms takes longer
CHANGE = "change of the robot"  # what is reported as resolved
CONTACTS = "contact forces"
TARE_TIME = 2.0  # s over which the readings of unloaded sensors are averaged
DISCOVERY_PERIOD = 0.1  # s between two looks at the graph before identification starts
LATER_DISCOVERY_PERIOD = 1.0  # s afterwards
MISSING_PERIOD = 2.0  # s until missing topics are reported
WARNING_PERIOD = 10.0  # s between two warnings
DESCRIPTION_PERIOD = 10.0  # s; viewers reload the whole robot for each description


class OnlineIdentifier:
    """Reads topics, solves every period, publishes estimates and answers services."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._node = node
        self._model = model = load_model(*model_of(values))
        options = identify_options(values)
        log = log_options(values)
        for reason in unused_live(options, log).values():
            # A robot file may name it, for logs.
            node.get_logger().warning(reason)
        topics = TopicSelection.of(log)
        names = ModelNames.of(model)
        check_model_names(topics.mapping, names, has_poses=bool(topics.poses))
        self._initial_state = InitialState.of(model, options, _read_tares(options, model, topics))
        self._parameters = self._initial_state.problem.parameters
        memory: float = values["memory"]
        self._pace = Pace(memory or float("inf"), values["lag"], values["row_share"])
        self._out: Path | None = given_path(values["out"])
        if self._out is not None:
            check_output(self._parameters, self._out)
        self._live_model = given_path(values["live_model"])
        if self._live_model is not None:
            check_output_file(self._live_model, lambda _: True)
            if self._live_model.exists():
                read_model(self._live_model)  # no other file may be replaced
            self._remove_live_model()
        self._period: float = values["solve_period"]
        self._save_time: float = values["save_time"]
        self._sensors = SensorTopics(
            node,
            resolve_topics(node, topics, sys.argv),
            self._parameters.model,
            values["settle"],
            values["queue_depth"],
        )
        self._requests = ServiceRequests()
        self._is_enabled = True
        self._identification: OnlineIdentification | None = None
        self._has_assumed_contacts = False
        self._selected: SelectedTopics | None = None
        self._unused: set[str] = set()
        self._receiver = MessageReceiver()
        self._taken = time.monotonic()  # when the newest message used was taken
        self._topics = EstimateTopics(node, self._parameters)
        self._markers = InertiaMarkers(node, self._parameters, log.frame_prefix)
        self._described = float("-inf")
        self._solves = 0
        self._newest: OnlineEstimate | None = None
        self._has_saved = False  # because a service asked for it
        self._solve_times: deque[float] = deque(maxlen=RECENT_SOLVES)  # s
        self._diagnostics = IdentifierDiagnostics()
        self._fault_reporter, self._change_reporter = FaultReporter(node), FaultReporter(node)
        for service, work in (
            ("reset", self._reset),
            ("solve", self._solve_on_request),
            ("save", self._save),
            ("tare", self._tare),
        ):
            node.create_service(Trigger, f"~/{service}", self._requests.handler(work))
        node.create_service(SetBool, "~/enable", self._enable)
        watch(node, PARAMETERS, self._change_parameters)
        self._status_publisher = StatusPublisher(node, self._diagnostics.statuses, model.name)

    def run(self, stop: Event) -> None:
        """Identify until stopped, save the final estimate if wanted, and print counts as JSON.

        Without an estimate at the end, this raises an EstimateError that states the reason.
        """
        try:
            with self._receiver:
                self._await_topics(stop)
                if self._identification is not None:
                    self._identify(stop)
        except BaseException:
            self._save_after_error()
            raise
        finally:
            self._requests.ended.set()
            if self._identification is not None:
                self._identification.close()
        if self._newest is None:
            raise EstimateError(f"stopped without an estimate: {self._diagnostics.reason}", "E811")

    def _await_topics(self, stop: Event) -> None:
        began = time.monotonic()
        while not stop.is_set() and self._identification is None:
            self._update_topics()
            missing = self._sensors.missing()
            if time.monotonic() - began >= MISSING_PERIOD and self._identification is None:
                self._fault_reporter.update(missing)
            self._diagnostics.set_waiting(self._sensors.found, missing.values())
            self._requests.perform()
            stop.wait(DISCOVERY_PERIOD)
        if self._identification is not None:
            self._fault_reporter.update({})

    def _update_topics(self) -> None:
        """Start identification as soon as the graph has the robot's topics.

        Topics that appear later restart it as long as there is no estimate to lose. Wrench sensors
        always do if contacts were only assumed, because they say far more.
        """
        selected = self._sensors.find()
        if selected is None or selected == self._selected:
            return
        names = ", ".join(topic.name for topic in selected.all)
        if self._identification is not None:
            measures_contacts = self._has_assumed_contacts and bool(selected.wrenches)
            if self._newest is not None and not measures_contacts:
                self._report_unused(selected)
                return
            self._node.get_logger().warning(f"new topics appeared; restarting with {names}")
            self._identification.close()
            self._forget_estimate()
            if measures_contacts:
                self._name_contacts(replace(self._initial_state.options, contact=()))
                self._has_assumed_contacts = False
        self._identification = OnlineIdentification(self._initial_state, selected, self._pace)
        self._receiver.subscribe(())  # some of them may be closed
        self._receiver.subscribe(self._sensors.subscriptions(selected))
        self._selected = selected
        self._node.get_logger().info(f"identifying {self._parameters.model.name} from {names}")

    def _assume_contacts(self) -> None:
        """Start anew with unknown forces where a robot without wrench sensors seems to stand."""
        before, selected = self._live, self._selected
        if not before.standing_on or selected is None:
            return
        options = self._initial_state.options
        self._name_contacts(naming_contacts(options, before.standing_on, "live topics"))
        self._has_assumed_contacts = True
        before.close()
        self._identification = OnlineIdentification(self._initial_state, selected, self._pace)
        for topic, payload in before.streams.messages():
            self._live.intake.feed(topic, payload)

    def _name_contacts(self, options: IdentifyOptions) -> None:
        self._initial_state = InitialState.of(self._model, options, self._initial_state.tares)
        self._parameters = self._initial_state.problem.parameters

    def _report_unused(self, selected: SelectedTopics) -> None:
        """Warn once of each topic that appeared too late, and unsubscribe from it."""
        used = () if self._selected is None else self._selected.all
        new = {topic.name for topic in selected.all if topic not in used} - self._unused
        if new:
            self._unused |= new
            self._node.get_logger().warning(
                f"{', '.join(sorted(new))} appeared late and is ignored: using it would discard "
                "all data so far; call ~/reset to restart with it"
            )
        self._sensors.release()

    def _identify(self, stop: Event) -> None:
        due = time.monotonic() + self._period
        discovered = time.monotonic()
        while not stop.is_set():
            count = self._receive()
            self._live.advance()
            self._assume_contacts()
            self._requests.perform()
            now = time.monotonic()
            if now - discovered >= LATER_DISCOVERY_PERIOD:
                self._update_topics()
                for _, subscription in self._receiver.subscriptions:
                    subscription.match_publishers()
                discovered = now
            if now >= due:
                faults = self._diagnostics.update_streams(self._live, self._setup_faults())
                if faults is not None:
                    self._fault_reporter.update(faults)
                if self._is_enabled and self._live.has_news:
                    self._solve()
                # A machine that cannot keep the period also needs time for the topics.
                spent = time.monotonic() - now
                due = max(due + self._period, now + 1.5 * spent)
            elif not count:
                time.sleep(POLL)
        self._finish()

    def _setup_faults(self) -> dict[str, str]:
        """Return why the topics in use cannot give an estimate; empty once there is one."""
        if not self._live.setup_fault or self._newest is not None:
            return {}
        # Wrench sensors may be ignored for their frames.
        return {**self._sensors.missing(), CONTACTS: self._live.setup_fault}

    @property
    def _live(self) -> OnlineIdentification:
        """The identification, once topics have been found."""
        if self._identification is None:
            missing = "; ".join(self._sensors.missing().values())
            raise EstimateError(f"no sensor topics yet; {missing or 'try again soon'}", "E812")
        return self._identification

    def _receive(self, until: int = FOREVER) -> int:
        """Take a batch of messages per topic; return how many arrived up to a time, ns."""
        taken, messages = self._receiver.take()
        if messages:
            self._taken = taken
        for topic, message in messages:
            if self._is_enabled:
                self._live.intake.feed(topic, message.payload)
        return sum(message.received <= until for _, message in messages)

    def _receive_until(self, until: int, timeout: float = float("inf")) -> bool:
        """Take all messages that had arrived at a time, ns; return False after ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while self._receive(until):
            self._live.advance()  # the buffers hold the messages of some seconds
            if time.monotonic() >= deadline:
                return False
        return True

    def _solve(self, *, exactly: bool = False) -> OnlineEstimate | None:
        began = time.monotonic()
        try:
            estimate = self._live.solve(exactly=exactly)
        except SymbidError as error:
            self._diagnostics.set_error(str(error))
            if exactly:
                raise
            return None
        spent = time.monotonic() - began
        known = None
        if estimate is not None:
            known = robot_uncertainty(estimate, self._live.intake.posture())
        self._diagnostics.set_estimate(self._live, estimate, known, spent, self._taken)
        if estimate is not None:
            change = estimate.change
            self._change_reporter.update({} if change is None else {CHANGE: str(change)})
            self._solves += 1
            self._newest = estimate
            if not exactly:
                self._solve_times.append(spent)
            self._publish(estimate, describe=exactly)
            if self._live_model is not None and known is not None:
                self._write_live_model(estimate, known, self._live_model)
        return estimate

    def _solve_exactly(self) -> OnlineEstimate:
        """Return the estimate from all data that have arrived."""
        self._receive_until(time.time_ns())
        estimate = self._solve(exactly=True)
        if estimate is None:
            raise EstimateError("too few data for an estimate; wait, or move the robot", "E813")
        return estimate

    def _publish(self, newest: OnlineEstimate, *, describe: bool) -> None:
        estimate = newest.found.estimate
        self._topics.publish(estimate, Time(nanoseconds=newest.until).to_msg())
        posture = self._live.intake.posture()
        self._markers.publish(estimate, newest.change or newest.followed, posture)
        now = time.monotonic()
        if describe or now - self._described >= DESCRIPTION_PERIOD:
            self._topics.describe(export_urdf(estimate, newest.parameters))
            self._described = now

    def _write_live_model(
        self, estimate: OnlineEstimate, known: RobotUncertainty, path: Path
    ) -> None:
        try:
            write_model(path, candidate_model(estimate, known), known.time)
        except SymbidError as error:  # identification does not depend on it
            self._node.get_logger().warning(str(error), throttle_duration_sec=WARNING_PERIOD)

    def _remove_live_model(self) -> None:
        """Remove the file of an earlier run or of discarded data."""
        if self._live_model is not None:
            self._live_model.unlink(missing_ok=True)

    def _solve_on_request(self) -> str:
        return _summarize(self._solve_exactly())

    def _save(self) -> str:
        if self._out is None:
            raise ParameterError(
                "parameter out: empty; start the identifier with -p out:=FOLDER", "E801"
            )
        estimate = self._solve_exactly()
        with collected_warnings() as warnings:
            text = self._write(estimate, self._out)
        self._has_saved = True
        alarms = (f"alarm: {alarm}" for alarm in self._alarms_of(estimate))
        return "; ".join([text, *warnings, *alarms])

    def _write(self, estimate: OnlineEstimate, out: Path) -> str:
        start = self._initial_state
        provenance = Provenance.now(start.files, start.options, command_line())
        found = estimate.found
        found = replace(found, estimate=replace(found.estimate, provenance=provenance))
        write_identification(found, estimate.parameters, out)
        return f"{_summarize(estimate)}, written to {out}"

    def _tare(self) -> str:
        """Record what the unloaded wrench sensors read; an estimate does not use these messages."""
        if not self._initial_state.options.sensor_error_kinds:
            raise ParameterError(
                "parameter sensor_errors: none, which a tare needs; restart the identifier with "
                "-p sensor_errors:=[typical]",
                "E801",
            )
        live, selected = self._live, self._selected
        assert selected is not None  # it is found together with the identification
        self._receive_until(time.time_ns())
        recording = TareRecording(selected, live.intake.checks)
        deadline = time.monotonic() + TARE_TIME
        while time.monotonic() < deadline and not self._requests.ended.is_set():
            _, messages = self._receiver.take()
            for topic, message in messages:
                recording.add(topic, message.payload)
            if not messages:
                time.sleep(POLL)
        tares = recording.tares()
        known = self._initial_state.tares
        self._initial_state = replace(self._initial_state, tares={**known, **tares})
        text = f"{', '.join(sorted(tares))} tared; {live.set_tares(tares)}"
        self._node.get_logger().info(text)
        return text

    def _forget_estimate(self) -> None:
        self._newest = None
        self._remove_live_model()
        self._markers.clear()

    def _reset(self) -> str:
        self._live.reset()
        self._forget_estimate()
        text = "all data are discarded; prior and tares remain"
        if self._has_saved:
            text += f"; the next save or the end replaces the result in {self._out}: copy it first"
        return text

    def _finish(self) -> None:
        """Process all received messages, save the final estimate and print counts as JSON."""
        with collected_warnings() as warnings:
            if not self._receive_until(time.time_ns(), max(LONGEST_DRAIN, self._save_time)):
                logger.warning(
                    "reading takes longer than `save_time`: the messages of the last %.1f s are "
                    "not used",
                    time.monotonic() - self._taken,
                )
            buffers = self._live.streams.buffers
            summary: dict[str, object] = {
                "received": {topic.name: buffer.received for topic, buffer in buffers.items()},
                "missing": {topic.name: buffer.missing for topic, buffer in buffers.items()},
            }
            final = self._newest if self._out is None else self._final_estimate()
            if final is not None and self._out is not None:
                summary["saved"] = self._write(final, self._out)
        if final is not None:
            alarms = self._alarms_of(final)
            summary["alarms"] = alarms
            if not alarms and not self._is_judged(final):
                warnings.append(TOO_EARLY_TO_FIT)
        summary |= {"warnings": warnings, "solves": self._solves}
        print(json.dumps(summary), flush=True)

    def _alarms_of(self, estimate: OnlineEstimate) -> tuple[str, ...]:
        """Return the alarms that are not too early."""
        is_judged = self._is_judged(estimate) or estimate.is_contradicted
        return estimate.alarms if is_judged else ()

    def _is_judged(self, estimate: OnlineEstimate) -> bool:
        """Return whether it is known if the model explains the data: an exact estimate tells."""
        return estimate.found.estimate.verdict is not None or self._live.can_tell_fit

    def _final_estimate(self) -> OnlineEstimate | None:
        """Return the estimate from all data, as exact as `save_time` allows.

        Without time for any, it is the newest one. None if there are too few data or they do not
        suit the robot; the diagnostics state why.
        """
        newest, needed = self._newest, min(self._solve_times, default=0.0)
        if newest is not None and needed > self._save_time:
            read = self._live.streams.joints.newest or newest.until
            logger.warning(
                "an estimate takes longer than `save_time`: saving the newest one, which lacks "
                "the last %.1f s of the data",
                max(read - newest.until, 0) * 1e-9,
            )
            return newest
        left = self._save_time - EXACT_COST * needed
        exactly = newest is None or (left >= 0.0 and self._live.hurry(left))
        try:
            final = self._solve(exactly=exactly)
        except SymbidError:
            final = None
        if final is None:
            if newest is not None:
                logger.warning("%s; saving the previous estimate", self._diagnostics.reason)
            return newest
        if not exactly:
            logger.warning(
                "an exact estimate takes longer than `save_time`: the saved one is of all data, "
                "with the window length and joint terms of an earlier choice"
            )
        return final

    def _save_after_error(self) -> None:
        """Save the newest estimate while an exception is ending the node."""
        if self._out is None or self._newest is None:
            return
        try:
            self._node.get_logger().error(self._write(self._newest, self._out))
        except Exception as error:
            self._node.get_logger().error(f"{self._out}: estimate not saved: {error}")

    def _change_parameters(self, live: dict[str, Any]) -> None:
        self._period = live["solve_period"]
        # The identifying thread makes the change, because it may be processing blocks.
        self._requests.put(lambda: self._set_memory(live["memory"]))

    def _set_memory(self, memory: float) -> str:
        self._pace = replace(self._pace, memory=memory or float("inf"))
        if self._identification is not None:
            self._identification.set_memory(self._pace.memory)
        return f"memory is {memory:g} s" if memory else "data are never forgotten"

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data and not self._is_enabled and self._identification is not None:
            self._identification.streams.expect_pause()
        self._is_enabled = bool(request.data)
        self._diagnostics.set_enabled(self._is_enabled)
        response.success = True
        response.message = "identifying" if request.data else "messages are ignored"
        return response


def _read_tares(
    options: IdentifyOptions, model: RobotModel, topics: TopicSelection
) -> dict[str, Tare]:
    """Return the tares in the bags that the options name."""
    bags = [source for source in options.tare if isinstance(source, Path)]
    return read_tare(bag_log(bags, model, topics)) if bags else {}


def _summarize(newest: OnlineEstimate) -> str:
    estimate = newest.found.estimate
    return f"{estimate.describe_determined()} determined by {estimate.samples} rows"
