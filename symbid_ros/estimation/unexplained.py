"""Size of the forces that a model leaves unexplained, apart from noise.

The variance of averaged white noise falls with the ratio r of the window lengths, an error that
lasts keeps its variance. From the residual variances v of short and v' of long windows, the lasting
part has the variance (v' - r v)/(1 - r). It may be chance if v' exceeds r v by less than twice the
relative deviation √(2/N) of N long windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.observations import Observations

# Share of the measured force below which an unexplained part raises no alarm.
SMALL = 0.01
# Share above which no effect that the model lacks, such as friction, is the cause: a fit explains
# at least nothing.
GROSS = 1.2
# Share above which predictions of a force are of no use.
LARGE = 0.5
# Standard deviations of a residual's variance that chance explains, and with which a single
# coordinate raises an alarm.
CHANCE, CLEAR = 2.0, 4.0
# A force counts as at least this share of the largest of its unit: a joint that carries almost
# nothing is not the one to look at.
LEAST_FORCE = 0.05
# Share of such a joint's own force above which an unexplained part that is not chance is not small
# either. A rotor that turns with two wrist joints leaves 6 to 8 % of the last one's force, which
# counts as 0.4 %; correct models of arms leave about 1 % at most. Below a tenth of `SMALL`, a force
# may be that of rounding errors.
SMALL_OF_OWN = 0.05


@dataclass(frozen=True)
class UnexplainedForce:
    """The part of a coordinate's force that neither the model nor noise explains.

    Attributes
    ----------
    coordinate : str
        ``base/moment_x`` … ``base/force_z`` or a joint.
    unit : str
        Nm or N.
    size, measured : float
        Root mean squares of the unexplained and of the measured force; the latter of all three
        axes for a base.
    share : float
        Unexplained share of the measured force, or of a twentieth of the largest such force if
        that is more.
    deviations : float
        By how much more of the residual lasts than of noise, in standard deviations of chance.
    """

    coordinate: str
    unit: str
    size: float
    measured: float
    share: float
    deviations: float = 0.0

    @property
    def own_share(self) -> float:
        """Unexplained share of the measured force, also where that is small."""
        return self.size / self.measured if self.measured > 0 else 0.0

    @property
    def is_clear_in_weak_joint(self) -> bool:
        """Whether it is small beside the largest force, but neither chance nor small by itself."""
        is_small = 0.1 * SMALL < self.share <= SMALL
        return is_small and self.own_share > SMALL_OF_OWN and self.deviations > CLEAR

    @property
    def is_small(self) -> bool:
        """Whether it raises no alarm although residuals are correlated in time."""
        return self.share <= SMALL and not self.is_clear_in_weak_joint

    @property
    def is_clearly_large(self) -> bool:
        """Whether a large part is unexplained, and chance is not the reason."""
        return self.share > LARGE and self.deviations > CLEAR

    @property
    def is_gross(self) -> bool:
        """Whether more is unexplained than measured, as with an effort of the wrong sign."""
        return self.share >= GROSS

    def __str__(self) -> str:
        """Return the sizes, such as ``3 Nm of 80 Nm unexplained on knee``."""
        size, measured = (force_text(one, self.unit) for one in (self.size, self.measured))
        return f"{size} of {measured} unexplained on {self.coordinate}"


def force_text(size: float, unit: str) -> str:
    """Return a force with two significant digits, such as ``110 Nm``."""
    return f"{float(f'{size:.2g}'):g} {unit}"


def unexplained_forces(
    short: Observations,
    long: Observations,
    phi: FloatArray,
    units: Sequence[str],
    factors: Sequence[int] = (),
) -> tuple[UnexplainedForce, ...]:
    """Return the unexplained force of each coordinate that has rows.

    The largest share comes first, those that may be chance last. Of shares that are small, those
    that are clear in a weak joint come first.

    Parameters
    ----------
    short, long : Observations
        Of the same log with the shortest and the longest windows.
    phi : (p,) float64
        Parameters.
    units : sequence of str
        Of the n coordinates.
    factors : sequence of int
        Which parameters are factors of measured efforts. Their columns contain the efforts, and
        the target does not.
    """
    ratio = short.window / long.window
    counts = short.counts.diagonal()
    independent = np.maximum(long.counts.diagonal() / long.inflation, 1)
    before, after = (
        one.rows.residual_moment(phi).diagonal() / np.maximum(one.counts.diagonal(), 1)
        for one in (short, long)
    )
    noise = ratio * before
    excess = np.divide(after - noise, noise, out=np.zeros_like(noise), where=noise > 0)
    deviations = excess / np.sqrt(2 / independent)
    lasting = np.maximum(after - noise, 0.0) / (1 - ratio)
    squares = short.rows.target_squares.copy()
    for column in factors:
        for row in np.flatnonzero(short.layout.structure[:, column]).tolist():
            squares[row] = phi[column] ** 2 * short.rows.column_squares(row, column)
    measured = squares / np.maximum(counts, 1)
    names = short.layout.coordinates
    # Single axes of a base's wrench may be near zero.
    for kind in ("base/moment", "base/force"):
        axes = [i for i, name in enumerate(names) if name.startswith(kind)]
        measured[axes] = measured[axes].sum()
    size, measured = np.sqrt(lasting), np.sqrt(measured)
    largest = {
        unit: max(one for one, other in zip(measured, units, strict=True) if other == unit)
        for unit in set(units)
    }
    found = []
    for i in np.flatnonzero(counts > 0).tolist():
        scale = max(measured[i], LEAST_FORCE * largest[units[i]])
        share = size[i] / scale if scale > 0 else 0.0
        found.append(
            UnexplainedForce(
                names[i],
                units[i],
                float(size[i]),
                float(measured[i]),
                float(share),
                float(deviations[i]),
            )
        )

    def rank(one: UnexplainedForce) -> tuple[bool, bool, bool, float]:
        return one.deviations <= CHANCE, one.share <= SMALL, one.is_small, -one.share

    return tuple(sorted(found, key=rank))
