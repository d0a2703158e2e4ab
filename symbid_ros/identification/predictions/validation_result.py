"""The result of a validation: errors of the original and of the identified robot, and a verdict."""

from dataclasses import asdict, dataclass, field
from html import escape
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.identification.offset_changes import OffsetChange
from symbid_ros.identification.predictions.error_changes import describe_change, percent
from symbid_ros.identification.predictions.force_errors import (
    LEAST_COVERAGE,
    ForceError,
    ForceRows,
    TotalMass,
)
from symbid_ros.json_documents import versioned

Advice = Literal["better", "equal", "worse", "mixed", "unfit"]
# Rows that a single coordinate needs to be named.
COVERAGE_ROWS = 20
# Normalised square above which the robot or its load is not that of the identified log. Logs of
# one robot have 1 to 1.4.
OTHER_ROBOT = 100.0
# Percent error of a joint with that many rows above which nothing of its effort is predicted.
NOTHING = 90.0


@dataclass(frozen=True)
class PredictedEfforts:
    """Measured and predicted forces in N windows, for plots; NaN where a row is not used.

    Attributes
    ----------
    stamp : (N,) int64
        Centres of the windows, ns.
    joints : tuple of str
        Names of the J joints.
    measured, before, after : (N, J) float64
        Motor efforts, measured and predicted by the original and the identified model, Nm or N.
    base : str
        Link of a floating base; empty if the base is fixed.
    wrench_measured, wrench_before, wrench_after : (N, 6) float64
        Moment and force of the environment in base axes; no columns if the base is fixed.
    """

    stamp: IntArray
    joints: tuple[str, ...]
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    base: str
    wrench_measured: FloatArray
    wrench_before: FloatArray
    wrench_after: FloatArray

    @classmethod
    def of(cls, rows: ForceRows) -> "PredictedEfforts":
        """Return the series of a log."""
        model, first = rows.model, rows.first_joint
        measured = rows.effort.copy()
        measured[:, :first] = rows.y[:, :first]
        measured = np.where(rows.valid, measured, np.nan)
        before, after = measured - rows.error_before, measured - rows.error_after
        return cls(
            rows.stamp,
            model.joint_names,
            measured[:, first:],
            before[:, first:],
            after[:, first:],
            model.links[0].name if model.floating else "",
            measured[:, :first],
            before[:, :first],
            after[:, :first],
        )


