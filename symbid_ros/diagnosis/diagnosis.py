"""The verdict on a log."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from symbid_ros.diagnosis.finding import Finding, Severity, json_figures


@dataclass(frozen=True)
class StreamFigures:
    """One topic in numbers.

    Attributes
    ----------
    topic : str
    messages : int
        Stamped in the part of the log that was judged.
    duration_s : float
        From the first stamp to the last.
    rate_hz : float
        Of the median period; 0 below two messages.
    jitter : float
        Standard deviation of the periods that are no gaps, as a share of their median.
    gaps, missing : int
        Periods 1.5 times too long and more, and the messages that would fill them.
    longest_gap_s : float
        Longest period.
    """

    topic: str
    messages: int
    duration_s: float
    rate_hz: float
    jitter: float
    gaps: int
    missing: int
    longest_gap_s: float


@dataclass(frozen=True)
class Diagnosis:
    """What a log is worth.

    Attributes
    ----------
    source : str
        Names of the bags.
    streams : tuple of StreamFigures
        Joint states first.
    findings : tuple of Finding
        What is wrong, worst first.
    figures : mapping of str to float
        What the checks against the model measured, units in the names.
    left_out : tuple of str
        Checks that could not be made, and why.
    """

    source: str
    streams: tuple[StreamFigures, ...]
    findings: tuple[Finding, ...]
    figures: Mapping[str, float]
    left_out: tuple[str, ...]

    @property
    def severity(self) -> Severity:
        """The worst of the findings'."""
        return max((one.severity for one in self.findings), default=Severity.CLEAN)

    def of(self, topic: str) -> tuple[Finding, ...]:
        """Return what is wrong with one topic; with an empty name, with all of them together."""
        return tuple(one for one in self.findings if one.stream == topic)

    def as_dict(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        return {
            "source": self.source,
            "severity": self.severity.name.lower(),
            "streams": [json_figures(asdict(stream)) for stream in self.streams],
            "findings": [finding.as_dict() for finding in self.findings],
            "figures": json_figures(self.figures),
            "left_out": list(self.left_out),
        }
