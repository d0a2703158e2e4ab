"""The demo writes a bag, estimates, models and a report."""

import json

import typer
from bag_editing import topic_counts
from preloaded import run_symbid
from report_pages import Page
from typer.testing import CliRunner

from symbid_ros.cli import demo
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.truncated_svd import METHODS
from symbid_ros.report.formatting import with_std

TITLES = ("prior", "OLS", "WLS-R", "WLS-C", "WLS-RC", "WLS-RC, own z", "MAP", "MAP-LMI", "truth")
FOLDERS = {method: method for method in (*METHODS, "map", "map_lmi")} | {"wls_rc_own_z": "wls_rc"}


def test_the_demo_writes_all_its_files(tmp_path, monkeypatch) -> None:
    out = tmp_path / "demo"
    monkeypatch.setenv("COLUMNS", "120")
    ended = run_symbid("demo", "--moves", 1, "--out", out, output=tmp_path / "first")
    assert ended.returncode == 0, ended.stderr
    assert all(f" {title} " in ended.stdout for title in TITLES)
    counts = topic_counts(out / "bag")
    sensors = ("/joint_states", "/imu/data", "/left_foot/wrench", "/right_foot/wrench")
    assert len({counts[topic] for topic in sensors}) == 1
    found = {}
    for folder, method in FOLDERS.items():
        found[folder] = json.loads((out / folder / "estimate.json").read_text())
        assert found[folder]["method"] == method
        for name in ("model.urdf", "model.xml", "information.npz"):
            assert (out / folder / name).is_file()
    # What the filtered rows' z was chosen on, the windows' own z and the others never saw.
    for folder, estimate in found.items():
        assert any("validation" in name for name in estimate["inputs"]) == (folder in METHODS)

    page = Page((out / "report.html").read_text())
    assert {row[0] for row in page.rows} >= set(TITLES)
    assert all(source.startswith("data:") for source in page.attributes("src"))
    own_z = found["wls_rc_own_z"]["rank"]
    choices = [row for row in page.rows if row[1:2] in (["the log itself"], ["the ideal bag"])]
    assert [row[0] for row in choices] == [t for t in TITLES[1:5] for _ in range(2)]
    assert ["WLS-RC", "the log itself", str(own_z)] in [row[:3] for row in choices]

    chosen = found["map_lmi"]
    assert all(chosen["consistent"].values())
    alarms = chosen["verdict"]["alarms"]
    assert ("no alarm" in page.source) == (not alarms)
    for link, gain in chosen["verdict"]["link_gain_bits"].items():
        mass = chosen["parameters"][f"{link}/m"]
        (row,) = [row for row in page.rows if row[0] == link and row[1].endswith(" of 10")]
        shown = with_std(mass["value"], mass["std"])
        assert row[2] == shown + ("" if mass["determined"] else "not measured")
        assert row[4] == f"{gain:.1f}"
    start = page.rows.index(["Combination, SI units", "Value ± std", "Unit", "Determined"]) + 1
    base = page.rows[start : start + len(chosen["verdict"]["base"])]
    assert [row[1] for row in base] == [
        with_std(one["value"], one["std"]) for one in chosen["verdict"]["base"]
    ]
    sections = page.attributes("id")
    assert {"forces", "robot", "data-summary", "realistic", "truncation"} <= set(sections)

    again = run_symbid("demo", "--out", out, output=tmp_path / "again")
    assert again.returncode == 2
    assert "--overwrite" in again.stderr


def test_a_demo_that_fails_leaves_the_earlier_one(tmp_path, monkeypatch) -> None:
    def fails(out, *_):
        assert (out / "prior.json").is_file()
        raise SymbidError("no", "E553")

    monkeypatch.setattr(demo, "demonstrate_offline", fails)
    out = tmp_path / "demo"
    out.mkdir()
    for name in ("prior.json", "report.html"):
        (out / name).write_text("earlier")
    app = typer.Typer()
    app.command()(demo.demo)
    ended = CliRunner().invoke(app, ["--out", str(out), "--overwrite"])
    assert isinstance(ended.exception, SymbidError)
    assert {each.name: each.read_text() for each in out.iterdir()} == {
        "prior.json": "earlier",
        "report.html": "earlier",
    }
