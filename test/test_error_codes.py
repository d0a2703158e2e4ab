"""docs/errors.md explains each error that a user can cause, by its code, and each alarm."""

import pickle
import re
from pathlib import Path

import symbid_ros
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.signals.defects import Defect, DefectError

PACKAGE = Path(symbid_ros.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "errors.md"


def test_the_codes_in_use_are_those_that_are_documented() -> None:
    texts = [path.read_text() for path in PACKAGE.rglob("*.py")]
    used = sorted(set(re.findall(r'"(E\d{3})"', "\n".join(texts))))
    rows = [line for line in PAGE.read_text().splitlines() if "SYMBID-" in line]
    cells = [re.fullmatch(r"\| `SYMBID-(E\d{3})` \| .+\. \| .+\. \|", row) for row in rows]
    assert [cell and cell[1] for cell in cells] == used  # each once, in order


def test_each_kind_of_alarm_is_explained() -> None:
    page = PAGE.read_text()
    section = page[page.index("## Alarms") : page.index("## Change alarms")]
    explained = " ".join(section.lower().split())
    assert [kind for kind in Alarm if kind not in explained] == []
    texts = "\n".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    assert [kind for kind in Alarm if f"{{Alarm.{kind.name}}}" not in texts] == []  # none is unused


def test_an_error_is_printed_with_its_code() -> None:
    error = SymbidError("bag: missing; give another", "E201")
    assert error.labelled == "bag: missing; give another (SYMBID-E201)"


def test_an_error_of_another_process_arrives_with_its_code() -> None:
    error = DefectError("joints", Defect.DUPLICATE, "joints: 3 stamps repeat", "E301")
    copy = pickle.loads(pickle.dumps(error))
    assert isinstance(copy, DefectError)
    assert (str(copy), vars(copy)) == (str(error), vars(error))
