"""The results of a study: a page of sections, with tables, figures and conclusions as files."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from symbid_ros.atomic_write import staged, write_text
from symbid_ros.model.tree import RobotModel
from symbid_ros.package_paths import package_version
from symbid_ros.report.content import TRUTH, LinkErrors
from symbid_ros.report.formatting import counted
from symbid_ros.report.templates import page_template, shared_css, unbroken_units
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import thesis
from symbid_ros.study.checks import (
    check_accelerations,
    load_closed_loop_runs,
    load_equation_residuals,
    load_realistic,
)
from symbid_ros.study.conclusions import (
    claim_conclusions,
    closed_loop_conclusions,
    data_sentences,
    headline,
    link_accuracy,
    realistic_conclusion,
)
from symbid_ros.study.draws import StudyResults
from symbid_ros.study.evidence import Conclusion, Evidence, describe_filter
from symbid_ros.study.figures import (
    acceleration_figure,
    closed_loop_figure,
    comparison_figure,
    filter_figure,
    link_figure,
)
from symbid_ros.study.plan import AccelerationPlan, ClosedLoopPlan, FigurePlan, Plan
from symbid_ros.study.plotting import CaptionedFigure
from symbid_ros.study.prediction_figures import (
    describe_estimates,
    ideal_figures,
    realistic_figures,
)
from symbid_ros.study.scores import Case
from symbid_ros.study.study_folder import StudyFolder
from symbid_ros.study.table import Table
from symbid_ros.study.tables import (
    acceleration_table,
    balance_table,
    equation_table,
    parameter_table,
    realistic_table,
    score_tables,
    technique_table,
)
from symbid_ros.study.thesis import TITLES

# Longer tables are folded.
LONG = 30

_METHOD = re.compile(r"(WLS|MAP)-(?=[A-Z])")


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes
    ----------
    anchor, title, caption : str
        Id, heading, and the sentence below it.
    conclusions : tuple of Conclusion
    sentences : tuple of str
        Further results in words.
    tables : tuple of Table
    figures : tuple of CaptionedFigure
    folded : bool
        Whether the tables are folded, and left out of a print.
    """

    anchor: str
    title: str
    caption: str = ""
    conclusions: tuple[Conclusion, ...] = ()
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[CaptionedFigure, ...] = ()
    folded: bool = False


PAGE = "report.html"


def publish(plan: Plan, folder: StudyFolder) -> Path:
    """Write report.html, conclusions.md, tables/ and figures/, and return the path of the page.

    Raises
    ------
    SymbidError
        If a result that the plan asks for is missing, or a file cannot be written.
    """
    results = StudyResults.read(plan, folder)
    sections = study_sections(results)
    with staged(folder.out) as out:
        for section in sections:
            for table in section.tables:
                write_text(out / "tables" / f"{table.name}.md", table.markdown)
                write_text(out / "tables" / f"{table.name}.csv", table.csv)
            for figure in section.figures:
                figure.save(out / "figures")
        write_text(out / "conclusions.md", _conclusions_text(plan, sections))
        write_text(out / PAGE, _render(results, sections))
        for name in ("tables", "figures"):  # those of another plan have other names
            shutil.rmtree(folder.out / name, ignore_errors=True)
    return folder.out / PAGE


def _render(results: StudyResults, sections: tuple[Section, ...]) -> str:
    """Return the page as HTML without scripts and external resources."""
    plan = results.plan
    template = page_template("study.html", "symbid_ros.study", {"unbroken": _unbroken})
    return template.render(
        title=plan.title,
        plan=plan,
        headline=headline(results.scores, plan),
        sections=sections,
        links=[*((each.anchor, each.title) for each in sections), ("data", "Data")],
        facts=_facts(plan),
        plan_text=yaml.safe_dump(
            plan.model_dump(exclude_unset=True), sort_keys=False, allow_unicode=True
        ),
        software=f"symbid_ros {package_version()}",
        css=shared_css() + Path(__file__).with_name("study.css").read_text(encoding="utf-8"),
    )


def _unbroken(text: str) -> str:
    """Return a text without line breaks between numbers and units, and within method names."""
    return _METHOD.sub("\\1\N{NON-BREAKING HYPHEN}", unbroken_units(text))


