"""Stamps and silence of live topics: what keeps their messages from being used."""

import time
from dataclasses import dataclass, field

from symbid_ros.online.live_streams import LiveStreams, TopicBuffer

SILENT = 2.0  # s without a message


@dataclass(frozen=True)
class _Counts:
    received: int = 0
    unstamped: int = 0
    stale: int = 0
    newest: int | None = None
    is_stale: bool = False


@dataclass
class StreamFaults:
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
