"""Measured and predicted forces of a log, their errors, and whether two errors differ."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import stdtrit

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import EstimateError
from symbid_ros.identification.predictions.intervals import HALF_WIDTH
from symbid_ros.identification.predictions.predictor import ForcePredictor, PredictionRows
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment, fingerprint

# A row belongs to a slow stretch if motion changes its torques by at most this share of the log's
# RMS torque of gravity.
SLOW = 0.1
# Errors are compared over this many contiguous blocks, whose errors are nearly independent.
BLOCKS = 10
ROWS_PER_BLOCK = 4
CONFIDENCE = 0.975  # one-sided
# Share of errors in their 90 % interval below which standard deviations are too small.
LEAST_COVERAGE = 0.7
# Two errors differ if their ratio exceeds this beyond chance.
RELEVANT = 1.05
# Rounding, as a share of the measured force.
ROUNDING = 1e-12
# Parts of a wrench, and where they begin.
SENSOR_PARTS = {"moment": 0, "force": 3}


def differ_relevantly(before: float | None, after: float | None) -> bool:
    """Return whether two errors differ by a relevant factor, perhaps by chance."""
    return bool(before and after and not 1 / RELEVANT < after / before < RELEVANT)


@dataclass(frozen=True)
class ForceError:
    """Error of predicted forces, at one coordinate or as the norm over several.

    Attributes
    ----------
    name : str
        Coordinate, such as a joint, or what the coordinates have in common.
    unit : str
        Nm or N.
    measured : float
        RMS of the measured effort or base wrench, in ``unit``.
    rmse_before, rmse_after : float
        RMS error of the original and of the identified model, in ``unit``.
    rows : int
        Number of rows in which the equation of motion holds.
    coverage : float or None
        Share of errors inside their 90 % interval.
    normalized_square : float or None
        Mean of squared errors over their predicted variance; about 1 for right intervals.
    """

    name: str
    unit: str
    measured: float
    rmse_before: float
    rmse_after: float
    rows: int
    coverage: float | None = None
    normalized_square: float | None = None

    @property
    def percent_before(self) -> float | None:
        """``rmse_before`` in percent of ``measured``; None if nothing was measured."""
        return 100 * self.rmse_before / self.measured if self.measured > 0 else None

    @property
    def percent_after(self) -> float | None:
        """``rmse_after`` in percent of ``measured``; None if nothing was measured."""
        return 100 * self.rmse_after / self.measured if self.measured > 0 else None

    def document(self) -> dict[str, object]:
        """Return the fields and percentages for JSON."""
        percent = {"percent_before": self.percent_before, "percent_after": self.percent_after}
        return asdict(self) | percent


@dataclass(frozen=True)
class TotalMass:
    """Total mass according to the models and to the forces on a floating base.

    Attributes
    ----------
    before, after : float
        Of the original and of the identified model, kg.
    measured, std : float
        According to the log, and its standard deviation, kg; None with too few rows for one.
    """

    before: float
    after: float
    measured: float
    std: float | None


@dataclass(frozen=True)
class ForceRows:
    """Measured and predicted forces of a log in N rows of n coordinates.

    Attributes
    ----------
    model : RobotModel
    stamp : (N,) int64
        Centres of the windows, or single instants, ns.
    valid : (N, n) bool
        Where the equation of motion holds.
    y, before, after : (N, n) float64
        Generalised force, and its predictions by the original and the identified model, Nm or N.
    effort : (N, n) float64
        Measured motor efforts; zero on a floating base.
    motion, gravity : (N, n) float64
        Predicted forces of the moving links: what motion adds, and what holds them still.
    variance : (N, n) float64
        Of the identified model's error; NaN if it is unknown.
    in_urdf, in_xml : (N, n) float64
        Predictions by what model.urdf and model.xml hold of the identified model.
    specific_force : (N, 3) float64
        Force on a floating base per unit of total mass, m/s²; zero for a fixed base.
    duration : float
        Length of the log, s.
    seconds : frozenset of int
        Fingerprints of the seconds of the log.
    """

    model: RobotModel
    stamp: IntArray
    valid: BoolArray
    y: FloatArray
    before: FloatArray
    after: FloatArray
    effort: FloatArray
    motion: FloatArray
    gravity: FloatArray
    variance: FloatArray
    in_urdf: FloatArray
    in_xml: FloatArray
    specific_force: FloatArray
    duration: float
    seconds: frozenset[int]

    @classmethod
    def of(cls, predictor: ForcePredictor, segments: Iterable[Segment], source: str) -> "ForceRows":
        """Predict the forces of the segments of a log named ``source``.

        Raises
        ------
        DataError, EstimateError
            When the log is too short, too slow or of other sensors.
        """
        seconds: set[int] = set()
        durations: list[float] = []

        def seen() -> Iterator[Segment]:
            for segment in segments:
                seconds.update(fingerprint(segment))
                durations.append(len(segment) / segment.rate)
                yield segment

        parts = [
            _predict(predictor, part) for part in predictor.rows(seen(), source) if len(part.stamp)
        ]
        if not any(part.valid.any() for part in parts):
            reason = "no joint moves" if parts else "too short to predict forces"
            raise EstimateError(f"{source}: {reason}; give a log with longer motion", "E508")
        series: dict[str, Any] = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(cls)
            if isinstance(getattr(parts[0], each.name), np.ndarray)
        }
        return replace(parts[0], **series, duration=sum(durations), seconds=frozenset(seconds))

    @property
    def first_joint(self) -> int:
        """Index of the first joint's coordinate."""
        return 6 * self.model.floating

    @property
    def used(self) -> IntArray:
        """Coordinates that have rows."""
        return np.flatnonzero(self.valid.any(axis=0))

    @property
    def joints(self) -> IntArray:
        """Coordinates of the moving joints that have rows."""
        moving = self.first_joint + np.array(self.model.moving_joints, dtype=np.int64)
        return np.intersect1d(self.used, moving)

    @property
    def sensors(self) -> IntArray:
        """Coordinates of wrist sensors' forces that have rows."""
        places = self.model.wrist_sensors.values()
        forces = [self.first_joint + place.start + axis for place in places for axis in (3, 4, 5)]
        return np.intersect1d(self.used, forces)

    def of_sensors(self, kinds: Sequence[str]) -> dict[str, IntArray]:
        """Return the coordinates with rows of each wrist sensor's moment or force, by name."""
        found = {
            f"{kind} at {frame}": self.first_joint + place.start + SENSOR_PARTS[kind] + np.arange(3)
            for frame, place in self.model.wrist_sensors.items()
            for kind in kinds
        }
        return {name: own for name, own in found.items() if np.isin(own, self.used).all()}

    @property
    def main(self) -> IntArray:
        """Coordinates by which models are judged: the joints if they have rows.

        Otherwise forces on the base, or those of wrist sensors on a robot with a fixed base.
        """
        if len(self.joints):
            return self.joints
        return np.arange(3, 6) if self.model.floating else self.sensors

    @property
    def error_before(self) -> FloatArray:
        """(N, n) measured minus predicted forces of the original model, zero if not valid."""
        return np.asarray((self.y - self.before) * self.valid)

    @property
    def error_after(self) -> FloatArray:
        """(N, n) measured minus predicted forces of the identified model, zero if not valid."""
        return np.asarray((self.y - self.after) * self.valid)

    def file_errors(self, places: IntArray) -> dict[str, float]:
        """Return the percent error of each model file of the result at some coordinates.

        It is empty if nothing was measured there.
        """
        files = {"model.urdf": self.in_urdf, "model.xml": self.in_xml}
        errors = {
            name: replace(self, after=predicted).error(places, name).percent_after
            for name, predicted in files.items()
        }
        return {name: value for name, value in errors.items() if value is not None}

    @property
    def is_slow(self) -> BoolArray:
        """(N,) whether gravity alone loads the joints."""
        joints = self.joints
        motion, gravity = self.motion[:, joints], self.gravity[:, joints]
        usual = np.sqrt(np.mean(np.sum(gravity**2, axis=1)))
        size = np.sqrt(np.sum(motion**2, axis=1))
        return np.asarray((size <= SLOW * usual) & self.valid[:, joints].any(axis=1) & (usual > 0))

    def selected(self, rows: BoolArray) -> "ForceRows":
        """Return the rows for which ``rows`` (N,) is true."""
        return replace(self, valid=self.valid & rows[:, None])

    def unit(self, coordinate: int) -> str:
        """Return the unit of a coordinate."""
        return self.model.coordinate_units[coordinate]

    def error(self, places: IntArray, name: str) -> ForceError:
        """Return the error at some coordinates, all joints or all of the base."""
        valid = self.valid[:, places]
        count = int(valid.any(axis=1).sum())

        def rms(values: FloatArray) -> float:
            return float(np.sqrt(np.sum((values[:, places] * valid) ** 2) / max(count, 1)))

        scores = self._standardized(places)
        return ForceError(
            name,
            " and ".join(dict.fromkeys(self.unit(place) for place in places.tolist())),
            # A joint's share of the measured wrenches is no effort of its motor.
            rms(self.effort if places[0] >= self.first_joint else self.y),
            rms(self.error_before),
            rms(self.error_after),
            count,
            float(np.mean(np.abs(scores) <= HALF_WIDTH)) if len(scores) else None,
            float(np.mean(scores**2)) if len(scores) else None,
        )

    def _standardized(self, places: IntArray) -> FloatArray:
        """Return errors (M,) in predicted standard deviations; none if these are unknown."""
        variance = self.variance[:, places]
        used = self.valid[:, places] & np.isfinite(variance) & (variance > 0)
        return np.asarray(self.error_after[:, places][used] / np.sqrt(variance[used]))

    def calibration(self) -> tuple[float, float] | None:
        """Return the coverage and normalised square of all coordinates, if known."""
        scores = self._standardized(self.used)
        if not len(scores):
            return None
        return float(np.mean(np.abs(scores) <= HALF_WIDTH)), float(np.mean(scores**2))

    def change(self, places: IntArray, comparisons: int = 1) -> "ErrorChange":
        """Compare the errors before and after the identification at some coordinates.

        Of several ``comparisons``, each has a wider interval (Bonferroni).
        """
        return compare_errors(
            self.error_before[:, places],
            self.error_after[:, places],
            self.y[:, places],
            comparisons,
        )

    def total_mass(self, predictor: ForcePredictor) -> TotalMass:
        """Return the mass that the forces on the base show: Σ f = m (a - g)."""
        masses = slice(0, predictor.parameters.inertial, 10)
        before, after = predictor.original[masses].sum(), predictor.unknowns[masses].sum()
        direction = self.specific_force * self.valid[:, 3:6]
        products = np.sum(self.error_after[:, 3:6] * direction, axis=1)
        squares = np.sum(direction**2, axis=1)
        blocks = _blocks(len(products))
        sums = np.array([[products[block].sum(), squares[block].sum()] for block in blocks])
        missing = sums[:, 0].sum() / sums[:, 1].sum()
        left = sums.sum(axis=0) - sums
        is_known = bool(np.all(left[:, 1] > 0))
        std = _jackknife_std(left[:, 0] / left[:, 1]) if is_known else None
        return TotalMass(float(before), float(after), float(after + missing), std)