def _facts(plan: Plan) -> dict[str, str]:
    """Return how the study was done."""
    logs = "; ".join(f"{name}: {log.description}" for name, log in plan.data.items())
    filters = ", ".join("none" if cutoff == 0 else f"{cutoff:g} Hz" for cutoff in plan.filters)
    source = {"validation": "on the validation log", "itself": "on the log itself"}[plan.z.using]
    facts = {
        "Logs": logs,
        "Evaluated on": f"{plan.validation.description}, every {1e3 * plan.judged_every:g} ms",
        "Priors": f"{plan.iterations} of each: {', '.join(map(str, plan.priors))}",
    }
    if plan.truncated_methods:
        facts["Filters"] = f"{filters}; second-order Butterworth, zero phase"
        facts["z"] = f"chosen {source}, by the error of {plan.z.by}"
    return facts


def _conclusions_text(plan: Plan, sections: tuple[Section, ...]) -> str:
    """Return all conclusions and sentences as Markdown."""
    lines = [f"# {plan.title}", ""]
    for section in sections:
        if not (section.conclusions or section.sentences):
            continue
        lines += [f"## {section.title}", ""]
        for one in section.conclusions:
            reason = f" {one.explanation}" if one.explanation else ""
            lines += [f"- {one.claim} **{one.verdict.capitalize()}.** {one.finding}{reason}"]
        lines += [*(f"- {sentence}" for sentence in section.sentences), ""]
    return "\n".join(lines)


def study_sections(results: StudyResults) -> tuple[Section, ...]:
    """Return the sections of the page, in order.

    Raises
    ------
    StudyError
        If a result is missing.
    """
    plan = results.plan
    tables = score_tables(plan, results.scores)
    short = tuple(table for table in tables if len(table.rows) <= LONG)
    folded = [table for table in tables if len(table.rows) > LONG]
    if plan.thesis:
        folded.insert(0, technique_table(plan.methods))
    if plan.figures is not None:
        folded.append(_parameter_table(results, plan.figures))
    # Figures come first, on screens as on paper.
    sections: list[Section] = []
    if not plan.thesis:
        sections.append(_comparison_section(results))
    if plan.figures is not None:
        sections += _prediction_sections(results, plan.figures)
    if plan.closed_loop is not None:
        sections.append(_closed_loop_section(results, plan.closed_loop))
    if plan.accelerations is not None:
        sections.append(_acceleration_section(results, plan.accelerations))
    if plan.thesis:
        sections.append(_filter_section(results))
    if plan.thesis:
        sections += _conclusion_sections(results)
    if short:
        sections.append(Section("tables", "Tables", tables=short))
    if plan.equation is not None:
        table = equation_table(load_equation_residuals(results.folder))
        sections.append(Section("equation", "Equation of motion", tables=(table,), folded=True))
    if folded:
        title = "More tables" if short else "Tables"
        sections.append(Section("more", title, tables=tuple(folded), folded=True))
    return tuple(sections)


def _conclusion_sections(results: StudyResults) -> Iterator[Section]:
    """Check the thesis's conclusions on each data set."""
    plan = results.plan
    for data in plan.data:
        evidence = Evidence(results.scores, data, tuple(plan.priors), results.row_errors(data))
        conclusions: list[Conclusion | None] = [*claim_conclusions(evidence)]
        if plan.figures is not None and plan.figures.data == data:
            depth = _link_depths(results.true_parameters(data).model)
            conclusions.append(link_accuracy(_link_errors(results, plan.figures), depth))
            conclusions.append(_realistic_conclusion(results, plan.figures))
        yield Section(
            f"conclusions-{data.replace(' ', '-')}",
            f"Conclusions on {data} data",
            "The thesis's conclusions, each checked on the numbers of this study. All sentences "
            "are computed from them.",
            conclusions=tuple(one for one in conclusions if one is not None),
        )


def _link_errors(results: StudyResults, figures: FigurePlan) -> LinkErrors:
    errors = results.link_errors(figures.data, figures.prior, figures.links)
    return LinkErrors(results.true_parameters(figures.data).link_names, errors)


def _link_depths(model: RobotModel) -> tuple[int, ...]:
    """Return the number of joints between the base and each link that has parameters."""
    depth = {0: 0}
    for child, joint in enumerate(model.joints, 1):
        depth[child] = depth[joint.parent] + 1
    return tuple(depth[i] for i, link in enumerate(model.links) if not link.virtual)


