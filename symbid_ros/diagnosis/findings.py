"""Findings about a log, their severity and the diagnosis that holds them."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import Enum, IntEnum
from typing import Any

import numpy as np

from symbid_ros.json_documents import versioned


class Severity(IntEnum):
    """Severity of a finding; the value is the doctor's exit status."""

    CLEAN = 0
    WARNING = 1
    UNUSABLE = 2


class Kind(Enum):
    """Kind of a finding; the value is a stable identifier."""

    # Of one stream by itself.
    RATE = "rate"
    GAP = "gap"
    DUPLICATE = "duplicate"
    DISORDER = "disorder"
    CLOCK_JUMP = "clock_jump"
    SILENT = "silent"
    SHORT = "short"
    NOT_FINITE = "not_finite"
    SPIKE = "spike"
    FROZEN = "frozen"
    SATURATED = "saturated"
    ACCELEROMETER_GAIN = "accelerometer_gain"
    GYROSCOPE_GAIN = "gyroscope_gain"
    COPY = "copy"
    STAMP = "stamp"
    JITTER = "jitter"
    QUATERNION_NORM = "quaternion_norm"
    ORIENTATION = "orientation"
    BASE_MOTION = "base_motion"
    UNIT = "unit"
    GRAVITY = "gravity"
    TWO_PUBLISHERS = "two_publishers"
    VELOCITY = "velocity"
    STAMP_RATE = "stamp_rate"
    UNSIGNED_EFFORT = "unsigned_effort"
    EFFORT_NOISE = "effort_noise"
    FOLLOWER_EFFORT = "follower_effort"
    FOLLOWER_POSITION = "follower_position"
    MISSING_JOINT = "missing_joint"
    UNKNOWN_JOINT = "unknown_joint"
    REORDERED_JOINTS = "reordered_joints"
    UNKNOWN_FRAME = "unknown_frame"
    LAYOUT = "layout"
    UNREADABLE = "unreadable"
    # Against the model.
    WEIGHT = "weight"
    MISSING_WRENCH = "missing_wrench"
    CONTRADICTION = "contradiction"
    BASE_MOUNTING = "base_mounting"
    MISSING_INERTIA = "missing_inertia"
    JOINT_READINGS = "joint_readings"
    WRENCH_SIGN = "wrench_sign"
    WRENCH_FRAME = "wrench_frame"
    WRENCH_GAIN = "wrench_gain"
    WRENCH_OFFSET = "wrench_offset"
    WRIST_SENSOR = "wrist_sensor"
    IMU_MOUNTING = "imu_mounting"
    ENCODER_OFFSET = "encoder_offset"
    DELAY = "delay"
    EFFORT_DELAY = "effort_delay"
    TORQUE_SIGN = "torque_sign"
    TORQUE_GAIN = "torque_gain"
    MISSING_BODY = "missing_body"
    EXCITATION = "excitation"


# Checks that wrong readings of joints disturb.
OF_READINGS = (
    *(Kind.WRENCH_SIGN, Kind.WRENCH_FRAME, Kind.WRENCH_GAIN, Kind.IMU_MOUNTING, Kind.WEIGHT),
    *(Kind.CONTRADICTION, Kind.TORQUE_SIGN, Kind.TORQUE_GAIN, Kind.ENCODER_OFFSET, Kind.DELAY),
    *(Kind.MISSING_BODY, Kind.EFFORT_DELAY, Kind.EXCITATION),
)
# Those that efforts without signs disturb.
OF_SIGNED_EFFORTS = (
    *(Kind.JOINT_READINGS, Kind.TORQUE_SIGN, Kind.TORQUE_GAIN, Kind.CONTRADICTION),
    *(Kind.BASE_MOUNTING, Kind.MISSING_BODY, Kind.ENCODER_OFFSET, Kind.DELAY),
)


@dataclass(frozen=True)
class Finding:
    """One fault of a log.

    Attributes
    ----------
    kind : Kind
    stream : str
        Topic; empty if the finding concerns all topics.
    severity : Severity
    message : str
        One line: what, where, how much and how to fix it.
    figures : mapping of str to float
        Measured values, with units in their names.
    """

    kind: Kind
    stream: str
    severity: Severity
    message: str
    figures: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        topic: str,
        kind: Kind,
        what: str,
        figures: Mapping[str, float],
        severity: Severity = Severity.UNUSABLE,
    ) -> "Finding":
        """Return a finding about a topic; its message starts with the topic's name."""
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
    """Return figures as JSON values: Python numbers, null for NaN and infinity."""
    return {name: _json_value(value) for name, value in figures.items()}


