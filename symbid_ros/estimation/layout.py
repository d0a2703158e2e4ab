"""Which entries of the regressor can be non-zero, and where they go in a flat row."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class RowLayout:
    """The flattened sample row: for each coordinate its non-zeros of K, then its y.

    Attributes
    ----------
    coordinates : tuple of str
        Names of the n coordinates.
    parameters : tuple of str
        Names of the p parameters.
    structure : (n, p) bool
        The entries of K that some motion makes non-zero.
    """

    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    structure: BoolArray

    @classmethod
    def of(cls, parameters: ParameterSet) -> "RowLayout":
        """Find the structure of a robot's regressor from noise-free random motions.

        Raises
        ------
        EstimateError
            When the robot cannot move at all.
        """
        model = parameters.model
        K = np.abs(equation_of_motion(parameters, random_motions(model, 20)).K).max(axis=0)
        # Entries that vanish by structure still hold rounding, of the column's size at most.
        structure = 1e-10 * np.maximum(K.max(axis=0), K.max(axis=1, keepdims=True)) < K
        return cls(model.coordinates, parameters.names, structure)

    def extended(self, names: tuple[str, ...], structure: BoolArray) -> "RowLayout":
        """Return the layout with more columns, and the coordinates (n, r) that they reach."""
        return RowLayout(
            self.coordinates,
            self.parameters + names,
            np.concatenate([self.structure, structure], axis=1),
        )

    @property
    def width(self) -> int:
        """Length w of the flat row."""
        return int(self.structure.sum()) + len(self.coordinates)

    @cached_property
    def columns(self) -> tuple[IntArray, ...]:
        """Per coordinate the indices of its parameters, in the flat row's order."""
        return tuple(np.flatnonzero(row) for row in self.structure)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Per coordinate its stretch of the flat row, y last."""
        ends = np.cumsum([len(columns) + 1 for columns in self.columns])
        return tuple(
            slice(int(end) - len(columns) - 1, int(end))
            for end, columns in zip(ends, self.columns, strict=True)
        )

    @cached_property
    def coordinate_pairs(self) -> IntArray:
        """(w w,) the place in an (n, n) matrix of the coordinates of any two entries."""
        n = len(self.columns)
        coordinate = np.repeat(np.arange(n), [len(each) + 1 for each in self.columns])
        return np.asarray((coordinate[:, None] * n + coordinate).ravel())

    @cached_property
    def moment_places(self) -> IntArray:
        """(w w,) where the product of two entries stands in a flat moment of [K y], (p+1, p+1)."""
        p = len(self.parameters)
        column = np.concatenate([np.append(each, p) for each in self.columns])
        return np.asarray((column[:, None] * (p + 1) + column).ravel())

    def flatten(self, rows: Rows) -> FloatArray:
        """Return the flat rows (N, w) of N samples."""
        flat = np.empty((len(rows.K), self.width))
        for coordinate, (columns, place) in enumerate(zip(self.columns, self.slices, strict=True)):
            flat[:, place.start : place.stop - 1] = rows.K[:, coordinate, columns]
            flat[:, place.stop - 1] = rows.y[:, coordinate]
        return flat

    def residual_map(self, phi: FloatArray) -> FloatArray:
        """Return B (w, n) with flat row @ B = y - K φ for the parameters φ (p,)."""
        B = np.zeros((self.width, len(self.coordinates)))
        for coordinate, (columns, place) in enumerate(zip(self.columns, self.slices, strict=True)):
            B[place.start : place.stop - 1, coordinate] = -phi[columns]
            B[place.stop - 1, coordinate] = 1.0
        return B


def random_motions(model: RobotModel, count: int) -> Samples:
    """Return ``count`` noise-free random states and accelerations, the same at every call.

    They show what the regressor can show: lengths, rates and accelerations are of
    order one in SI units, joint limits are ignored, nothing touches the robot.

    Raises
    ------
    EstimateError
        When the robot cannot move at all.
    """
    if not model.coordinates:
        raise EstimateError(
            f"{model.source}: its base is fixed and no joint moves, so no force tells of its "
            "inertia; name a model with joints, or give --base floating"
        )
    rng = np.random.default_rng(0)
    joints, base = (count, len(model.joints)), (3, count, 3)
    motion = rng.normal(size=base) if model.floating else np.zeros(base)
    if not model.floating:
        motion[2] = -model.gravity
    return Samples(
        stamp=np.arange(count, dtype=np.int64),
        position=model.followed(rng.uniform(-np.pi, np.pi, joints)),
        velocity=model.followed(rng.normal(size=joints), rates=True),
        acceleration=model.followed(rng.normal(size=joints), rates=True),
        effort=np.zeros(joints),
        base_angular_velocity=motion[0],
        base_angular_acceleration=motion[1],
        base_specific_force=motion[2],
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )
