"""A small study from the command to the page: its numbers equal those of direct calls."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import PHONE
from small_study import PLAN, SmallStudy, run_inline

from symbid_ros.bags import bag_log
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.rows.dataset import Processing, read_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.signals.filters import LowPass
from symbid_ros.study import page
from symbid_ros.study.draws import StudyResults
from symbid_ros.study.page import publish, study_sections
from symbid_ros.study.plan import load_plan
from symbid_ros.study.study_folder import StudyFolder

KINDS = {"±25 %": ("percent", 25.0), "±0.125": ("absolute", 0.125)}
COLUMNS = {
    "gen_force_rmse": "Gen. force [N, Nm]",
    "torque_rmse": "Torque [Nm]",
    "com_position_rmse_mm": "CoM [mm]",
    "com_momentum_rmse": "Momentum [Ns, Nms]",
    "parameter_error_pct": "Parameters [%]",
}
TITLES = {
    "ref": "Ref.",
    "ols": "OLS",
    "wls_r": "WLS-R",
    "wls_c": "WLS-C",
    "wls_rc": "WLS-RC",
    "map": "MAP",
    "map_lmi": "MAP-LMI",
}


@pytest.fixture(scope="module")
def direct(simulated) -> dict[tuple[str, str], dict[str, float]]:
    """Return the mean errors by prior and method, from direct calls."""
    logs = (
        simulated("smooth", moves=1, motion_seed=21, noise_seed=5),
        simulated("smooth", moves=1, motion_seed=22, ideal=True),
    )
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    filtered = Processing(LowPass(30.0))
    log, ideal = (read_dataset(bag_log([bag]), parameters, filtered) for bag in logs)
    windows = read_dataset(bag_log([logs[0]]), parameters)
    motion = read_true_motion([logs[1]], parameters.model)[::10]
    means = {}
    for label, (kind, amount) in KINDS.items():
        found: dict[str, list] = {method: [] for method in TITLES}
        for seed in (8, 9):
            prior = draw_prior(parameters, kind, amount, seed)
            by_filter = SolvedProblem.of(Problem(log.observations, parameters, prior))
            by_windows = SolvedProblem.of(Problem(windows.observations, parameters, prior))
            vectors = {"ref": prior.mean}
            ranks = {}
            for method in ("ols", "wls_r", "wls_c", "wls_rc"):
                estimate = by_filter.truncated(
                    method, Truncation(validation=ideal.observations)
                ).estimate
                vectors[method], ranks[method] = estimate.value, estimate.rank
            vectors["map"] = by_windows.map().estimate.value
            vectors["map_lmi"] = by_windows.map_lmi().estimate.value
            judged = evaluate(parameters, vectors, parameters.values, motion)
            for method, metrics in judged.items():
                found[method].append({**vars(metrics), "rank": ranks.get(method, np.nan)})
        for method, each in found.items():
            means[label, method] = {
                name: float(np.mean([one[name] for one in each])) for name in each[0]
            }
    return means


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("table", ["table_2_smooth", "table_4_1_smooth", "table_c1_smooth"])
def test_tables_equal_direct_calls(small: SmallStudy, direct, table):
    rows = read_csv(small.out / "tables" / f"{table}.csv")
    assert len(rows) == (14 if table == "table_c1_smooth" else 7)
    names = {title: method for method, title in TITLES.items()}
    for row in rows:
        expected = direct[row["Prior"], names[row["Method"]]]
        for metric, column in COLUMNS.items():
            # Weights and solution are found in turn until they change by 1e-9 of a deviation.
            assert float(row[column]) == pytest.approx(expected[metric], rel=1e-6)
        if not np.isnan(expected["rank"]):
            assert float(row["Singular values"]) == expected["rank"]


def test_ratios_are_ours_over_the_thesis(small: SmallStudy):
    rows = {row["Method"]: row for row in read_csv(small.out / "tables/table_2_smooth.csv")}
    row = rows["WLS-RC"]
    assert float(row["CoM of the thesis [mm]"]) == 1.0
    assert float(row["CoM ratio"]) == pytest.approx(float(row["CoM [mm]"]))
    assert rows["MAP-LMI"]["CoM of the thesis [mm]"] == ""


def test_parameter_table_shows_the_first_draw(small: SmallStudy):
    rows = read_csv(small.out / "tables/table_d1.csv")
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    assert [row["Parameter"] for row in rows] == list(parameters.names)
    np.testing.assert_allclose([float(row["Real"]) for row in rows], parameters.values)
    prior = draw_prior(parameters, "percent", 25.0, 8)
    np.testing.assert_allclose([float(row["Ref."]) for row in rows], prior.mean)


def test_second_run_repeats_no_task_and_writes_equal_files(small: SmallStudy, symbid_here):
    def files(folder: Path) -> dict[str, bytes]:
        found = (path for path in sorted(folder.rglob("*")) if path.is_file())
        return {str(path.relative_to(small.out)): path.read_bytes() for path in found}

    work = small.out / "work"
    before, times = files(small.out), [path.stat().st_mtime_ns for path in work.rglob("*")]
    again = symbid_here("study", small.file, "--out", small.out, "--workers", 1)
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("all complete") == 4
    assert times == [path.stat().st_mtime_ns for path in work.rglob("*")]
    assert files(small.out) == before


def test_deleted_results_are_computed_again_exactly(small: SmallStudy):
    folder = StudyFolder(small.out)
    lost = [
        small.out / "work/draws/smooth, percent 25, 1.json",
        small.out / "work/rows/smooth of 1 moves 21, noise 1 x 5, all, 30 Hz.npz",
    ]
    before = json.loads(lost[0].read_text())
    for file in lost:
        file.unlink()
    run_inline(small.plan, folder)
    assert all(file.exists() for file in lost)
    assert json.loads(lost[0].read_text()) == before


def test_another_plan_is_rejected_and_files_stay(small: SmallStudy, symbid_here, tmp_path: Path):
    other = tmp_path / "other.yaml"
    other.write_text(small.file.read_text().replace("prior_seed: 8", "prior_seed: 9"))
    page = (small.out / "report.html").read_bytes()
    refused = symbid_here("study", other, "--out", small.out)
    assert refused.returncode == 2
    assert "another plan" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1
    assert (small.out / "report.html").read_bytes() == page


@pytest.mark.parametrize("method", ["ols", "map"])
def test_study_of_one_method(small: SmallStudy, tmp_path: Path, method: str):
    file = tmp_path / "one.yaml"
    file.write_text(
        "title: One method\nabout: It needs the rows of no other.\niterations: 1\n"
        "data: { short: { scenario: smooth, moves: 1, motion_seed: 21, noise_seed: 5 } }\n"
        "validation: { scenario: smooth, moves: 1, motion_seed: 22, noise: 0.0 }\n"
        f"priors: [{{ percent: 25.0 }}]\nmethods: [{method}]\n"
    )
    plan, folder = load_plan(str(file))[0], StudyFolder(tmp_path / "out")
    shutil.copytree(small.out / "work/logs", folder.work / "logs")  # not simulated again
    run_inline(plan, folder)
    assert publish(plan, folder).is_file()
    results = StudyResults.read(plan, folder)
    assert method in {case.method for case in results.draws}


def test_interrupted_study_leaves_no_process_and_no_partial_bag(tmp_path: Path):
    plan, out = tmp_path / "small.yaml", tmp_path / "out"
    plan.write_text(PLAN, encoding="utf-8")
    command = [str(Path(sys.executable).parent / "symbid"), "study", str(plan)]
    with subprocess.Popen(
        [*command, "--out", str(out), "--workers", "2"],
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    ) as study:
        unfinished = out / "work/logs/.unfinished"
        until(lambda: unfinished.is_dir() and any(unfinished.iterdir()))
        study.send_signal(signal.SIGINT)
        _, output = study.communicate(timeout=300)
    assert study.returncode == 130
    assert output.splitlines()[-1] == "symbid: interrupted"
    assert "Traceback" not in output

    def gone() -> bool:
        try:
            os.killpg(study.pid, 0)
        except ProcessLookupError:
            return True
        return False

    until(gone)
    assert not list(out.glob("work/logs/*/metadata.yaml"))


def until(condition) -> None:
    """Wait at most five minutes for another process."""
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Resources(HTMLParser):
    """Collects the addresses, ids and tags of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "data", "srcset"):
                self.addresses.append(value)


