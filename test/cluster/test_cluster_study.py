"""A study on a cluster writes the tables of a study in processes of one machine."""

import shutil

import pytest
from small_study import symbid

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


def run(*arguments: object) -> None:
    ran = symbid(*arguments)
    assert ran.returncode == 0, ran.stderr


def test_a_study_on_a_cluster_gives_the_same_tables(cluster, tmp_path) -> None:
    (tmp_path / "plan.yaml").write_text(PLAN, encoding="utf-8")
    alone, both = tmp_path / "alone", tmp_path / "both"
    run("study", tmp_path / "plan.yaml", "--out", alone, "--workers", 1)
    # Simulating takes longest; what follows is done again.
    shutil.copytree(alone, both)
    for folder in ("work/rows", "work/draws", "tables"):
        shutil.rmtree(both / folder)
    run("study", tmp_path / "plan.yaml", "--out", both, "--dask", cluster.address)
    tables = [sorted((folder / "tables").iterdir()) for folder in (alone, both)]
    assert [one.name for one in tables[0]] == [one.name for one in tables[1]]
    assert tables[0]
    for one, two in zip(*tables, strict=True):
        assert one.read_bytes() == two.read_bytes()
