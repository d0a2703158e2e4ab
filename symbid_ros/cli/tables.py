"""Tables and lines that commands print on the terminal."""

import os
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from rich import box
from rich.console import Console, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from symbid_ros.bags import BagInfo, FileInfo, LostRange, RecoveryReport
from symbid_ros.cli.fitted_tables import UNLIMITED, Row, print_table, written_files
from symbid_ros.cli.flags import flag
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Severity
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.verdict import Verdict
from symbid_ros.identification.predictions.comparison import Comparison
from symbid_ros.identification.predictions.error_changes import describe_files, percent
from symbid_ros.identification.predictions.force_errors import ForceError
from symbid_ros.identification.predictions.validation_result import Validation
from symbid_ros.messages.topics import OfferedQos
from symbid_ros.options import spelled
from symbid_ros.report.content import METRICS, REALISTIC_METRICS, MethodResult, Metric, best_labels
from symbid_ros.report.formatting import counted, significant, with_std

ERRORS = ("measured", "before", "after"), ("before %", "after %", "in 90 %")
LEGEND = (
    "before: RMS error of the original model, after: of the identified model, both in the unit of "
    "measured"
)
# Units of errors whose names do not state them.
UNITS = {one.key: one.unit for one in (*METRICS, *REALISTIC_METRICS)} | {
    "com_std_mm": "mm",
    "torque_std": "Nm",
    "com_coverage": "of the true values",
    "torque_coverage": "of the true values",
}
SHOWN = 20  # number of lost ranges to print; --json gives all


def print_info(info: BagInfo) -> None:
    """Print a bag's files and topics."""
    console = Console(highlight=False)
    distro = f", ROS 2 {info.ros_distro}" if info.ros_distro else ""
    console.print(Text(f"{info.bag}: {_size(info.size)}{distro}"), soft_wrap=True)
    if info.start is not None and info.end is not None:
        console.print(f"{_time(info.start)} to {_time(info.end)}, {info.duration:.3f} s")
    console.print(counted(info.count, "message"))
    for file in info.files:
        console.print(Text(f"{file.name}: {', '.join(_traits(file))}"), soft_wrap=True)
        if file.fault:
            console.print(Text(f"{file.name}: {file.fault}", style="red"), soft_wrap=True)
    rows = []
    for topic in info.topics:
        rate = "–" if topic.rate is None else f"{topic.rate:.4g}"
        qos = ", ".join(dict.fromkeys(map(_qos, topic.qos)))
        rows.append((topic.name, _type(topic.msgtype), str(topic.count), rate, Text(qos)))
    _print_topics(console, ("messages", "Hz", "publishers"), rows)


def print_recovery(recovery: RecoveryReport) -> None:
    """Print how many messages of a bag were kept and lost, and where."""
    console = Console(highlight=False)
    rows = []
    for topic in recovery.topics:
        missing = Text(str(topic.lost), style="red" if topic.lost else "")
        rows.append((topic.name, _type(topic.msgtype), str(topic.kept), missing))
    _print_topics(console, ("kept", "lost"), rows)
    for hole in recovery.holes[:SHOWN]:
        console.print(Text(_hole(hole)), soft_wrap=True)
    if len(recovery.holes) > SHOWN:
        console.print(f"and {len(recovery.holes) - SHOWN} more lost ranges, see --json")
    if recovery.repeated:
        console.print(f"{counted(recovery.repeated, 'repeated chunk')} left out")
    for count, name in (
        (recovery.attachments, "attachments"),
        (recovery.metadata, "metadata records"),
    ):
        if count.kept or count.lost:
            console.print(f"{name}: {count.kept} kept, {count.lost} lost")
    at_least = "" if recovery.is_counted else "at least "
    verdict = f"{recovery.kept} messages kept, {at_least}{recovery.lost} lost"
    console.print(Text(verdict, style="green" if recovery.is_whole else "red"), soft_wrap=True)
    console.print(Text(f"wrote {recovery.out}"), soft_wrap=True)


def _print_topics(
    console: Console,
    headers: Sequence[str],
    rows: Sequence[tuple[str, str, *tuple[Text | str, ...]]],
) -> None:
    """Print a table of topics, their types and other cells.

    On a narrow terminal, types break behind the package, then topics behind each slash. Names break
    anywhere only if that does not suffice. In a pipe, each topic has one line.
    """
    console = _as_wide_as_needed(console)

    def table(*breaks: bool, is_dense: bool = False, folds: bool = False) -> Table:
        table = Table(
            pad_edge=False,
            box=box.SIMPLE_HEAD,
            collapse_padding=is_dense,
            show_edge=not is_dense,
        )
        for name in ("topic", "type"):
            table.add_column(name, no_wrap=not folds, overflow="fold")
        for name in headers:
            is_text = name == "publishers"
            table.add_column(
                name,
                justify="left" if is_text else "right",
                no_wrap=not is_text,
                overflow="fold",
            )
        for topic, kind, *others in rows:
            names = zip((topic, kind), breaks, strict=True)
            table.add_row(
                *(Text(_broken(name) if is_broken else name) for name, is_broken in names), *others
            )
        return table

    tables = table(False, False), table(False, True), table(True, True)
    for one in (*tables, table(True, True, is_dense=True)):
        if _fits(console, one):
            console.print(one)
            return
    console.print(table(False, False, folds=True))


