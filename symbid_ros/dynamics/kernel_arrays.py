"""Arrays that the compiled :mod:`symbid_ros.dynamics.kernel` works on."""

from typing import Any, NamedTuple

from symbid_ros.arrays import FloatArray, IntArray

# Samples of a tile. The tile's results fit the second-level cache for robots of 60 joints, and the
# state and forces of one link the first-level cache.
LANES = 64
# Numbers of a link's state, and of its wrench per unit parameter, for each sample of a tile.
STATE, WRENCH = 36, 42


class Tree(NamedTuple):
    """A robot's joints and the places of its packed results.

    Attributes
    ----------
    parent : (J,) int64
        Parent links; joint j carries link j + 1.
    pose : (J, 15, 4) float64
        :attr:`symbid_ros.dynamics.kinematics.JointTable.pose`.
    reference : (J,) float64
        Positions at which the child has the pose of the model file.
    revolute : (J,) float64
        1 for a revolute joint, 0 for a prismatic one.
    rank : (L,) int64
        Position of each link among those with parameters, -1 for others.
    ranked : int
        Number of links with parameters.
    floating : bool
        Whether the first six coordinates are those of the base.
    pair_start : (L + 1,) int64
        Slices of the pairs of each link.
    pair_joint, pair_place : (P,) int64
        The joints between the base and the link, and where their rows of its columns begin.
    """

    parent: IntArray
    pose: FloatArray
    reference: FloatArray
    revolute: FloatArray
    rank: IntArray
    ranked: int
    floating: bool
    pair_start: IntArray
    pair_joint: IntArray
    pair_place: IntArray


class Motion(NamedTuple):
    """Motion of N samples.

    Attributes
    ----------
    position, velocity, acceleration : (N, J) float64
    omega, alpha, force : (N, 3) float64
        Of the base.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    omega: FloatArray
    alpha: FloatArray
    force: FloatArray


class Loads(NamedTuple):
    """Efforts and measured wrenches of N samples.

    Attributes
    ----------
    effort : (N, J) float64
    wrench : (N, F, 6) float64
        Moment and force in each sensor's frame.
    link : (F,) int64
        The link on which the wrench acts.
    carrier : (F,) int64
        The link to which the frame is fixed.
    rotation, translation : (F, 3, 3) and (F, 3) float64
        Pose of the frame in its link.
    path : (J, L) bool
        Whether a joint lies between the base and a link.
    """

    effort: FloatArray
    wrench: FloatArray
    link: IntArray
    carrier: IntArray
    rotation: FloatArray
    translation: FloatArray
    path: Any


class Windows(NamedTuple):
    """Weights of W windows of consecutive samples.

    Attributes
    ----------
    first : (W,) int64
        First sample of each window.
    start : (W + 1,) int64
        Slices of ``weight``.
    weight : (S,) float64
        Weights of the samples of all windows.
    """

    first: IntArray
    start: IntArray
    weight: FloatArray
