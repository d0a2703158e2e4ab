"""What the numbers say, in one sentence."""

from collections.abc import Iterable, Mapping

from symbid_ros.report.content import PRIOR, TRUTH, Metric, ReportContent
from symbid_ros.report.numerals import significant


def best_labels(
    rows: Mapping[str, Mapping[str, float]], metrics: Iterable[Metric]
) -> dict[str, frozenset[str]]:
    """Return, by metric key, the labels with the smallest value.

    The truth competes with nobody; the prior does, so that a method which made
    things worse is seen to have done so.
    """
    best = {}
    for metric in metrics:
        values = {
            label: row[metric.key]
            for label, row in rows.items()
            if metric.key in row and label != TRUTH
        }
        smallest = min(values.values(), default=0.0)
        best[metric.key] = frozenset(label for label, v in values.items() if v == smallest)
    return best


def impossible_links(consistent: dict[str, bool]) -> tuple[str, ...]:
    """Return the links whose mass or pseudo-inertia no body can have."""
    return tuple(link for link, possible in consistent.items() if not possible)


def headline(content: ReportContent) -> str:
    """Return the verdict on the chosen method, computed from its numbers."""
    estimate = content.estimate
    clauses = []
    own, prior = content.metrics_of(content.chosen), content.metrics_of(PRIOR)
    key = "com_position_rmse_mm"
    if own is not None and key in own:
        error = own[key]
        clause = f"CoM error {significant(error)} mm"
        if prior is not None and key in prior:
            against = "against" if error < prior[key] else "no better than"
            clause += f" {against} {significant(prior[key])} mm of the prior"
        clauses.append(clause)
    if estimate.determined is not None:
        clauses.append(
            f"{int(estimate.determined.sum())} of {len(estimate.names)} parameters "
            "determined by the data"
        )
    possible = len(estimate.consistent) - len(impossible_links(estimate.consistent))
    clauses.append(f"{possible} of {len(estimate.consistent)} links physically possible")
    return f"{content.chosen}: {'; '.join(clauses)}."
