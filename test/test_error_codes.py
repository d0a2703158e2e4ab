"""Every error that a user can cause has a code, and every code its entry."""

import pickle
import re
from pathlib import Path

import symbid_ros
from symbid_ros.error_codes import CODES
from symbid_ros.errors import SymbidError
from symbid_ros.signals.defects import Defect, DefectError

PACKAGE = Path(symbid_ros.__file__).parent


def test_the_codes_in_use_are_those_that_are_documented() -> None:
    texts = [path.read_text() for path in PACKAGE.rglob("*.py") if path.name != "error_codes.py"]
    assert set(re.findall(r'"(E\d{3})"', "\n".join(texts))) == set(CODES)
    for entry in CODES.values():
        assert entry.cause.endswith(".")
        assert entry.fix.endswith(".")


def test_an_error_is_printed_with_its_code() -> None:
    error = SymbidError("bag: missing; give another", "E201")
    assert error.labelled == "bag: missing; give another (SYMBID-E201)"


def test_an_error_of_another_process_arrives_with_its_code() -> None:
    error = DefectError("joints", Defect.DUPLICATE, "joints: 3 stamps repeat", "E301")
    copy = pickle.loads(pickle.dumps(error))
    assert isinstance(copy, DefectError)
    assert (str(copy), vars(copy)) == (str(error), vars(error))
