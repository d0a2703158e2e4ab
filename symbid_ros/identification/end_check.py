"""Comparison of identifications by their errors on the end of a log, which each left out."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from symbid_ros.estimation.estimate import HoldOut
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.predictions.validation import validate_segments
from symbid_ros.identification.report_data import ForceSeries
from symbid_ros.signals.segments import Segment


@dataclass(frozen=True)
class EndCheck:
    """How well an identification without the end of a log predicts that end.

    Attributes
    ----------
    holdout : HoldOut
    forces : ForceSeries or None
        Measured and predicted forces, unless no part of the log could be left out.
    window : float
        Length of the windows of its rows, s; 0 for filtered rows.
    predictor : ForcePredictor or None
    held_out : iterable of Segment
        The end of the log.
    """

    holdout: HoldOut
    forces: ForceSeries | None = None
    window: float = 0.0
    predictor: ForcePredictor | None = None
    held_out: Iterable[Segment] = ()

    def percent_over(self, window: float) -> float | None:
        """Return the error of forces averaged over windows of a length, s, in percent."""
        if self.predictor is None or window == self.window:
            return self.holdout.percent_after
        alike = self.predictor.over_windows(window)
        return validate_segments(alike, self.held_out, "end of the log").percent_after


def percents(one: EndCheck, other: EndCheck) -> tuple[float, float] | None:
    """Return the errors of two checks on the end of a log in percent; None if one has none.

    An average over a longer window contains less noise, so both are over the longer one.
    """
    window = max(one.window, other.window)
    first, second = one.percent_over(window), other.percent_over(window)
    return None if first is None or second is None else (first, second)


class CheckedTrial(NamedTuple):
    """An identification of a log, with its check on the end of the log."""

    problem: LoadedProblem
    found: Identification
    check: EndCheck