def _realistic_conclusion(results: StudyResults, figures: FigurePlan) -> Conclusion | None:
    realistic = {name: one["torque_rmse"] for name, one in load_realistic(results.folder).items()}
    ideal = {TRUTH: 0.0}
    for method in results.plan.compared:
        case = Case.of(figures.data, figures.prior, method, figures.torque)
        ideal[method] = results.scores.means[case]["torque_rmse"]
    return realistic_conclusion(ideal, realistic)


def _comparison_section(results: StudyResults) -> Section:
    """Compare the data sets of a study without counterpart in the thesis."""
    plan, scores, data = results.plan, results.scores, [*results.plan.data]
    cutoff = plan.filters[0] if len(plan.filters) == 1 else None
    is_single = len(plan.priors) == 1
    sentences: list[str] = []
    for prior in map(str, plan.priors):
        label = "" if is_single else f"Priors {prior}. "
        sentences += (f"{label}{one}" for one in data_sentences(scores, data, prior, plan.methods))
    return Section(
        "comparison",
        f"Priors {plan.priors[0]}" if is_single else "Comparison",
        sentences=tuple(sentences),
        figures=tuple(
            comparison_figure(scores, data, prior, plan.compared, cutoff, shown=plan.shown_metrics)
            for prior in map(str, plan.priors)
        ),
    )


def _filter_section(results: StudyResults) -> Section:
    plan, printed = results.plan, thesis.table_c1()
    return Section(
        "filters",
        "Filters",
        "Each error against the cutoff of the filter. Hollow markers: the thesis’s values "
        "(Table C.1).",
        figures=tuple(
            filter_figure(
                results.scores, data, prior, plan.compared, printed, shown=plan.shown_metrics
            )
            for data in plan.data
            for prior in map(str, plan.priors)
        ),
    )


def _parameter_table(results: StudyResults, figures: FigurePlan) -> Table:
    data, prior, cutoff = figures.data, figures.prior, figures.parameters
    estimates = {m: results.estimate(data, prior, m, cutoff) for m in results.plan.compared}
    return parameter_table(
        results.true_parameters(data),
        estimates,
        data,
        f"One draw of a {prior} prior, rows of the truncated methods {describe_filter(cutoff)}",
    )


def _prediction_sections(results: StudyResults, figures: FigurePlan) -> Iterator[Section]:
    links = _link_errors(results, figures)
    titled = LinkErrors(links.links, {TITLES[name]: one for name, one in links.percent.items()})
    estimates = describe_estimates(figures.data, str(figures.prior), figures.links)
    yield Section(
        "predictions",
        "Predictions",
        "Predictions by the first draw’s estimates along the ideal validation motion. The cutoffs "
        "are the plan’s, which may differ from the best ones (Table C.1).",
        figures=(
            *ideal_figures(results, figures),
            link_figure(titled, estimates, results.plan.iterations),
        ),
    )
    yield Section(
        "realistic",
        "Realistic predictions",
        "Predictions by the same estimates along the same motion, from the robot’s own sensors.",
        tables=(realistic_table(load_realistic(results.folder)),),
        figures=realistic_figures(results, figures),
    )


def _acceleration_section(results: StudyResults, accelerations: AccelerationPlan) -> Section:
    checks = {
        name: check_accelerations(accelerations, name, results.folder)
        for name in accelerations.logs
    }
    return Section(
        "accelerations",
        "Vibration and the filter",
        tables=(acceleration_table(checks, accelerations.cutoff),),
        figures=(acceleration_figure(checks, accelerations.cutoff),),
    )


def _closed_loop_section(results: StudyResults, loop: ClosedLoopPlan) -> Section:
    by_prior = {
        str(spread): load_closed_loop_runs(results.plan, results.folder, spread)
        for spread in loop.priors
    }
    together: dict[str, list[BalanceResult]] = {}
    for runs in by_prior.values():
        for method, found in runs.items():
            together.setdefault(method, []).extend(found)
    together[TRUTH] = together[TRUTH][:1]
    labelled = {TITLES.get(method, method): runs for method, runs in together.items()}
    moves = counted(loop.moves, "move")
    about = f"{moves}; priors {', '.join(by_prior)}, estimates from {loop.data} data."
    return Section(
        "closed-loop",
        "Closed loop",
        "The balance controller moves the true robot; its model is the prior, an estimate or the "
        f"truth. {about}",
        conclusions=closed_loop_conclusions(together),
        tables=tuple(balance_table(prior, runs) for prior, runs in by_prior.items()),
        figures=(closed_loop_figure(labelled, about),),
        folded=True,
    )
