"""What the terminal says of a log's health."""

from rich.console import Console
from rich.table import Table
from rich.text import Text

from symbid_ros.diagnosis.findings import Diagnosis, Finding, Severity

STYLES = {Severity.CLEAN: "green", Severity.WARNING: "yellow", Severity.UNUSABLE: "bold red"}


def print_diagnosis(diagnosis: Diagnosis) -> None:
    """Print a log's streams, what is wrong with them and the verdict."""
    console = Console(highlight=False)
    table = Table(pad_edge=False)
    table.add_column("stream", overflow="fold")
    for name in ("count", "Hz", "gaps", "gap s"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    for stream in diagnosis.streams:
        table.add_row(
            Text(stream.topic),
            str(stream.messages),
            f"{stream.rate_hz:.4g}",
            str(stream.gaps),
            f"{stream.longest_gap_s:.3g}",
            _verdict(diagnosis.of(stream.topic)),
        )
    console.print(table)
    # Long lines are left to the terminal to wrap: whoever reads them from a pipe gets them whole.
    for finding in diagnosis.findings:
        told = Text(f"{finding.kind.value}: ", style=STYLES[finding.severity])
        console.print(told.append(finding.message, style=""), soft_wrap=True)
    for reason in diagnosis.left_out:
        console.print(Text(f"left out: {reason}", style="dim"), soft_wrap=True)
    severity = diagnosis.severity
    number = len(diagnosis.findings)
    verdict = "clean" if not number else f"{severity.name.lower()}, {number} found"
    console.print(Text(verdict, style=STYLES[severity]))


def _verdict(findings: tuple[Finding, ...]) -> Text:
    """Return the kinds of what is wrong with one stream."""
    if not findings:
        return Text("clean", style="green")
    worst = max(one.severity for one in findings)
    return Text(", ".join(dict.fromkeys(one.kind.value for one in findings)), style=STYLES[worst])
