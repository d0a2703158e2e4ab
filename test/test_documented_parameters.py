"""The tables of docs/conventions.md and docs/theory.md name every parameter of the code."""

import re
from pathlib import Path

import pytest

from symbid_ros.choices import JOINT_TERMS, SENSOR_ERROR_KINDS
from symbid_ros.estimation.prior_std import term_scale
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sensor_errors import ALL_KINDS

DOCS = Path(__file__).resolve().parents[1] / "docs"
SLIDING = """<robot name="slide">
  <link name="world"/><link name="car"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="{}"><parent link="world"/><child link="car"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def rows(page: str, first: str) -> dict[str, list[str]]:
    """Return the other cells of a page's rows whose first cell matches, by what it captures."""
    cells = [
        re.split(r"(?<!\\)\|", line)[1:-1]
        for line in (DOCS / page).read_text(encoding="utf-8").splitlines()
        if line.startswith("| ")
    ]
    matched = [(re.match(first, line[0].strip()), line[1:]) for line in cells]
    return {found[1]: [one.strip() for one in rest] for found, rest in matched if found}


@pytest.mark.parametrize(("place", "kind"), [(0, "revolute"), (1, "prismatic")])
def test_every_joint_term_has_its_unit_and_prior(place, kind, tmp_path) -> None:
    """Names, units and prior standard deviations of terms that a model file does not state."""
    shown = rows("conventions.md", f"`<joint>/({'|'.join(JOINT_TERMS)})`$")
    assert list(shown) == list(JOINT_TERMS)
    model = tmp_path / "slide.urdf"
    model.write_text(SLIDING.format(kind))
    parameters = ParameterSet(load_model(model), terms=tuple(JOINT_TERMS))
    known = zip(parameters.units[-len(JOINT_TERMS) :], term_scale(parameters), strict=True)
    for (unit, std), (units, stds, _) in zip(known, shown.values(), strict=True):
        assert units.split(", ")[place].replace("²", "^2") == unit
        assert float(stds.split(", ")[place]) == pytest.approx(std)


def test_every_sensor_error_has_a_row() -> None:
    shown = rows("conventions.md", f"`<\\w+>/({'|'.join(ALL_KINDS)})[_`]")
    assert set(shown) == set(ALL_KINDS)


def test_every_sensor_error_has_its_prior_in_the_theory() -> None:
    text = "\n".join(rows("theory.md", r"(`.*`.*)"))
    assert not [kind for kind in SENSOR_ERROR_KINDS if f"`{kind}`" not in text]
