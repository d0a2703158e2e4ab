"""What commands print fits a terminal and arrives complete in a pipe."""

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_pages import SENSORS, VERDICT, estimate
from rich.box import HEAVY_HEAD
from rich.console import Console

from symbid_ros.cli.fitted_tables import print_table
from symbid_ros.cli.tables import print_diagnosis, print_estimate, print_metrics
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, StreamFigures
from symbid_ros.report.content import METRICS, MethodResult

ALARMS = ("the data would have the prior 9.0 times wider: a sensor's calibration is wrong",)


@pytest.fixture
def printed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")

    def run(**fields):
        verdict = fields.pop("verdict", VERDICT)
        links = ("base_link", "shin [left]")
        shown = replace(estimate(links, (), "map_lmi"), **{"rank": None, "verdict": verdict})
        print_estimate(replace(shown, **fields), Path("out"), ("estimate.json", "model.xml"))
        return capsys.readouterr().out.splitlines()

    return run


def test_each_link_has_a_row(printed):
    lines = printed()
    assert max(map(len, lines)) <= 80
    (line,) = [line for line in lines if "shin [left]" in line]
    assert line.split("│")[5].strip() == "5 of 10"
    assert all(len(cell.strip()) <= 11 for cell in line.split("│"))


def test_a_link_of_which_nothing_is_known_has_none(printed):
    world = np.arange(20) < 10  # the parameters of base_link
    shown = estimate(("base_link", "shin [left]"), (), "map_lmi")
    prior, found = np.where(world, 0.0, shown.prior), np.where(world, False, shown.determined)
    assert not any("base_link" in line for line in printed(prior=prior, determined=found))
    for some in ({"prior": prior}, {"determined": found}):
        fields = {"prior": shown.prior, "determined": np.full(20, True), **some}
        assert any("base_link" in line for line in printed(**fields))


def test_the_last_lines_show_rows_determined_parameters_alarms_and_files(printed):
    assert printed()[-5:] == [
        "4321 rows of each coordinate, averaged over windows of 161 ms, condition 1e+03",
        "2 of 20 parameter combinations, 10 of 20 single parameters determined",
        "62 bits of information gained",
        "no alarm",
        "wrote out/: estimate.json, model.xml",
    ]


def test_an_alarm_is_one_line_in_a_pipe_however_long(printed):
    lines = printed(verdict=replace(VERDICT, alarms=ALARMS * 2))
    assert lines[:2] == [f"alarm: {ALARMS[0]}"] * 2
    assert lines[-2] == "2 alarms: do not trust these numbers yet"
    assert "no alarm" not in lines


def test_a_floating_robot_whose_prior_was_widened_is_not_recommended(printed):
    widened = replace(VERDICT, alarms=ALARMS, prior_scale=40.0)
    lines = printed(verdict=widened, base="floating")
    assert lines[-2] == (
        "1 alarm: do not trust these numbers yet, as the data widened the prior 40 times"
    )


def test_sensor_errors_are_counted(printed):
    assert "1 of 2 sensor errors determined" in printed(verdict=replace(VERDICT, sensors=SENSORS))


def test_a_truncated_method_shows_its_rank_and_no_verdict(printed):
    assert printed(verdict=None, rank=7)[-2:] == [
        "4321 rows of each coordinate, 7 singular values, condition 1e+03",
        "wrote out/: estimate.json, model.xml",
    ]


