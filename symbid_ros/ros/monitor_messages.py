"""The identifier's messages, parsed for display.

Missing keys and values that are not numbers count as unknown, because another version of the
identifier may publish other keys.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.options import spelled
from symbid_ros.report.formatting import counted
from symbid_ros.ros.parameters import Parameter

# Counts of a stream that should be zero.
PAUSES = "pauses"
FAULTS = "missing", PAUSES, "late", "dropped"
LEVELS = {1: "warning", 2: "error"}
# Messages of the status "estimate".
DISABLED = "disabled by ~/enable"
TOO_EARLY_TO_FIT = "too early to tell whether the model with its joint terms explains the data"

AS_FLAGS = Parameter(
    "as_flags",
    False,
    "Whether warnings name flags of symbid live, not parameters.",
)


@dataclass(frozen=True)
class PublishedLink:
    """Estimate of one link from ``~/estimate``.

    Attributes
    ----------
    name : str
    phi, std : (10,) float64
        Parameters and their standard deviations, SI units; NaN if unknown.
    determined : int or None
        Number of parameters determined by the data; None if unknown.
    is_possible : bool
        Whether some mass density has these parameters.
    """

    name: str
    phi: FloatArray
    std: FloatArray
    determined: int | None
    is_possible: bool

    @property
    def com(self) -> FloatArray:
        """Centre of mass (3,) in the link's frame, m."""
        with np.errstate(all="ignore"):
            com: FloatArray = self.phi[1:4] / self.phi[0]
        return com

    @property
    def com_std(self) -> FloatArray:
        """Standard deviation of the centre of mass (3,), m.

        A first-order approximation without the correlation of m·c and m, which messages lack.
        """
        with np.errstate(all="ignore"):
            std: FloatArray = np.hypot(self.std[1:4], self.com * self.std[0]) / abs(self.phi[0])
        return std

    def shrinkage(self, first: "PublishedLink") -> float:
        """Return the factor by which the standard deviations have shrunk since ``first``.

        It is the geometric mean over the ten parameters: 10 is one decimal on average. NaN if
        unknown.
        """
        with np.errstate(all="ignore"):
            ratios = np.log(first.std) - np.log(self.std)
            known = np.isfinite(ratios)
            return float(np.exp(ratios[known].mean())) if known.any() else math.nan

    def error(self, truth: FloatArray) -> float:
        """Return the RMS of the ten errors against ``truth`` (10,), each divided by its σ."""
        with np.errstate(all="ignore"):
            scaled = (self.phi - truth) / self.std
            known = np.isfinite(scaled)
            return float(np.sqrt(np.mean(scaled[known] ** 2))) if known.any() else math.nan


@dataclass(frozen=True)
class RobotEstimate:
    """Estimate of a robot from ``~/estimate``."""

    stamp: int  # time of the newest data, ns
    model: str  # name of the robot
    links: tuple[PublishedLink, ...]
    joint_terms: int  # number of friction, armature and offset terms
    joint_determined: int  # number of them that the data determine

    @property
    def parameters(self) -> int:
        """Number of all parameters."""
        return len(PARAMETERS) * len(self.links) + self.joint_terms

    @property
    def determined(self) -> int | None:
        """Number of all parameters determined by the data; None if unknown."""
        counts = [link.determined for link in self.links if link.determined is not None]
        return sum(counts) + self.joint_determined if counts else None


@dataclass(frozen=True)
class StreamCounts:
    """Rate of an input topic in Hz (NaN if unknown), and counts of its faults."""

    topic: str
    rate: float
    faults: Mapping[str, int]

    @property
    def counted_faults(self) -> tuple[str, ...]:
        """Each fault with its count, such as ``2 missing`` or ``1 pause``."""
        return tuple(
            counted(count, "pause") if what == PAUSES else f"{count} {what}"
            for what, count in self.faults.items()
        )


