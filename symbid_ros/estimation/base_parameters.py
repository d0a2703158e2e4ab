"""Base parameters: the combinations of parameters that affect forces.

The columns of the regressor K are linearly dependent for every motion, so K φ is a function of
fewer numbers, φ_base = B φ (Gautier and Khalil 1990, IEEE Trans. Robotics and Automation 6(3);
numerically Gautier 1991, J. Robotic Systems 8(4)). The dependences are a property of the
kinematic tree and are found from noise-free random states. Noisy data would give full rank.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby

import numpy as np
from scipy.linalg import qr

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.row_layout import random_motions
from symbid_ros.model.parameters import ParameterSet

# With columns of unit length, none of 67 published robots (floating or fixed) has a singular value
# between 2e-9 and 0.2. A robot that has one is reported as unclear.
RANK_TOLERANCE = 1e-6
# A column below this share of the largest one is rounding, or comes from axes aligned to 8 digits.
EFFECT_TOLERANCE = 1e-8
# Smallest ratio of singular values at which the rank is clear.
CLEAR_GAP = 1e3
# Coefficients of unit-length columns below this are structural zeros.
ROUNDING = 1e-12
# Smallest share of a parameter's effect that four printed digits can show.
PRINTED_SHARE = 1e-4


@dataclass(frozen=True)
class BaseParameters:
    """The grouping φ_base = B φ, with K φ = K[:, independent] φ_base for every motion.

    Each base parameter is one *independent* parameter plus multiples of dependent ones. Effects
    that two links share are assigned to the link nearer to the base, so the first base parameter
    of a floating robot is its total mass.

    Attributes
    ----------
    names, units : tuple of str
        Names and units of the p parameters.
    independent : (b,) int64
        Index of the independent parameter of each base parameter, ascending.
    matrix : (b, p) float64
        B, in SI units; B[:, independent] is the identity.
    effect : (p,) float64
        Root mean square over random motions of the generalised forces of one unit of each
        parameter; zero if the parameter never has an effect.
    kept, dropped : float
        Smallest singular value within the rank and largest one beyond it, of columns with unit
        length.
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
        """Whether a wide gap in the singular values defines the rank."""
        return self.dropped * CLEAR_GAP < self.kept

    @cached_property
    def alone(self) -> BoolArray:
        """(p,) parameters that are base parameters by themselves, to four digits.

        The others have no effect, or an effect only in combinations (Atkeson, An and Hollerbach
        1986, Int. J. Robotics Research 5(3)).
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

        Coefficients have four significant digits and SI units. Terms below 1e-4 of their
        parameter's effect are omitted. At most ``terms`` terms are printed.
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


def base_parameters(parameters: ParameterSet) -> BaseParameters:
    """Return the base parameters of a robot.

    Raises
    ------
    EstimateError
        When no part of the robot can move.
    """
    p = len(parameters)
    count = 20 + p // 4
    motions = random_motions(parameters.model, count)
    motions = replace(motions, stamp=parameters.typical_stamps(count))
    K = equation_of_motion(parameters, motions).K
    effect = np.sqrt(np.mean(np.sum(K**2, axis=1), axis=0))
    effect[effect < EFFECT_TOLERANCE * effect.max()] = 0.0
    felt = np.flatnonzero(effect)
    # Six random combinations of each state's rows give more rows than columns. With all rows the
    # QR of a humanoid would take ten times as long.
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
    """Choose independent columns block by block, each relative to all earlier blocks.

    ``columns`` (k, k) have unit length, and ``length`` (k,) before scaling. A block has the columns
    of one link or joint. Return the independent columns (b,), an orthonormal basis (k, b) of their
    span, and the singular values on either side of the rank decision.
    """
    chosen: list[int] = []
    basis = np.empty((len(columns), 0))
    kept, dropped = [1.0], [0.0]
    for block in blocks:
        own = columns[:, block]
        # One projection leaves rounding of the removed part; two are enough.
        for _ in range(2):
            own = own - basis @ (basis.T @ own)
        _, values, directions = np.linalg.svd(own, full_matrices=False)
        rank = int(np.sum(values > RANK_TOLERANCE))
        kept += values[:rank].tolist()
        dropped += values[rank:].tolist()
        # The null space of the unscaled columns depends on geometry alone, not on the states.
        remaining = np.delete(np.arange(len(block)), _eliminated(directions[rank:] / length[block]))
        chosen += block[remaining].tolist()
        basis = np.hstack([basis, np.linalg.qr(own[:, remaining])[0]])
    return np.array(chosen, dtype=np.int64), basis, min(kept), max(dropped)


def _eliminated(null: FloatArray) -> list[int]:
    """Return the columns to express by the others, one for each row of ``null`` (d, k).

    They are the pivots of a Cholesky factorisation of the projector on the null space, which
    keeps coefficients small. Among equal pivots the last is used, as is customary (Ixx stays,
    Iyy goes).
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
    """Return X (b, k) with columns = columns[:, chosen] @ X, rounding set to zero."""
    coordinates = basis.T @ columns
    X = np.asarray(np.linalg.solve(coordinates[:, chosen], coordinates), dtype=np.float64)
    X[np.abs(X) < ROUNDING] = 0.0
    X[:, chosen] = np.eye(len(chosen))
    return X
