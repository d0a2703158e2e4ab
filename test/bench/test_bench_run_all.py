"""bench/README.md holds what bench/run_all.py writes."""

import run_all
from run_all import HEADING, PAGE, SECTIONS, command_of, parts


def test_the_page_begins_as_run_all_begins_it() -> None:
    assert PAGE.read_text(encoding="utf-8").startswith(HEADING)


def test_every_section_of_the_page_is_of_the_command_that_run_all_runs() -> None:
    shown = parts(PAGE.read_text(encoding="utf-8"))
    known = {section.title: section for section in SECTIONS}
    assert shown
    assert shown.keys() <= known.keys()
    for title, text in shown.items():
        command = " ".join(command_of(known[title]))
        assert text.startswith(f"{known[title].text}\n\n    .venv/bin/python {command}\n"), title


def test_writing_no_section_anew_leaves_the_page_as_it_is(monkeypatch, tmp_path) -> None:
    """Sections that are not run again stay, also those whose figures are of another machine."""
    copy = tmp_path / "README.md"
    copy.write_text(PAGE.read_text(encoding="utf-8"), encoding="utf-8")
    monkeypatch.setattr(run_all, "PAGE", copy)
    monkeypatch.setattr("sys.argv", ["run_all.py", "--only", "cluster"])
    unchanged = parts(copy.read_text(encoding="utf-8"))
    monkeypatch.setattr(run_all, "measured", lambda *_: "new\n")
    run_all.main()
    written = parts(copy.read_text(encoding="utf-8"))
    assert written.pop("Growth with the number of workers").strip() == "new"
    assert {title: text.strip() for title, text in written.items()} == {
        title: text.strip() for title, text in unchanged.items()
    }