def test_page_is_self_contained(small: SmallStudy):
    text = (small.out / "report.html").read_text(encoding="utf-8")
    page = Resources()
    page.feed(text)
    assert not page.tags & {"script", "img", "iframe", "object", "embed"}
    assert len(set(page.ids)) == len(page.ids)
    for address in page.addresses:
        assert address == "data:," or address.removeprefix("#") in page.ids, address
    assert all(address.startswith("#") for address in re.findall(r"url\(([^)]*)\)", text))
    assert str(small.out) not in text


def test_page_and_folder_show_every_table_and_figure(small: SmallStudy):
    text = (small.out / "report.html").read_text(encoding="utf-8")
    for title in (
        "Table I:",
        "Table II:",
        "Table 4.1:",
        "Table C.1:",
        "Table D.1:",
        "Appendix B",
        "Fig. 3:",
        "Fig. 4:",
        "Fig. 5:",
        "Fig. 6:",
        "Fig. 4.1a:",
        "Fig. 4.1b:",
        "Fig. 4.2:",
        "Fig. 4.3:",
        "Closed loop",
    ):
        assert title in text
    figures = {path.stem for path in (small.out / "figures").glob("*.svg")}
    assert figures == {path.stem for path in (small.out / "figures").glob("*.png")}
    assert len(figures) == text.count("<figure>")


