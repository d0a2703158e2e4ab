"""Base parameters: the combinations of parameters that forces can tell of at all.

Columns of the regressor K depend on each other, whatever the motion: K φ is a
function of fewer numbers, φ_base = B φ (Gautier and Khalil 1990, IEEE Trans.
Robotics and Automation 6(3); numerically Gautier 1991, J. Robotic Systems 8(4)).
Which ones is a property of the kinematic tree, so it is found from noise-free
random states; data with noise would give full rank.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.linalg import qr

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.information import random_motions
from symbid_ros.model.parameters import ParameterSet

# Columns of unit length have no singular value between 2e-9 and 0.2 in any of 67 published
# robots, floating or fixed; a robot that has one is reported as unclear.
RANK_TOLERANCE = 1e-6
# A column this small against the largest one is rounding, or axes aligned to eight digits.
EFFECT_TOLERANCE = 1e-8
# Gap below which the rank is a matter of taste.
CLEAR_GAP = 1e3
# Coefficients of unit-length columns below this are zeros of the tree.
ROUNDING = 1e-12
# Smallest share of a parameter's effect that four printed digits can show.
PRINTED_SHARE = 1e-4


@dataclass(frozen=True)
class BaseParameters:
    """The grouping φ_base = B φ, with K φ = K[:, independent] φ_base for every motion.

    Each base parameter is one *independent* parameter plus multiples of dependent
    ones. Links nearer the base come first: what two links share is counted to the
    one nearer the base, so that the first base parameter of a floating robot is its
    total mass.

    Attributes
    ----------
    names, units : tuple of str
        Of the p parameters.
    independent : (b,) int64
        Index of the parameter that leads each base parameter, ascending.
    matrix : (b, p) float64
        B, in SI units; B[:, independent] is the identity.
    effect : (p,) float64
        Root mean square over random motions of the generalised forces of one unit of
        each parameter; zero where the parameter has no effect on any motion.
    kept, dropped : float
        Smallest singular value that counted towards the rank and largest one that
        did not, of columns scaled to unit length.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    independent: IntArray
    matrix: FloatArray
    effect: FloatArray
    kept: float
    dropped: float

    def __len__(self) -> int:
        return len(self.independent)

    @property
    def clear(self) -> bool:
        """Whether a wide gap separates what counts from what does not."""
        return self.dropped * CLEAR_GAP < self.kept

    @property
    def without_effect(self) -> BoolArray:
        """(p,) parameters that no motion can show."""
        return np.asarray(self.effect == 0.0)

    @cached_property
    def alone(self) -> BoolArray:
        """(p,) parameters that are base parameters by themselves, to four digits.

        The others have no effect, or show in combinations only (Atkeson, An and
        Hollerbach 1986, Int. J. Robotics Research 5(3)).
        """
        alone = np.zeros(len(self.names), dtype=bool)
        alone[self.independent[np.count_nonzero(self._visible, axis=1) == 1]] = True
        return alone

    @cached_property
    def _visible(self) -> BoolArray:
        """(b, p) terms that four printed digits can show."""
        share = np.abs(self.matrix) * self.effect[self.independent, None]
        return np.asarray(share > PRINTED_SHARE * self.effect)

    def describe(self, index: int, terms: int | None = None) -> str:
        """Return base parameter ``index`` as a sum, like ``thigh/Ixx - thigh/Iyy + 0.16·foot/m``.

        Coefficients have four significant digits and are in SI units; a term below
        1e-4 of its parameter's effect is left out. At most ``terms`` terms are written.
        """
        row, lead = self.matrix[index], self.independent[index]
        others = np.flatnonzero(self._visible[index])
        written = [lead, *others[others != lead]]
        more = 0 if terms is None else max(0, len(written) - terms)
        text = self.names[lead]
        for column in written[1 : len(written) - more]:
            size = f"{abs(row[column]):.4g}"
            factor = "" if size == "1" else f"{size}·"
            text += f" {'-' if row[column] < 0 else '+'} {factor}{self.names[column]}"
        return f"{text} + … ({more} more)" if more else text

    def text(self, terms: int | None = 8) -> str:
        """Return all base parameters, one a line, and what has no effect."""
        lines = [
            f"{len(self)} base parameters of {len(self.names)} parameters, "
            f"{np.sum(self.alone)} of them alone"
        ]
        lines += [
            f"{index + 1:4d}  {self.describe(index, terms)}  [{self.units[lead]}]"
            for index, lead in enumerate(self.independent)
        ]
        silent = [self.names[column] for column in np.flatnonzero(self.without_effect)]
        if silent:
            lines.append("no effect on any motion: " + ", ".join(silent))
        if not self.clear:
            lines.append(
                f"their number is unclear: singular values {self.kept:.1e} and {self.dropped:.1e} "
                "lie on either side; look for axes that are nearly parallel in the model file"
            )
        return "\n".join(lines)


