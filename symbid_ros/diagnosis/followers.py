"""Compares what a log says about joints that follow others with the model file."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.model.tree import Mimic, RobotModel
from symbid_ros.signals.defects import ALWAYS
from symbid_ros.signals.efforts import rounding_errors
from symbid_ros.signals.streams import JointStream

# A follower is elsewhere if its position differs by more than this, rad and m (RMS), which backlash
# does not explain, and by more than this share of its motion.
LEAST = {"revolute": 0.02, "prismatic": 1e-3}
SHARE = 0.1
# Positions with a larger correlation follow a straight line.
LINEAR = 0.98
# Followers whose efforts a sentence adds up one by one.
MOST_SUMS = 4


@dataclass
class FollowerCheck:
    """Moments of the positions of followers and their leaders, and who reports an effort.

    Attributes
    ----------
    topic : str
    model : RobotModel
    """

    topic: str
    model: RobotModel
    # Σ z zᵀ of z = (1, leader, follower, difference), of each follower, by its joint.
    _moments: dict[int, FloatArray] = field(default_factory=dict)
    # Positions (leader, follower) that are subtracted before, for the digits.
    _origins: dict[int, FloatArray] = field(default_factory=dict)
    _with_effort: set[int] = field(default_factory=set)

    def add(self, joints: JointStream, during: tuple[int, int] = ALWAYS) -> None:
        """Add messages from the first stamp of ``during`` up to the second, ns."""
        inside = slice(*np.searchsorted(joints.stamp, during).tolist())
        position, effort = joints.position[inside], joints.effort[inside]
        is_effort = np.isfinite(effort) & (np.abs(effort) > rounding_errors(effort)[:, None])
        column = {name: index for index, name in enumerate(joints.names)}
        names = self.model.joint_names
        for joint, mimic in self.model.followers.items():
            own, leader = column.get(names[joint]), column.get(names[mimic.leader])
            if own is None:
                continue
            if is_effort[:, own].any():
                self._with_effort.add(joint)
            if leader is not None:
                self._add_positions(joint, mimic, position[:, [leader, own]])

    def _add_positions(self, joint: int, mimic: Mimic, pair: FloatArray) -> None:
        """Add the positions (N, 2) of a leader and its follower."""
        pair = pair[np.isfinite(pair).all(axis=1)]
        if not len(pair):
            return
        difference = pair[:, 1] - (mimic.multiplier * pair[:, 0] + mimic.offset)
        shifted = pair - self._origins.setdefault(joint, pair[0])
        z = np.column_stack([np.ones(len(pair)), shifted, difference])
        self._moments[joint] = self._moments.get(joint, np.zeros((4, 4))) + z.T @ z

    def findings(self) -> Iterator[Finding]:
        """Yield at most one finding about positions and one about efforts."""
        yield from self._position_findings()
        yield from self._effort_findings()

    def _position_findings(self) -> Iterator[Finding]:
        """Yield the finding of followers that are not where the model file puts them."""
        figures: dict[str, float] = {}
        texts = []
        for joint, moments in self._moments.items():
            found = self._contradiction(joint, moments)
            if found is not None:
                texts.append(found[0])
                figures |= found[1]
        if texts:
            yield Finding.of(
                self.topic,
                Kind.FOLLOWER_POSITION,
                f"positions contradict the <mimic> or <equality> of {self.model.source}: "
                f"{', '.join(texts)}; an identification computes the position of such a joint from "
                "its leader's: correct multiplier and offset in the model or the positions in the "
                "driver, or remove <mimic> if the joint moves by itself",
                figures,
                Severity.WARNING,
            )

    def _contradiction(
        self, joint: int, moments: FloatArray
    ) -> tuple[str, Mapping[str, float]] | None:
        """Return how a follower contradicts the model, and the figures; None if it does not."""
        mimic, follower = self.model.followers[joint], self.model.joints[joint]
        mean = moments[0, 1:3] / moments[0, 0]
        covariance = moments[1:3, 1:3] / moments[0, 0] - np.outer(mean, mean)
        deviation = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
        difference = float(np.sqrt(moments[3, 3] / moments[0, 0]))
        moved = max(abs(mimic.multiplier) * deviation[0], deviation[1])
        least = LEAST[follower.kind]
        if difference <= max(least, SHARE * moved):
            return None
        leader = self.model.joint_names[mimic.leader]
        figures = {f"{follower.name}/difference": difference}
        stated = _line(mimic.multiplier, leader, mimic.offset)
        unit = "rad" if follower.kind == "revolute" else "m"
        if abs(covariance[0, 1]) > LINEAR * deviation.prod() and deviation[1] > least:
            slope = float(covariance[0, 1] / covariance[0, 0])
            at_leader, at_follower = mean + self._origins[joint]
            offset = float(at_follower - slope * at_leader)
            figures |= {f"{follower.name}/multiplier": slope, f"{follower.name}/offset": offset}
            shown = offset if abs(offset) > least else 0.0
            return f"{follower.name} is {_line(slope, leader, shown)} instead of {stated}", figures
        return f"{follower.name} differs from {stated} by {difference:.2g} {unit} (RMS)", figures

    def _effort_findings(self) -> Iterator[Finding]:
        """Yield the finding of followers with an effort.

        Alignment leaves these efforts out, because many drivers repeat the leader's.
        """
        found = {joint: self.model.followers[joint] for joint in sorted(self._with_effort)}
        if not found:
            return
        names = self.model.joint_names
        sums = dict[str, str]()
        for joint, mimic in found.items():
            leader = names[mimic.leader]
            times = "" if mimic.multiplier == 1.0 else f" times {mimic.multiplier:.4g}"
            sums[leader] = f"{sums.get(leader, leader)} plus that of {names[joint]}{times}"
        each = " and ".join(f"the effort of {text} as that of {one}" for one, text in sums.items())
        if len(found) > MOST_SUMS:
            each = (
                "the effort of each leader plus those of its followers times their multipliers as "
                "that of the leader"
            )
        which = ", ".join(f"{names[one]} (follows {names[by.leader]})" for one, by in found.items())
        yield Finding.of(
            self.topic,
            Kind.FOLLOWER_EFFORT,
            f"the effort of {which} is not used, because the effort of the leader must move both; "
            f"if each joint has a motor, publish {each}; if the efforts only repeat the leader's, "
            "nothing is wrong",
            {f"{names[joint]}/multiplier": mimic.multiplier for joint, mimic in found.items()},
            Severity.WARNING,
        )


def _line(multiplier: float, leader: str, offset: float) -> str:
    """Return a linear function of a leader's position."""
    shift = f" {'+' if offset > 0 else '-'} {abs(offset):.3g}" if offset else ""
    return f"{multiplier:.3g} times {leader}{shift}"
