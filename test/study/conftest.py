"""A small study, run once as a user would, by the command."""

import pytest
from small_study import PLAN, SmallStudy


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory, symbid_here) -> SmallStudy:
    folder = tmp_path_factory.mktemp("study")
    file = folder / "small.yaml"
    file.write_text(PLAN, encoding="utf-8")
    out = folder / "out"
    ran = symbid_here("study", file, "--out", out, "--workers", 1)
    assert ran.returncode == 0, ran.stderr
    return SmallStudy(file, out)
