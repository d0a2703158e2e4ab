"""Findings about the signs, gains and units of efforts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from symbid_ros.diagnosis.common_scale import (
    MILLI,
    Cause,
    ScaleEvidence,
    common_unit,
    joints_in_milli,
    masses_fault,
    unit_name,
)
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.options import robot_file_line

# Range of a reading over its expected value, relative to other sensors, that inertia errors of
# ±25 % can cause: 0.75/1.25 and its inverse.
GAINS = 0.6, 1.6
# Standard deviations by which a gain must differ.
DEVIATIONS = 3.0
# Smallest gain that is reported, relative to the common gain.
SMALLEST = 1e-4


@dataclass(frozen=True)
class SignConversions:
    """What the user's options have changed in efforts and wrenches before they are checked.

    Attributes
    ----------
    effort_scale : mapping of str to float
        Factors of joints' efforts.
    flipped : frozenset of str
        Frames whose wrenches are reversed.
    """

    effort_scale: Mapping[str, float] = field(default_factory=dict)
    flipped: frozenset[str] = frozenset()

    def effort_line(self, factors: Mapping[str, float]) -> str:
        """Return the robot file's line that multiplies efforts, as they are read now, by these."""
        given = {name: self.effort_scale.get(name, 1.0) for name in factors}
        stated = [f"{name}:={scale:g}" for name, scale in given.items() if scale != 1.0]
        products = (f"{name}:={one * given[name]:.3g}" for name, one in factors.items())
        line = robot_file_line("effort_scale", *products)
        return f"{line} instead of {', '.join(stated)}" if stated else line


NO_CONVERSIONS = SignConversions()
NO_LIMIT = 0.0, np.inf
NO_SHARES: Mapping[str, float] = MappingProxyType({})
NO_GAINS: Mapping[str, tuple[float, float]] = MappingProxyType({})


def effort_findings(
    topic: str,
    known: Mapping[str, tuple[float, float]],
    common: float,
    unknown: Mapping[str, tuple[float, float]] = NO_GAINS,
    *,
    hidden: Mapping[str, float] = NO_SHARES,
    limits: Mapping[str, tuple[float, float]] = NO_GAINS,
    evidence: ScaleEvidence | None = None,
    conversions: SignConversions = NO_CONVERSIONS,
) -> Iterator[Finding]:
    """Yield findings about signs and gains of efforts.

    Parameters
    ----------
    topic : str
    known : mapping of str to (float, float)
        Gains of joints that the log determines, with their standard deviations.
    common : float
        The gain of the other sensors.
    unknown : mapping of str to (float, float)
        The same of the other driven joints.
    hidden : mapping of str to float
        Those of them whose efforts differ from the load although they hardly show it, with the
        share of the effort that the load explains.
    limits : mapping of str to (float, float)
        RMS efforts, and the limits of the model.
    evidence : ScaleEvidence, optional
        Whether the model's masses may have the wrong unit; None if wrenches show that they do not.
    conversions : SignConversions
        Those that the user gave.
    """
    # The deviation is that of the ratio 1/g, relative to the ratio.
    negative = [name for name, (gain, std) in known.items() if gain < 0 and DEVIATIONS * std < 1]
    if negative:
        are_all = len(negative) > 2 and len(negative) == len(known)
        # If all known signs are wrong, so are those of joints whose load does not show theirs.
        several = {**known, **unknown} if are_all else {name: known[name] for name in negative}
        reversed_gains = {name: gain / common for name, (gain, _) in several.items()}
        yield sign_finding(topic, reversed_gains, conversions, are_all=are_all)
    wrong = {}
    for name, (gain, std) in known.items():
        # The standard deviation includes the errors of the inertias.
        is_significant = abs(gain - common) > DEVIATIONS * std
        reads = common / max(gain, SMALLEST * common)
        if gain > 0 and is_significant and not GAINS[0] < reads < GAINS[1]:
            wrong[name] = reads
    groups = list(_similar_groups(wrong))
    # If all joints have the same wrong unit, so have those whose load does not show theirs.
    are_all = len(known) > 2 and [len(names) for names in groups] == [len(known)]
    usual = dict.fromkeys(unknown, float(np.median(list(wrong.values())))) if are_all else {}
    factors = {name: 1 / one for name, one in (wrong | usual).items()}
    factors |= {name: within_limit(factors[name], *limits.get(name, NO_LIMIT)) for name in usual}
    masses = ""
    if are_all:
        unit = common_unit([1 / one for one in wrong.values()])
        factor = unit or 1 / float(np.median(list(wrong.values())))
        cause = Cause.UNIT if evidence is None else evidence.cause(factor)
        if cause is Cause.MASSES:
            yield _masses_finding(topic, wrong, factor)
            return
        masses = "" if cause is Cause.UNIT else masses_fault(factor)
        if unit is not None:
            line = conversions.effort_line(dict.fromkeys(factors, unit))
            yield _unit_finding(topic, wrong, unit, line, masses)
            return
    if not usual:
        beyond = {name: one for name, one in limits.items() if name in unknown and one[0] > one[1]}
        if beyond:
            yield _limit_finding(topic, beyond, (*known, *unknown), conversions)
        if hidden:
            yield _hidden_finding(topic, hidden)
    line = conversions.effort_line(factors)
    drives = "all" if are_all else ",".join(factors)
    action = f"write {line}, or give `drive_gain` {drives} to identify the factors"
    is_any_right = any(GAINS[0] < common / gain < GAINS[1] for gain, _ in known.values() if gain)
    if len(groups) > 1 and not is_any_right:  # no joint reads Nm
        action = "give `drive_gain` all to identify the factors: unlike ones are those of currents"
    if masses:
        action += f", or correct the masses in the model, which may be {masses}"
    for names in groups:
        reads = float(np.median([wrong[name] for name in names]))
        whose = "all joints" if are_all else ", ".join(names)
        yield Finding(
            Kind.TORQUE_GAIN,
            topic,
            Severity.WARNING,
            f"{topic}: effort of {whose} reads {reads:.3g} times what the motion implies; "
            f"inertia errors of 25 % explain only {GAINS[0]:g} to {GAINS[1]:g}; check its unit, "
            f"gear ratio or torque constant, or {action}",
            {"reads": reads} | {f"{name}/reads": wrong[name] for name in names},
        )


