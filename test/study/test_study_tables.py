"""Tables of a study: our values, the thesis's, and their ratios."""

import csv
import io

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.package_paths import config_file
from symbid_ros.study import thesis
from symbid_ros.study.figures import filter_figure
from symbid_ros.study.plan import DataSet, Plan, PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Case, Scores
from symbid_ros.study.table import Cell, Column, Table, TableRow
from symbid_ros.study.tables import comparison_table, parameter_table, score_tables

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
    """Return random errors, so that no two are equal."""
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


def read(table: Table) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(table.csv)))


def by_name(study: Plan, means: Scores) -> dict[str, Table]:
    return {table.name: table for table in score_tables(study, means)}


def table_d1(model: RobotModel) -> Table:
    true = ParameterSet(model)
    estimates = {"map_lmi": 1.01 * true.values, "ols": 1.5 * true.values}
    return parameter_table(true, estimates, "smooth", "One draw")


def test_tables_depend_on_the_plan() -> None:
    study = plan()
    thesis_tables = {"table_2_smooth", "table_4_1_smooth", "table_c1_smooth"}
    assert set(by_name(study, scores(study))) == thesis_tables
    relative = plan(priors=[PERCENT])
    assert set(by_name(relative, scores(relative))) == thesis_tables - {"table_4_1_smooth"}
    other = plan(thesis=False)
    assert set(by_name(other, scores(other))) == {"comparison"}


@pytest.mark.parametrize(
    ("name", "prior", "printed"),
    [("table_2_smooth", "±25 %", 1.85), ("table_4_1_smooth", "±0.125", 12.8)],
)
def test_best_over_filters_has_the_thesis_values(name: str, prior: str, printed: float) -> None:
    study = plan()
    means = scores(study)
    rows = {row["Method"]: row for row in read(by_name(study, means)[name])}
    tried = [means.means[Case("smooth", prior, "wls_rc", cutoff)] for cutoff in (0.0, 30.0)]
    least = min(one["gen_force_rmse"] for one in tried)
    row = rows["WLS-RC"]
    assert row["Prior"] == prior
    # CSV files hold all digits.
    assert float(row["Gen. force [N, Nm]"]) == least
    assert float(row["Gen. force of the thesis [N, Nm]"]) == printed
    assert float(row["Gen. force ratio"]) == pytest.approx(least / printed, rel=1e-15)
    assert float(row["Singular values"]) == pytest.approx(np.mean([one[RANK] for one in tried]))
    # The thesis lacks this method, which has no singular values.
    assert rows["MAP-LMI"]["Gen. force of the thesis [N, Nm]"] == ""
    assert rows["MAP-LMI"]["Singular values"] == ""
    assert list(rows) == ["Ref.", "OLS", "WLS-RC", "MAP-LMI"]


def test_priors_missing_in_the_thesis_have_no_references() -> None:
    study = plan(priors=[PriorSpread(percent=50.0)])
    table = by_name(study, scores(study))["table_2_smooth"]
    assert all(cell.reference is None for row in table.rows for cell in row.cells)
    assert "ratio" not in table.csv


def test_table_c1_has_a_row_for_each_filter() -> None:
    study = plan()
    means = scores(study)
    rows = read(by_name(study, means)["table_c1_smooth"])
    assert len(rows) == len(means.means)
    row = next(
        row
        for row in rows
        if (row["Prior"], row["Method"], row["Filter [Hz]"]) == ("±25 %", "OLS", "0.0")
    )
    assert float(row["CoM of the thesis [mm]"]) == 173.0
    assert float(row["CoM [mm]"]) == means.means[Case("smooth", "±25 %", "ols", 0.0)][METRICS[2]]


