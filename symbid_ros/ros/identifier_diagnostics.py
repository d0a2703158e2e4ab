"""The status of an online identifier on ``/diagnostics``, with the faults of its topics."""

import math
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.estimation.change import LinkChange
from symbid_ros.learning.candidate import RobotUncertainty
from symbid_ros.messages.topics import Topic
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.online.identification import OnlineIdentification
from symbid_ros.online.live_streams import LiveStreams, TopicBuffer
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.report.formatting import counted
from symbid_ros.ros.estimate_topics import estimate_status
from symbid_ros.ros.monitor_messages import DISABLED, TOO_EARLY_TO_FIT
from symbid_ros.ros.reporting import ERROR, OK, WARN, NodeStatus
from symbid_ros.signals.calibrating_rows import CalibratingRows

SILENCE = 2.0  # s without a message until a topic is reported
RATE_PERIOD = 0.5  # s; shortest time over which rates are computed
IN_ORDER = "in order"
TOO_FEW = "too few data for an estimate"
TOO_EARLY = "too early to detect a change"


@dataclass(frozen=True)
class _Counts:
    received: int = 0
    unstamped: int = 0
    stale: int = 0
    newest: int | None = None
    is_stale: bool = False


def _sensor_statuses(outcome: OnlineEstimate) -> tuple[NodeStatus, ...]:
    """Return the status with the estimated sensor errors, if there are any."""
    found, rows = outcome.found, outcome.found.rows
    if not isinstance(rows, CalibratingRows) or found.factor is None:
        return ()
    names = rows.errors.names
    first = len(found.unknowns) - len(names)
    values: dict[str, object] = {}
    stds = np.linalg.norm(found.factor[first:], axis=1)
    for name, value, std in zip(names, found.unknowns[first:], stds, strict=True):
        values |= {name: f"{value:.6g}", f"{name}/std": f"{std:.3g}"}
    return (NodeStatus("sensors", OK, f"{len(names)} sensor errors estimated", values),)


@dataclass
class StreamMonitor:
    """Finds topics that are silent or whose messages are all unusable, from their message counts.

    Invalid stamps remain a topic's fault when it falls silent, as do messages of another robot.
    """

    _last: dict[str, _Counts] = field(default_factory=dict)
    _received: dict[str, float] = field(default_factory=dict)
    _stamp_faults: dict[str, str] = field(default_factory=dict)
    # Number of messages that were dropped when the last usable one arrived.
    _dropped: dict[str, int] = field(default_factory=dict)

    def check(self, streams: LiveStreams, checks: Mapping[Topic, MessageCheck]) -> dict[str, str]:
        """Return the faults since the last check, by topic."""
        faults: dict[str, str] = {}
        now = time.monotonic()
        for topic, buffer in streams.buffers.items():
            name = topic.name
            last = self._last.get(name, _Counts())
            new = buffer.received - last.received
            is_stale = new > 0 and buffer.stale - last.stale == new
            self._last[name] = _Counts(
                buffer.received, buffer.unstamped, buffer.stale, buffer.newest, is_stale
            )
            if new:
                self._received[name] = now
                # After a jump of the clock, older messages are stale for one check only.
                is_lasting = is_stale and last.is_stale
                fault = _stamp_fault(buffer, last, streams.clock if is_lasting else None)
                self._stamp_faults[name] = fault
                self._dropped[name] = checks[topic].dropped
            elif (dropped := checks[topic].dropped) > self._dropped.get(name, 0):
                reason = checks[topic].reason.removeprefix(f"{name}: ")
                fault = f"none of {dropped - self._dropped.get(name, 0)} messages is used: {reason}"
            elif not (fault := self._stamp_faults.get(name, "")):
                is_silent = now - self._received.setdefault(name, now) > SILENCE
                fault = f"no message for over {SILENCE:g} s; check its driver" if is_silent else ""
            if fault:
                faults[name] = f"{name}: {fault}"
        return faults

    def pause(self) -> None:
        """Expect no messages until the next check."""
        self._received.clear()


