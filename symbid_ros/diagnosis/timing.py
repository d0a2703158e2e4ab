"""Checks the stamps of a topic slice by slice in constant memory."""

from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import IntArray
from symbid_ros.diagnosis.findings import FaultSpan, Finding, Kind, Severity, StreamFigures
from symbid_ros.signals.defects import Intervals
from symbid_ros.signals.segments import SHORTEST_PAUSE

# Stamps whose periods vary more are arrival times instead of sampling times.
JITTER = 0.25
# Hz; below it the averaging windows are too long for fast motion. A driver may be slower by 2 %.
SLOWEST, TOLERANCE = 50.0, 0.98
# A recorder subscribes to topics one by one; larger differences of start or end, s, are faults.
MAX_OFFSET = 1.0
# A topic with a larger share of missing messages is unusable.
MOST_MISSING = 0.5
# Number of gaps whose times are kept.
GAPS_KEPT = 200


@dataclass
class TimingCheck:
    """Statistics of the stamps of one topic.

    Attributes
    ----------
    topic : str
    first, last : int or None
        First and last stamp, ns.
    messages, gaps, missing : int
        See :class:`StreamFigures`.
    longest : int
        Longest period, ns.
    spans : list of FaultSpan
        The longest gaps.
    """

    topic: str
    first: int | None = None
    last: int | None = None
    messages: int = 0
    gaps: int = 0
    missing: int = 0
    longest: int = 0
    spans: list[FaultSpan] = field(default_factory=list)
    _recording: int = 0
    _paused: int = 0  # between recordings, ns
    _ends: dict[int, tuple[int, int]] = field(default_factory=dict)  # recording and last of parts
    _periods: dict[int, list[int]] = field(default_factory=dict)  # of parts
    _deviations: float = 0.0
    _steps: int = 0

    def add(self, stamps: IntArray, recording: int = 0, part: int = 0) -> None:
        """Add the stamps (N,), ns, of the next slice, in any order.

        Messages that name different joints are parts of a topic, each with a period of its own.
        """
        self.messages += len(stamps)
        if not len(stamps):
            return
        if self.last is not None and recording != self._recording:
            self._paused += int(stamps.min()) - self.last
        self._recording = recording
        before, last = self._ends.get(part, (recording, None))
        if last is not None and before == recording:
            stamps = np.append(last, stamps[stamps > last])
        found = Intervals.between(stamps)
        first, last = int(found.stamps[0]), int(found.stamps[-1])
        self._ends[part] = recording, last
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)
        if not found.period:
            return
        self._periods.setdefault(part, []).append(found.period)
        self.gaps += int(np.count_nonzero(found.missing))
        self.missing += int(found.missing.sum())
        steps = found.steps
        self.longest = max(self.longest, int(steps.max()))
        self._keep_gaps(found)
        regular = steps[2 * steps < 3 * found.period] / found.period - 1
        self._deviations += float(np.sum(regular**2))
        self._steps += len(regular)

    def _keep_gaps(self, found: Intervals) -> None:
        gaps = np.flatnonzero(found.missing)
        longest = gaps[np.argsort(-found.steps[gaps], kind="stable")[:GAPS_KEPT]]
        self.spans += [
            FaultSpan(Kind.GAP, self.topic, int(found.stamps[one]), int(found.stamps[one + 1]))
            for one in longest.tolist()
        ]
        if len(self.spans) > GAPS_KEPT:
            self.spans = sorted(self.spans, key=lambda one: one.start - one.stop)[:GAPS_KEPT]

    @property
    def period(self) -> float:
        """Median of the slices' periods, of the slowest part, s; 0 below two messages."""
        medians = [float(np.median(each)) for each in self._periods.values()]
        return max(medians, default=0.0) * 1e-9

    @property
    def figures(self) -> StreamFigures:
        """Statistics of the topic."""
        first, last = self.first or 0, self.last or 0
        return StreamFigures(
            topic=self.topic,
            messages=self.messages,
            duration_s=(last - first - self._paused) * 1e-9,
            rate_hz=1 / self.period if self.period else 0.0,
            jitter=float(np.sqrt(self._deviations / max(self._steps, 1))),
            gaps=self.gaps,
            missing=self.missing,
            longest_gap_s=self.longest * 1e-9,
        )

    def findings(self, first: int, last: int) -> list[Finding]:
        """Return the findings, given the start and end of the recording, ns."""
        figures, found = self.figures, []
        if self.missing:
            share = self.missing / (self.missing + self.messages)
            # A share of nearly all would be rounded to all.
            percent = f"{100 * share:.2g}" if share < 0.995 else "over 99"
            pause = ""
            if self.longest >= SHORTEST_PAUSE:
                pause = "; give recordings with a pause between them as several bags or logs"
            gaps = "1 gap, which" if self.gaps == 1 else f"{self.gaps} gaps, the longest"
            found.append(
                Finding(
                    Kind.GAP,
                    self.topic,
                    Severity.UNUSABLE if share > MOST_MISSING else Severity.WARNING,
                    f"{self.topic}: {self.missing} messages ({percent} %) are missing in "
                    f"{gaps} lasts {figures.longest_gap_s:.3g} s; record "
                    f"closer to the sensor, with a deeper queue{pause}",
                    {
                        "gaps": self.gaps,
                        "missing": self.missing,
                        "longest_gap_s": figures.longest_gap_s,
                    },
                )
            )
        late = max((self.first or first) - first, 0) * 1e-9
        early = max(last - (self.last or last), 0) * 1e-9
        if max(late, early) > max(MAX_OFFSET, 5 * self.period):
            found.append(
                Finding(
                    Kind.GAP,
                    self.topic,
                    Severity.WARNING,
                    f"{self.topic}: begins {late:.3g} s after and ends {early:.3g} s before the "
                    "other topics; only the time that all topics have in common is used; start and "
                    "stop all together",
                    {"late_s": late, "early_s": early},
                )
            )
        slow, unsteady = 0 < figures.rate_hz < TOLERANCE * SLOWEST, figures.jitter > JITTER
        if slow or unsteady:
            what = (
                f"comes at {figures.rate_hz:.3g} Hz, below {SLOWEST:g} Hz; raise the driver's rate"
                if slow
                else f"has periods that vary by {100 * figures.jitter:.0f} %, more than "
                f"{100 * JITTER:.0f} %; stamp messages when they are sampled, not when they arrive"
            )
            found.append(
                Finding(
                    Kind.RATE,
                    self.topic,
                    Severity.WARNING,
                    f"{self.topic}: {what}",
                    {"rate_hz": figures.rate_hz, "jitter": figures.jitter},
                )
            )
        return found
