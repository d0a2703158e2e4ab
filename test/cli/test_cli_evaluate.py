"""`symbid evaluate` and `symbid report`, with and without their optional inputs."""

import json
import shutil
from dataclasses import asdict, fields

import numpy as np
import pytest
from json_schemas import require_valid
from report_pages import Page

from symbid_ros.estimation.archive import load_deviation_factor
from symbid_ros.identification.predictions.evaluation import Metrics
from symbid_ros.identification.predictions.intervals import summarise_intervals
from symbid_ros.identification.predictions.realistic_prediction import RealisticMetrics
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion


@pytest.fixture(scope="module")
def prior(symbid_here, model, tmp_path_factory):
    path = tmp_path_factory.mktemp("prior") / "prior.json"
    ended = symbid_here("prior", "--model", model, "--percent", 25, "--seed", 3, "--out", path)
    assert (ended.returncode, ended.stderr) == (0, "")
    return path


@pytest.fixture(scope="module")
def found(symbid_here, model, short, prior, tmp_path_factory):
    """What two methods found in one log, side by side."""
    out = tmp_path_factory.mktemp("found")
    for method in ("map_lmi", "wls_rc"):
        ended = symbid_here(
            *("identify", short, "--model", model, "--prior", prior),
            *("--method", method, "--window", 0.081, "--joint-terms", "none"),
            *("--out", out / method),
        )
        assert ended.returncode == 0
        # The truncated method leaves links that no mass density can realise.
        assert ("the nearest" in ended.stderr) == (method == "wls_rc")
    return out


def test_an_estimate_with_covariance_has_intervals(symbid_here, model, ideal, found) -> None:
    command = ("evaluate", found / "map_lmi", "--truth", model, "--bag", ideal)
    shown = symbid_here(*command)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "90 % intervals" in shown.stdout
    intervals = json.loads(symbid_here(*command, "--json").stdout)["intervals"]
    estimate = json.loads((found / "map_lmi" / "estimate.json").read_text())["parameters"]
    parameters = ParameterSet.of_names(load_model(model), tuple(estimate))
    expected = summarise_intervals(
        parameters,
        np.array([estimate[name]["value"] for name in parameters.names]),
        load_deviation_factor(found / "map_lmi" / "information.npz"),
        parameters.values,
        read_true_motion([ideal], parameters.model),
    )
    assert intervals == pytest.approx(asdict(expected))
    assert all(f"{value:.4g}" in shown.stdout for value in intervals.values())


def test_an_estimate_without_covariance_has_none(symbid_here, model, ideal, found) -> None:
    command = ("evaluate", found / "wls_rc", "--truth", model, "--bag", ideal)
    ended = symbid_here(*command)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "intervals" not in ended.stdout
    assert "intervals" not in json.loads(symbid_here(*command, "--json").stdout)


def test_a_page_without_truth_shows_what_was_found(
    symbid_here, model, short, found, tmp_path
) -> None:
    file = tmp_path / "report.html"
    ended = symbid_here(
        *("report", found / "wls_rc", found / "map_lmi"),
        *("--model", model, "--bag", short, "--out", file),
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, f"wrote {file}\n", "")
    page = Page(file.read_text())
    assert page.row("Coordinate") == ["Coordinate", "WLS-RC", "MAP-LMI"]
    document = json.loads((found / "map_lmi" / "estimate.json").read_text())
    masses = [row for row in page.rows if row[0] == "m"]
    for row, link in zip(masses, document["consistent"], strict=True):
        mass = document["parameters"][f"{link}/m"]
        assert float(row[1]) == pytest.approx(mass["value"], abs=0.051 * mass["std"])
    assert "methods" not in page.attributes("id")


def test_a_report_needs_nothing_but_the_result(symbid_here, found, tmp_path) -> None:
    result = tmp_path / "result"
    shutil.copytree(found / "map_lmi", result)
    ended = symbid_here("report", result)
    assert (ended.returncode, ended.stdout) == (0, f"wrote {result / 'report.html'}\n")
    page = Page((result / "report.html").read_text())
    assert {"forces", "data-summary", "log", "data"} <= set(page.attributes("id"))
    assert "missing" not in page.attributes("id")


