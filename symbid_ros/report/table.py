"""Comparison of methods as a table for the terminal."""

from collections.abc import Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from symbid_ros.report.content import METRICS, MethodResult, best_labels
from symbid_ros.report.formatting import significant


def metrics_table(methods: Sequence[MethodResult]) -> Table:
    """Return a table of the five metrics, with the best value of each column in bold.

    Parameters
    ----------
    methods : sequence of MethodResult
        Rows in the order shown; a row without metrics shows dashes.

    Returns
    -------
    rich.table.Table
        At most 80 columns wide.
    """
    table = Table(
        title="Errors against the ground truth",
        caption="best of each column in bold",
        box=box.SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("", no_wrap=True)
    for metric in METRICS:
        table.add_column(f"{metric.title}\n[dim]{metric.unit}[/dim]", justify="right", no_wrap=True)
    best = best_labels({method.label: method.metrics or {} for method in methods}, METRICS)
    for method in methods:
        metrics = method.metrics or {}
        cells = [
            Text(
                significant(metrics.get(metric.key)),
                style="bold" if method.label in best[metric.key] else "",
            )
            for metric in METRICS
        ]
        table.add_row(Text(method.label), *cells)
    return table
