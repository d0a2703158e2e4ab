"""The demo of learning writes a page, figures and a bag, and needs no ROS."""

import json
from xml.etree import ElementTree

from bag_editing import topic_counts
from browser import PHONE
from preloaded import run_symbid
from report_pages import Page

FIGURES = "com_error", "feed_forward", "deviations"


def test_three_robots_move_side_by_side_and_are_reported(tmp_path, monkeypatch, browser) -> None:
    out = tmp_path / "demo"
    monkeypatch.setenv("COLUMNS", "60")
    words = "--learn", "--payload", "--moves", 1
    ended = run_symbid("demo", *words, "--out", out, output=tmp_path / "first")
    assert ended.returncode == 0, ended.stderr
    assert "takes over a model: mass 41.0" in ended.stdout
    assert "attached: 5 kg, L_thigh" in ended.stdout
    assert "removed: 5 kg, L_thigh" in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 60
    assert json.loads((out / "prior.json").read_text())["seed"] == 2
    counts = topic_counts(out / "bag")
    assert {"/joint_states", "/ground_truth/odom"} <= set(counts)

    page = Page((out / "report.html").read_text())
    assert ["", "file alone", "learning", "true model"] in page.rows
    assert all(source.startswith("data:") for source in page.attributes("src"))
    assert "takes over a model" in page.source
    for name in FIGURES:
        assert page.source.count(f'id="{name.replace("_", "-")}-') > 0
        assert (out / f"{name}.png").stat().st_size > 10_000
        ElementTree.parse(out / f"{name}.svg")
    with browser.page(out / "report.html", PHONE) as phone:
        edges = phone.tab.locator("figure svg").evaluate_all(
            "all => all.map(e => e.getBoundingClientRect().right)"
        )
        assert (len(edges), phone.overflow) == (3, [])
        assert max(edges) <= PHONE
    robots = ElementTree.parse(out / "robots.svg").getroot()
    drawn = robots.findall(".//{*}polyline")
    assert len(drawn) == 2 * 3
    frames = [line.find("{*}animate").get("values").split(";") for line in drawn]
    assert len(set(map(len, frames))) == 1
    # An outcome is shown only when it is known.
    outcomes = [
        text for text in robots.findall(".//{*}g/{*}text") if text.find("{*}animate") is not None
    ]
    assert [text.text.partition(" ")[0] for text in outcomes] == ["still", "still"]
    assert all(text.find("{*}animate").get("values") == "0;1" for text in outcomes)

    for words in (("--out", out), ("--out", tmp_path / "other", "--online")):
        again = run_symbid("demo", "--learn", *words, output=tmp_path / f"again{len(words)}")
        assert again.returncode == 2
    assert not (tmp_path / "other").exists()
    unloaded = run_symbid("demo", "--payload", output=tmp_path / "unloaded")
    assert unloaded.returncode == 2