def _json_value(value: Any) -> Any:
    # Counts and comparisons of arrays are NumPy scalars, which the json module refuses.
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def merged(of_streams: Iterable[Finding], of_model: Iterable[Finding]) -> list[Finding]:
    """Return all findings, worst first.

    A gyroscope's gain is reported once for each topic. If efforts have no signs, those that depend
    on them are left out.
    """
    found = list(of_streams)
    if has_unsigned_efforts(found):
        of_model = [one for one in of_model if one.kind not in OF_SIGNED_EFFORTS]
    known = {one.stream for one in found if one.kind is Kind.GYROSCOPE_GAIN}
    found += [
        one for one in of_model if one.kind is not Kind.GYROSCOPE_GAIN or one.stream not in known
    ]
    return sorted(found, key=lambda one: -one.severity)


def has_unsigned_efforts(findings: Iterable[Finding]) -> bool:
    """Return whether efforts are said to be magnitudes, which tell no sign and no gain."""
    return any(one.kind is Kind.UNSIGNED_EFFORT for one in findings)


@dataclass(frozen=True)
class FaultSpan:
    """A time in which a topic has no usable messages.

    Attributes
    ----------
    kind : Kind
        ``GAP``, ``FROZEN`` or ``SILENT``.
    stream : str
        Topic; empty for all.
    start, stop : int
        Stamps, ns.
    """

    kind: Kind
    stream: str
    start: int
    stop: int


@dataclass(frozen=True)
class StreamFigures:
    """Statistics of one topic.

    Attributes
    ----------
    topic : str
    messages : int
        Messages with a stamp in the checked part of the log.
    duration_s : float
        Time from the first stamp to the last.
    rate_hz : float
        Inverse of the median period; 0 below two messages.
    jitter : float
        Standard deviation of the periods without gaps, relative to their median.
    gaps, missing : int
        Periods of at least 1.5 medians, and the messages missing in them.
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


@dataclass
class ModelChecks:
    """Findings, figures, and skipped checks with their reasons."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Diagnosis:
    """Findings and statistics of a log.

    Attributes
    ----------
    source : str
        Names of the bags.
    streams : tuple of StreamFigures
        Joint states first.
    findings : tuple of Finding
        Findings, worst first.
    figures : mapping of str to float
        Values measured by the checks against the model, with units in their names.
    left_out : tuple of str
        Skipped checks and their reasons.
    """

    source: str
    streams: tuple[StreamFigures, ...]
    findings: tuple[Finding, ...]
    figures: Mapping[str, float]
    left_out: tuple[str, ...]

    @property
    def severity(self) -> Severity:
        """Severity of the worst finding."""
        return max((one.severity for one in self.findings), default=Severity.CLEAN)

    def with_finding(self, finding: Finding) -> "Diagnosis":
        """Return the diagnosis with one more finding."""
        return replace(self, findings=tuple(merged([finding], self.findings)))

    def with_readings(self, finding: Finding, what: str) -> "Diagnosis":
        """Return the diagnosis with wrong readings, without the findings that depend on them.

        ``what`` says on what these depend.
        """
        kinds = ", ".join(one.value for one in OF_READINGS)
        kept = [one for one in self.findings if one.kind not in OF_READINGS]
        left_out = (f"{kinds}: they depend on {what}",)
        found = replace(self, findings=tuple(kept), left_out=left_out)
        return found.with_finding(finding)

    def of(self, topic: str) -> tuple[Finding, ...]:
        """Return the findings of one topic; an empty name returns those of all topics together."""
        return tuple(one for one in self.findings if one.stream == topic)

    def as_dict(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        document = {
            "source": self.source,
            "severity": self.severity.name.lower(),
            "streams": [json_figures(asdict(stream)) for stream in self.streams],
            "findings": [finding.as_dict() for finding in self.findings],
            "figures": json_figures(self.figures),
            "left_out": list(self.left_out),
        }
        return versioned("diagnosis", document)
