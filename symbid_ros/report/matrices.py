"""Matrices of a report: how well each parameter is determined, and how parameters correlate."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.image import imsave

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import TERMS
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.content import ParameterCorrelation
from symbid_ros.report.formatting import significant, with_std

# Okabe and Ito's blue and vermilion, on which the opacity shows the size.
POSITIVE, NEGATIVE = (0, 114, 178), (213, 94, 0)
PAIRS_SHOWN = 8
LINK_CHANGES_SHOWN, TERM_CHANGES_SHOWN = 8, 4
LABELS_SHOWN = 22  # at most, beside the correlation matrix


@dataclass(frozen=True)
class MatrixCell:
    """One parameter: share of its information that is from the data, and its description."""

    share: float
    is_determined: bool
    text: str


@dataclass(frozen=True)
class DeterminedMatrix:
    """Rows of links or joints, columns of parameter kinds; None where there is no parameter."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[MatrixCell | None, ...]], ...]


def determined_matrices(
    estimate: Estimate, prior_std: FloatArray | None
) -> tuple[DeterminedMatrix, ...]:
    """Return the matrices of the links' and of the joints' parameters."""
    if estimate.std is None or estimate.determined is None:
        return ()
    cells: dict[str, dict[str, MatrixCell]] = {}
    for index, name in enumerate(estimate.names):
        owner, _, kind = name.rpartition("/")
        if name in estimate.fixed or (kind not in PARAMETERS and kind not in TERMS):
            continue
        is_determined = bool(estimate.determined[index])
        std, share = float(estimate.std[index]), float(is_determined)
        if prior_std is not None and prior_std[index] > 0:
            share = float(np.clip(1 - (std / prior_std[index]) ** 2, 0.0, 1.0))
        unit = estimate.units[index].replace("^2", "²")
        text = (
            f"{name}: {with_std(float(estimate.value[index]), std)} {unit}, original "
            f"{significant(float(estimate.prior[index]))}; {100 * share:.0f} % from the data"
        )
        cells.setdefault(owner, {})[kind] = MatrixCell(round(share, 3), is_determined, text)
    matrices = []
    for every in (PARAMETERS, TERMS):
        kinds = tuple(kind for kind in every if any(kind in own for own in cells.values()))
        rows = tuple(
            (owner, tuple(own.get(kind) for kind in kinds))
            for owner, own in cells.items()
            if any(kind in own for kind in kinds)
        )
        if rows:
            matrices.append(DeterminedMatrix(kinds, rows))
    return tuple(matrices)


@dataclass(frozen=True)
class CorrelationImage:
    """Correlations as a picture that suits light and dark pages.

    Attributes
    ----------
    size : int
        Number of parameters.
    address : str
        PNG as a data URI.
    groups : tuple of (str, int)
        Link or joint of consecutive parameters, and how many it has. The name is empty where it
        does not fit.
    pairs : tuple of (str, str, str)
        The strongest correlations between parameters, and their values.
    """

    size: int
    address: str
    groups: tuple[tuple[str, int], ...]
    pairs: tuple[tuple[str, str, str], ...]


def correlation_image(spread: ParameterCorrelation) -> CorrelationImage:
    """Return the picture of a correlation matrix; its diagonal is blank."""
    matrix = spread.correlation - np.diag(np.diag(spread.correlation))
    pixels = np.zeros((*matrix.shape, 4), dtype=np.uint8)
    pixels[..., :3] = np.where((matrix > 0)[..., None], POSITIVE, NEGATIVE)
    pixels[..., 3] = np.round(255 * np.abs(matrix))
    buffer = io.BytesIO()
    imsave(buffer, pixels, format="png")
    address = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    groups: list[tuple[str, int]] = []
    for name in spread.names:
        owner, _, kind = name.rpartition("/")
        label = owner if kind in PARAMETERS else "joint terms"
        if groups and groups[-1][0] == label:
            groups[-1] = label, groups[-1][1] + 1
        else:
            groups.append((label, 1))
    rows, columns = np.triu_indices(len(matrix), 1)
    strength = np.abs(matrix[rows, columns])
    order = np.argsort(-strength, kind="stable")[:PAIRS_SHOWN]
    pairs = tuple(
        (
            spread.names[rows[place]],
            spread.names[columns[place]],
            f"{matrix[rows[place], columns[place]]:+.3f}".replace("-", "−"),
        )
        for place in order.tolist()
    )
    return CorrelationImage(len(matrix), address, _legible(groups), pairs)


def _legible(groups: Sequence[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
    """Return groups in which names that would overlap the one above are empty."""
    distance = sum(count for _, count in groups) / LABELS_SHOWN
    kept: list[tuple[str, int]] = []
    since = distance
    for name, count in groups:
        is_free = since >= distance
        kept.append((name if is_free else "", count))
        since = count if is_free else since + count
    return tuple(kept)


@dataclass(frozen=True)
class LargeChange:
    """A parameter that changed much."""

    name: str
    before: str
    after: str
    deviations: str


def largest_changes(estimate: Estimate, prior_std: FloatArray | None) -> tuple[LargeChange, ...]:
    """Return the parameters that changed most, in standard deviations of the original.

    Those of links come first, then joint terms, which often have no original value.
    """
    if prior_std is None or estimate.std is None:
        return ()
    change = np.zeros(len(estimate.names))
    known = prior_std > 0
    change[known] = (estimate.value - estimate.prior)[known] / prior_std[known]
    is_of_link = np.array([name.rpartition("/")[2] in PARAMETERS for name in estimate.names])
    order = np.argsort(-np.abs(change), kind="stable")
    order = np.concatenate(
        [
            order[is_of_link[order]][:LINK_CHANGES_SHOWN],
            order[~is_of_link[order]][:TERM_CHANGES_SHOWN],
        ]
    )
    return tuple(
        LargeChange(
            estimate.names[index],
            significant(float(estimate.prior[index])).replace("-", "−"),
            f"{with_std(float(estimate.value[index]), float(estimate.std[index]))} "
            f"{estimate.units[index]}".replace("^2", "²"),
            f"{change[index]:+.1f}".replace("-", "−"),
        )
        for index in order.tolist()
        if abs(change[index]) > 0
    )