@dataclass(frozen=True)
class Validation:
    """How well an identified robot predicts a log, compared with the original model.

    The rows are those of the identification: the equation of motion averaged over its windows, or
    at its filtered instants. Identified sensor errors are removed from both predictions.

    Attributes
    ----------
    result, model, method, log : str
        Names of the result, the robot, the method and the log.
    seconds, seconds_used : float
        Length of the log, and of its part that the identification used, s.
    coordinates : tuple of ForceError
        Moment and force on a floating base, then the joints.
    torque, base_moment, base_force : ForceError or None
        All joints, and the wrench on a floating base. Without efforts on a fixed base, ``torque``
        is about the forces of wrist sensors.
    slow : ForceError or None
        All joints on slow stretches, where gravity alone loads them.
    slow_seconds : float
        Length of these, s.
    mass : TotalMass or None
        None for a fixed base.
    coverage : float or None
        Share of errors inside their 90 % interval; None for methods without covariance. The
        variance is that of the estimate plus that of the residuals of the identified log, whose
        noise is scaled to the rate of this one.
    normalized_square : float or None
        Mean of squared errors over their predicted variance; about 1 for right intervals.
    advice : {"better", "equal", "worse", "mixed", "unfit"}
        The identified model compared with the original one, beyond chance; unfit if it errs by more
        than was measured.
    verdict : str
        The same as a sentence with figures.
    file_percents : dict of str to float
        Percent errors, as ``percent_after``, of what each model file of the result holds.
    efforts : PredictedEfforts
    deciding : tuple of ForceError
        Errors by which the advice was chosen; ``main`` is one of them.
    worse : tuple of str
        Joints, wrist sensors, or moment and force on the base, that the identified model predicts
        clearly worse.
    not_judged : tuple of str
        Joints without a row: they hardly move, or their efforts are unknown.
    offsets : tuple of OffsetChange
        Wrist sensors whose offset is not that of the identified log, because they were tared again.
        All errors are without this change.
    alarms : tuple of str
        Alarms of the identification. Forces may be predicted well although its numbers are wrong.
    """

    result: str
    model: str
    method: str
    log: str
    seconds: float
    seconds_used: float
    coordinates: tuple[ForceError, ...]
    torque: ForceError | None
    base_moment: ForceError | None
    base_force: ForceError | None
    slow: ForceError | None
    slow_seconds: float
    mass: TotalMass | None
    coverage: float | None
    normalized_square: float | None
    advice: Advice
    verdict: str
    file_percents: dict[str, float]
    efforts: PredictedEfforts = field(repr=False, compare=False)
    deciding: tuple[ForceError, ...] = ()
    worse: tuple[str, ...] = ()
    not_judged: tuple[str, ...] = ()
    offsets: tuple[OffsetChange, ...] = ()
    alarms: tuple[str, ...] = ()

    @property
    def is_better(self) -> bool:
        """Whether the identified model predicts the log better than the original one."""
        return self.advice == "better"

    @property
    def is_recommended(self) -> bool:
        """Whether to use the identified model for this robot and load."""
        return self.is_better and not self.is_of_other_robot

    @property
    def main(self) -> ForceError:
        """The error that every verdict states: of all joints, or of the base without efforts."""
        found = self.base_force if self.torque is None else self.torque
        assert found is not None  # a log has rows of the joints or of the base
        return found

    @property
    def percent_before(self) -> float | None:
        """Error of the original model, percent of the measured torque."""
        return self.main.percent_before

    @property
    def percent_after(self) -> float | None:
        """Error of the identified model, percent of the measured torque."""
        return self.main.percent_after

    @property
    def change(self) -> str:
        """The errors by which the advice was chosen, before and after."""
        return ", ".join(describe_change(one) for one in self.deciding or (self.main,))

    @property
    def uncovered(self) -> tuple[ForceError, ...]:
        """Coordinates of whose errors too few lie in their 90 % interval."""
        return tuple(
            one
            for one in self.coordinates
            if one.coverage is not None
            and one.coverage < LEAST_COVERAGE
            and one.rows >= COVERAGE_ROWS
        )

    @property
    def is_covered(self) -> bool:
        """Whether the intervals hold about as many errors as they claim, if there are any."""
        return not self.uncovered and (self.coverage is None or self.coverage >= LEAST_COVERAGE)

    @property
    def is_of_other_robot(self) -> bool:
        """Whether the errors are those of another robot or load than the identified one."""
        return (self.normalized_square or 0.0) > OTHER_ROBOT and not self.is_covered

    @property
    def unpredicted(self) -> tuple[str, ...]:
        """Joints of whose efforts nothing is predicted."""
        return tuple(
            one.name
            for one in self.coordinates
            if not one.name.startswith("base/")
            and one.rows >= COVERAGE_ROWS
            and (one.percent_after or 0.0) > NOTHING
        )

    @property
    def counted_alarms(self) -> str:
        """The number of alarms of the identification as a clause."""
        count = len(self.alarms)
        return f"its identification raised {count} alarm{'s' if count > 1 else ''}"

    @property
    def groups(self) -> tuple[ForceError, ...]:
        """Errors over several coordinates."""
        every = self.torque, self.slow, self.base_moment, self.base_force
        return tuple(one for one in every if one is not None)

    def document(self) -> dict[str, object]:
        """Return everything but the series, for JSON."""
        mass = None
        if self.mass is not None:
            mass = {f"{name}_kg": value for name, value in asdict(self.mass).items()}
        errors = {
            name: None if error is None else error.document()
            for name in ("torque", "slow", "base_moment", "base_force")
            for error in [getattr(self, name)]
        }
        document = {
            "verdict": self.verdict,
            "advice": self.advice,
            "is_recommended": self.is_recommended,
            "worse": list(self.worse),
            "not_judged": list(self.not_judged),
            "identification_alarms": len(self.alarms),
            "percent_before": self.percent_before,
            "percent_after": self.percent_after,
            "file_percents": self.file_percents,
            "result": self.result,
            "model": self.model,
            "method": self.method,
            "log": self.log,
            "duration_s": self.seconds,
            "used_s": self.seconds_used,
            "coverage": self.coverage,
            "normalized_square": self.normalized_square,
            "mass": mass,
            "slow_s": self.slow_seconds,
            **errors,
            "coordinates": [one.document() for one in self.coordinates],
        }
        return versioned("validation", document)

    def __repr__(self) -> str:
        lines = [f"<Validation of {self.result} on {self.log}: {self.verdict}"]
        lines += [
            f"  {one.name}: {one.rmse_before:.3g} → {one.rmse_after:.3g} {one.unit}"
            f" ({percent(one.percent_before)} → {percent(one.percent_after)})"
            for one in self.coordinates
        ]
        return "\n".join(lines) + ">"

    def _repr_html_(self) -> str:
        titles = "", "measured", "before", "after", "unit", "before %", "after %"
        head = "".join(f"<th>{title}</th>" for title in titles)
        rows = "".join(
            f"<tr><td>{escape(one.name)}</td><td>{one.measured:.3g}</td>"
            f"<td>{one.rmse_before:.3g}</td><td>{one.rmse_after:.3g}</td><td>{one.unit}</td>"
            f"<td>{percent(one.percent_before)}</td><td>{percent(one.percent_after)}</td></tr>"
            for one in (*self.groups, *self.coordinates)
        )
        return (
            f"<h4>{escape(self.result)} on {escape(self.log)}</h4>"
            f"<p><b>{escape(self.verdict)}</b></p><table><tr>{head}</tr>{rows}</table>"
        )
