"""Every parameter of one draw, as each method found it, beside the thesis's (Table D.1)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.study import thesis
from symbid_ros.study.plan import Spread
from symbid_ros.study.sheet import Cell, Column, Row, Sheet, beside
from symbid_ros.study.thesis import TITLES


@dataclass(frozen=True)
class Draw:
    """One draw of the prior, and what the methods made of it.

    Attributes
    ----------
    data : str
        The data set.
    prior : Spread
        How the prior was drawn.
    filter : float
        Hz, cutoff of the truncated methods' rows.
    names, units : tuple of str
        Of the p parameters.
    real : (p,) float64
        The truth.
    estimates : dict of str to (p,) float64
        By method, "ref" for the prior itself.

    Raises
    ------
    StudyError
        When the sizes do not agree.
    """

    data: str
    prior: Spread
    filter: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    real: FloatArray
    estimates: Mapping[str, FloatArray]

    def __post_init__(self) -> None:
        sizes = {"units": len(self.units), "real": len(self.real)}
        sizes |= {method: len(values) for method, values in self.estimates.items()}
        for what, size in sizes.items():
            if size != len(self.names):
                raise StudyError(
                    f"draw on {self.data}: {what} has {size} entries for {len(self.names)} "
                    "parameters; give one for each"
                )


def parameters(draw: Draw) -> Sheet:
    """Return Table D.1: every parameter, what each method made of it, and how far off that is."""
    printed = thesis.table_d1()
    methods = [method for method in TITLES if method in draw.estimates]
    rows = []
    for index, (name, unit) in enumerate(zip(draw.names, draw.units, strict=True)):
        real = float(draw.real[index])
        # The thesis's robot had no friction and its columns came first, in the same order.
        known = index < len(printed.real) and np.isclose(real, printed.real[index])
        cells = [Cell(real)]
        for method in methods:
            own = float(draw.estimates[method][index])
            theirs = (
                float(printed.estimates[method][index])
                if known and method in printed.estimates
                else None
            )
            cells += [Cell(own, theirs, rated=False), Cell(_off(own, real), _off(theirs, real))]
        rows.append(Row((Cell(words=name), Cell(words=unit)), tuple(cells)))
    columns = [Column("Real")]
    for method in methods:
        columns += [Column(TITLES[method]), Column(f"{TITLES[method]} error", "%")]
    return Sheet(
        name="table_d1",
        title=f"Table D.1: parameters, {draw.data}",
        caption=(
            f"One draw of a {draw.prior} prior, rows of the truncated methods filtered at "
            f"{draw.filter:g} Hz; errors relative to the real value." + beside(rows)
        ),
        headings=(Column("Parameter"), Column("Unit")),
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            "The thesis's figures are one draw of a ±25 % prior at 50 Hz, another one than ours: "
            "single ratios tell of the draws as much as of the methods.",
        )
        if beside(rows)
        else (),
    )


def _off(value: float | None, real: float) -> float | None:
    return None if value is None or real == 0 else 100 * abs(value - real) / abs(real)
