"""Orientations of IMUs that are no rotations."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.signals.slices import Slice

# Four decimals of a quaternion, the fewest that drivers print, leave its norm this near to one.
TOLERANCE = 1e-3


@dataclass
class Orientation:
    """The quaternions of one IMU's topic.

    Attributes
    ----------
    topic : str
    messages, wrong : int
        With an orientation, and with one whose norm is not one.
    worst : float
        Norm furthest from one.
    """

    topic: str
    messages: int = 0
    wrong: int = 0
    worst: float = 1.0

    def add(self, piece: Slice) -> None:
        """Take a slice in which no topic was silent."""
        for imu in () if piece.streams is None else piece.streams.imus:
            if imu.topic != self.topic or imu.orientation is None:
                continue
            inside = (imu.stamp >= piece.start) & (imu.stamp < piece.stop)
            norm = np.linalg.norm(imu.orientation[inside], axis=1)
            off = np.abs(norm - 1)
            self.messages += int(np.count_nonzero(np.isfinite(norm)))
            self.wrong += int(np.count_nonzero(off > TOLERANCE))
            if np.any(off > abs(self.worst - 1)):
                self.worst = float(norm[np.nanargmax(off)])

    def findings(self) -> list[Finding]:
        """Return whether some are no rotations."""
        if not self.wrong:
            return []
        return [
            Finding(
                Kind.QUATERNION_NORM,
                self.topic,
                Severity.WARNING,
                f"{self.topic}: {self.wrong} of {self.messages} orientations are no unit "
                f"quaternions, the worst has norm {self.worst:.4g}; normalise them, or mark the "
                "orientation absent by a covariance of -1",
                {"messages": self.wrong, "worst_norm": self.worst},
            )
        ]
