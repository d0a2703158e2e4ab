"""Several results side by side: a row for each, and errors of each joint on the same data."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.choices import TERMS
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.report_data import Coverage, ForceSeries
from symbid_ros.report.content import MethodResult
from symbid_ros.report.first_screen import describe_combinations
from symbid_ros.report.formatting import ABSENT, significant, with_std
from symbid_ros.report.shown_log import describe_identified_log

# Results predict the same data if the ends of their parts differ by less than this share.
DIFFERENT_ENDS = 0.1


@dataclass(frozen=True)
class ComparedResults:
    """Several results as text: a row for each, and the error of each joint.

    Attributes
    ----------
    columns : tuple of str
        Titles of what is compared.
    rows : tuple of (str, tuple of str)
        Label of each result and its values.
    labels : tuple of str
        Results that know the error of each joint.
    joints : tuple of (str, tuple of (str, bool))
        Name of each joint and, for these results, its error and whether it is the smallest; empty
        if the errors are those of different data.
    has_other_data : bool
        Whether they are.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]
    labels: tuple[str, ...]
    joints: tuple[tuple[str, tuple[tuple[str, bool], ...]], ...]
    has_other_data: bool


def compared_results(results: Sequence[MethodResult]) -> ComparedResults | None:
    """Return the table of several results; None for a single one."""
    if len(results) < 2:
        return None
    rows, columns = [], dict[str, None]()
    for result in results:
        estimate, summary = result.estimate, result.summary
        assert estimate is not None
        held_out, verdict = estimate.holdout, estimate.verdict
        alarms = ABSENT if verdict is None else str(len(verdict.alarms) or "none")
        cells = {"Log": describe_identified_log(result)} if result.log is not None else {}
        cells |= {
            "Error on data held out": ABSENT if held_out is None else held_out.summary,
            "Alarms": alarms,
            "Joint terms": estimate.describe_terms() or _named_terms(estimate) or "none",
            "Determined combinations": describe_combinations(estimate),
        }
        if summary is not None:
            cells["Mass"] = f"{with_std(summary.mass, summary.mass_std)} kg"
        columns |= dict.fromkeys(cells)
        rows.append((result.label, cells))
    predicted = {
        result.label: (log.coverage, log.forces)
        for result in results
        if (log := result.drawn) is not None and log.forces is not None
    }
    is_same = are_of_same_data([*predicted.values()])
    known = {
        label: dict(zip(forces.coordinates, forces.rmse_after.tolist(), strict=True))
        for label, (_, forces) in predicted.items()
        if is_same
    }
    return ComparedResults(
        tuple(columns),
        tuple((label, tuple(cells.get(name, ABSENT) for name in columns)) for label, cells in rows),
        tuple(known) if len(known) > 1 else (),
        _joint_errors(known) if len(known) > 1 else (),
        not is_same,
    )


def are_of_same_data(predicted: Sequence[tuple[Coverage, ForceSeries]]) -> bool:
    """Return whether forces are those of the same part of one log, apart from its ends.

    Parts begin and end with windows, whose lengths differ between results.
    """
    if not predicted:
        return True
    first = predicted[0][0].begin
    ends = np.array(
        [[1e-9 * (log.begin - first) + t for t in (f.start, f.stop)] for log, f in predicted]
    )
    tolerance = DIFFERENT_ENDS * float(np.max(ends[:, 1] - ends[:, 0]))
    is_one_log = len({log.log for log, _ in predicted}) == 1
    return is_one_log and bool(np.max(np.ptp(ends, axis=0)) <= tolerance)


def _joint_errors(
    known: Mapping[str, Mapping[str, float]],
) -> tuple[tuple[str, tuple[tuple[str, bool], ...]], ...]:
    """Return the error at each coordinate that every result predicts, and mark the smallest."""
    first = next(iter(known.values()))
    joints = []
    for name in first:
        errors = [one.get(name, float("nan")) for one in known.values()]
        if not name.startswith("base/") and all(map(math.isfinite, errors)):
            texts, smallest = [*map(significant, errors)], significant(min(errors))
            joints.append((name, tuple((text, text == smallest) for text in texts)))
    return tuple(joints)


def _named_terms(estimate: Estimate) -> str:
    """Return the joint terms that the user named."""
    kinds = {name.rpartition("/")[2] for name in estimate.names}
    return ", ".join(term for term in TERMS if term in kinds)
