"""Colours, dashes and markers that mean the same in every figure."""

from dataclasses import dataclass

from symbid_ros.report.content import PRIOR, TRUTH, ReportContent


@dataclass(frozen=True)
class Style:
    """How one parameter set is drawn; colour is never the only sign.

    Attributes
    ----------
    colour : str
        From the palette of Okabe and Ito, which colour-blind readers tell apart.
    dash : str
        Matplotlib's line style.
    width : float
        Line width, points.
    marker : str
        Matplotlib's marker.
    """

    colour: str
    dash: str
    width: float
    marker: str


# The truth lies wide and dark below, the estimate thin and bright on it: both stay visible where
# they agree.
_TRUTH = Style("#3a3a3a", "-", 2.6, "|")
_PRIOR = Style("#8f8f8f", "--", 1.2, "s")
_CHOSEN = Style("#0072b2", "-", 1.1, "o")
_OTHERS = (
    Style("#d55e00", "-.", 1.1, "^"),
    Style("#b07c00", ":", 1.2, "v"),
    Style("#009e73", "-.", 1.1, "D"),
    Style("#cc79a7", ":", 1.2, "P"),
    Style("#56b4e9", "-.", 1.1, "X"),
    Style("#000000", ":", 1.1, "*"),
)


def styles(content: ReportContent) -> dict[str, Style]:
    """Return the style of every label that occurs in the report."""
    labels = [m.label for m in content.methods]
    labels += [s.label for s in content.predictions or ()]
    labels += content.link_errors.percent if content.link_errors else ()
    named = {TRUTH: _TRUTH, PRIOR: _PRIOR, content.chosen: _CHOSEN}
    others = [label for label in dict.fromkeys(labels) if label not in named]
    return named | {label: _OTHERS[i % len(_OTHERS)] for i, label in enumerate(others)}