def test_a_result_of_an_earlier_version_says_what_is_missing(
    symbid_here, short, found, tmp_path
) -> None:
    result = tmp_path / "result"
    shutil.copytree(found / "map_lmi", result)
    (result / "report_data.npz").unlink()
    symbid_here("report", result)
    page = Page((result / "report.html").read_text())
    assert "missing" in page.attributes("id")
    assert "forces" not in page.attributes("id")
    unused = symbid_here("report", result, "--start", 1)
    assert unused.returncode == 2
    assert "--start has no effect without --bag" in unused.stderr
    ended = symbid_here("report", result, "--bag", short)
    assert (ended.returncode, ended.stderr) == (0, "")
    page = Page((result / "report.html").read_text())
    assert "forces" in page.attributes("id")
    assert "missing" not in page.attributes("id")


def test_invalid_report_requests_are_one_line_errors(
    symbid_here, model, short, prior, found, tmp_path
) -> None:
    file = tmp_path / "report.html"
    for subject, options, says in (
        (prior, (), "holds a prior"),
        (found / "map_lmi", ("--realistic", short), "add --truth"),
        (found / "none", (), "cannot read it"),
        (found / "map_lmi" / "estimate.json", (), "not a result of `symbid identify`, a file"),
        (short, (), f"{short}: not a result of `symbid identify`"),
    ):
        command = ("report", subject, "--model", model, "--bag", short, "--out", file)
        ended = symbid_here(*command, *options)
        assert ended.returncode == 2
        assert says in ended.stderr
        assert ended.stderr.count("\n") == 1
        assert not file.exists()
    beside = symbid_here("report", model)  # the page would be written into this folder
    assert "not a result of `symbid identify`, a file" in beside.stderr


def test_realistic_predictions_come_beside_the_ideal_ones(
    symbid_here, model, short, ideal, prior
) -> None:
    command = ("evaluate", prior, "--truth", model, "--bag", ideal)
    plain = symbid_here(*command)
    assert "from noisy sensors" not in plain.stdout
    both = symbid_here(*command, "--realistic", short)
    assert (both.returncode, both.stderr) == (0, "")
    assert "from noisy sensors" in both.stdout
    figures = json.loads(symbid_here(*command, "--realistic", short, "--json").stdout)
    require_valid("evaluation", figures)
    realistic = figures.pop("realistic")
    assert figures == json.loads(symbid_here(*command, "--json").stdout)
    names = {field.name for field in fields(Metrics)}
    assert set(figures) == {"schema_version", "sticking_pct", *names}
    assert set(realistic) == {field.name for field in fields(RealisticMetrics)}
    assert all(f"{value:.4g}" in both.stdout for value in realistic.values())


def test_bags_unsuitable_for_predictions_are_one_line_errors(
    symbid_here, model, short, ideal, prior, copied_without, tmp_path
) -> None:
    command = ("evaluate", prior, "--truth", model, "--bag", ideal, "--realistic")
    no_imu = copied_without(short, tmp_path / "bag", "imu")
    for options, named in (
        ((no_imu,), "Imu"),
        ((short, "--velocity-cutoff", 900), "cutoff 900 Hz"),
    ):
        ended = symbid_here(*command, *options)
        assert ended.returncode == 2
        assert named in ended.stderr
        assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize("command", ["evaluate", "report"])
def test_a_nominal_model_is_not_taken_for_the_truth(
    symbid_here, model, ideal, found, tmp_path, command
) -> None:
    nominal = tmp_path / "nominal.urdf"
    robot = load_model(model)
    nominal.write_text(urdf_text(robot.with_phi(1.01 * robot.phi)))
    given = (command, found / "map_lmi", "--bag", ideal)
    out = ("--out", tmp_path / "page.html") if command == "report" else ()
    ended = symbid_here(*given, "--truth", nominal, *out)
    assert ended.returncode == 0
    words = " ".join(ended.stderr.split())
    assert f"{nominal.name} leaves 1 % of the bag's forces unexplained" in words
    assert symbid_here(*given, "--truth", model, *out).stderr == ""
    assert symbid_here(*given, "--truth", model, "--quiet", *out).stderr == ""
