"""The version is known without an installation."""

import sys
from importlib.metadata import PackageNotFoundError, version

import pytest

from symbid_ros.package_paths import package_version


def test_a_source_tree_that_is_not_installed_has_the_version_of_its_package_xml(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed = version("symbid_ros")
    package_version.cache_clear()
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(PackageNotFoundError):
        version("symbid_ros")
    assert package_version() == installed
    package_version.cache_clear()