@dataclass(frozen=True)
class IdentifierStatus:
    """Statuses of the identifier on ``/diagnostics``."""

    values: Mapping[str, str]  # of the status "estimate"
    warnings: tuple[str, ...]  # level and message of every status that is not OK
    streams: tuple[StreamCounts, ...]
    is_enabled: bool = True
    is_ready: bool = True  # whether all topics have usable messages
    is_judged: bool = True  # whether it can tell if the model explains the data
    followed: str = ""  # the last change, from which the estimate has started anew

    @property
    def no_warning(self) -> str:
        """What there is to say without a warning."""
        return "no warning" if self.is_judged else f"no warning yet: {TOO_EARLY_TO_FIT}"

    def number(self, key: str) -> float:
        """Return a value as a number; NaN if it is missing or not a number."""
        return _number(self.values.get(key, ""))


def read_estimate(message: DiagnosticArray) -> RobotEstimate:
    """Parse a message of ``~/estimate``."""
    links: list[PublishedLink] = []
    joint_terms = joint_determined = 0
    for status in message.status:
        values = _values(status)
        determined = [value for key, value in values.items() if key.endswith("/determined")]
        if PARAMETERS[0] in values:
            links.append(_link(status, values, determined))
        else:
            # A term that the data do not ask for has a standard deviation of exactly 0.
            joint_terms += sum(
                "/" not in key and _number(values.get(f"{key}/std", "")) != 0 for key in values
            )
            joint_determined += determined.count("true")
    stamp = message.header.stamp
    return RobotEstimate(
        stamp=stamp.sec * 1_000_000_000 + stamp.nanosec,
        model=next((status.hardware_id for status in message.status), ""),
        links=tuple(links),
        joint_terms=joint_terms,
        joint_determined=joint_determined,
    )


def read_status(
    statuses: Mapping[str, DiagnosticStatus], *, as_flags: bool = False
) -> IdentifierStatus:
    """Parse the newest statuses of one identifier, by part; its warnings may name flags."""
    estimate, streams = statuses.get("estimate"), statuses.get("streams")
    change = statuses.get("change")
    is_followed = change is not None and _level(change) == 0 and "since" in _values(change)
    warnings = [
        f"{LEVELS.get(_level(status), 'stale')}: "
        + spelled(status.message, _flag if as_flags else str)
        for status in statuses.values()
        if _level(status) > 0
    ]
    return IdentifierStatus(
        values={} if estimate is None else _values(estimate),
        warnings=tuple(warnings),
        streams=() if streams is None else _streams(_values(streams)),
        is_enabled=estimate is None or estimate.message != DISABLED,
        is_ready=streams is None or _level(streams) == 0,
        is_judged=estimate is None or estimate.message != TOO_EARLY_TO_FIT,
        followed=change.message if change is not None and is_followed else "",
    )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _link(
    status: DiagnosticStatus, values: Mapping[str, str], determined: Sequence[str]
) -> PublishedLink:
    return PublishedLink(
        name=status.name,
        phi=np.array([_number(values.get(name, "")) for name in PARAMETERS]),
        std=np.array([_number(values.get(f"{name}/std", "")) for name in PARAMETERS]),
        determined=determined.count("true") if determined else None,
        is_possible=_level(status) == 0,
    )


def _streams(values: Mapping[str, str]) -> tuple[StreamCounts, ...]:
    """Group the keys ``<topic>/<count>`` by topic, in the order of the message."""
    topics: dict[str, dict[str, float]] = {}
    for key, value in values.items():
        topic, _, what = key.rpartition("/")
        if topic:
            topics.setdefault(topic, {})[what] = _number(value)
    return tuple(
        StreamCounts(
            topic,
            counted.get("rate", math.nan),
            {
                what: int(count)
                for what, count in counted.items()
                if what in FAULTS and 0 < count < math.inf
            },
        )
        for topic, counted in topics.items()
    )


def _values(status: DiagnosticStatus) -> dict[str, str]:
    return {entry.key: entry.value for entry in status.values}


def _level(status: DiagnosticStatus) -> int:
    return int.from_bytes(status.level, "little")


def _number(text: str) -> float:
    # A value may have a unit, such as "1000.2 Hz".
    try:
        return float(text.split(maxsplit=1)[0])
    except (ValueError, IndexError):
        return math.nan
