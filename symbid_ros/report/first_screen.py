"""What a reader sees first: whether to use the model, its mass, and its error on held-out data."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.calibration.extended_problem import ASSUMED
from symbid_ros.identification.predictions.error_changes import (
    describe_files,
    percent,
    percent_change,
)
from symbid_ros.identification.predictions.force_errors import differ_relevantly
from symbid_ros.identification.predictions.holdout import REPEATED
from symbid_ros.identification.report_data import ReportData
from symbid_ros.report.content import PRIOR, MethodResult, ReportContent
from symbid_ros.report.formatting import ABSENT, fixed, significant, with_std
from symbid_ros.report.robot_summary import RobotSummary
from symbid_ros.report.shown_log import describe_given, describe_identified_log

# Bars that exceed this multiple of the third quartile are cut off.
OUTLIER = 3.0
# Bars that are shown at once; the rest is folded.
BARS_SHOWN = 12
OPEN_SCALE = (
    "The common scale of efforts and masses was not measured: it is that of the model file’s "
    "masses."
)


@dataclass(frozen=True)
class Recommendation:
    """Whether to use a model.

    Attributes
    ----------
    kind : {"good", "caution", "bad"}
    sentence : str
        The recommendation with its main figure.
    remark : str
        What limits it; may be empty.
    """

    kind: Literal["good", "caution", "bad"]
    sentence: str
    remark: str = ""


def recommend(estimate: Estimate) -> Recommendation:
    """Return whether to use a model, from its alarms and its error on held-out data."""
    found = _recommended(estimate)
    if any(one.startswith(ASSUMED) for one in estimate.remarks):
        return replace(found, remark=_joined(found.remark, OPEN_SCALE))
    return found


def _recommended(estimate: Estimate) -> Recommendation:
    alarms = () if estimate.verdict is None else estimate.verdict.alarms
    holdout = estimate.holdout
    if alarms:
        return _with_alarms(estimate, len(alarms))
    calm = "" if estimate.verdict is None else "; no alarm"
    if holdout is None or not _is_tried(estimate):
        why = "" if holdout is None else f" ({holdout.summary})"
        return Recommendation(
            "caution",
            f"Validate this model before you use it: no data were held out{calm}.",
            f"Run symbid validate with a log that was not used{why}.",
        )
    figure = change_on_held_out_data(estimate)
    repeats = (
        "The motion repeats itself there, so other motions may be predicted worse."
        if holdout.repeats >= REPEATED
        else ""
    )
    if holdout.advice == "better":
        remark = _joined(repeats, _files(estimate))
        return Recommendation("good", f"Use this model: {figure}{calm}.", remark)
    if holdout.advice == "equal" and differ_relevantly(
        holdout.percent_before, holdout.percent_after
    ):
        return Recommendation(
            "caution",
            f"The data held out are too few to tell whether this model is better: {figure}{calm}.",
            "Run symbid validate with a longer log that was not used.",
        )
    if holdout.advice == "equal":
        return Recommendation(
            "caution", f"This model hardly differs from the original: {figure}{calm}.", repeats
        )
    kinds = {
        "worse": "it is worse than the original",
        "unfit": "its error is larger than the measured forces",
    }
    worse = kinds.get(holdout.advice, "it is partly worse than the original")
    return Recommendation("bad", f"Do not use this model, {worse}: {figure}{calm}.", repeats)


def _with_alarms(estimate: Estimate, number: int) -> Recommendation:
    count = "1 alarm" if number == 1 else f"{number} alarms"
    figure = f"; {change_on_held_out_data(estimate)}" if _is_tried(estimate) else ""
    if estimate.predicts_better:
        return Recommendation(
            "caution",
            f"Use this model for predictions, not its single parameters: {count}{figure}.",
            _joined(
                "Either the robot has an effect that the model lacks, or the model file is far "
                "from the robot.",
                _files(estimate),
            ),
        )
    doubt = estimate.doubt and (
        f"{estimate.doubt[0].upper()}{estimate.doubt[1:]}. A fault of a sensor does so, and the "
        "data held out have the same fault."
    )
    return Recommendation("bad", f"Do not use this model yet: {count}{figure}.", doubt)


def _files(estimate: Estimate) -> str:
    """Return by how much the model files alone err, as a sentence; may be empty."""
    holdout = estimate.holdout
    if holdout is None:
        return ""
    found = describe_files(holdout.file_percents, holdout.percent_after)
    return f"{found[0].upper()}{found[1:]}." if found else ""


def _joined(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


def _is_tried(estimate: Estimate) -> bool:
    return estimate.holdout is not None and estimate.holdout.seconds > 0


def change_on_held_out_data(estimate: Estimate) -> str:
    """Return the error on held-out data, such as "torque error on data held out 9 % → 1 %"."""
    holdout = estimate.holdout
    assert holdout is not None
    before, after = holdout.percent_before, holdout.percent_after
    has_several = holdout.summary.count("→") > 1  # the advice is about another error
    if before is None or after is None or has_several:
        return f"error on data held out {holdout.summary.partition(' on the last')[0]}"
    what = "torque" if "torque" in holdout.summary else "force"
    return f"{what} error on data held out {percent_change(before, after)}"


@dataclass(frozen=True)
class KeyFigure:
    """A main figure of the robot or the log."""

    title: str
    value: str  # one or several lines
    note: str = ""

    @property
    def lines(self) -> list[str]:
        """The lines of the value."""
        return self.value.splitlines()


def key_figures(content: ReportContent) -> tuple[KeyFigure, ...]:
    """Return mass, centre of mass, share of determined combinations, and length of the log."""
    shown, estimate = content.shown, content.estimate
    figures = []
    if shown.summary is not None:
        figures += [_mass(shown.summary), _com(shown.summary)]
    if estimate.verdict is not None:
        figures.append(
            KeyFigure(
                "Determined",
                describe_combinations(estimate),
                "parameter combinations; the others keep the model file’s values",
            )
        )
    figures += _error_against_truth(content)
    if shown.log is not None:
        used = f"{significant(shown.log.coverage.seconds)} s used"
        note = f"{describe_identified_log(shown)}; {_describe_findings(shown.log)}"
        figures.append(KeyFigure("Log", used, note.replace(f", {used}", "")))
    return tuple(figures)


def _error_against_truth(content: ReportContent) -> list[KeyFigure]:
    key = "com_position_rmse_mm"
    metrics, prior = content.metrics_of(content.chosen), content.metrics_of(PRIOR)
    if metrics is None or key not in metrics:
        return []
    note = "" if prior is None else f"of the centre of mass; original {significant(prior[key])} mm"
    return [KeyFigure("Error against the truth", f"{significant(metrics[key])} mm", note)]


def describe_combinations(estimate: Estimate) -> str:
    """Return the number of determined combinations, as the terminal does."""
    if estimate.verdict is None:
        return ABSENT
    return f"{len(estimate.verdict.directions)} of {estimate.identified}"


def _describe_findings(log: ReportData) -> str:
    if not log.coverage.is_checked:
        return "not checked"
    count = len(log.coverage.findings)
    if count == 0:
        return "the doctor found no fault"
    return "the doctor found 1 fault" if count == 1 else f"the doctor found {count} faults"


def _mass(summary: RobotSummary) -> KeyFigure:
    title = "Total mass" if summary.is_floating else "Mass of the moving links"
    original = f"original {significant(summary.mass_before, 4)} kg"
    if summary.is_mass_measured is False:
        source = "" if summary.has_mass_moved else ", mostly the model file’s"
        original = f"not measured by this log{source}; {original}"
    return KeyFigure(title, f"{with_std(summary.mass, summary.mass_std)} kg", original)


def _com(summary: RobotSummary) -> KeyFigure:
    posture = "mean posture" if summary.is_mean_posture else "zero posture"
    whose = "" if summary.is_floating else " of the moving links"
    before = ", ".join(fixed(1e3 * one, 1) for one in summary.com_before)
    return KeyFigure(
        f"Centre of mass{whose}",
        "\n".join(
            f"{axis} {with_std(1e3 * value, 1e3 * std)} mm"
            for axis, value, std in zip("xyz", summary.com, summary.com_std, strict=True)
        ),
        f"in the base frame at the {posture}; original {before} mm".replace("-", "−"),
    )


@dataclass(frozen=True)
class ErrorBar:
    """Error at one coordinate before and after, as text and as bars.

    Attributes
    ----------
    name : str
    before, after : str
        With the unit.
    share_before, share_after : str
        The same in percent of the measured force; empty if that is unknown.
    width_before, width_after : float
        Percent of the longest bar.
    cut_before, cut_after : bool
        Whether a bar is cut off.
    is_worse : bool
        Whether the error has grown by a relevant factor.
    """

    name: str
    before: str
    after: str
    share_before: str
    share_after: str
    width_before: float
    width_after: float
    cut_before: bool
    cut_after: bool
    is_worse: bool


@dataclass(frozen=True)
class ErrorBars:
    """Bars with a common scale.

    Attributes
    ----------
    bars : tuple of ErrorBar
        The largest first.
    scale : str
        What full length means.
    note : str
        Where the errors come from.
    title : str
        What has bars.
    """

    bars: tuple[ErrorBar, ...]
    scale: str
    note: str
    title: str

    @property
    def has_cut(self) -> bool:
        """Whether a bar is cut off."""
        return any(bar.cut_before or bar.cut_after for bar in self.bars)

    @property
    def shown(self) -> tuple[ErrorBar, ...]:
        """Bars that are always visible."""
        return self.bars[:BARS_SHOWN]

    @property
    def folded(self) -> tuple[ErrorBar, ...]:
        """The remaining bars."""
        return self.bars[BARS_SHOWN:]


def error_bars(result: MethodResult) -> ErrorBars | None:
    """Return the error of each joint before and after, or of the base without joints."""
    forces = None if result.drawn is None else result.drawn.forces
    holdout = None if result.estimate is None else result.estimate.holdout
    trial = "Last part of the log, predicted by a trial identification without it."
    if forces is not None:
        numbers = np.stack([forces.rmse_before, forces.rmse_after, forces.rms_measured], axis=1)
        rows = [
            ErrorRow(name, unit, *row)
            for name, unit, row in zip(
                forces.coordinates, forces.units, numbers.tolist(), strict=True
            )
            if np.isfinite(row[1])
        ]
        if forces.is_held_out:
            return _scaled(rows, trial)
        where = "data that the identification used"
        return _scaled(
            rows, f"On {where if result.given is None else describe_given(result.given)}."
        )
    if holdout is None or not holdout.coordinates:
        return None
    pairs = holdout.coordinates.items()
    return _scaled([ErrorRow(name, "Nm", *pair, np.nan) for name, pair in pairs], trial)


class ErrorRow(NamedTuple):
    """RMS errors at one coordinate, and RMS of the measured force; NaN if that is unknown."""

    name: str
    unit: str
    before: float
    after: float
    measured: float


def _scaled(rows: Sequence[ErrorRow], note: str) -> ErrorBars | None:
    """Return bars of the joints, or of the base without joints."""
    rows = [row for row in rows if not row.name.startswith("base/")] or rows
    if not rows:
        return None
    before, after, measured = (np.array([row[i] for row in rows]) for i in (2, 3, 4))
    is_relative = bool(np.any(measured > 0))
    scale = np.ones(len(rows))
    if is_relative:
        # A joint without load has no percentage, and no bar.
        scale = np.where(measured > 0, measured, np.inf) / 100
    longest = robust_maximum(np.maximum(before, after) / scale)
    if is_relative:
        # An error of the original model above the measured force must not hide the other one.
        longest = min(longest, max(100.0, robust_maximum(after / scale)))
    longest = rounded_up(longest)

    def is_cut(length: float) -> bool:
        return length > longest * (1 + 1e-9)

    bars = []
    for row, size in zip(rows, scale.tolist(), strict=True):
        name, unit, first, second, load = row
        has_share = is_relative and load > 0
        bars.append(
            ErrorBar(
                name,
                f"{significant(first)} {unit}",
                f"{significant(second)} {unit}",
                percent(first / size) if has_share else "",
                percent(second / size) if has_share else "",
                _width(first / size, longest),
                _width(second / size, longest),
                is_cut(first / size),
                is_cut(second / size),
                second > first and differ_relevantly(first, second),
            )
        )
    order = np.argsort(-np.maximum(before, after) / scale, kind="stable")
    quantity = "torque" if all(row.unit == "Nm" for row in rows) else "torque or force"
    unit = f"% of the measured {quantity}" if is_relative else "Nm or N"
    has_sensors = any("/" in row.name and not row.name.startswith("base/") for row in rows)
    return ErrorBars(
        tuple(bars[index] for index in order.tolist()),
        f"{significant(longest, 2)} {unit}",
        note,
        "Error on each joint and sensor axis" if has_sensors else "Error on each joint",
    )


def _width(value: float, longest: float) -> float:
    return round(100 * min(value / longest, 1.0), 1) if longest > 0 else 0.0


def rounded_up(value: float) -> float:
    """Return the next larger of 1, 2 and 5 times a power of ten; zero for zero."""
    if value <= 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9)))


def robust_maximum(values: FloatArray) -> float:
    """Return the largest value, or less if it exceeds most others by far."""
    finite = np.sort(values[np.isfinite(values) & (values > 0)])
    if not len(finite):
        return 0.0
    quartile = float(np.quantile(finite, 0.75))
    return min(float(finite[-1]), OUTLIER * quartile)