def _stamp_fault(buffer: TopicBuffer, last: _Counts, clock: int | None) -> str:
    """Return the fault of new stamps; ``clock``, ns, is given if they are from another time."""
    unstamped = buffer.unstamped - last.unstamped
    # A single one among others is where a simulation or a looping bag starts again at zero.
    if unstamped > 1 or 0 < unstamped == buffer.received - last.received:
        return (
            f"header.stamp is zero in {counted(buffer.unstamped, 'message')}, ignored; make the "
            "driver set the stamp (with use_sim_time it needs /clock)"
        )
    if clock is not None:
        return (
            f"stamps are at {buffer.newest_stale * 1e-9:.3f} s, other topics at "
            f"{clock * 1e-9:.3f} s, and these messages are ignored; synchronise the clocks"
        )
    if buffer.newest is not None and buffer.newest == last.newest:
        return (
            f"header.stamp stays at {buffer.newest * 1e-9:.3f} s; make the driver set the stamp of "
            "each message"
        )
    return ""


class IdentifierDiagnostics:
    """Statuses that the identifying thread sets and the publishing thread reads.

    Each status is replaced as a whole, so no lock is needed.
    """

    def __init__(self) -> None:
        self._is_enabled = True
        self._has_tried = False  # to make an estimate
        self._estimate = NodeStatus("estimate", WARN, "no estimate yet")
        self._streams = NodeStatus("streams", WARN, "no sensor topics yet")
        self._change = NodeStatus("change", OK, TOO_EARLY)
        self._sensors: tuple[NodeStatus, ...] = ()
        self._counts: dict[str, int] = {}
        self._dropped: dict[str, int] = {}
        self._monitor = StreamMonitor()
        self._updated = self._solved = self._taken = time.monotonic()
        self._age = float("nan")  # of the newest estimate when its messages were taken, s

    def statuses(self) -> Sequence[NodeStatus]:
        """Return the current statuses."""
        estimate, streams = self._estimate, self._streams
        now = time.monotonic()
        values = {**estimate.values, "since_solved": f"{now - self._solved:.2f}"}
        if "age" in values:  # it grows during a solve and while no data arrive
            values["age"] = f"{self._age + now - self._taken:.3f}"
        estimate = replace(estimate, values=values)
        if not self._is_enabled:
            estimate = replace(estimate, level=OK, message=DISABLED)
            streams = replace(streams, level=OK, message=DISABLED)
        return (
            estimate,
            streams,
            self._change,
            *self._sensors,
        )

    def set_waiting(self, found: Iterable[Topic], missing: Iterable[str] = ()) -> None:
        """Set the topics found so far, and why others are missing."""
        names = ", ".join(sorted(topic.name for topic in found))
        message = f"waiting for sensor topics, found {names}" if names else "no sensor topics yet"
        self._streams = NodeStatus("streams", WARN, "; ".join([message, *missing]))

    @property
    def reason(self) -> str:
        """Why there is no estimate: the last solver error, and what stops further data."""
        reasons = [self._estimate.message] if self._has_tried else []
        if not self._is_enabled:
            reasons.append(DISABLED)
        elif self._streams.message != IN_ORDER:
            reasons.append(self._streams.message)
        return "; ".join(reasons) or TOO_FEW

    def set_enabled(self, is_enabled: bool) -> None:
        """Set whether messages are used."""
        self._is_enabled = is_enabled

    def set_error(self, message: str) -> None:
        """Set why solving failed."""
        self._has_tried = True
        self._estimate = NodeStatus("estimate", ERROR, message)

    def set_estimate(
        self,
        live: OnlineIdentification,
        outcome: OnlineEstimate | None,
        known: RobotUncertainty | None,
        solve_time: float,
        taken: float,
    ) -> None:
        """Set the newest estimate, or None for too few data, and its computing time, s.

        ``known`` is what the estimate knows of the whole robot. ``taken`` is when the newest
        message was taken from its topic, s of the monotonic clock.
        """
        self._solved = time.monotonic()
        self._has_tried = True
        if outcome is None:
            self._estimate = NodeStatus("estimate", WARN, TOO_FEW)
            return
        newest, self._taken = live.streams.joints.newest, taken
        self._age = 0.0 if newest is None else max((newest - outcome.until) * 1e-9, 0.0)
        # A warning all the same: no controller may use a model that is not yet judged.
        is_judged = live.can_tell_fit or (outcome.is_contradicted and bool(outcome.alarms))
        alarms = outcome.alarms if is_judged or not outcome.alarms else (TOO_EARLY_TO_FIT,)
        status = self._estimate_status(outcome, alarms, known, solve_time)
        if status.level == OK and not is_judged:
            status = replace(status, message=TOO_EARLY_TO_FIT)
        self._estimate = status
        self._sensors = _sensor_statuses(outcome)
        values = {"evidence": f"{live.evidence:.1f}"}
        change = outcome.change or outcome.followed
        if change is None:
            message = "no change" if live.can_tell_change else TOO_EARLY
            self._change = NodeStatus("change", OK, message, values)
        else:
            suspect, *others = change.suspects
            alternatives = ", ".join(other.subject for other in others)
            values["since"] = f"{change.since * 1e-9:.3f}"
            if isinstance(suspect, LinkChange):
                values |= {
                    "link": suspect.link,
                    "link/alternatives": alternatives,
                    "mass": f"{suspect.phi[0]:.4f}",
                    "mass/std": f"{suspect.std[0]:.4f}",
                }
            else:
                values |= {"sensor": suspect.subject, "sensor/alternatives": alternatives}
                numbers = zip(suspect.sensor.names, suspect.error, suspect.std, strict=True)
                for name, error, std in numbers:
                    values |= {name: f"{error:.6g}", f"{name}/std": f"{std:.2g}"}
            is_followed = outcome.change is None
            message = f"{change}; the estimate is of later data" if is_followed else str(change)
            self._change = NodeStatus("change", OK if is_followed else WARN, message, values)

    def _estimate_status(
        self,
        outcome: OnlineEstimate,
        alarms: Sequence[str],
        known: RobotUncertainty | None,
        solve_time: float,
    ) -> NodeStatus:
        details = {
            "window": f"{outcome.window:g}",
            "age": f"{self._age:.3f}",
            "data_time": f"{outcome.until * 1e-9:.3f}",
            "solve_time": f"{solve_time:.3f}",
        }
        if known is not None:
            details |= {
                "mass": f"{known.mass:.4f}",
                "mass/std": f"{known.mass_std:.6f}",
                "com/std": f"{known.com_std:.6f}",
            }
        return estimate_status(outcome.found.estimate, alarms, details)

    def update_streams(
        self, live: OnlineIdentification, setup_faults: Mapping[str, str]
    ) -> dict[str, str] | None:
        """Update the status of the topics; return their faults, or None before `RATE_PERIOD`.

        ``setup_faults`` holds, by subject, why the topics in use cannot give an estimate.
        """
        now = time.monotonic()
        elapsed = now - self._updated
        if elapsed < RATE_PERIOD:
            return None
        self._updated = now
        values: dict[str, object] = {}
        if not self._is_enabled:
            self._monitor.pause()
        faults_by_topic = {**self._monitor.check(live.streams, live.intake.checks), **setup_faults}
        for topic, buffer in live.streams.buffers.items():
            name = topic.name
            before, received = self._counts.get(name, 0), buffer.received
            self._counts[name] = received
            # A topic that was silent may have begun at any time of this interval.
            is_known = received == 0 or 0 < before <= received
            values[f"{name}/rate"] = (
                f"{(received - before) / elapsed if is_known else math.nan:.1f}"
            )
            values[f"{name}/received"] = received
            values[f"{name}/missing"] = buffer.missing
            values[f"{name}/pauses"] = buffer.pauses
            values[f"{name}/late"] = buffer.late
            values[f"{name}/disordered"] = buffer.disordered
            values[f"{name}/dropped"] = live.intake.checks[topic].dropped
            values[f"{name}/unstamped"] = buffer.unstamped
        values |= {"clock_jumps": live.intake.clock_jumps, "stale": live.streams.stale}
        values["lost_blocks"] = live.lost_blocks
        faults = [*faults_by_topic.values(), *list(live.faults)[-1:]]
        faults += self._newly_dropped(live, faults_by_topic)
        level = WARN if faults else OK
        self._streams = NodeStatus("streams", level, "; ".join(faults) or IN_ORDER, values)
        return faults_by_topic

    def _newly_dropped(self, live: OnlineIdentification, reported: Collection[str]) -> list[str]:
        """Return the number of messages dropped since the last update, and why.

        Topics with a reported fault are left out.
        """
        dropped = []
        for topic, check in live.intake.checks.items():
            new = check.dropped - self._dropped.get(topic.name, 0)
            self._dropped[topic.name] = check.dropped
            if new and topic.name not in reported:
                dropped.append(f"{new} messages dropped, the last one because {check.reason}")
        return dropped