def _broken(name: str) -> str:
    """Return a name with a line for each of its parts, which end with a slash."""
    return name[:1] + name[1:].replace("/", "/\n")


def _traits(file: FileInfo) -> Iterator[str]:
    yield _size(file.size)
    yield " ".join([file.storage, *file.compression])
    yield "finished" if file.is_finished else "not finished"
    yield "indexed" if file.is_indexed else "not indexed"
    if file.recorded_by:
        yield f"written by {file.recorded_by}"
    for count, name in ((file.attachments, "attachment"), (file.metadata, "metadata record")):
        if count:
            yield counted(count, name)


def _hole(hole: LostRange) -> str:
    place = f"bytes {hole.offset} to {hole.offset + hole.length}: " if hole.length else ""
    if hole.after is not None and hole.before is not None:
        when = f", between {_time(hole.after)} and {_time(hole.before)}"
    elif hole.after is not None:
        when = f", after {_time(hole.after)}"
    elif hole.before is not None:
        when = f", before {_time(hole.before)}"
    else:
        when = ""
    number = f"{hole.messages}" if hole.is_counted else f"{hole.messages} or more"
    return f"{hole.file}: {place}{hole.fault}, {number} messages{when}"


def _qos(offer: OfferedQos) -> str:
    depth = f"{offer.depth}" if offer.history == "keep_last" else "all"
    latched = ", latched" if offer.durability == "transient_local" else ""
    return f"{offer.reliability.replace('_', ' ')}, {depth}{latched}"


def _type(msgtype: str) -> str:
    """Return a type's short name, as in ROS 2's documentation."""
    return msgtype.replace("/msg/", "/")


def _time(stamp: int) -> str:
    """Return nanoseconds as a date, or as seconds if they are not Unix time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    if seconds < 1_000_000_000 or seconds > 9_000_000_000:
        return f"{seconds}.{nanoseconds // 1_000_000:03} s"
    date = datetime.fromtimestamp(seconds, UTC)
    return f"{date:%Y-%m-%d %H:%M:%S}.{nanoseconds // 1_000_000:03} UTC"


def _size(size: int) -> str:
    number = float(size)
    for unit in ("B", "kB", "MB"):
        if number < 1000:
            return f"{number:.4g} {unit}"
        number /= 1000
    return f"{number:.4g} GB"


STYLES = {Severity.CLEAN: "green", Severity.WARNING: "yellow", Severity.UNUSABLE: "bold red"}


def print_diagnosis(diagnosis: Diagnosis) -> None:
    """Print a log's streams, the findings and the verdict."""
    console = Console(highlight=False)
    if diagnosis.streams:
        _print_streams(console, diagnosis)
    # Rich does not wrap these lines, so that a pipe receives them complete.
    for finding in diagnosis.findings:
        line = Text(f"{finding.kind.value}: ", style=STYLES[finding.severity])
        console.print(line.append(spelled(finding.message, flag), style=""), soft_wrap=True)
    for reason in diagnosis.left_out:
        console.print(Text(f"left out: {reason}", style="dim"), soft_wrap=True)
    severity = diagnosis.severity
    number = len(diagnosis.findings)
    verdict = "clean" if not number else f"{severity.name.lower()}, {number} found"
    console.print(Text(verdict, style=STYLES[severity]))


def _print_streams(console: Console, diagnosis: Diagnosis) -> None:
    """Print a line for each stream; on a narrow terminal, columns continue below."""
    console = _as_wide_as_needed(console)
    headers = ("count", "Hz"), ("gaps", "gap s")
    table = Table()
    for name in ("stream", *headers[0], *headers[1]):
        justify: JustifyMethod = "left" if name == "stream" else "right"
        table.add_column(name, justify=justify, no_wrap=True)
    table.add_column("verdict", overflow="fold")
    rows: list[Row] = []
    for one in diagnosis.streams:
        numbers = str(one.messages), f"{one.rate_hz:.4g}", str(one.gaps), f"{one.longest_gap_s:.3g}"
        found = diagnosis.of(one.topic)
        table.add_row(Text(one.topic), *numbers, _verdict(found, ", "))
        rows.append((one.topic, [*numbers, _verdict(found, "\n")]))
    if _fits(console, table):
        console.print(table)
    else:
        print_table(console, "stream", [*headers, ("verdict",)], rows, style=box.HEAVY_HEAD)


