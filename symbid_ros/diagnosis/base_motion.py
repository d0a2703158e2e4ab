"""Check of an IMU on a base that counts as fixed: it must rest."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.driving import is_accelerating
from symbid_ros.signals.streams import ImuStream

# Share of a log in which a base that counts as fixed may move.
BRIEF = 0.05


@dataclass
class BaseMotionCheck:
    """Counts messages of one IMU on the base at which the base turns or accelerates.

    Attributes
    ----------
    topic : str
    messages, moving : int
    """

    topic: str
    messages: int = 0
    moving: int = 0

    def add(self, imu: ImuStream, model: RobotModel, during: tuple[int, int]) -> None:
        """Add the messages between two stamps, ns, if the IMU is on a fixed base."""
        try:
            is_on_base = not model.floating and model.frame(imu.frame_id).link == 0
        except ModelError:
            return  # nothing says where it is
        if not is_on_base:
            return
        readings = np.hstack([imu.angular_velocity, imu.linear_acceleration])
        known = np.isfinite(readings).all(axis=1)
        if not known.any():
            return
        stamp, rate, force = imu.stamp[known], *np.split(readings[known], 2, axis=1)
        # A gyroscope at rest may have an offset of any size.
        moving = is_accelerating(stamp, rate - np.median(rate, axis=0), force)
        inside = (stamp >= during[0]) & (stamp < during[1])
        self.messages += int(np.count_nonzero(inside))
        self.moving += int(np.count_nonzero(moving & inside))

    def findings(self) -> list[Finding]:
        """Return a finding if the base moves."""
        share = self.moving / max(self.messages, 1)
        if share <= BRIEF:
            return []
        what = (
            f"the base turns or accelerates in {100 * share:.0f} % of the log, although it counts "
            f"as fixed; give `base` floating, or `wheel_topic` {self.topic} to leave out times "
            "of driving"
        )
        figures = {"moving_share": share}
        return [Finding.of(self.topic, Kind.BASE_MOTION, what, figures, Severity.WARNING)]