def test_an_impossible_link_is_marked(printed):
    lines = printed(consistent={"base_link": True, "shin [left]": False}, std=None, determined=None)
    (line,) = [line for line in lines if "shin [left]" in line]
    assert [cell.strip() for cell in line.split("│")[4:7]] == ["–", "–", "no"]


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_wide_table_continues_below_with_complete_names_and_numbers(width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    headers = ("m", "mc_x", "mc_y", "mc_z"), ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
    cells = [f"(1.{index}e-04)" for index in range(10)]
    print_table(Console(), "link", headers, [("wrist_2_link", cells), None, ("base", cells)])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    numbers = [one for line in lines if "wrist_2_link" in line for one in line.split()[1:]]
    assert numbers == cells


def test_a_long_name_stays_in_one_line_if_the_table_fits(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    name = "wam/shoulder_pitch_link"
    print_table(Console(), "link", (("kg",), ("determined",)), [(name, ["1.0", "3 of 10"])])
    (line,) = [one for one in capsys.readouterr().out.splitlines() if "wam" in one]
    assert line.split() == [name, "1.0", "3", "of", "10"]


@pytest.mark.parametrize("width", [48, 50, 80])
def test_names_stay_whole_beside_the_columns_of_a_group(width, capsys, monkeypatch):
    """In a frame, whether padded, dense (50 columns) or in parts (48 columns)."""
    monkeypatch.setenv("COLUMNS", str(width))
    name = "left_upper_arm_link"
    headers = ("kg", "± kg"), ("determined",)
    print_table(
        Console(), "link", headers, [(name, ["1.000", "0.100", "3 of 10"])], style=HEAVY_HEAD
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert all(name in line for line in lines if "│" in line)


class TestMetricsTable:
    methods = (
        MethodResult("prior", None, dict.fromkeys((m.key for m in METRICS), 12.3)),
        MethodResult("WLS-RC", None, dict.fromkeys((m.key for m in METRICS), 0.456)),
        MethodResult("OLS", None, dict.fromkeys((m.key for m in METRICS), 11813.0)),
        MethodResult("truth", None, dict.fromkeys((m.key for m in METRICS), 3.2e-12)),
        MethodResult("unmeasured", None, None),
    )

    def printed(self, *, colours: bool = False, width: int = 80) -> str:
        stream = io.StringIO()
        console = Console(
            file=stream,
            width=width,
            force_terminal=colours,
            color_system="standard" if colours else None,
        )
        print_metrics(console, self.methods)
        return stream.getvalue()

    def test_fits_in_80_columns(self) -> None:
        lines = self.printed().splitlines()
        assert max(map(len, lines)) <= 80
        assert next(line for line in lines if "OLS" in line).split() == ["OLS", *["11813"] * 5]

    def test_continues_below_on_a_narrow_terminal(self) -> None:
        lines = self.printed(width=60).splitlines()
        assert max(map(len, lines)) <= 60
        shown = [cell for line in lines if "OLS" in line for cell in line.split()[1:]]
        assert shown == ["11813"] * 5

    def test_the_best_method_is_bold_and_the_truth_is_excluded(self) -> None:
        bold = "\x1b[1m"
        lines = self.printed(colours=True).splitlines()
        assert next(line for line in lines if "WLS-RC" in line).count(bold) == 5
        assert bold not in next(line for line in lines if "truth" in line)

    def test_a_star_marks_the_best_where_nothing_is_bold(self) -> None:
        starred = {line.split()[0]: line.count(" *") for line in self.printed().splitlines()[2:-2]}
        assert starred.pop("WLS-RC") == 5
        assert not any(starred.values())

    def test_a_missing_metric_is_a_dash(self) -> None:
        line = next(line for line in self.printed().splitlines() if "unmeasured" in line)
        assert line.split()[1:] == ["—"] * 5


@pytest.mark.parametrize("width", [40, 60, 80])
def test_streams_keep_their_names_and_verdicts(width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    topic = "/right_foot/wrench"
    found = [Finding.of(topic, kind, "it is wrong", {}) for kind in (Kind.DISORDER, Kind.DUPLICATE)]
    stream = StreamFigures(topic, 8000, 40.0, 200.0, 0.0, 3, 4, 0.125)
    print_diagnosis(Diagnosis("log", (stream,), tuple(found), {}, ()))
    lines = capsys.readouterr().out.splitlines()
    assert (
        max(map(len, lines[: lines.index(next(one for one in lines if "it is" in one))])) <= width
    )
    shown = re.split(r"[\s│┃]+", " ".join(lines))
    assert topic in shown
    assert {"8000", "200", "3", "0.125"} <= set(shown)
    assert {"disorder", "duplicate"} <= {word.strip(",") for word in shown}


def test_in_a_pipe_each_stream_has_a_line(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    topic = "/left_arm/force_torque_sensor_broadcaster/wrench_of_the_left_tool"
    stream = StreamFigures(topic, 8000, 40.0, 200.0, 0.0, 3, 4, 0.125)
    print_diagnosis(Diagnosis("log", (stream,), (), {}, ()))
    (line,) = [one for one in capsys.readouterr().out.splitlines() if topic in one]
    assert line.split()[1::2] == [topic, "8000", "200", "3", "0.125", "clean"]


def test_a_log_that_cannot_be_read_has_no_empty_table(capsys):
    found = Finding.of("/joint_states", Kind.CLOCK_JUMP, "the clock jumps", {})
    print_diagnosis(Diagnosis("log", (), (found,), {}, ()))
    assert capsys.readouterr().out.splitlines()[0] == "clock_jump: /joint_states: the clock jumps"
