"""A study's results as people read them: a page, tables and figures."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import jinja2
import yaml

import symbid_ros.report
from symbid_ros.atomic_write import write_text
from symbid_ros.package_paths import package_version
from symbid_ros.study.conclusions import headline
from symbid_ros.study.draws import StudyResults
from symbid_ros.study.plan import Plan
from symbid_ros.study.plotting import inline, save
from symbid_ros.study.sections import Section, sections
from symbid_ros.study.study_folder import StudyFolder


def publish(plan: Plan, folder: StudyFolder) -> Path:
    """Write report.html, tables/ and figures/ and return the page's place.

    Raises
    ------
    SymbidError
        When something that the plan asks for has not been worked out, or cannot be written.
    """
    results = StudyResults.read(plan, folder)
    made = sections(results)
    for name in ("tables", "figures"):
        shutil.rmtree(folder.out / name, ignore_errors=True)
    for section in made:
        for table in section.tables:
            write_text(folder.out / "tables" / f"{table.name}.md", table.markdown)
            write_text(folder.out / "tables" / f"{table.name}.csv", table.csv)
        for drawing in section.drawings:
            save(drawing, folder.out / "figures")
    write_text(folder.out / "conclusions.md", _in_words(plan, made))
    place = folder.out / "report.html"
    page = Page(
        title=plan.title,
        about=plan.about,
        headline=headline(results.scores, plan),
        sections=made,
        facts=_facts(plan),
        plan=yaml.safe_dump(
            plan.model_dump(exclude_unset=True), sort_keys=False, allow_unicode=True
        ),
        software=f"symbid_ros {package_version()}",
    )
    write_text(place, render(page))
    return place


def _in_words(plan: Plan, made: tuple[Section, ...]) -> str:
    lines = [f"# {plan.title}", ""]
    for section in made:
        if not (section.conclusions or section.sentences):
            continue
        lines += [f"## {section.title}", ""]
        for one in section.conclusions:
            reason = f" {one.explanation}" if one.explanation else ""
            lines += [f"- {one.claim} **{one.verdict.capitalize()}.** {one.finding}{reason}"]
        lines += [*(f"- {sentence}" for sentence in section.sentences), ""]
    return "\n".join(lines)


def _facts(plan: Plan) -> dict[str, str]:
    logs = ", ".join(f"{name} ({log.identity})" for name, log in plan.data.items())
    filters = ", ".join("none" if cutoff == 0 else f"{cutoff:g} Hz" for cutoff in plan.filters)
    chosen = {"validation": "on the validation log", "itself": "by the log itself"}[plan.z.using]
    facts = {
        "Logs": logs,
        "Judged along": f"{plan.validation.identity}, every {1e3 * plan.judged_every:g} ms",
        "Priors": f"{plan.iterations} of each: {', '.join(map(str, plan.priors))}",
    }
    if plan.truncated_methods:
        facts["Filters"] = f"{filters}; second-order Butterworth, zero phase"
        facts["z"] = f"chosen {chosen}, to predict {plan.z.by}"
    return facts


_UNIT = re.compile(r"(?<=\d) (?=(?:%|mm|Nm|Nms|Ns|N|Hz|s|kg|rad/s²|ms|times)(?!\w))")
_METHOD = re.compile(r"(WLS|MAP)-(?=[A-Z])")


@dataclass(frozen=True)
class Page:
    """All that a study shows.

    Attributes
    ----------
    title, about, headline : str
        At the head of the page; the headline is the outcome in a sentence.
    sections : tuple of Section
    facts : dict of str to str
        What was done, in the order shown.
    plan : str
        The study's file, for those who want to do it again.
    software : str
    """

    title: str
    about: str
    headline: str
    sections: tuple[Section, ...]
    facts: dict[str, str]
    plan: str
    software: str


def render(page: Page) -> str:
    """Return the page: no script, no address outside itself."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symbid_ros", "study"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"inline": inline, "unbroken": unbroken}
    report = Path(symbid_ros.report.__file__).parent
    return environment.get_template("study.html").render(
        page=page,
        css=(report / "report.css").read_text(encoding="utf-8")
        + Path(__file__).with_name("study.css").read_text(encoding="utf-8"),
    )


def unbroken(text: str) -> str:
    """Return a sentence whose figures stay with their units, and methods' names whole."""
    return _METHOD.sub("\\1\N{NON-BREAKING HYPHEN}", _UNIT.sub("\N{NO-BREAK SPACE}", text))
