"""Layout of flat rows: the structural non-zeros of a robot's regressor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import TERMS
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import combined_coordinates, possible_states
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.column_groups import ColumnGroups
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class RowLayout:
    """Layout of a flat sample row: for each coordinate its structural non-zeros of K, then its y.

    Attributes
    ----------
    coordinates : tuple of str
        Names of the n coordinates.
    parameters : tuple of str
        Names of the p parameters.
    structure : (n, p) bool
        Entries of K that are non-zero for some motion.
    combined : tuple of int
        Coordinates whose rows are orthonormal combinations of several, without unmeasured contacts.
    """

    coordinates: tuple[str, ...]
    parameters: tuple[str, ...]
    structure: BoolArray
    combined: tuple[int, ...] = ()

    @classmethod
    def of(cls, parameters: ParameterSet) -> "RowLayout":
        """Find the structure of a robot's regressor from noise-free random motions.

        Raises
        ------
        EstimateError
            When no part of the robot can move.
        """
        model = parameters.model
        samples = replace(random_motions(model, 20), stamp=parameters.typical_stamps(20))
        K = np.zeros((model.dof, len(parameters)))
        # Rows depend on which contacts touch something, if that is known.
        for touching in possible_states(model) or (None,):
            state = None if touching is None else np.tile(touching, (len(samples), 1))
            rows = equation_of_motion(parameters, replace(samples, touching=state))
            K = np.maximum(K, np.abs(rows.K).max(axis=0))
        # Structural zeros still contain rounding, relative to their column or row. Joint terms do
        # not count in the row, so that a column's structure is the same beside any of them.
        by_links = K[:, : parameters.inertial].max(axis=1, keepdims=True, initial=0.0)
        structure = 1e-10 * np.maximum(K.max(axis=0), by_links) < K
        return cls(model.coordinates, parameters.names, structure, combined_coordinates(model))

    def extended(self, names: tuple[str, ...], structure: BoolArray) -> "RowLayout":
        """Return the layout with more parameters, non-zero in the coordinates ``structure``."""
        return RowLayout(
            self.coordinates,
            self.parameters + names,
            np.concatenate([self.structure, structure], axis=1),
            self.combined,
        )

    def restricted(self, parameters: tuple[str, ...]) -> "RowLayout":
        """Return the layout with some of the parameters, in the same order."""
        if parameters not in self._restrictions:
            kept = [self.parameters.index(name) for name in parameters]
            self._restrictions[parameters] = RowLayout(
                self.coordinates, parameters, self.structure[:, kept], self.combined
            )
        return self._restrictions[parameters]

    @cached_property
    def _restrictions(self) -> dict[tuple[str, ...], "RowLayout"]:
        """Layouts with some of the parameters; one object for each, for what it caches."""
        return {}

    @cached_property
    def own_coordinates(self) -> tuple[int, ...]:
        """Coordinates with a parameter that affects no other."""
        own = self.structure[:, self.structure.sum(axis=0) == 1]
        return tuple(np.flatnonzero(own.any(axis=1)).tolist())

    @cached_property
    def term_coordinates(self) -> frozenset[int]:
        """Coordinates that a joint term or an own parameter affects."""
        is_term = [name.rpartition("/")[2] in TERMS for name in self.parameters]
        affected = np.flatnonzero(self.structure[:, is_term].any(axis=1))
        return frozenset([*affected.tolist(), *self.own_coordinates])

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
        """Per coordinate its slice of the flat row, y last."""
        ends = np.cumsum([len(columns) + 1 for columns in self.columns])
        return tuple(
            slice(int(end) - len(columns) - 1, int(end))
            for end, columns in zip(ends, self.columns, strict=True)
        )

    @cached_property
    def column_groups(self) -> ColumnGroups:
        """The columns of [K y], by the coordinates in which they are non-zero."""
        return ColumnGroups(self.structure, [np.arange(one.start, one.stop) for one in self.slices])

    @cached_property
    def _moment_pattern(self) -> csr_array:
        """Places in a flat moment (w w,) of the entries of :meth:`moments_by_pair`."""
        n, p = len(self.columns), len(self.parameters)
        coordinate = np.repeat(np.arange(n), [len(each) + 1 for each in self.columns])
        column = np.concatenate([np.append(each, p) for each in self.columns])
        one, other = np.triu_indices(self.width)
        rows = column[one] * (p + 1) + column[other]
        pairs = coordinate[one] * n + coordinate[other]
        places = one + self.width * other  # in Fortran order, as BLAS returns the moment
        return csr_array((places, (rows, pairs)), shape=((p + 1) ** 2, n**2))

    def moments_by_pair(self, gram: FloatArray) -> csr_array:
        """Return the moments of [K y] by pairs of coordinates, from those of the flat rows.

        Parameters
        ----------
        gram : (w, w) float64
            Upper triangle of Σ rowᵀ row of flat rows, in Fortran order, with half its diagonal.

        Returns
        -------
        ((p + 1) (p + 1), n n) csr_array
            X with X + Xᵀ the moment Σ [K y]ᵀ P [K y], where X is the product with a flat symmetric
            precision P (n, n) across coordinates.
        """
        pattern = self._moment_pattern  # sorted once for each layout
        data = gram.ravel(order="F")[pattern.data]
        return csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)

    def flatten(self, blocks: Sequence[Rows]) -> FloatArray:
        """Return the flat rows (N, w) of all samples of blocks."""
        flat = np.empty((sum(len(rows.y) for rows in blocks), self.width))
        first = 0
        for rows in blocks:
            part = flat[first : first + len(rows.y)]
            for i, (columns, place) in enumerate(zip(self.columns, self.slices, strict=True)):
                part[:, place.start : place.stop - 1] = rows.K[:, i, columns]
                part[:, place.stop - 1] = rows.y[:, i]
            first += len(part)
        return flat

    def spread(self, values: BoolArray) -> BoolArray:
        """Return values of coordinates (N, n) for all columns of the flat rows (N, w)."""
        return np.repeat(values, [place.stop - place.start for place in self.slices], axis=1)


def random_motions(model: RobotModel, count: int) -> Samples:
    """Return ``count`` noise-free random states and accelerations, the same in every call.

    Rates and accelerations are of order one in SI units, joint limits are ignored, and nothing
    touches the robot.

    Raises
    ------
    EstimateError
        When no part of the robot can move.
    """
    if not model.coordinates:
        raise EstimateError(
            f"{model.source}: its base is fixed and no joint moves, so its inertia has no effect; "
            "give a model with joints, or `base` floating",
            "E419",
        )
    rng = np.random.default_rng(0)
    joints, base = (count, len(model.joints)), (3, count, 3)
    motion = rng.normal(size=base) if model.floating else np.zeros(base)
    if not model.floating:
        motion[2] = -model.gravity
    random = Samples(
        stamp=np.arange(count, dtype=np.int64),
        position=model.apply_mimics(rng.uniform(-np.pi, np.pi, joints)),
        velocity=model.apply_mimics(rng.normal(size=joints), rates=True),
        acceleration=model.apply_mimics(rng.normal(size=joints), rates=True),
        effort=np.zeros(joints),
        base_angular_velocity=motion[0],
        base_angular_acceleration=motion[1],
        base_specific_force=motion[2],
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )
    # A joint reverses in too few of these motions for the friction about a reversal to show.
    reversing = rng.uniform(-1.0, 1.0, (2, *joints))
    return replace(random, leading=np.sign(reversing[0]), creeping=reversing[1])