def _predict(predictor: ForcePredictor, part: PredictionRows) -> ForceRows:
    """Return measured and predicted forces of consecutive rows."""
    parameters, unknowns = predictor.parameters, predictor.unknowns
    inertial, masses = slice(0, parameters.inertial), slice(0, parameters.inertial, 10)
    K, valid = part.rows.K, part.valid
    variance = np.full(part.rows.y.shape, np.nan)
    if predictor.factor is not None:
        variance = np.sum((K @ predictor.factor) ** 2, axis=2) + part.noise
    specific_force = np.zeros((len(K), 3))
    if parameters.model.floating:
        specific_force = K[:, 3:6, masses] @ unknowns[masses] / unknowns[masses].sum()
    return ForceRows(
        model=parameters.model,
        stamp=part.stamp,
        valid=valid,
        y=part.rows.y.copy(),  # a view would keep the regressor in memory
        before=K @ predictor.original,
        after=K @ unknowns,
        effort=part.effort,
        motion=(K[..., inertial] @ unknowns[inertial] - part.gravity) * valid,
        gravity=part.gravity * valid,
        variance=variance,
        in_urdf=K @ predictor.in_file("model.urdf"),
        in_xml=K @ predictor.in_file("model.xml"),
        specific_force=specific_force,
        duration=0.0,
        seconds=frozenset(),
    )


