"""The pose of a robot in the world, from motion capture or odometry.

Without an IMU the pose is differentiated like a joint's position. With gravity known, an IMU at the
tracked frame would read the result. Wrenches in world axes become wrenches on the robot, and soles
at rest have a constant pose in the world, which tells the geometry of legs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray, IntArray, concatenated, map_arrays
from symbid_ros.errors import DataError
from symbid_ros.model.tree import ON_LINK, STANDARD_GRAVITY
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.splines import interpolating_spline
from symbid_ros.signals.streams import ImuStream, WrenchStream
from symbid_ros.signals.weak_form import prefilter

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DEGREE = 5  # of the splines, whose second derivative is a cubic
# Cutoff as a multiple of that of the samples, its largest share of the rate, and the periods of the
# cutoff in which the low-pass settles.
CUTOFF, LARGEST_SHARE, SETTLING = 2.0, 0.4, 4
# Poses are not differentiated across a gap of more than this many periods.
LONGEST_GAP = 5.5


@dataclass(frozen=True)
class PoseStream:
    """Messages of one Odometry or PoseStamped topic.

    Attributes
    ----------
    topic : str
        Topic as recorded, for messages to the user.
    frame_id : str
        The tracked frame of the robot.
    world : str
        Frame in which the pose is given, with z upwards.
    stamp : (N,) int64
        header.stamp in nanoseconds.
    position : (N, 3) float64
        Origin of the tracked frame, m.
    orientation : (N, 4) float64
        Quaternion xyzw of the tracked frame.
    """

    topic: str
    frame_id: str
    world: str
    stamp: IntArray
    position: FloatArray
    orientation: FloatArray

    def imu(self) -> ImuStream:
        """Return what an IMU at the tracked frame would read.

        Raises
        ------
        DataError
            When there are too few poses.
        """
        parts = [part.smoothed() for part in self._gapless()]
        parts = [part for part in parts if len(part.stamp)]
        if not parts:
            raise DataError(
                f"{self.topic}: {len(self.stamp)} poses are too few to differentiate; record "
                "longer, or publish at a higher rate",
                "E327",
            )
        return concatenated([part._differentiated() for part in parts])

    def at(self, stamp: IntArray) -> FloatArray:
        """Return positions and quaternions (M, 7) at stamps (M,), NaN in gaps."""
        values = np.column_stack([self.position, self._continuous])
        found = np.full((len(stamp), 7), np.nan)
        if len(values) < 2:
            return found
        after = np.clip(np.searchsorted(self.stamp, stamp), 1, len(values) - 1)
        steps = np.diff(self.stamp)
        is_near = (steps <= LONGEST_GAP * np.median(steps))[after - 1]
        inside = (stamp >= self.stamp[0]) & (stamp <= self.stamp[-1])
        inside &= is_near | (self.stamp[after] == stamp)
        for column, one in enumerate(values.T):
            found[inside, column] = np.interp(stamp[inside], self.stamp, one)
        return found

    def smoothed(self) -> "PoseStream":
        """Return the poses after a low-pass, without the ends at which it settles.

        Its cutoff is above that of the samples, because noise of the second derivative is large
        and forces are not filtered here.
        """
        if len(self.stamp) <= DEGREE:
            return map_arrays(self, lambda values: values[:0])
        rate = 1e9 / float(np.median(np.diff(self.stamp)))
        cutoff = min(CUTOFF * prefilter(rate)[0].cutoff, LARGEST_SHARE * rate)
        edge = int(np.ceil(SETTLING * rate / cutoff))
        if len(self.stamp) <= 2 * edge + DEGREE:
            return map_arrays(self, lambda values: values[:0])
        low_pass = LowPass(cutoff)
        quaternion = low_pass(self._continuous, rate)
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        position = low_pass(self.position, rate)
        filtered = replace(self, position=position, orientation=quaternion)
        return map_arrays(filtered, lambda values: values[edge:-edge])

    def _gapless(self) -> "Iterator[PoseStream]":
        """Yield the parts between gaps."""
        steps = np.diff(self.stamp)
        longest = LONGEST_GAP * float(np.median(steps)) if len(steps) else 0.0
        ends = [0, *(np.flatnonzero(steps > longest) + 1).tolist(), len(self.stamp)]
        for start, stop in pairwise(ends):
            yield map_arrays(self, lambda values: values[start:stop])  # noqa: B023

    def _differentiated(self) -> ImuStream:
        seconds, quaternion = self._seconds, self._continuous
        rate = self._spline(quaternion)(seconds, 1)
        half = _times(quaternion * [-1.0, -1.0, -1.0, 1.0], rate)
        acceleration = self._spline(self.position)(seconds, 2)
        felt = Rotation.from_quat(quaternion).inv().apply(acceleration - STANDARD_GRAVITY)
        return ImuStream(
            topic=self.topic,
            frame_id=self.frame_id,
            stamp=self.stamp,
            orientation=quaternion,
            angular_velocity=2 * half[:, :3],
            linear_acceleration=felt,
        )

    def on_robot(self, wrench: WrenchStream, link: str = "") -> WrenchStream:
        """Return a wrench in world axes about the world's origin as one at the tracked frame.

        Parameters
        ----------
        wrench : WrenchStream
            In the frame ``world``.
        link : str
            The link that it acts on; by default the one that carries the tracked frame.
        """
        inside = (wrench.stamp >= self.stamp[0]) & (wrench.stamp <= self.stamp[-1])
        stamp = wrench.stamp[inside]
        seconds = (stamp - self.stamp[0]) * 1e-9
        place = self._spline(self.position)(seconds)
        turn = Rotation.from_quat(self._spline(self._continuous)(seconds)).inv()
        force = wrench.force[inside]
        return replace(
            wrench,
            frame_id=f"{self.frame_id}{ON_LINK}{link}" if link else self.frame_id,
            stamp=stamp,
            force=turn.apply(force),
            torque=turn.apply(wrench.torque[inside] - np.cross(place, force)),
        )

    @property
    def _seconds(self) -> FloatArray:
        seconds: FloatArray = (self.stamp - self.stamp[0]) * 1e-9
        return seconds

    @property
    def _continuous(self) -> FloatArray:
        """(N, 4) quaternions without changes of sign, as q and -q are the same rotation."""
        q = self.orientation / np.linalg.norm(self.orientation, axis=1, keepdims=True)
        turns_back = np.sum(q[1:] * q[:-1], axis=1) < 0
        signs = np.concatenate([[1.0], np.where(np.cumsum(turns_back) % 2, -1.0, 1.0)])
        continuous: FloatArray = q * signs[:, None]
        return continuous

    def _spline(self, values: FloatArray) -> "BSpline":
        return interpolating_spline(self._seconds, values, DEGREE)


def _times(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the products of quaternions xyzw (N, 4)."""
    vector: FloatArray = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    scalar = a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)
    product: FloatArray = np.column_stack([vector, scalar])
    return product
