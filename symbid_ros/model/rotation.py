"""Conversions between rotation matrices, URDF's rpy and the quaternions of MuJoCo and ROS."""

import numpy as np

from symbid_ros.arrays import FloatArray


def rotation_from_rpy(rpy: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) of fixed-axis roll, pitch, yaw in rad (URDF)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return fixed-axis roll, pitch, yaw (3,) in rad of a (3, 3) rotation.

    At gimbal lock (pitch ±90°) roll is zero and yaw takes the remaining rotation.
    """
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) > 1e-9:
        roll = np.arctan2(rotation[2, 1], rotation[2, 2])
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    else:
        roll = 0.0
        yaw = np.arctan2(-rotation[0, 1], rotation[1, 1])
    return np.array([roll, pitch, yaw])


def rotation_from_quaternion(wxyz: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) rotations of quaternions (..., 4), scalar first.

    The quaternions are normalised first, so rounding in a file or message has no effect on
    orthogonality.
    """
    w, x, y, z = np.moveaxis(wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_from_xyzw(xyzw: FloatArray) -> FloatArray:
    """Return the (..., 3, 3) rotations of ROS quaternions (..., 4), scalar last."""
    return rotation_from_quaternion(np.roll(xyzw, 1, axis=-1))


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternion (4,) of a rotation, scalar first and non-negative.

    Shepperd's method divides by the largest component, which keeps full precision for every
    rotation.
    """
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    outer = np.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], squares[2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[3]],
        ]
    )
    best: FloatArray = outer[np.argmax(squares)]
    quaternion = best / np.linalg.norm(best)
    return -quaternion if quaternion[0] < 0 else quaternion