def _as_wide_as_needed(console: Console) -> Console:
    """Return a console without a limit of width if it writes to a pipe or a file."""
    if console.is_terminal or "COLUMNS" in os.environ:
        return console
    return Console(highlight=False, width=UNLIMITED)


def _fits(console: Console, table: Table) -> bool:
    """Return whether no name would break."""
    options = console.options.update(max_width=UNLIMITED)
    return console.measure(table, options=options).minimum <= console.width


def _verdict(findings: tuple[Finding, ...], separator: str) -> Text:
    """Return the kinds of findings on one stream."""
    if not findings:
        return Text("clean", style="green")
    worst = max(one.severity for one in findings)
    kinds = dict.fromkeys(one.kind.value for one in findings)
    return Text(separator.join(kinds), style=STYLES[worst])


def print_estimate(estimate: Estimate, out: Path, files: Sequence[str]) -> None:
    """Print alarms, the table of links, the verdict, and the files written to ``out``."""
    console = Console(highlight=False)
    # Rich does not wrap these lines, so that a pipe receives them complete.
    for alarm in estimate.verdict.alarms if estimate.verdict is not None else ():
        console.print(Text(f"alarm: {spelled(alarm, flag)}", style="bold red"), soft_wrap=True)
    print_links(console, estimate)
    for line in [*_lines(estimate), written_files(out, files)]:
        console.print(line, soft_wrap=True)


def print_links(console: Console, estimate: Estimate) -> None:
    """Print each link's mass, determined parameters and physical possibility.

    A link of which nothing is stated or found is left out, such as the world of an arm.
    """
    position = {name: index for index, name in enumerate(estimate.names)}
    rows: list[Row] = []
    for link, possible in estimate.consistent.items():
        mass = position[f"{link}/m"]
        own = slice(mass, mass + 10)
        count = 0 if estimate.determined is None else int(estimate.determined[own].sum())
        if not count and not estimate.prior[own].any():
            continue
        determined = "–" if estimate.determined is None else f"{count} of 10"
        cells: list[Text | str] = [
            f"{estimate.prior[mass]:.3f}",
            f"{estimate.value[mass]:.3f}",
            "–" if estimate.std is None else f"{estimate.std[mass]:.3f}",
            determined,
            "yes" if possible else Text("no", style="red"),
        ]
        rows.append((link, cells))
    groups = ("prior kg", "mass kg", "± kg"), ("determined", "possible")
    title = f"{estimate.model}, {estimate.method}"
    print_table(console, "link", groups, rows, title=title, style=box.HEAVY_HEAD)


def _lines(estimate: Estimate) -> list[RenderableType]:
    verdict = estimate.verdict
    windows = ""
    if verdict is not None and verdict.window > 0:
        windows = f", averaged over windows of {1e3 * verdict.window:g} ms"
    cut = "" if estimate.rank is None else f", {counted(estimate.rank, 'singular value')}"
    lines: list[RenderableType] = [
        f"{estimate.samples} rows of each coordinate{windows}{cut}, condition "
        f"{estimate.condition:.3g}"
    ]
    if verdict is not None:
        if terms := estimate.describe_terms():
            lines.append(Text(f"joint terms by evidence: {terms}"))
        lines += [Text(remark) for remark in estimate.remarks]
        lines += [Text(line) for line in estimate.describe_warming()]
        lines += [Text(payload) for payload in estimate.describe_payloads()]
        lines += _verdict_lines(estimate, verdict)
    if estimate.holdout is not None:
        found = estimate.holdout
        lines.insert(1, Text(f"held out: {spelled(found.summary, flag)}"))
        if files := describe_files(found.file_percents, found.percent_after):
            lines.insert(2, Text(files))
    return lines


