"""What an identification changed: mass, centre of mass and principal moments of each link."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.archive import load_deviation_factor
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.json_documents import versioned
from symbid_ros.model.inertia import PARAMETERS, com_from_phi


@dataclass(frozen=True)
class Change:
    """A quantity before and after an identification.

    Attributes
    ----------
    before, after : tuple of float
        Of the original and of the identified robot.
    std : tuple of float or None
        Standard deviations of ``after``, to first order in the parameters; None if the method gives
        no covariance.
    """

    before: tuple[float, ...]
    after: tuple[float, ...]
    std: tuple[float, ...] | None


@dataclass(frozen=True)
class LinkChange:
    """Inertia of one link before and after an identification.

    Attributes
    ----------
    name : str
    mass_kg : Change
        One value.
    com_m : Change
        Centre of mass x, y, z in the link's frame.
    principal_inertia_kg_m2 : Change
        Principal moments about the centre of mass, the smallest first.
    determined : int or None
        How many of the ten parameters the data determine; None if the method gives none.
    """

    name: str
    mass_kg: Change
    com_m: Change
    principal_inertia_kg_m2: Change
    determined: int | None


@dataclass(frozen=True)
class TermChange:
    """A joint term, such as ``knee/viscous``, before and after an identification."""

    name: str
    unit: str
    before: float
    after: float
    std: float | None
    determined: bool | None


@dataclass(frozen=True)
class RobotChange:
    """All links and joint terms of a result.

    Attributes
    ----------
    result, model, method : str
        Folder of the result, names of robot and method.
    links : tuple of LinkChange
    joint_terms : tuple of TermChange
        Terms that were identified, and those of sensors.
    """

    result: str
    model: str
    method: str
    links: tuple[LinkChange, ...]
    joint_terms: tuple[TermChange, ...]

    def document(self) -> dict[str, object]:
        """Return what ``symbid diff --json`` prints."""
        return versioned("difference", asdict(self))


def robot_change(folder: Path) -> RobotChange:
    """Compare the identified robot of a result with the original one.

    Raises
    ------
    EstimateError
        When a file of the result is missing or invalid.
    """
    estimate = load_estimate(folder / "estimate.json")
    factor = None if estimate.std is None else load_deviation_factor(folder / "information.npz")
    if factor is not None and len(factor) != len(estimate.names):
        raise EstimateError(
            f"{folder}: the covariance of information.npz has {len(factor)} parameters, "
            f"estimate.json has {len(estimate.names)}; identify the log again",
            "E523",
        )
    place = {name: index for index, name in enumerate(estimate.names)}
    links = tuple(
        _link_change(estimate, factor, link, [place[f"{link}/{name}"] for name in PARAMETERS])
        for link in estimate.consistent
    )
    of_links = {f"{link}/{name}" for link in estimate.consistent for name in PARAMETERS}
    terms = tuple(
        TermChange(
            name,
            estimate.units[index],
            float(estimate.prior[index]),
            float(estimate.value[index]),
            None if estimate.std is None else float(estimate.std[index]),
            None if estimate.determined is None else bool(estimate.determined[index]),
        )
        for name, index in place.items()
        if name not in of_links | estimate.fixed
    )
    return RobotChange(str(folder), estimate.model, estimate.method, links, terms)


def _link_change(
    estimate: Estimate, factor: FloatArray | None, link: str, columns: list[int]
) -> LinkChange:
    before, after = estimate.prior[columns], estimate.value[columns]
    covariance: FloatArray | None = None
    if factor is not None and estimate.std is not None:
        # The factor lacks the scale that all masses share, which moves no centre of mass.
        scale = 0.0 if estimate.verdict is None else estimate.verdict.mass_scale
        spread = np.column_stack([factor[columns], scale * after])
        covariance = spread @ spread.T
    mass_std = None if estimate.std is None else (float(estimate.std[columns[0]]),)
    determined = None
    if estimate.determined is not None:
        determined = int(np.count_nonzero(estimate.determined[columns]))
    return LinkChange(
        link,
        Change((float(before[0]),), (float(after[0]),), mass_std),
        _change(lambda phi: com_from_phi(phi)[1], before, after, covariance),
        _change(principal_moments, before, after, covariance),
        determined,
    )


def principal_moments(phi: FloatArray) -> FloatArray:
    """Return the principal moments (3,) of φ (10,) about the centre of mass, smallest first."""
    moments: FloatArray = np.asarray(np.linalg.eigvalsh(com_from_phi(phi)[2]), dtype=np.float64)
    return moments


def _change(
    quantity: Callable[[FloatArray], FloatArray],
    before: FloatArray,
    after: FloatArray,
    covariance: FloatArray | None,
) -> Change:
    std = None
    if covariance is not None:
        jacobian = _jacobian(quantity, after)
        variances = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
        std = tuple(np.sqrt(np.maximum(variances, 0.0)).tolist())
    return Change(tuple(quantity(before).tolist()), tuple(quantity(after).tolist()), std)


def _jacobian(quantity: Callable[[FloatArray], FloatArray], phi: FloatArray) -> FloatArray:
    """Return the derivative of a quantity by φ (10,), from central differences."""
    sizes = np.repeat([abs(phi[0]), np.abs(phi[1:4]).max(), np.abs(phi[4:]).max()], (1, 3, 6))
    steps = 1e-6 * np.where(sizes > 0, sizes, 1.0)
    columns = [
        (quantity(phi + step) - quantity(phi - step)) / (2 * size)
        for step, size in zip(np.diag(steps), steps, strict=True)
    ]
    return np.stack(columns, axis=1)
