"""The status of an online identifier on ``/diagnostics``, with the faults of its topics."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from symbid_ros.messages.topics import Topic
from symbid_ros.online.identification import OnlineEstimate, OnlineIdentification
from symbid_ros.online.live_streams import LiveStreams, TopicBuffer
from symbid_ros.ros.diagnostics import ERROR, OK, WARN, NodeStatus
from symbid_ros.ros.estimate_topics import estimate_status

SILENT = 2.0  # s without a message
# Rates are counted over this time at least, s.
LEAST_COUNTED = 0.5
IN_ORDER = "in order"


@dataclass(frozen=True)
class _Counts:
    received: int = 0
    unstamped: int = 0
    stale: int = 0
    newest: int | None = None
    is_stale: bool = False


@dataclass
class StreamMonitor:
    """Compares the counts of every topic with those of the last look."""

    _last: dict[str, _Counts] = field(default_factory=dict)
    _heard: dict[str, float] = field(default_factory=dict)

    def look(self, streams: LiveStreams) -> dict[str, str]:
        """Return what is wrong since the last look, by topic."""
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
                self._heard[name] = now
                # What is left of the time before a clock's jump is stale for a moment only.
                is_lasting = is_stale and last.is_stale
                fault = _stamp_fault(buffer, last, streams.clock if is_lasting else None)
            else:
                silent = now - self._heard.setdefault(name, now) > SILENT
                fault = f"no message for {SILENT:g} s or more; check its driver" if silent else ""
            if fault:
                faults[name] = f"{name}: {fault}"
        return faults


def _stamp_fault(buffer: TopicBuffer, last: _Counts, clock: int | None) -> str:
    """Return what is wrong with new stamps; ``clock``, ns, if they are of another time."""
    if buffer.unstamped > last.unstamped:
        return (
            "header.stamp is zero; let its driver set the stamp (with use_sim_time it needs "
            "/clock). These messages are left out"
        )
    if clock is not None:
        return (
            f"stamped at {buffer.newest_stale * 1e-9:.3f} s while other topics are at "
            f"{clock * 1e-9:.3f} s; synchronise the clocks. These messages are left out"
        )
    if buffer.newest is not None and buffer.newest == last.newest:
        return (
            f"header.stamp stands still at {buffer.newest * 1e-9:.3f} s; let its driver set the "
            "stamp of each message"
        )
    return ""


class IdentifierDiagnostics:
    """Statuses that the identifying thread sets and the publishing one reads.

    Each is replaced as a whole, so that no lock is needed.
    """

    def __init__(self) -> None:
        self._is_enabled = True
        self._estimate = NodeStatus("estimate", WARN, "no estimate yet")
        self._streams = NodeStatus("streams", WARN, "no sensor topics yet")
        self._change = NodeStatus("change", OK, "too early to tell a change")
        self._counts: dict[str, int] = {}
        self._dropped: dict[str, int] = {}
        self._faults = StreamMonitor()
        self._counted = self._solved = time.monotonic()

    def look(self) -> Sequence[NodeStatus]:
        """Return the statuses of this moment."""
        estimate = self._estimate
        if not self._is_enabled:
            estimate = NodeStatus("estimate", WARN, "not enabled", estimate.values)
        silence = time.monotonic() - self._solved
        return (
            NodeStatus(
                estimate.part,
                estimate.level,
                estimate.message,
                {**estimate.values, "since_solved": f"{silence:.2f}"},
            ),
            self._streams,
            self._change,
        )

    def waiting(self, found: Iterable[Topic], missing: Iterable[str] = ()) -> None:
        """Take which topics have turned up so far, and what keeps the others."""
        names = ", ".join(sorted(topic.name for topic in found))
        message = f"waiting for sensor topics, found {names}" if names else "no sensor topics yet"
        self._streams = NodeStatus("streams", WARN, "; ".join([message, *missing]))

    @property
    def obstacle(self) -> str:
        """What kept it from an estimate."""
        if self._streams.message != IN_ORDER:
            return self._streams.message
        return self._estimate.message

    def enabled(self, is_enabled: bool) -> None:
        """Take whether messages are read at all."""
        self._is_enabled = is_enabled

    def refused(self, reason: str) -> None:
        """Take why there is no estimate."""
        self._estimate = NodeStatus("estimate", ERROR, reason)

    def solved(
        self, live: OnlineIdentification, outcome: OnlineEstimate | None, seconds: float
    ) -> None:
        """Take an estimate and how long it took."""
        self._solved = time.monotonic()
        if outcome is None:
            self._estimate = NodeStatus("estimate", WARN, "too little has come to tell anything")
            return
        newest = live.streams.joints.newest
        age = 0.0 if newest is None else (newest - outcome.until) * 1e-9
        self._estimate = self._estimate_health(outcome, age, seconds)
        figures = {"evidence": f"{live.evidence:.1f}"}
        if outcome.change is None:
            message = "no change" if live.can_tell_change else "too early to tell a change"
            self._change = NodeStatus("change", OK, message, figures)
        else:
            suspect, *others = outcome.change.suspects
            figures |= {
                "link": suspect.link,
                "link/alternatives": ", ".join(other.link for other in others),
                "since": f"{outcome.change.since * 1e-9:.3f}",
                "mass": f"{suspect.phi[0]:.4f}",
                "mass/std": f"{suspect.std[0]:.4f}",
            }
            self._change = NodeStatus("change", WARN, str(outcome.change), figures)

    def _estimate_health(self, outcome: OnlineEstimate, age: float, seconds: float) -> NodeStatus:
        facts = {
            "window": f"{outcome.window:g}",
            "age": f"{max(age, 0.0):.3f}",
            "data_time": f"{outcome.until * 1e-9:.3f}",
            "solve_time": f"{seconds:.3f}",
        }
        return estimate_status(outcome.found.estimate, outcome.alarms, facts)

    def heard(self, live: OnlineIdentification) -> dict[str, str] | None:
        """Update the status of the topics; return their faults, or None if it is too early."""
        now = time.monotonic()
        elapsed = now - self._counted
        if elapsed < LEAST_COUNTED:
            return None
        self._counted = now
        figures: dict[str, object] = {}
        faults_by_topic = self._faults.look(live.streams)
        for topic, buffer in live.streams.buffers.items():
            name = topic.name
            new = buffer.received - self._counts.get(name, 0)
            self._counts[name] = buffer.received
            figures[f"{name}/rate"] = f"{new / elapsed:.1f}"
            figures[f"{name}/received"] = buffer.received
            figures[f"{name}/missing"] = buffer.missing
            figures[f"{name}/late"] = buffer.late
            figures[f"{name}/disordered"] = buffer.disordered
            figures[f"{name}/dropped"] = live.checks[topic].dropped
            figures[f"{name}/unstamped"] = buffer.unstamped
        figures |= {"clock_jumps": live.clock_jumps, "stale": live.streams.stale}
        figures["lost_blocks"] = live.lost_blocks
        faults = [*faults_by_topic.values(), *list(live.faults)[-1:], *self._newly_dropped(live)]
        level = WARN if faults else OK
        self._streams = NodeStatus("streams", level, "; ".join(faults) or IN_ORDER, figures)
        return faults_by_topic

    def _newly_dropped(self, live: OnlineIdentification) -> list[str]:
        """Return how many messages were dropped since the last look, and why."""
        dropped = []
        for topic, check in live.checks.items():
            new = check.dropped - self._dropped.get(topic.name, 0)
            self._dropped[topic.name] = check.dropped
            if new:
                dropped.append(f"{new} messages dropped, the last because {check.reason}")
        return dropped
