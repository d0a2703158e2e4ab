"""Expect errors by their codes and by what they name, not by their wording."""

import pytest

from symbid_ros.errors import SymbidError


def raises_code(code: str, names: str | None = None) -> pytest.RaisesExc[SymbidError]:
    """Expect an error with a code, whose message matches a regular expression."""
    return pytest.raises(SymbidError, match=names, check=lambda error: error.code == code)
