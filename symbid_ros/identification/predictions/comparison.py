"""Comparison of results on one log that they did not use."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.errors import EstimateError
from symbid_ros.identification.predictions.error_changes import enumerate_words, percent
from symbid_ros.identification.predictions.force_errors import ForceRows, compare_errors
from symbid_ros.identification.predictions.validation import assess, predictor_of
from symbid_ros.identification.predictions.validation_result import Validation
from symbid_ros.identification.result import Result
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.json_documents import versioned
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import sensor_names
from symbid_ros.signals.log import Log

WINDOW = 0.161  # s; for comparisons of results without windows


@dataclass(frozen=True)
class Comparison:
    """Several results validated on the same rows of one log.

    Attributes
    ----------
    ranking : tuple of Validation
        The smallest error first.
    verdict : str
        Which result to use.
    recommended : str or None
        Its name; None if none is better than the original model and fit for this robot and load.
    """

    ranking: tuple[Validation, ...]
    verdict: str
    recommended: str | None

    def document(self) -> dict[str, object]:
        """Return everything but the series, for JSON."""
        ranking = [one.document() for one in self.ranking]
        content = {"verdict": self.verdict, "recommended": self.recommended, "ranking": ranking}
        return versioned("comparison", content)


@on_one_blas_thread
def compare(
    results: Sequence[Result | str | Path], log: Log, *, payload: str | Sequence[str] = ()
) -> Comparison:
    """Rank results by their error on a log, all on the same rows.

    Unless all results have equal rows, the rows are averaged over the longest of their windows.
    Only rows that are valid for every result count.

    Parameters
    ----------
    results : sequence of Result, str or Path
        Results, or folders of saved ones, of robots with the same joints.
    log : Log
        Measurements that no identification used.
    payload : str or sequence of str
        As of :func:`validate`.

    Raises
    ------
    SymbidError
        When a file of a result, or the log, is invalid or belongs to another robot.
    """
    predictors = [predictor_of(result, log, payload) for result in results]
    first = predictors[0]
    lengths = [one.settings.window for one in predictors if one.settings.filter == "weak"]
    window = max((length for length in lengths if length), default=WINDOW)
    has_equal_rows = len({one.settings for one in predictors}) == 1
    data = []
    for predictor in predictors:
        model = predictor.parameters.model
        if model.coordinates != first.parameters.model.coordinates:
            difference = describe_difference(model, first.parameters.model)
            raise EstimateError(
                f"{predictor.name}: its {difference} of {first.name}; compare results of one robot",
                "E512",
            )
        alike = predictor if has_equal_rows else predictor.over_windows(window)
        data.append(ForceRows.of(alike, AlignedLog(log, model), log.source))
    valid = np.logical_and.reduce([one.valid for one in data])
    if not valid.any():
        raise EstimateError(
            f"{log.source}: has no row that is valid for every result; give a log in which more "
            "joints move",
            "E508",
        )
    data = [replace(one, valid=valid) for one in data]
    found = [
        assess(predictor, rows, log.source)
        for predictor, rows in zip(predictors, data, strict=True)
    ]
    order = sorted(range(len(found)), key=lambda index: found[index].main.rmse_after)
    ranking = tuple(found[index] for index in order)
    best = ranking[0]
    if len(ranking) == 1:
        recommended = best.result if best.is_recommended else None
        return Comparison(ranking, f"{best.result}: {best.verdict}", recommended)
    verdict, chosen = _ranking_verdict(ranking[:2], [data[index] for index in order[:2]])
    recommended = None if chosen is None else chosen.result
    return Comparison(ranking, verdict + _remark_on_use(ranking), recommended)


def describe_difference(model: RobotModel, other: RobotModel) -> str:
    """Return in what a robot differs from another one of other coordinates."""
    sensors, others = (", ".join(sensor_names(one)) or "none" for one in (model, other))
    moving, first = (
        [one.joint_names[joint] for joint in one.moving_joints] for one in (model, other)
    )
    if sensors != others and moving == first:
        return f"wrist sensors are {sensors} instead of {others}, those"
    return "joints are not those"


def _ranking_verdict(
    pair: Sequence[Validation], data: Sequence[ForceRows]
) -> tuple[str, Validation | None]:
    """Compare the best two results, and return which one to use, if any."""
    best, second = pair
    if best.advice in ("equal", "worse"):
        said = f"{best.change} with {best.result}, the best of them"
        return f"none is clearly better than the original model: {said}", None
    places = data[0].main
    change = compare_errors(
        data[1].error_after[:, places], data[0].error_after[:, places], data[0].y[:, places]
    )
    figures = " against ".join(_after(one) for one in pair)
    if change.is_decrease:
        verdict, equals = f"{best.result} predicts best: {figures}", [best]
    else:
        verdict, equals = f"{best.result} and {second.result} hardly differ: {figures}", [*pair]
    verdict += "".join(f"; {_objection(one)}" for one in equals if not one.is_recommended)
    chosen = next((one for one in equals if one.is_recommended), None)
    if chosen is not None and chosen.alarms:
        verdict += f"; {chosen.result}: {chosen.counted_alarms}"
    return verdict, chosen


def _objection(found: Validation) -> str:
    """Return why not to use a result of small errors."""
    reasons = {
        "mixed": f"{enumerate_words(found.worse)} got worse than with the original model",
        "unfit": "its error is larger than the measured forces",
        "better": "it is not fit for this robot or load",
    }
    reason = reasons.get(found.advice, "it is not clearly better than the original model")
    return f"do not use {found.result}, {reason}"


def _remark_on_use(ranking: Sequence[Validation]) -> str:
    """Return how much of the log each result was identified from; empty if none was."""
    used = [
        f"{one.result} used {one.seconds_used:.0f} s" for one in ranking if one.seconds_used > 0
    ]
    if not used:
        return ""
    return (
        f"; {enumerate_words(used)} of this log's {ranking[0].seconds:.0f} s for the "
        "identification; repeat this with another log"
    )


def _after(found: Validation) -> str:
    main = found.main
    if main.percent_after is None:
        return f"{main.rmse_after:.3g} {main.unit}"
    return percent(main.percent_after)
