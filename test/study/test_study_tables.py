"""Tables of a study: ours, the thesis's, and what lies between."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.errors import StudyError
from symbid_ros.study import thesis
from symbid_ros.study.figures import grid_drawing
from symbid_ros.study.plan import DataSet, Plan, PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Case, Scores
from symbid_ros.study.table import Cell, Column, Row, Table
from symbid_ros.study.tables import Draw, comparison, parameters, tables

PERCENT, ABSOLUTE = PriorSpread(percent=25.0), PriorSpread(absolute=0.125)
METHODS = ["map_lmi", "ols", "wls_rc"]


def plan(**changes: object) -> Plan:
    entries: dict[str, object] = {
        "title": "A study",
        "thesis": True,
        "data": {"smooth": DataSet()},
        "priors": [PERCENT, ABSOLUTE],
        "filters": [0.0, 30.0],
        "methods": METHODS,
    }
    return Plan.model_validate(entries | changes)


def scores(study: Plan) -> Scores:
    """Errors of random size, so that no two are alike."""
    generator = np.random.default_rng(4)
    cases = [
        Case(data, str(spread), method, cutoff)
        for data in study.data
        for spread in study.priors
        for method in (REFERENCE, *study.methods)
        for cutoff in (study.filters if method in ("ols", "wls_rc") else [None])
    ]
    return Scores(
        {
            case: {
                name: float(generator.uniform(0.1, 10))
                for name in (METRICS if case.filter is None else (*METRICS, RANK))
            }
            for case in cases
        }
    )


def read(sheet: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(sheet.csv)))


def by_name(sheets: tuple[Table, ...]) -> dict[str, Table]:
    return {sheet.name: sheet for sheet in sheets}


def draw() -> Draw:
    printed = thesis.table_d1()
    names = tuple(f"parameter {number}" for number in range(110))
    return Draw(
        data="smooth",
        prior=PERCENT,
        filter=50.0,
        names=names,
        units=("kg",) * 110,
        real=printed.real,
        estimates={"map_lmi": 1.01 * printed.real, "ols": 1.5 * printed.real},
    )


def test_only_tables_with_inputs_are_made() -> None:
    study = plan()
    everything = by_name(tables(study, scores(study), draw()))
    assert set(everything) == {
        "table_1",
        "table_2_smooth",
        "table_4_1_smooth",
        "table_c1_smooth",
        "table_d1",
    }
    relative = plan(priors=[PERCENT])
    assert "table_4_1_smooth" not in by_name(tables(relative, scores(relative)))
    assert "table_d1" not in by_name(tables(relative, scores(relative)))
    other = plan(thesis=False)
    assert set(by_name(tables(other, scores(other)))) == {"comparison"}


@pytest.mark.parametrize(
    ("name", "prior", "printed"),
    [("table_2_smooth", "±25 %", 1.85), ("table_4_1_smooth", "±0.125", 12.8)],
)
def test_best_over_filters_stands_beside_the_thesis(name: str, prior: str, printed: float) -> None:
    study = plan()
    means = scores(study)
    rows = {row["Method"]: row for row in read(by_name(tables(study, means))[name])}
    tried = [means.means[Case("smooth", prior, "wls_rc", cutoff)] for cutoff in (0.0, 30.0)]
    least = min(one["gen_force_rmse"] for one in tried)
    row = rows["WLS-RC"]
    assert row["Prior"] == prior
    # No digit is lost.
    assert float(row["Gen. force [N, Nm]"]) == least
    assert float(row["Gen. force of the thesis [N, Nm]"]) == printed
    assert float(row["Gen. force ratio"]) == pytest.approx(least / printed, rel=1e-15)
    assert float(row["Singular values"]) == pytest.approx(np.mean([one[RANK] for one in tried]))
    # The thesis has no such method, and that one no singular values.
    assert rows["MAP-LMI"]["Gen. force of the thesis [N, Nm]"] == ""
    assert rows["MAP-LMI"]["Singular values"] == ""
    assert list(rows) == ["Ref.", "OLS", "WLS-RC", "MAP-LMI"]


def test_priors_that_the_thesis_did_not_print_stand_alone() -> None:
    study = plan(priors=[PriorSpread(percent=50.0)])
    sheet = by_name(tables(study, scores(study)))["table_2_smooth"]
    assert all(cell.reference is None for row in sheet.rows for cell in row.cells)
    assert "ratio" not in sheet.csv


def test_every_filter_has_its_row() -> None:
    study = plan()
    means = scores(study)
    rows = read(by_name(tables(study, means))["table_c1_smooth"])
    assert len(rows) == len(means.means)
    row = next(
        row
        for row in rows
        if (row["Prior"], row["Method"], row["Filter [Hz]"]) == ("±25 %", "OLS", "0.0")
    )
    assert float(row["CoM of the thesis [mm]"]) == 173.0
    assert float(row["CoM [mm]"]) == means.means[Case("smooth", "±25 %", "ols", 0.0)][METRICS[2]]


def test_least_error_of_a_prior_is_marked_in_one_row() -> None:
    study = plan()
    for name in ("table_2_smooth", "table_4_1_smooth", "table_c1_smooth"):
        sheet = by_name(tables(study, scores(study)))[name]
        for prior in {row.labels[0].display for row in sheet.rows}:
            rows = [row for row in sheet.rows if row.labels[0].display == prior]
            for column in range(len(METRICS)):
                values = [row.cells[column].value for row in rows]
                marked = [row.cells[column].value for row in rows if row.cells[column].best]
                assert marked == [min(value for value in values if value is not None)]


def test_parameters_err_relative_to_the_real_ones() -> None:
    sheet = parameters(draw())
    printed = thesis.table_d1()
    for index, row in enumerate(read(sheet)):
        assert float(row["Real"]) == printed.real[index]
        assert float(row["MAP-LMI error [%]"]) == pytest.approx(1.0)
        assert float(row["OLS error [%]"]) == pytest.approx(50.0)
        theirs = 100 * abs(printed.estimates["ols"][index] / printed.real[index] - 1)
        assert float(row["OLS error of the thesis [%]"]) == pytest.approx(theirs, abs=1e-12)
        if theirs:
            assert float(row["OLS error ratio"]) == pytest.approx(50.0 / theirs)
        assert float(row["OLS of the thesis"]) == printed.estimates["ols"][index]
        # How two estimates compare tells nothing; how their errors do does.
        assert "OLS ratio" not in row


def test_another_robots_parameters_have_no_figures_of_the_thesis() -> None:
    other = draw()
    sheet = parameters(replace(other, real=other.real + 1.0))
    assert not sheet.notes
    assert "thesis" not in sheet.caption
    assert all(cell.reference is None for row in sheet.rows for cell in row.cells)


def test_draw_of_another_size_is_refused() -> None:
    with pytest.raises(StudyError, match="109 entries for 110"):
        replace(draw(), real=thesis.table_d1().real[1:])


def test_comparison_names_its_one_filter_or_says_that_it_is_the_best() -> None:
    one = plan(thesis=False, filters=[30.0], data={"a": DataSet(), "b": DataSet()})
    sheet = comparison(one, scores(one))
    assert "rows of OLS and WLS-RC filtered at 30 Hz" in sheet.caption
    ours_alone = plan(thesis=False, methods=["map_lmi"])
    assert "filter" not in comparison(ours_alone, scores(ours_alone)).caption
    assert [row.labels[0].display for row in sheet.rows] == ["a"] * 8 + ["b"] * 8
    several = plan(thesis=False)
    assert "least over the filters" in comparison(several, scores(several)).caption


def test_markdown_has_ours_first_and_the_thesis_in_brackets() -> None:
    sheet = Table(
        "name",
        "Title",
        "Caption.",
        (Column("Method"),),
        (Column("CoM", "mm"), Column("Count")),
        (
            Row((Cell(text="a|b"),), (Cell(2.0, 4.0, best=True), Cell(7.0))),
            Row((Cell(text="c"),), (Cell(1234.5678), Cell())),
        ),
        ("A note.",),
    )
    assert sheet.markdown == (
        "## Title\n\nCaption.\n\n"
        "| Method | CoM (mm) | Count |\n| :-- | --: | --: |\n"
        "| a\\|b | **2.00** (4.00, ×0.50) | 7.00 |\n| c | 1235 | — |\n\n- A note.\n"
    )
    assert sheet.csv == (
        "Method,CoM [mm],CoM of the thesis [mm],CoM ratio,Count\n"
        "a|b,2.0,4.0,0.5,7.0\nc,1234.5678,,,\n"
    )


def test_metrics_left_out_of_the_plan_are_left_out_of_tables_and_figures() -> None:
    whole, few = plan(), plan(metrics=["torque", "com"])
    made = scores(whole)
    tables_of_few, every = by_name(tables(few, made)), by_name(tables(whole, made))
    for name in ("table_2_smooth", "table_c1_smooth"):
        titles = [column.title for column in tables_of_few[name].columns]
        assert titles == ["Torque", "CoM", "Singular values"]
        for row, full in zip(tables_of_few[name].rows, every[name].rows, strict=True):
            assert row.cells == (full.cells[1], full.cells[2], full.cells[5])
    assert tables_of_few["table_1"] == every["table_1"]
    drawing = grid_drawing(made, "smooth", str(PERCENT), METHODS, shown=few.shown_metrics)
    assert len(drawing.figure.axes) == 2
