"""What is wrong with a log, one thing at a time."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum, IntEnum
from types import MappingProxyType
from typing import Any

import numpy as np


class Severity(IntEnum):
    """How bad it is; the value is the doctor's exit status."""

    CLEAN = 0
    WARNING = 1
    UNUSABLE = 2


class Kind(Enum):
    """What can be wrong; the value is a stable identifier."""

    # Of one stream by itself.
    RATE = "rate"
    GAP = "gap"
    DUPLICATE = "duplicate"
    DISORDER = "disorder"
    CLOCK_JUMP = "clock_jump"
    SILENT = "silent"
    NOT_FINITE = "not_finite"
    FROZEN = "frozen"
    SATURATED = "saturated"
    QUATERNION_NORM = "quaternion_norm"
    ORIENTATION = "orientation"
    UNIT = "unit"
    GRAVITY = "gravity"
    VELOCITY = "velocity"
    MISSING_JOINT = "missing_joint"
    UNKNOWN_JOINT = "unknown_joint"
    REORDERED_JOINTS = "reordered_joints"
    UNKNOWN_FRAME = "unknown_frame"
    LAYOUT = "layout"
    UNREADABLE = "unreadable"
    # Against the model.
    WEIGHT = "weight"
    CONTRADICTION = "contradiction"
    WRENCH_SIGN = "wrench_sign"
    WRENCH_FRAME = "wrench_frame"
    WRENCH_GAIN = "wrench_gain"
    IMU_MOUNTING = "imu_mounting"
    DELAY = "delay"
    TORQUE_SIGN = "torque_sign"
    TORQUE_GAIN = "torque_gain"
    EXCITATION = "excitation"


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    kind : Kind
    stream : str
        Topic; empty where it is about all of them.
    severity : Severity
    message : str
        What, where, how much and what to do, in one line.
    figures : mapping of str to float
        The numbers behind it, units in their names.
    """

    kind: Kind
    stream: str
    severity: Severity
    message: str
    figures: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    @classmethod
    def of(
        cls,
        topic: str,
        kind: Kind,
        what: str,
        figures: Mapping[str, float],
        severity: Severity = Severity.UNUSABLE,
    ) -> "Finding":
        """Return one about a topic, with whose name its message begins."""
        return cls(kind, topic, severity, f"{topic}: {what}", figures)

    def as_dict(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        return {
            "kind": self.kind.value,
            "stream": self.stream,
            "severity": self.severity.name.lower(),
            "message": self.message,
            "figures": json_figures(self.figures),
        }


def json_figures(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures as JSON can hold them: Python's own numbers, null for NaN and infinity."""
    return {name: _json_value(value) for name, value in figures.items()}


def _json_value(value: Any) -> Any:
    # Counts and comparisons of arrays are NumPy scalars, which the json module refuses.
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


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