def test_equation_of_motion_holds_with_and_without_friction(small: SmallStudy):
    rows = read_csv(small.out / "tables/appendix_b.csv")
    error = {(r["Robot"], r["Model"], r["Contact forces"]): float(r["RMSE [N, Nm]"]) for r in rows}
    for robot, model in (
        ("without friction", "rigid links"),
        ("with friction", "rigid links, friction"),
    ):
        assert error[robot, model, "measured"] < 1e-9
        assert error[robot, model, "by Eq. 4.1"] < 1e-6
    assert error["with friction", "rigid links", "measured"] > 0.1


def test_filter_degrades_vibrating_accelerations(small: SmallStudy):
    rows = {r["Log"]: r for r in read_csv(small.out / "tables/accelerations.csv")}
    shaking, floating = (float(rows[log]["e_a [rad/s²]"]) for log in ("vibrating", "floating"))
    assert shaking > 5 * floating
    assert float(rows["vibrating"]["e_a of the thesis [rad/s²]"]) == 57.0


def test_controller_tracks_best_with_the_best_model(small: SmallStudy):
    rows = {r["Model"]: r for r in read_csv(small.out / "tables/closed_loop_25percent.csv")}
    truth, ours = (float(rows[m]["CoM tracking, median [mm]"]) for m in ("Truth", "MAP-LMI"))
    assert ours < truth + 1.0
    assert rows["OLS"]["Stood"] == "0 of 1"
    assert "not positive definite" in rows["OLS"]["Ended by"]


def test_page_fits_a_dark_phone(small: SmallStudy, browser):
    with browser.page(small.out / "report.html", PHONE, dark=True) as page:
        assert page.problems == page.requests == page.overflow == []


def test_page_fits_a_screen_and_its_print_is_short_with_figures_first(small: SmallStudy, browser):
    with browser.page(small.out / "report.html") as page:
        assert page.problems == page.requests == page.overflow == []
        pages = page.printed_pages()
    assert len(pages) <= 6
    assert "Fig. 3:" in pages[0]
    assert "Conclusions on" not in "".join(pages[:2])


@pytest.mark.parametrize(("longest", "titles"), [(30, ["Tables", "More tables"]), (0, ["Tables"])])
def test_every_section_has_content(small: SmallStudy, monkeypatch, longest, titles):
    monkeypatch.setattr(page, "LONG", longest)
    sections = study_sections(small.results)
    assert [one.title for one in sections if "ables" in one.title] == titles
    for one in sections:
        assert one.tables or one.figures or one.conclusions or one.sentences, one.title
