"""All nodes among foreign traffic, for 2.5 s; `make soak` does it for minutes."""

from pathlib import Path

from soak import soak


def test_foreign_traffic_neither_changes_results_nor_ends_nodes(tmp_path: Path) -> None:
    found = soak(2.5, tmp_path)
    assert found.largest_difference < 1e-6, found
