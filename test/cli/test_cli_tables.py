"""What `symbid identify` prints fits a terminal and survives a pipe."""

from dataclasses import replace
from pathlib import Path

import pytest
from report_pages import SENSORS, VERDICT, estimate

from symbid_ros.cli.tables import print_estimate

ALARMS = ("the data would have the prior 9.0 times wider: a sensor's calibration is wrong",)


@pytest.fixture
def printed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")

    def run(**fields):
        verdict = fields.pop("verdict", VERDICT)
        links = ("base_link", "shin [left]")
        shown = replace(estimate(links, (), "map_lmi"), **{"rank": None, "verdict": verdict})
        print_estimate(replace(shown, **fields), Path("out"))
        return capsys.readouterr().out.splitlines()

    return run


def test_each_link_has_its_line(printed):
    lines = printed()
    assert max(map(len, lines)) <= 80
    (line,) = [line for line in lines if "shin [left]" in line]
    assert line.split("│")[5].strip() == "5 of 10"
    assert all(len(cell.strip()) <= 11 for cell in line.split("│"))


def test_rows_alarms_and_files_have_theirs(printed):
    assert printed()[-4:] == [
        "4321 rows of each coordinate, averaged over windows of 161 ms, condition 1e+03",
        "2 of 20 directions determined, 62 bit gained",
        "no alarm",
        "wrote out/: estimate.json, information.npz, model.urdf, model.xml",
    ]


def test_an_alarm_is_one_line_in_a_pipe_however_long(printed):
    lines = printed(verdict=replace(VERDICT, alarms=ALARMS * 2))
    assert lines[:2] == [f"alarm: {ALARMS[0]}"] * 2
    assert lines[-2] == "2 alarms: do not trust these numbers yet"
    assert "no alarm" not in lines


def test_sensor_errors_are_counted(printed):
    assert "1 of 2 sensor errors determined" in printed(verdict=replace(VERDICT, sensors=SENSORS))


def test_a_truncated_method_tells_its_rank_and_no_verdict(printed):
    assert printed(verdict=None, rank=7)[-2:] == [
        "4321 rows of each coordinate, 7 singular values, condition 1e+03",
        "wrote out/: estimate.json, information.npz, model.urdf, model.xml",
    ]


def test_an_impossible_link_is_called_so(printed):
    lines = printed(consistent={"base_link": True, "shin [left]": False}, std=None, determined=None)
    (line,) = [line for line in lines if "shin [left]" in line]
    assert [cell.strip() for cell in line.split("│")[4:7]] == ["–", "–", "no"]
