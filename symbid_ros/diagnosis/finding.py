"""What is wrong with a log, one thing at a time."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
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
