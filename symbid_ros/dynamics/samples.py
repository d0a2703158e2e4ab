"""Motion of a robot and forces on it at single instants."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray, map_arrays


@dataclass(frozen=True)
class Samples:
    """Motion of a robot and forces on it at N instants.

    Joint columns are in model order. Base quantities are in base axes at the base's origin. A
    fixed base has zero rates, and its specific force is minus gravity.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    position, velocity, acceleration : (N, J) float64
        Joint motion, rad or m.
    effort : (N, J) float64
        Joint torques or forces applied by the motors, Nm or N.
    base_angular_velocity, base_angular_acceleration : (N, 3) float64
        rad/s and rad/s².
    base_specific_force : (N, 3) float64
        Acceleration of the base's origin minus gravity, m/s².
    wrenches : (N, F, 6) float64
        Per sensor the (moment; force) of the environment on the robot, in the sensor frame's
        axes about its origin.
    wrench_frames : tuple of str
        Names of the F sensor frames.
    touching : (N, C) bool or None
        Which contacts without a sensor touch something; None if all may.
    sliding, leading, creeping, friction_state : (N, J) float64 or None
        Of :func:`coulomb_column`, :func:`leading_column`, :func:`creeping_column` and
        :func:`friction_state`, filtered like the efforts; None for single instants.
    upward : (N, 3) float64 or None
        Direction away from the earth in base axes; None if it follows from the motion of the base
        (:func:`symbid_ros.dynamics.upright.upward`).
    """

    stamp: IntArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    base_angular_velocity: FloatArray
    base_angular_acceleration: FloatArray
    base_specific_force: FloatArray
    wrenches: FloatArray
    wrench_frames: tuple[str, ...]
    touching: BoolArray | None = None
    sliding: FloatArray | None = None
    leading: FloatArray | None = None
    creeping: FloatArray | None = None
    friction_state: FloatArray | None = None
    upward: FloatArray | None = None

    @classmethod
    def none(cls, joint_names: tuple[str, ...]) -> "Samples":
        """Return no instants of a robot without wrench sensors."""
        joints, base = np.zeros((0, len(joint_names))), np.zeros((0, 3))
        stamp = np.zeros(0, dtype=np.int64)
        return cls(stamp, joints, joints, joints, joints, base, base, base, np.zeros((0, 0, 6)), ())

    def __len__(self) -> int:
        return len(self.stamp)

    def __getitem__(self, index: slice | IntArray) -> "Samples":
        """Return the samples at a slice or at indices."""
        return map_arrays(self, lambda values: values[index])

    def blocks(self, size: int) -> Iterator["Samples"]:
        """Yield consecutive blocks of at most ``size`` samples."""
        for start in range(0, len(self), size):
            yield self[start : start + size]
