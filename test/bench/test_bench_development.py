"""Benchmarks that need development packages say so before they work for minutes."""

import sys
from importlib import import_module

import development
import pytest

NEEDY = (
    *("alarms", "bag_to_model", "base_gravity", "cluster", "excitation", "fleet"),
    *("foreign_robots", "intervals", "peers"),
)


@pytest.mark.parametrize("name", NEEDY)
def test_missing_packages_are_named_at_the_start(name, monkeypatch, capsys) -> None:
    monkeypatch.setattr(development, "_is_installed", lambda _: False)
    monkeypatch.setattr(sys, "argv", [name])
    with pytest.raises(SystemExit, match="not installed; run `make setup-dev`"):
        import_module(name).main()
    assert capsys.readouterr().out == ""


def test_installed_packages_are_accepted() -> None:
    development.require_packages("numpy", "scipy")
    with pytest.raises(SystemExit, match=r"^no-such-package not installed"):
        development.require_packages("numpy", "no-such-package")
