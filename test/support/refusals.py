"""Errors by their stable codes, whatever their wording."""

import pytest

from symbid_ros.errors import SymbidError


def refused(code: str, match: str | None = None):
    """Expect an error with a code and, if given, a name in its message."""
    return pytest.raises(SymbidError, match=match, check=lambda error: error.code == code)
