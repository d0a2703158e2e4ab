"""Values printed in the thesis, with the names that studies use.

N. van der Gaag, "Least Squares Inertial Parameter Identification of Bipedal Systems": Tables II
(chapter 3), 4.1, C.1 and D.1. Table D.1 is one draw of the prior; the others are means over twenty.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.saved_results import METHOD_TITLES
from symbid_ros.study.plan import PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Case, Scores

# Name of the data set in the thesis's scores.
DATA = "thesis"
# Labels in tables and figures, in the order shown.
TITLES: Mapping[str, str] = {REFERENCE: "Ref.", **METHOD_TITLES}
PRIORS = (PriorSpread(percent=12.5), PriorSpread(percent=25))
ABSOLUTE_PRIOR = PriorSpread(absolute=0.125)
# Section 4.2.2: e_a of the logs of Fig. 4.3, filtered at 70 Hz, rad/s² (the text says Nm).
ACCELERATION_ERRORS: Mapping[str, float] = {"vibrating": 57.0, "floating": 5.0}
# Appendix B: orders of magnitude in N and Nm, by robot, model and source of the contact forces.
EQUATION_RESIDUALS: Mapping[tuple[str, str, str], float] = {
    ("with friction", "rigid links", "measured"): 1.0,
    ("with friction", "rigid links, friction", "by Eq. 4.1"): 1e-5,
    ("without friction", "rigid links", "by Eq. 4.1"): 5e-6,
}

_FOLDER = Path(__file__).with_suffix("")
_METHODS = {title: method for method, title in TITLES.items()}


@dataclass(frozen=True)
class PrintedParameters:
    """Table D.1: one draw of a ±25 % prior, with rows filtered at 50 Hz.

    Attributes
    ----------
    real : (110,) float64
        True values: ten parameters of each of the eleven links in the order of `ParameterSet`,
        first the body, then the right and the left leg from the hip down; kg, kg m, kg m².
    estimates : dict of str to (110,) float64
        By method.
    """

    real: FloatArray
    estimates: Mapping[str, FloatArray]


@cache
def table_2() -> Scores:
    """Return Table II: the smallest mean of each error over the filters."""
    return Scores(dict(_means(_read("table_2")["rows"], PRIORS)))


@cache
def table_4_1() -> Scores:
    """Return Table 4.1: as Table II, with an absolute half-width of the priors."""
    return Scores(dict(_means(_read("table_4_1")["rows"], (ABSOLUTE_PRIOR,))))


@cache
def table_c1() -> Scores:
    """Return Table C.1: every prior, method and filter."""
    return Scores(dict(_means(_read("table_c1")["rows"], PRIORS)))


@cache
def published() -> Scores:
    """Return Tables C.1 and 4.1 as the means of one study."""
    return Scores({**table_c1().means, **table_4_1().means})


@cache
def table_d1() -> PrintedParameters:
    """Return Table D.1: parameters of all links."""
    links = _read("table_d1")["links"]
    columns = {
        column: np.array(
            [links[str(number)][name][column] for number in range(1, 12) for name in PARAMETERS]
        )
        for column in ("real", "ols", "wls_r", "wls_c", "wls_rc")
    }
    return PrintedParameters(columns.pop("real"), columns)


def _read(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((_FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return content


def _means(
    rows: list[dict[str, Any]], priors: Iterable[PriorSpread]
) -> Iterable[tuple[Case, dict[str, float]]]:
    """Yield the case and the means of each row of a table."""
    labels = {one.percent / 100 if one.percent else one.amount: str(one) for one in priors}
    for row in rows:
        method = _METHODS[row["method"]]
        prior = labels[row["prior"] if "prior" in row else row["prior_absolute"]]
        # The prior has no singular values: 0 in Table 4.1, a dash in the other tables.
        names = METRICS if method == REFERENCE else (*METRICS, RANK)
        case = Case(DATA, prior, method, row.get("filter_hz"))
        yield case, {name: float(row[name]) for name in names}