def test_smallest_error_of_each_prior_is_marked() -> None:
    study = plan()
    for name in ("table_2_smooth", "table_4_1_smooth", "table_c1_smooth"):
        table = by_name(study, scores(study))[name]
        for prior in {row.labels[0].display for row in table.rows}:
            rows = [row for row in table.rows if row.labels[0].display == prior]
            for column in range(len(METRICS)):
                values = [row.cells[column].value for row in rows]
                marked = [row.cells[column].value for row in rows if row.cells[column].best]
                assert marked == [min(value for value in values if value is not None)]


def test_parameter_errors_are_relative_to_the_true_values() -> None:
    table = table_d1(load_model(config_file("symbitron.xml")))
    printed = thesis.table_d1()
    for index, row in enumerate(read(table)):
        assert float(row["Real"]) == pytest.approx(printed.real[index], rel=1e-12)
        assert float(row["MAP-LMI error [%]"]) == pytest.approx(1.0)
        assert float(row["OLS error [%]"]) == pytest.approx(50.0)
        theirs = 100 * abs(printed.estimates["ols"][index] / printed.real[index] - 1)
        assert float(row["OLS error of the thesis [%]"]) == pytest.approx(
            theirs, rel=1e-10, abs=1e-10
        )
        if theirs:
            assert float(row["OLS error ratio"]) == pytest.approx(50.0 / theirs)
        assert float(row["OLS of the thesis"]) == printed.estimates["ols"][index]
        # Ratios of errors are meaningful; ratios of estimates are not.
        assert "OLS ratio" not in row


def test_parameters_of_another_robot_have_no_references() -> None:
    table = table_d1(random_robot(3, links=11))
    assert not table.notes
    assert "thesis" not in table.caption
    assert all(cell.reference is None for row in table.rows for cell in row.cells)


def test_caption_of_comparison_names_the_filter() -> None:
    one = plan(thesis=False, filters=[30.0], data={"a": DataSet(), "b": DataSet()})
    table = comparison_table(one, scores(one))
    assert "rows of OLS and WLS-RC filtered at 30 Hz" in table.caption
    ours_alone = plan(thesis=False, methods=["map_lmi"])
    assert "filter" not in comparison_table(ours_alone, scores(ours_alone)).caption
    assert [row.labels[0].display for row in table.rows] == ["a"] * 8 + ["b"] * 8
    several = plan(thesis=False)
    assert "smallest over the filters" in comparison_table(several, scores(several)).caption


def test_markdown_and_csv_of_a_table() -> None:
    table = Table(
        "name",
        "Title",
        "Caption.",
        (Column("Method"),),
        (Column("CoM", "mm"), Column("Count")),
        (
            TableRow((Cell(text="a|b"),), (Cell(2.0, 4.0, best=True), Cell(7.0))),
            TableRow((Cell(text="c"),), (Cell(1234.5678), Cell())),
        ),
        ("A note.",),
    )
    assert table.markdown == (
        "## Title\n\nCaption.\n\n"
        "| Method | CoM (mm) | Count |\n| :-- | --: | --: |\n"
        "| a\\|b | **2.00** (4.00, ×0.50) | 7.00 |\n| c | 1235 | — |\n\n- A note.\n"
    )
    assert table.csv == (
        "Method,CoM [mm],CoM of the thesis [mm],CoM ratio,Count\n"
        "a|b,2.0,4.0,0.5,7.0\nc,1234.5678,,,\n"
    )


def test_tables_and_figures_show_only_the_metrics_of_the_plan() -> None:
    complete, few = plan(), plan(metrics=["torque", "com"])
    means = scores(complete)
    tables_of_few, every = by_name(few, means), by_name(complete, means)
    for name in ("table_2_smooth", "table_c1_smooth"):
        titles = [column.title for column in tables_of_few[name].columns]
        assert titles == ["Torque", "CoM", "Singular values"]
        for row, full in zip(tables_of_few[name].rows, every[name].rows, strict=True):
            assert row.cells == (full.cells[1], full.cells[2], full.cells[5])
    figure = filter_figure(means, "smooth", str(PERCENT), METHODS, shown=few.shown_metrics)
    assert len(figure.figure.axes) == 2
