"""Forces that an identified robot predicts, on the same rows as its identification."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import Term
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import (
    variance_of_all_rows,
    with_all_rows,
    with_contacts,
    without_contacts,
)
from symbid_ros.dynamics.upright import upward
from symbid_ros.errors import EstimateError, OptionError, SymbidError
from symbid_ros.estimation.archive import load_archive, load_correlation
from symbid_ros.estimation.estimate import MODEL_FILES, Estimate, RowSettings
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.estimation.observations import covered_seconds
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.result_files import load_estimated_model
from symbid_ros.identification.rows.aligned_log import joined_segments
from symbid_ros.identification.rows.dataset import SAMPLES_AT_ONCE, Processing
from symbid_ros.model.load import load_identified_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.warming import warming_in
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.log import Log
from symbid_ros.signals.sampled_rows import RowBuilder, SampledRows, sampled_rows
from symbid_ros.signals.segments import Segment, fingerprint
from symbid_ros.signals.sensor_drift import final_drifts, is_drift
from symbid_ros.signals.sensor_errors import ALL_KINDS, DRIVE_GAIN, PLACE, SensorErrors
from symbid_ros.signals.sensor_samples import SensorSamples, at_base, build_samples
from symbid_ros.signals.weak_form import check_windows, equation_rows, windowed_rows

# Joint terms that the model files of a result hold.
FILE_TERMS: dict[str, frozenset[Term]] = {
    "model.urdf": frozenset(("viscous", "coulomb")),
    "model.xml": frozenset(("viscous", "coulomb", "armature", "stiffness")),
}
CHUNK = 512  # samples whose efforts and gravity are computed at once


@dataclass(frozen=True)
class PredictionRows:
    """Consecutive rows of a log.

    Attributes
    ----------
    stamp : (N,) int64
        Centres of the windows, or single instants, ns.
    rows : Rows
        In all unknowns.
    valid : (N, n) bool
        Where the equation holds.
    effort : (N, n) float64
        Measured motor efforts; zero on a floating base.
    gravity : (N, n) float64
        Forces that hold the identified links still.
    noise : (N, n) float64
        Variance of a row's residual, (Nm)² or N²; NaN or infinite if it is unknown.
    """

    stamp: IntArray
    rows: Rows
    valid: BoolArray
    effort: FloatArray
    gravity: FloatArray
    noise: FloatArray


@dataclass(frozen=True)
class ForcePredictor:
    """An identified robot and the rows on which its forces are predicted.

    Attributes
    ----------
    name : str
        Name of the result.
    parameters : ParameterSet
        The robot's p parameters. With unmeasured contacts, the rows of all its coordinates remain.
    estimate : Estimate
        Parameters in the order of the columns.
    sensor_names : tuple of str
        The s sensor errors. Of those that drift during the identified log, the values at its end
        are used.
    unknowns : (p + s,) float64
        Identified parameters and sensor errors.
    linearization : (p + s,) float64
        Where the rows were linearized in the sensor errors.
    factor : (p + s, r) float64 or None
        L of the covariance L Lᵀ of the unknowns; None for truncated methods.
    noise : (n,) float64 or None
        Variance of a row's residual in the identified log, (Nm)² or N²; None if it is unknown.
        With unmeasured contacts, that of the independent rows.
    correlation : (n, n) float64 or None
        Of the residuals of the independent rows' coordinates; None if they count as independent.
    settings : RowSettings
        How rows are made.
    seconds : frozenset of int
        Fingerprints of the seconds that were identified.
    """

    name: str
    parameters: ParameterSet
    estimate: Estimate
    sensor_names: tuple[str, ...]
    unknowns: FloatArray
    linearization: FloatArray
    factor: FloatArray | None
    noise: FloatArray | None
    correlation: FloatArray | None
    settings: RowSettings
    seconds: frozenset[int]

    @classmethod
    def of(cls, found: Identification, parameters: ParameterSet) -> "ForcePredictor":
        """Return the predictor of an identification."""
        estimate, calibration = found.estimate, found.calibration
        parameters = replace(parameters, model=with_all_rows(parameters.model))
        return cls(
            name="result",
            parameters=parameters,
            estimate=estimate,
            sensor_names=_sensor_names(estimate),
            unknowns=found.unknowns,
            linearization=found.unknowns if calibration is None else calibration.linearization,
            factor=found.factor,
            noise=_row_noise(estimate, parameters.model),
            correlation=found.correlation,
            settings=estimate.rows or RowSettings("weak", found.window),
            seconds=covered_seconds(found.observations),
        )

    @classmethod
    def load(cls, folder: Path) -> "ForcePredictor":
        """Read the predictor of a saved result.

        Raises
        ------
        EstimateError, ModelError
            When a file is missing, malformed or belongs to another result.
        """
        saved = load_estimate(folder / "estimate.json")
        found = load_estimated_model(folder, load_result_robot(folder, saved))
        model = found.parameters.model.with_force_only(saved.force_only)
        model = model.with_end_stops(saved.end_stops)
        model = with_all_rows(with_contacts(model, saved.contacts))
        found = replace(found, parameters=replace(found.parameters, model=model))
        estimate = found.estimate
        if estimate is None:
            raise EstimateError(f"{folder}: holds a prior; give the folder of a result", "E527")
        sensors = () if estimate.verdict is None else estimate.verdict.sensors
        unknowns = np.concatenate([found.values, [one.value for one in sensors]])
        calibration, factor = found.calibration, found.deviation_factor
        if sensors and factor is not None:
            if calibration is None:
                raise EstimateError(
                    f"{folder}: was written by an earlier version, which did not save what "
                    "predictions with sensor errors need; identify the log again",
                    "E527",
                )
            factor = np.concatenate([factor, calibration.factor])
        settings = estimate.rows
        if settings is None:
            window = None if estimate.verdict is None else estimate.verdict.window
            settings = RowSettings("weak", window)
        return cls(
            name=str(folder),
            parameters=found.parameters,
            estimate=estimate,
            sensor_names=_sensor_names(estimate),
            unknowns=unknowns,
            linearization=unknowns if calibration is None else calibration.linearization,
            factor=factor,
            noise=_row_noise(estimate, found.parameters.model),
            correlation=load_correlation(folder / "information.npz"),
            settings=settings,
            seconds=covered_seconds(load_archive(folder / "information.npz")),
        )

    def with_frames_of(self, log: Log) -> "ForcePredictor":
        """Return the predictor with the frames that a log says are fixed to the robot's links."""
        model = log.applied_to(self.parameters.model)
        return replace(self, parameters=replace(self.parameters, model=model))

    def carrying(self, payloads: Sequence[str]) -> "ForcePredictor":
        """Return the predictor of a robot that carries payloads, and no others.

        Parameters
        ----------
        payloads : sequence of str
            ``LINK,MASS,X,Y,Z``, or ``LINK,MASS`` if the result has identified the place.

        Raises
        ------
        ModelError, OptionError
            When a payload is invalid, or its place is unknown.
        """
        carried = tuple(Payload.parse(text, self.parameters.model) for text in payloads)
        known = {name.rpartition("/")[0] for name in self.sensor_names if PLACE in name}
        for text, one in zip(payloads, carried, strict=True):
            if one.frame is not None and one.name not in known:
                raise OptionError(
                    f"`payload` {text}: {self.name} has no position for this payload; give "
                    "LINK,MASS,X,Y,Z",
                    "E503",
                )
        return replace(self, parameters=replace(self.parameters, payloads=carried))

    @property
    def original(self) -> FloatArray:
        """(p + s,) parameters of the original model with the identified sensor errors."""
        count = len(self.parameters)
        return np.concatenate([self.estimate.prior, self.unknowns[count:]])

    def in_file(self, name: str) -> FloatArray:
        """Return the unknowns (p + s,) as a model file of the result holds them.

        What it cannot hold is zero: other joint terms, shared drives, ripples, negative friction.
        """
        unknowns = self.unknowns.copy()
        is_held = np.zeros(len(self.parameters), dtype=bool)
        is_held[: self.parameters.inertial] = True
        is_held[self.parameters.sensor_offsets] = True
        for term, place in self.parameters.term_columns.items():
            if term in FILE_TERMS[name]:
                is_held[place] = unknowns[place] > 0
        unknowns[: len(is_held)][~is_held] = 0.0
        return unknowns

    def over_windows(self, window: float) -> "ForcePredictor":
        """Return a predictor of rows averaged over windows of another length, s.

        The noise of its rows is unknown.
        """
        return replace(self, settings=RowSettings("weak", window), noise=None)

    def rows(self, segments: Iterable[Segment], source: str) -> Iterator[PredictionRows]:
        """Yield the rows of the segments of a log named ``source``.

        Raises
        ------
        DataError
            When the rate of the log is too low for the windows.
        EstimateError
            When the log has other sensors than those whose errors were identified.
        """
        settings = self.settings
        if settings.filter != "weak":
            joined = joined_segments(segments)
            own = self if not joined else self._in_log_of(*joined)
            yield from own._filtered_rows(joined, source)
            return
        if not settings.window:
            raise EstimateError(
                f"{self.name}: does not say how its rows were averaged; identify the log again",
                "E527",
            )
        windows = (settings.window,)
        first = None
        for segment in segments:
            check_windows(windows, segment.rate, source)
            first = first or segment
            build, correct = self._in_log_of(segment)._builders(first, source)
            main = windowed_rows(segment, build, windows, ())
            beside = windowed_rows(segment, correct, windows, ())
            for (rows,), (other,) in zip(main, beside, strict=True):
                effort, gravity, noise = np.moveaxis(other.mean.K, 2, 0)
                yield PredictionRows(rows.stamp, rows.mean, rows.valid, effort, gravity, noise)

    def _in_log_of(self, *segments: Segment) -> "ForcePredictor":
        """Return the predictor of segments of one log.

        Friction that changes during the identified log is that at its end in other logs. Stamps do
        not tell logs apart, since those of a simulation start at zero, nor does a single second,
        since two runs may start alike.
        """
        if not self.parameters.warming:
            return self
        seconds = frozenset[int]().union(*map(fingerprint, segments))
        if 2 * len(seconds & self.seconds) > min(len(seconds), len(self.seconds)):
            return self
        warm = warming_in(self.parameters.names, self.parameters.model)
        return replace(self, parameters=replace(self.parameters, warming=warm))

    def _noise_at(self, rate: float) -> FloatArray:
        """Return the variance (n,) of a row's residual in a log of another rate, Hz.

        That of averaged white noise falls with the number of samples, and what the model does not
        explain remains.
        """
        if self.noise is None:
            return np.full(self.parameters.model.dof, np.nan)
        if not self.settings.rate or self.estimate.verdict is None:
            return self.noise
        sizes = {one.coordinate: one.size for one in self.estimate.verdict.unexplained}
        lasting = [sizes.get(name, 0.0) ** 2 for name in self.parameters.model.coordinates]
        remains = np.minimum(lasting, self.noise)
        known = np.isfinite(self.noise)
        noise = self.noise.copy()
        noise[known] = remains[known] + (self.noise - remains)[known] * self.settings.rate / rate
        return noise

    def _filtered_rows(
        self, segments: tuple[Segment, ...], source: str
    ) -> Iterator[PredictionRows]:
        settings = self.settings
        options = IdentifyOptions(
            filter=settings.filter,
            window=settings.window,
            cutoff=settings.cutoff,
            channels=settings.channels,
        )
        smoothing = Processing.of(options).smoothing
        assert smoothing is not None  # any filter but "weak" has one
        samples = build_samples(segments, self.parameters.model, smoothing, source)
        for block in samples.blocks(SAMPLES_AT_ONCE):
            single = sampled_rows(self.parameters, block)
            beside = self._columns_beside(block, self.parameters, segments[0].rate)
            effort, gravity, noise = np.moveaxis(beside, 2, 0)
            yield PredictionRows(single.stamp, single.rows, single.valid, effort, gravity, noise)

    def _builders(self, segment: Segment, source: str) -> tuple[RowBuilder, RowBuilder]:
        """Return builders of rows in the unknowns, and of columns beside them."""
        parameters = self.parameters
        count = len(parameters)
        errors, order = self._errors(segment, source)
        theta = self.unknowns[count:][order]
        finals = final_drifts(self.sensor_names)
        if errors is not None:
            drifting = [errors.names.index(error) for error in finals]
            theta[drifting] += self.unknowns[count:][list(finals.values())]
        placed = parameters if errors is None else errors.placed(parameters, theta)

        def columns(readings: SensorSamples) -> Iterator[SampledRows]:
            for start in range(0, len(readings), CHUNK):
                part = readings[start : start + CHUNK]
                corrected = part if errors is None else errors.corrected(part, theta)
                samples = at_base(corrected, placed.model)
                beside = self._columns_beside(samples, placed, segment.rate)
                flat = np.zeros(beside.shape[:2])
                yield SampledRows(part.stamp, Rows(beside, flat), np.ones(flat.shape, dtype=bool))

        if errors is None:
            return equation_rows(parameters), columns
        point = self.linearization
        linearization = LinearizationPoint(point[:count], point[count:][order])
        ordered = CalibratingRows(parameters, errors, linearization)

        def in_own_order(readings: SensorSamples) -> Iterator[SampledRows]:
            places = count + order
            changes = [count + index for index in finals.values()]
            drifting = [count + self.sensor_names.index(error) for error in finals]
            for part in ordered(readings):
                K = np.zeros((*part.rows.y.shape, len(self.unknowns)))
                K[..., :count], K[..., places] = part.rows.K[..., :count], part.rows.K[..., count:]
                K[..., changes] = K[..., drifting]
                yield replace(part, rows=Rows(K, part.rows.y))

        return in_own_order, columns

    def _errors(self, segment: Segment, source: str) -> tuple[SensorErrors | None, IntArray]:
        """Return the sensor errors of a log, and the places of its errors among the unknowns."""
        if not self.sensor_names:
            return None, np.zeros(0, dtype=np.int64)
        # Another log need not have the payload of the one that was identified.
        unplaced = self.parameters.unplaced
        constant = [
            name
            for name in self.sensor_names
            if not is_drift(name) and (PLACE not in name or name.rpartition("/")[0] in unplaced)
        ]
        parts = [name.rpartition("/")[2] for name in constant]
        kinds = [kind for kind in ALL_KINDS if any(one.startswith(kind) for one in parts)]
        gained = [name.rpartition("/") for name in constant]
        errors = SensorErrors.of(
            kinds,
            self.parameters.model,
            segment.wrench_frames,
            segment.imu_frames,
            tuple(joint for joint, _, kind in gained if kind == DRIVE_GAIN),
            payloads=unplaced,
        )
        if set(errors.names) != set(constant):
            other = sorted(set(errors.names) ^ set(constant))[0].rpartition("/")[0]
            raise EstimateError(
                f"{source}: its sensors are not those whose errors {self.name} holds ({other} is "
                "in one of them only); give a log of the same sensors",
                "E528",
            )
        places = [self.sensor_names.index(name) for name in errors.names]
        return errors, np.array(places, dtype=np.int64)

    def _columns_beside(
        self, samples: Samples, parameters: ParameterSet, rate: float
    ) -> FloatArray:
        """Return (N, n, 3) what is needed beside the rows of a log with a rate, Hz.

        These are motor efforts, forces that hold the identified links still, and the variance of
        a row's residual.
        """
        model = parameters.model
        joints, base = np.zeros_like(samples.velocity), np.zeros_like(samples.base_specific_force)
        still = replace(
            samples,
            velocity=joints,
            acceleration=joints,
            base_angular_velocity=base,
            base_angular_acceleration=base,
            upward=upward(samples),
        )
        inertial = slice(0, parameters.inertial)
        K = equation_of_motion(parameters, still).K[..., inertial]
        columns = np.zeros((len(samples), model.dof, 3))
        columns[:, 6 * model.floating :, 0] = np.nan_to_num(samples.effort)
        model.fold_followers(columns)
        noise = self._noise_at(rate)
        if model.contacts is not None:
            columns = without_contacts(model, still, columns)
            correlation = np.eye(model.dof) if self.correlation is None else self.correlation
            noise = variance_of_all_rows(model, still, noise, correlation)
        columns[..., 1] = K @ self.unknowns[inertial]
        columns[..., 2] = noise
        return columns


def load_result_robot(folder: Path, estimate: Estimate) -> RobotModel:
    """Return the robot of a result's folder; earlier versions did not say which file has it.

    Raises
    ------
    EstimateError
        When its model cannot be read.
    """
    name = estimate.model_file
    if not name:
        is_mjcf = any(one.endswith(".xml") for one in estimate.inputs)
        name = MODEL_FILES[is_mjcf]
    try:
        return load_identified_model(folder / name, estimate.base_option)
    except SymbidError as error:
        raise EstimateError(
            f"{folder}: its model cannot be read ({error}); identify the log again", "E527"
        ) from None


def _sensor_names(estimate: Estimate) -> tuple[str, ...]:
    return () if estimate.verdict is None else tuple(one.name for one in estimate.verdict.sensors)


def _row_noise(estimate: Estimate, model: RobotModel) -> FloatArray | None:
    """Return the variance (n,) of a row's residual; infinite for coordinates with few rows."""
    if not estimate.row_std:
        return None
    return np.array([estimate.row_std.get(name, np.inf) ** 2 for name in model.coordinates])