def _verdict_lines(estimate: Estimate, verdict: Verdict) -> list[RenderableType]:
    lines: list[RenderableType] = [
        f"{estimate.describe_determined()} determined",
        f"{verdict.gain:.0f} bits of information gained",
    ]
    if verdict.sensors:
        known = sum(error.determined for error in verdict.sensors)
        lines.append(f"{known} of {len(verdict.sensors)} sensor errors determined")
    if gains := verdict.describe_drive_gains():
        lines.append(Text(gains))
    lines += [Text(place) for place in verdict.describe_payload_places()]
    if drift := verdict.describe_drift():
        lines.append(Text(drift))
    if verdict.unexplained:
        worst = verdict.unexplained[0]
        what = f"at most {worst}" if worst.size else "nothing unexplained"
        if not verdict.is_coloured:  # else an alarm says so
            lines.append(Text(f"{what}, apart from noise"))
    if scale := verdict.describe_mass_scale(floating=estimate.is_floating):
        lines.append(Text(spelled(scale, flag)))
    if not verdict.alarms:
        return [*lines, Text("no alarm", style="green")]
    alarms = counted(len(verdict.alarms), "alarm")
    if estimate.predicts_better:
        advice = "use this model for predictions, not its single parameters"
    else:
        reason = estimate.doubt and f", as {estimate.doubt}"
        advice = f"do not trust these numbers yet{reason}"
    return [*lines, Text(f"{alarms}: {advice}", style="bold red")]


def errors_table(title: str, errors: Mapping[str, float]) -> Table:
    """Return a table of errors by name."""
    table = Table(show_header=False, title=title, title_justify="left")
    for name, value in errors.items():
        table.add_row(name, f"{value:.4g}", UNITS.get(name, ""))
    return table


def print_metrics(console: Console, methods: Sequence[MethodResult]) -> None:
    """Print methods and their metrics.

    The best value of each column has a star and is bold. A method without metrics shows dashes.
    """
    groups = tuple(tuple(map(_header, some)) for some in (METRICS[:2], METRICS[2:]))
    best = best_labels({method.label: method.metrics or {} for method in methods}, METRICS)
    rows: list[Row] = []
    for method in methods:
        metrics = method.metrics or {}
        cells = [
            Text(f"*{shown}", style="bold") if method.label in best[metric.key] else Text(shown)
            for metric in METRICS
            for shown in [significant(metrics.get(metric.key))]
        ]
        rows.append((method.label, cells))
    print_table(console, "", groups, rows, title="Errors against the ground truth")
    console.print(Text("*: best of each column", style="dim italic"))


def _header(metric: Metric) -> str:
    return f"{metric.title}\n[dim]{metric.unit}[/dim]"


def print_validation(found: Validation) -> None:
    """Print errors by coordinate, total mass, intervals and the verdict."""
    console = Console(highlight=False)
    console.print(Text(f"{found.model}, {found.method}"), soft_wrap=True)
    rows: list[Row] = [(error.name, _error_cells(error)) for error in found.coordinates]
    rows += [None, *((error.name, _error_cells(error)) for error in found.groups)]
    print_table(console, "", ERRORS, rows)
    _print_legend(console, [*found.coordinates, *found.groups])
    if found.slow is not None:
        console.print(f"slow stretches: {found.slow_seconds:.1f} s, in which gravity dominates")
    if (mass := found.mass) is not None:
        console.print(
            f"total mass: {mass.before:.2f} kg → {mass.after:.2f} kg, while the forces show "
            f"{with_std(mass.measured, mass.std or 0.0)} kg, if the sensors have no common gain "
            "error",
            soft_wrap=True,
        )
    if found.coverage is not None and found.normalized_square is not None:
        console.print(
            f"intervals: {100 * found.coverage:.0f} % of the errors lie in their 90 % interval; "
            f"mean of (error / std)²: {significant(found.normalized_square)}, ideally 1",
            soft_wrap=True,
        )
    is_sure = found.is_covered and not found.alarms
    style = "bold red" if not found.is_recommended else "green" if is_sure else "yellow"
    console.print(Text(spelled(found.verdict, flag), style=style), soft_wrap=True)


def _print_legend(console: Console, errors: Sequence[ForceError]) -> None:
    console.print(Text(LEGEND), soft_wrap=True)
    if any(one.coverage is None for one in errors):
        console.print(
            Text(
                "in 90 %: – if the standard deviation of the errors is unknown, as with methods "
                "without a covariance, or if the compared results have windows of different lengths"
            ),
            soft_wrap=True,
        )
    if any(one.percent_after is None for one in errors):
        console.print(Text("before %, after %: – if nothing was measured"), soft_wrap=True)


def _error_cells(error: ForceError) -> list[str]:
    inside = "–" if error.coverage is None else f"{100 * error.coverage:.0f} %"
    return [
        f"{significant(error.measured)} {error.unit}",
        significant(error.rmse_before),
        significant(error.rmse_after),
        percent(error.percent_before),
        percent(error.percent_after),
        inside,
    ]


def print_comparison(found: Comparison) -> None:
    """Print the results by their errors, the best first."""
    console = Console(highlight=False)
    rows = [(one.result, _error_cells(one.main)) for one in found.ranking]
    print_table(console, "result", ERRORS, rows)
    _print_legend(console, [one.main for one in found.ranking])
    console.print(Text(spelled(found.verdict, flag)), soft_wrap=True)
