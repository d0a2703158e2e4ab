"""The demo leaves a bag, estimates, models and a report behind."""

import json

from symbid_ros.bags.reader import topic_counts
from symbid_ros.estimation.thesis import METHODS

TITLES = ("prior", "OLS", "WLS-R", "WLS-C", "WLS-RC", "truth")


def test_the_demo_leaves_its_artefacts(symbid, tmp_path) -> None:
    out = tmp_path / "demo"
    ended = symbid("demo", "--moves", 1, "--out", out, columns=120)
    assert ended.returncode == 0, ended.stderr
    assert all(title in ended.stdout for title in TITLES)
    counts = topic_counts(out / "bag")
    sensors = ("/joint_states", "/imu/data", "/left_foot/wrench", "/right_foot/wrench")
    assert len({counts[topic] for topic in sensors}) == 1
    for method in METHODS:
        (folder,) = out.rglob(f"{method}/estimate.json")
        assert json.loads(folder.read_text())["method"] == method
        assert (folder.parent / "model.urdf").is_file()
        assert (folder.parent / "model.xml").is_file()
    report = (out / "report.html").read_text()
    assert all(title in report for title in TITLES)
    assert "http://" not in report.replace("http://www.w3.org", "")
    assert "src=" not in report.replace('src="data:', "")

    again = symbid("demo", "--out", out)
    assert again.returncode == 2
    assert "--overwrite" in again.stderr
