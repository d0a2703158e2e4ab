"""Tells a wrong unit of all forces from a wrong unit of the model's masses.

Both multiply the forces that the model implies by one factor, so motion cannot tell them apart.
Densities of links and limits of efforts can.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import ball_density

# Factors of the efforts of so many joints that differ from one power of ten, and from each other,
# by less are its unit. The model's masses may err by as much.
SAME_UNIT, FEWEST_OF_A_UNIT = 1.25, 3
MILLI = 1e-3
KGF = 9.80665  # N
# RMS efforts that are this many times the limits of their joints may be in mNm: more than drives
# give beyond stated limits, and less than a thousand times what they can.
TIMES_LIMIT = 10.0, 1 / MILLI
# Densities of models, kg/m³, as model_density computes them. Of 67 URDFs of example-robot-data all
# but one are within, half between 120 and 560.
DENSITIES = 10.0, 5e3
# Share by which a model file's total mass may err, that of each link by default. Errors of
# single links average out in the total, but those of a file without cables or covers do not.
MASS_ERROR = 0.25


class Cause(Enum):
    """Why all forces differ from those of the model by one factor."""

    UNIT = auto()
    MASSES = auto()


@dataclass(frozen=True)
class ScaleEvidence:
    """What tells a unit of forces from one of masses.

    Attributes
    ----------
    density : float
        Of the model, kg/m³.
    times_limit : float
        Largest RMS effort of a joint, relative to its limit.
    """

    density: float
    times_limit: float = 0.0

    def cause(self, factor: float) -> Cause | None:
        """Return why forces have to be multiplied by a factor; None if that cannot be told."""
        causes = set[Cause]()
        for of_unit, of_masses in (
            (_is_density(self.density), _is_density(self.density / factor)),
            (self.times_limit * factor < TIMES_LIMIT[0], self.times_limit < TIMES_LIMIT[0]),
        ):
            if of_unit != of_masses:
                causes.add(Cause.UNIT if of_unit else Cause.MASSES)
        return causes.pop() if len(causes) == 1 else None


def unit_of(factor: float) -> float | None:
    """Return the unit, Nm or N, that forces to be multiplied by a factor are in; None if unknown.

    It is a power of ten other than one, or kgf (kgf m) in place of ten.
    """
    power = float(np.log10(factor)) if factor > 0 else 0.0
    nearest = float(np.rint(power))
    if nearest == 0 or abs(power - nearest) >= np.log10(SAME_UNIT):
        return None
    return KGF if nearest == 1 else 10.0**nearest


def common_unit(factors: Collection[float]) -> float | None:
    """Return the unit that efforts are in which have to be multiplied by factors, if it is one.

    Torque constants and gear ratios of three joints or more are not that close to one.
    """
    units = {unit_of(one) for one in factors}
    is_one = len(factors) >= FEWEST_OF_A_UNIT and len(units) == 1
    return units.pop() if is_one and max(factors) < SAME_UNIT * min(factors) else None


def joints_in_milli(times_limits: Mapping[str, float], driven: Sequence[str]) -> list[str]:
    """Return the joints whose efforts may be in mNm; all driven ones if most of them may be.

    Parameters
    ----------
    times_limits : mapping of str to float
        RMS efforts over the limits of the model, of joints beyond them.
    driven : sequence of str
        All driven joints. One driver gives the efforts of all joints in one unit.
    """
    found = [name for name, one in times_limits.items() if TIMES_LIMIT[0] < one < TIMES_LIMIT[1]]
    return list(driven) if 2 * len(found) > len(driven) else found


def unit_name(unit: float, of: str = "Nm") -> str:
    """Return the name of a unit of torques, or of forces ``N``."""
    if unit == KGF:
        return "kgf m" if of == "Nm" else "kgf"
    names = {1e3: f"k{of}", MILLI: f"m{of} (Nmm)" if of == "Nm" else f"m{of}"}
    return names.get(unit, f"units of {unit:g} {of}")


def masses_fault(factor: float) -> str:
    """Return what is wrong with the masses of a model that are a factor too large."""
    if factor == 1 / MILLI:
        return "in g"
    times = 10.0 if factor == KGF else max(factor, 1 / factor)
    size = f"{times:.0f}" if times > 100 else f"{times:.3g}"
    return f"{size} times too {'large' if factor > 1 else 'small'}"


def is_plausible_mass(ratio: float) -> bool:
    """Return whether a robot may weigh so many times what its model file says."""
    # A file that is wrong by MASS_ERROR of the true mass differs by more of its own.
    return 1 - MASS_ERROR <= ratio <= 1 / (1 - MASS_ERROR)


def load_cause(change: float) -> str:
    """Return why forces carry more or less than the true mass, and what to do, by the sign."""
    if change > 0:
        return (
            "it carried a payload, which the model must contain, or the forces have a wrong unit "
            "or scale"
        )
    return (
        "a support without a sensor, such as a crane or a cable, carried the rest: record without "
        "it, or name the frame that it holds in `contact` (FRAME:point for a rope); or the forces "
        "have a wrong unit or scale"
    )


def model_density(phi: FloatArray) -> float:
    """Return the density of the links (L, 10) at the median of mass, kg/m³; NaN without mass."""
    links = sorted((ball_density(one), float(one[0])) for one in phi if one[0] > 0)
    if not links:
        return np.nan
    densities, masses = np.array(links).T
    return float(densities[np.searchsorted(np.cumsum(masses), masses.sum() / 2)])


def _is_density(value: float) -> bool:
    return DENSITIES[0] < value < DENSITIES[1]
