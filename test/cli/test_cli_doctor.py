"""``symbid bag doctor``: a log's verdict as table, data and exit status."""

import json
import math

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from json_schemas import require_valid
from random_robots import CONFIG

from symbid_ros.cli.bag import print_verdict
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity, StreamFigures

MODEL = CONFIG / "symbitron.xml"
LEFT = "/left_foot/wrench"


@pytest.fixture(scope="module")
def tare(simulated):
    return simulated("tare", ideal=True)


def test_streams_alone_are_clean(symbid_here, tare) -> None:
    result = symbid_here("bag", "doctor", tare)
    assert result.returncode == 0
    assert result.stdout.splitlines()[-1] == "clean"
    assert "left out: all checks against a model: no model is given" in result.stdout


def test_json_holds_what_the_table_says(symbid_here, tare) -> None:
    result = symbid_here("bag", "doctor", tare, "--model", MODEL, "--json")
    assert result.returncode == 1
    told = json.loads(result.stdout)
    require_valid("diagnosis", told)
    assert told["severity"] == "warning"
    assert [one["kind"] for one in told["findings"]] == ["excitation"]
    joints = told["streams"][0]
    assert (joints["topic"], joints["messages"], joints["gaps"]) == ("/joint_states", 5000, 0)
    assert joints["rate_hz"] == pytest.approx(1000)
    text = symbid_here("bag", "doctor", tare, "--model", MODEL).stdout
    assert told["findings"][0]["message"] in text
    assert text.splitlines()[-1] == "warning, 1 found"


def test_exit_status_separates_unusable_from_doubtful_logs(symbid_here, tare, tmp_path) -> None:
    def elsewhere(messages: Messages) -> None:
        messages.reframe("nowhere")

    bag = edit_bag(tare, tmp_path / "bag", {LEFT: elsewhere})
    result = symbid_here("bag", "doctor", bag, "--model", MODEL)
    assert result.returncode == 2
    assert f"unknown_frame: {LEFT}: " in result.stdout
    assert result.stdout.splitlines()[-1] == "unusable, 1 found"
    assert symbid_here("bag", "doctor", bag).returncode == 0


@pytest.mark.parametrize(
    ("part", "kind", "status"),
    [
        (("--start", 1000), "silent", 2),
        (("--stop", 0.005), "short", 2),
        (("--stop", 0.05), "short", 2),
        (("--stop", 0.3), "short", 1),
    ],
)
def test_a_part_without_enough_data_is_not_clean(
    symbid_here, tare, tmp_path, part: tuple[str, float], kind: str, status: int
) -> None:
    """Unusable where an identification refuses the same part."""
    result = symbid_here("bag", "doctor", tare, "--model", MODEL, "--json", *part)
    assert result.returncode == status
    (found,) = json.loads(result.stdout)["findings"]
    assert found["kind"] == kind
    options = "--model", MODEL, "--out", tmp_path / "out", "--method", "ols", *part
    identified = symbid_here("identify", tare, *options)
    assert (identified.returncode == 2) is (status == 2)


def test_the_table_fits_a_narrow_terminal(symbid_here, tare) -> None:
    text = symbid_here("bag", "doctor", tare, columns=60).stdout
    table = [line for line in text.splitlines() if line.startswith(("│", "┃"))]
    assert max(map(len, table)) <= 60
    assert "…" not in text


def test_an_invalid_bag_is_a_one_line_error(symbid_here, tmp_path) -> None:
    result = symbid_here("bag", "doctor", tmp_path / "none")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("severity", [Severity.WARNING, Severity.UNUSABLE])
@pytest.mark.parametrize("kind", Kind)
def test_every_kind_of_finding_is_printed_in_both_forms(capsys, kind, severity) -> None:
    """Whatever computed the figures: Python, NumPy, or a division by nothing."""
    figures = {
        "count": np.sum(np.array([1, 2])),
        "is_late": np.bool_(True),
        "share": np.float32(0.25),
        "scale": 2.5,
        "unknown": np.float64("nan"),
    }
    finding = Finding(kind, LEFT, severity, f"{LEFT}: [odd] \u2212 it is wrong; mend it", figures)
    stream = StreamFigures(LEFT, np.int64(7), 1.0, math.inf, 0.0, 0, 0, 0.0)
    diagnosis = Diagnosis("log", (stream,), (finding,), {"angle": np.float64(3)}, ("delay",))
    print_verdict(diagnosis, as_json=True)
    told = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    require_valid("diagnosis", told)
    assert told["findings"][0] == {
        "kind": kind.value,
        "stream": LEFT,
        "severity": severity.name.lower(),
        "message": finding.message,
        "figures": {"count": 3, "is_late": True, "share": 0.25, "scale": 2.5, "unknown": None},
    }
    assert told["figures"] == {"angle": 3.0}
    assert (told["streams"][0]["messages"], told["streams"][0]["rate_hz"]) == (7, None)
    print_verdict(diagnosis, as_json=False)
    text = capsys.readouterr().out
    assert f"{kind.value}: {finding.message}" in text
    assert text.splitlines()[-1] == f"{severity.name.lower()}, 1 found"
