"""A study's results as people read them: a page, tables and figures."""

import shutil
from pathlib import Path

import yaml

from symbid_ros.atomic_write import write_text
from symbid_ros.package_paths import package_version
from symbid_ros.study.data_claims import headline
from symbid_ros.study.drawing import save
from symbid_ros.study.page import Page, Section, render
from symbid_ros.study.plan import Plan
from symbid_ros.study.results import Results
from symbid_ros.study.sections import sections
from symbid_ros.study.workspace import Workspace


def publish(plan: Plan, space: Workspace) -> Path:
    """Write report.html, tables/ and figures/ and return the page's place.

    Raises
    ------
    SymbidError
        When something that the plan asks for has not been worked out, or cannot be written.
    """
    results = Results.read(plan, space)
    made = sections(results)
    for folder in ("tables", "figures"):
        shutil.rmtree(space.out / folder, ignore_errors=True)
    for section in made:
        for sheet in section.sheets:
            write_text(space.out / "tables" / f"{sheet.name}.md", sheet.markdown)
            write_text(space.out / "tables" / f"{sheet.name}.csv", sheet.csv)
        for drawing in section.drawings:
            save(drawing, space.out / "figures")
    write_text(space.out / "conclusions.md", _in_words(plan, made))
    place = space.out / "report.html"
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
            reason = f" {one.because}" if one.because else ""
            lines += [f"- {one.claim} **{one.verdict.capitalize()}.** {one.sentence}{reason}"]
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
    if plan.truncated:
        facts["Filters"] = f"{filters}; second-order Butterworth, zero phase"
        facts["z"] = f"chosen {chosen}, to predict {plan.z.by}"
    return facts