@dataclass(frozen=True)
class ErrorChange:
    """Ratio of two RMS errors.

    Attributes
    ----------
    log_ratio : float
        Logarithm of the second error over the first.
    half_width : float
        Half the width of its 95 % interval, wider if it is one of several.
    """

    log_ratio: float
    half_width: float

    @property
    def is_decrease(self) -> bool:
        """Whether the second error is smaller, beyond chance and by a relevant amount."""
        return self.log_ratio < -max(self.half_width, float(np.log(RELEVANT)))

    @property
    def is_increase(self) -> bool:
        """Whether the second error is larger, beyond chance and by a relevant amount."""
        return self.log_ratio > max(self.half_width, float(np.log(RELEVANT)))


def compare_errors(
    first: FloatArray, second: FloatArray, force: FloatArray, comparisons: int = 1
) -> ErrorChange:
    """Compare the RMS of two errors (N, m) of a force (N, m) by the jackknife over blocks of rows.

    Errors of consecutive rows are correlated, those of blocks hardly (Efron 1982, chapter 3). The
    ratio of sums weighs each block by its errors, so that a block at rest counts little.
    """
    blocks = _blocks(len(first))
    sums = np.array([[np.sum(one[block] ** 2) for one in (first, second)] for block in blocks])
    rounding = ROUNDING**2 * float(np.sum(force**2)) + np.finfo(float).tiny

    def log_ratio(pair: FloatArray) -> FloatArray:
        ratio: FloatArray = 0.5 * np.log((pair[..., 1] + rounding) / (pair[..., 0] + rounding))
        return ratio

    std = _jackknife_std(log_ratio(sums.sum(axis=0) - sums))
    confidence = 1 - (1 - CONFIDENCE) / comparisons
    half_width = float(stdtrit(len(blocks) - 1, confidence)) * std
    return ErrorChange(float(log_ratio(sums.sum(axis=0))), half_width)


def _blocks(count: int) -> list[slice]:
    """Return contiguous parts of ``count`` rows."""
    number = max(2, min(BLOCKS, count // ROWS_PER_BLOCK))
    edges = np.linspace(0, count, number + 1).astype(int).tolist()
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _jackknife_std(without: FloatArray) -> float:
    """Return the standard deviation of a statistic from its values without each block (B,)."""
    count = len(without)
    return float(np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2)))