def within_limit(factor: float, rms: float, limit: float) -> float:
    """Return the factor of an effort, or the largest that keeps its RMS within the limit."""
    return min(factor, limit / rms) if rms > 0 else factor


def _unit_finding(
    topic: str, reads: Mapping[str, float], unit: float, line: str, masses: str
) -> Finding:
    """Return the finding that the efforts of all joints are in another unit.

    If the masses of the model may be wrong instead, it says how, and has a figure for that.
    """
    middle = float(np.median(list(reads.values())))
    or_fault, or_action, figures = "", "", dict[str, float]()
    if masses:
        or_fault = f", or as if the masses in the model were {masses}"
        or_action = ", or correct masses and inertias in the model"
        figures = {"masses_times": unit}
    return Finding(
        Kind.TORQUE_GAIN,
        topic,
        Severity.WARNING,
        f"{topic}: effort of all joints reads {middle:.3g} times what the motion implies, as if "
        f"in {unit_name(unit)}{or_fault}; give Nm (N), or write {line}{or_action}",
        {"reads": middle} | {f"{joint}/reads": one for joint, one in reads.items()} | figures,
    )


def _masses_finding(topic: str, reads: Mapping[str, float], factor: float) -> Finding:
    """Return the finding that the masses of the model are wrong, and not the efforts."""
    middle = float(np.median(list(reads.values())))
    return Finding(
        Kind.TORQUE_GAIN,
        topic,
        Severity.WARNING,
        f"{topic}: effort of all joints reads {middle:.3g} times what the motion implies, as if "
        f"the masses in the model were {masses_fault(factor)}; correct its masses and inertias "
        "(kg, kg m²)",
        {"reads": middle, "masses_times": factor},
    )


def _hidden_finding(topic: str, hidden: Mapping[str, float]) -> Finding:
    """Return the finding that efforts do not contain the load of their joints."""
    most = 100 * max(hidden.values())
    return Finding(
        Kind.TORQUE_GAIN,
        topic,
        Severity.WARNING,
        f"{topic}: effort of {', '.join(hidden)} does not show the load that the motion implies: "
        f"beside friction, armature and offset, the load explains {most:.2g} % of the effort, so "
        "no factor follows; check which joint the driver means by this effort, the model's "
        "inertias beyond the joint, and whether something else carries or drives it, such as a "
        "brake, a spring or a hand",
        {f"{name}/load_share": share for name, share in hidden.items()},
    )


def _limit_finding(
    topic: str,
    excess: Mapping[str, tuple[float, float]],
    driven: Sequence[str],
    conversions: SignConversions,
) -> Finding:
    """Return the finding that the RMS efforts of joints exceed their limits."""
    ratios = {name: effort / limit for name, (effort, limit) in excess.items()}
    each = ", ".join(
        f"{name} {effort:.3g} of {limit:g}" for name, (effort, limit) in excess.items()
    )
    action = "check their unit"
    may_be_milli = joints_in_milli(ratios, driven)
    if may_be_milli:
        line = conversions.effort_line(dict.fromkeys(may_be_milli, MILLI))
        action += f", and for mNm write {line}"
    return Finding(
        Kind.TORQUE_GAIN,
        topic,
        Severity.WARNING,
        f"{topic}: RMS efforts exceed the limits in the model: {each} Nm (N); {action}, or correct "
        "the limits",
        {f"{name}/times_limit": one for name, one in ratios.items()},
    )


def sign_finding(
    topic: str, gains: Mapping[str, float], conversions: SignConversions, *, are_all: bool
) -> Finding:
    """Return the finding that joints with these gains have the wrong sign."""
    size = f" (gain {np.mean(list(gains.values())):.2f} relative to the others)"
    return Finding(
        Kind.TORQUE_SIGN,
        topic,
        Severity.UNUSABLE,
        f"{topic}: effort of {'all joints' if are_all else ', '.join(gains)} has the wrong sign"
        f"{'' if are_all else size}; give it along the joint's axis, or write "
        f"{conversions.effort_line(dict.fromkeys(gains, -1.0))}",
        {f"{name}/gain": gain for name, gain in gains.items()},
    )


def _similar_groups(reads: Mapping[str, float]) -> Iterator[list[str]]:
    """Yield groups of joints with similar errors, such as the same wrong unit."""
    names: list[str] = []
    for name in sorted(reads, key=lambda each: reads[each]):
        if names and reads[name] > GAINS[1] * reads[names[0]]:
            yield names
            names = []
        names.append(name)
    if names:
        yield names
