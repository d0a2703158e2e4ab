"""A study on a cluster writes the tables of a study on one machine."""

import shutil

import pytest
from preloaded import run_symbid
from small_study import run_inline

from symbid_ros.cluster import connection
from symbid_ros.study.page import publish
from symbid_ros.study.plan import load_plan
from symbid_ros.study.study_folder import StudyFolder

pytest.importorskip("distributed", reason="clusters are not tested: Dask is not installed")

PLAN = """\
title: A study of one log
data:
  smooth: { scenario: smooth, moves: 1, motion_seed: 5, noise_seed: 6 }
validation: { scenario: smooth, moves: 1, motion_seed: 7, noise: 0.0 }
priors: [{ percent: 25.0 }]
iterations: 1
prior_seed: 8
filters: [30.0]
methods: [wls_rc]
"""


def test_without_a_scheduler_nothing_is_written(symbid_here, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(connection, "CONNECTING_TIME", 0.2)
    out = tmp_path / "out"
    ended = symbid_here("study", "noise", "--out", out, "--dask", "tcp://127.0.0.1:1")
    assert (ended.returncode, "SYMBID-E951" in ended.stderr, out.exists()) == (2, True, False)


def test_a_study_on_a_cluster_gives_the_same_tables(cluster, tmp_path) -> None:
    (tmp_path / "plan.yaml").write_text(PLAN, encoding="utf-8")
    alone, both = tmp_path / "alone", tmp_path / "both"
    content, folder = load_plan(str(tmp_path / "plan.yaml"))[0], StudyFolder(alone)
    folder.reserve(content)
    run_inline(content, folder)
    publish(content, folder)
    # Simulating takes longest; what follows is done again.
    shutil.copytree(alone, both)
    for folder in ("work/rows", "work/draws", "tables"):
        shutil.rmtree(both / folder)
    words = ("study", tmp_path / "plan.yaml", "--out", both, "--dask", cluster.address)
    ran = run_symbid(*words, output=tmp_path / "symbid")
    assert ran.returncode == 0, ran.stderr
    tables = [sorted((folder / "tables").iterdir()) for folder in (alone, both)]
    assert [one.name for one in tables[0]] == [one.name for one in tables[1]]
    assert tables[0]
    for one, two in zip(*tables, strict=True):
        assert one.read_bytes() == two.read_bytes()
