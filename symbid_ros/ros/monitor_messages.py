"""The identifier's messages, read back: what a monitor shows of them.

Keys that are missing or hold no number are taken as not known: an identifier of another
version says less or more.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import PARAMETERS

# What a stream counts that should not happen.
FAULTS = "missing", "late", "dropped"
LEVELS = {1: "warning", 2: "error"}


@dataclass(frozen=True)
class LinkEstimate:
    """One link as ``~/estimate`` tells it.

    Attributes
    ----------
    name : str
    phi, std : (10,) float64
        Parameters and their standard deviations, SI units; NaN where not told.
    determined : int or None
        How many of the ten the data decide; None where not told.
    is_possible : bool
        Whether some mass density can realise the parameters.
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

        First order in m·c and m, whose correlations a message does not carry.
        """
        with np.errstate(all="ignore"):
            std: FloatArray = np.hypot(self.std[1:4], self.com * self.std[0]) / abs(self.phi[0])
        return std

    def shrinkage(self, first: "LinkEstimate") -> float:
        """Return how many times smaller the ten deviations are than at ``first``.

        Their geometric mean: 10 means one decimal gained on average. NaN where not told.
        """
        with np.errstate(all="ignore"):
            ratios = np.log(first.std) - np.log(self.std)
            told = np.isfinite(ratios)
            return float(np.exp(ratios[told].mean())) if told.any() else math.nan

    def error(self, truth: FloatArray) -> float:
        """Return the root mean square of the ten errors against ``truth`` (10,), each in its σ."""
        with np.errstate(all="ignore"):
            scaled = (self.phi - truth) / self.std
            told = np.isfinite(scaled)
            return float(np.sqrt(np.mean(scaled[told] ** 2))) if told.any() else math.nan


@dataclass(frozen=True)
class RobotEstimate:
    """One ``~/estimate``.

    Attributes
    ----------
    stamp : int
        Time of its newest data, ns.
    model : str
        Name of the robot.
    links : tuple of LinkEstimate
    joint_terms, joint_determined : int
        How many friction, armature and offset terms there are, and how many the data decide.
    """

    stamp: int
    model: str
    links: tuple[LinkEstimate, ...]
    joint_terms: int
    joint_determined: int

    @property
    def parameters(self) -> int:
        """How many parameters there are in all."""
        return len(PARAMETERS) * len(self.links) + self.joint_terms

    @property
    def determined(self) -> int | None:
        """How many of all parameters the data decide; None where not told."""
        counts = [link.determined for link in self.links if link.determined is not None]
        return sum(counts) + self.joint_determined if counts else None


@dataclass(frozen=True)
class StreamCounts:
    """One input topic: rate in Hz (NaN where not told) and whatever was counted wrong with it."""

    topic: str
    rate: float
    faults: Mapping[str, int]


@dataclass(frozen=True)
class IdentifierStatus:
    """What the identifier says of itself on ``/diagnostics``.

    Attributes
    ----------
    facts : mapping of str to str
        Values of its status ``estimate``.
    warnings : tuple of str
        Messages of every status that is not OK, with the word for its level.
    streams : tuple of StreamCounts
    """

    facts: Mapping[str, str]
    warnings: tuple[str, ...]
    streams: tuple[StreamCounts, ...]

    def number(self, key: str) -> float:
        """Return a fact that is a number, NaN where it is none."""
        return _number(self.facts.get(key, ""))


def read_estimate(message: DiagnosticArray) -> RobotEstimate:
    """Read ``~/estimate``."""
    links: list[LinkEstimate] = []
    joint_terms = joint_determined = 0
    for status in message.status:
        values = _values(status)
        verdicts = [value for key, value in values.items() if key.endswith("/determined")]
        if PARAMETERS[0] in values:
            links.append(_link(status, values, verdicts))
        else:
            joint_terms += sum("/" not in key for key in values)
            joint_determined += verdicts.count("true")
    stamp = message.header.stamp
    return RobotEstimate(
        stamp=stamp.sec * 1_000_000_000 + stamp.nanosec,
        model=next((status.hardware_id for status in message.status), ""),
        links=tuple(links),
        joint_terms=joint_terms,
        joint_determined=joint_determined,
    )


def read_status(statuses: Mapping[str, DiagnosticStatus]) -> IdentifierStatus:
    """Read the newest statuses of one identifier, by the part of the name behind its own."""
    estimate, streams = statuses.get("estimate"), statuses.get("streams")
    warnings = [
        f"{LEVELS.get(_level(status), 'stale')}: {status.message}"
        for status in statuses.values()
        if _level(status) > 0
    ]
    return IdentifierStatus(
        facts={} if estimate is None else _values(estimate),
        warnings=tuple(warnings),
        streams=() if streams is None else _streams(_values(streams)),
    )


def _link(
    status: DiagnosticStatus, values: Mapping[str, str], verdicts: Sequence[str]
) -> LinkEstimate:
    return LinkEstimate(
        name=status.name,
        phi=np.array([_number(values.get(name, "")) for name in PARAMETERS]),
        std=np.array([_number(values.get(f"{name}/std", "")) for name in PARAMETERS]),
        determined=verdicts.count("true") if verdicts else None,
        is_possible=_level(status) == 0,
    )


def _streams(values: Mapping[str, str]) -> tuple[StreamCounts, ...]:
    """Gather ``<topic>/<what>`` by topic, in the order told."""
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
    # "1000.2 Hz" says a number too.
    try:
        return float(text.split(maxsplit=1)[0])
    except (ValueError, IndexError):
        return math.nan