def base_parameters(parameters: ParameterSet) -> BaseParameters:
    """Group a robot's parameters into those that its forces can tell apart.

    Raises
    ------
    EstimateError
        When the robot cannot move at all.
    """
    p = len(parameters)
    motions = random_motions(parameters.model, 20 + p // 4)
    K = equation_of_motion(parameters, motions).K
    effect = np.sqrt(np.mean(np.sum(K**2, axis=1), axis=0))
    effect[effect < EFFECT_TOLERANCE * effect.max()] = 0.0
    felt = np.flatnonzero(effect)
    # Six random combinations of each state's rows outnumber the columns; all rows would only
    # make the QR of a humanoid ten times as long.
    combinations = np.random.default_rng(0).normal(size=(len(K), 6, K.shape[1]))
    (factor,) = qr((combinations @ K[:, :, felt]).reshape(-1, len(felt)), mode="r")
    length = np.linalg.norm(factor, axis=0)
    columns = factor[: len(felt)] / length
    owners = [parameters.names[column].rpartition("/")[0] for column in felt]
    blocks = [
        np.array([k for k, _ in block])
        for _, block in groupby(enumerate(owners), key=lambda pair: pair[1])
    ]
    chosen, basis, kept, dropped = _independent(columns, length, blocks)
    matrix = np.zeros((len(chosen), p))
    matrix[:, felt] = _coefficients(columns, chosen, basis) * length / length[chosen, None]
    return BaseParameters(
        parameters.names, parameters.units, felt[chosen], matrix, effect, kept, dropped
    )


def _independent(
    columns: FloatArray, length: FloatArray, blocks: Sequence[IntArray]
) -> tuple[IntArray, FloatArray, float, float]:
    """Choose independent columns block by block, each against all blocks before it.

    Parameters
    ----------
    columns : (k, k) float64
        Of unit length.
    length : (k,) float64
        Their lengths before scaling.
    blocks : sequence of (≤ 10,) int64
        Columns of one link or joint.

    Returns
    -------
    chosen : (b,) int64
        Independent columns.
    basis : (k, b) float64
        Orthonormal basis of their span.
    kept, dropped : float
        Singular values on either side of the decision.
    """
    chosen: list[int] = []
    basis = np.empty((len(columns), 0))
    kept, dropped = [1.0], [0.0]
    for block in blocks:
        own = columns[:, block]
        # Once leaves the rounding of what was taken away; twice is enough.
        for _ in range(2):
            own = own - basis @ (basis.T @ own)
        _, values, directions = np.linalg.svd(own, full_matrices=False)
        rank = int(np.sum(values > RANK_TOLERANCE))
        kept += values[:rank].tolist()
        dropped += values[rank:].tolist()
        # The null space of the columns as they were depends on geometry alone, not on the states.
        remaining = np.delete(np.arange(len(block)), _eliminated(directions[rank:] / length[block]))
        chosen += block[remaining].tolist()
        basis = np.hstack([basis, np.linalg.qr(own[:, remaining])[0]])
    return np.array(chosen, dtype=np.int64), basis, min(kept), max(dropped)


def _eliminated(null: FloatArray) -> list[int]:
    """Return which columns to express by the others, one for each row of ``null`` (d, k).

    Taken by pivoted Cholesky of the projector on the null space, so that no
    coefficient is large; among equals the last, as is the custom (Ixx stays, Iyy goes).
    """
    orthonormal, _ = np.linalg.qr(null.T)
    projector = orthonormal @ orthonormal.T
    eliminated: list[int] = []
    for _ in null:
        diagonal = np.diag(projector)
        last = int(np.flatnonzero(diagonal > (1 - 1e-6) * diagonal.max())[-1])
        eliminated.append(last)
        column = projector[:, last]
        projector = projector - np.outer(column, column) / column[last]
    return eliminated


def _coefficients(columns: FloatArray, chosen: IntArray, basis: FloatArray) -> FloatArray:
    """Return X (b, k) with columns = columns[:, chosen] @ X, rounding taken for zero."""
    coordinates = basis.T @ columns
    X = np.asarray(np.linalg.solve(coordinates[:, chosen], coordinates), dtype=np.float64)
    X[np.abs(X) < ROUNDING] = 0.0
    X[:, chosen] = np.eye(len(chosen))
    return X
