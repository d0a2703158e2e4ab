"""Sensor errors of a log as further unknowns."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import KINEMATIC_ERRORS
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior, stacked
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.calibration.drift_evidence import drift_by_evidence
from symbid_ros.identification.calibration.drive_gains import InitialFactors
from symbid_ros.identification.calibration.stance_closure import (
    RestingSoles,
    closure_rows,
    contradicted_geometry,
    find_stances,
)
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset, observe
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.calibrating_rows import CalibratingRows, LinearizationPoint
from symbid_ros.signals.segments import Segment, stamp_spans
from symbid_ros.signals.sensor_drift import SensorDrift
from symbid_ros.signals.sensor_errors import COMPLIANCE, DRIVE_GAIN, PLACE, SensorErrors
from symbid_ros.signals.sensor_noise import FORCES, MOTION
from symbid_ros.signals.weak_form import ALL_WINDOWS, suitable_windows

# The first pass is linearised about the prior; then Gauss-Newton.
PASSES = 3
# An unknown place of a payload multiplies unknown gains, and begins at the origin of its frame.
PASSES_WITH_PLACES = 8
# Relative deviation of the common scale of drive gains from which a log leaves it open, if the
# deviations of the links are this many times wider.
OPEN_SCALE, WIDE = 0.1, 30.0
# An open scale is held at that of the first guesses, which rest on the masses of the model. A prior
# of single masses cannot decide it: the smaller all masses, the smaller their differences from it.
ASSUMED_STD = 0.01
ASSUMED = (
    "the log does not show the common scale of efforts, masses and friction: it is taken from the "
    "model file's masses, and the standard deviations do not contain its error; "
)
GIVE = "leave a calibrated joint out of `drive_gain`, or give the `total_mass` of a floating robot"
WITH_PAYLOAD = "give a log with a known `payload`, " + GIVE
WITHOUT_PAYLOAD = (
    "the `payload` is carried all the time and acts like a part of its link: give a log without it "
    "as well, " + GIVE
)
LONGER = (
    "the payload changes the efforts too little: give longer logs or a heavier payload, " + GIVE
)
# Deflection of an elastic joint under its root mean square effort, rad or m: a prior deviation. An
# effort below this share of the largest counts as that.
DEFLECTION, LEAST_EFFORT = 2e-3, 0.02
# Deviation of a fixed gain, as a share of its prior deviation.
FIXED = 1e-6
# Channels whose noise enters the rows of sensor errors.
NOISY_CHANNELS = MOTION + FORCES
# The linearisation point need not be exact.
POINT_CONVERGED = 1e-2


@dataclass(frozen=True)
class Mounting:
    """Rotation of an IMU that the checks of the log found.

    Attributes
    ----------
    rotation : (3,) float64
        Rotation vector from the IMU's axes to those of its frame, rad.
    std : float
        Standard deviation of each component, rad.
    """

    rotation: FloatArray
    std: float


@dataclass(frozen=True)
class SensorErrorRequest:
    """Which sensor errors to identify.

    Attributes
    ----------
    kinds : tuple of str
        Of :data:`symbid_ros.signals.sensor_errors.KINDS`.
    tares : mapping of str to Tare
        By frame of the wrench sensor.
    mountings : mapping of str to Mounting
        By frame of the IMU.
    factors : InitialFactors or None
        First guesses of the drives' factors, if they are unknown.
    """

    kinds: tuple[str, ...]
    tares: Mapping[str, Tare]
    mountings: Mapping[str, Mounting] = field(default_factory=dict)
    factors: InitialFactors | None = None


@dataclass(frozen=True)
class ExtendedProblem:
    """A problem with sensor errors as further unknowns, for any linearization point.

    Attributes
    ----------
    problem : Problem
        Without observations, with the prior of all unknowns.
    errors : SensorErrors
    layout : RowLayout
        Of the rows.
    drift : SensorDrift or None
        Changes of sensor errors during the log, unknowns after the errors themselves.
    """

    problem: Problem
    errors: SensorErrors
    layout: RowLayout
    drift: SensorDrift | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        wrench_frames: tuple[str, ...],
        imu_frames: tuple[str, ...],
        request: SensorErrorRequest,
        measured: Samples | Segment,
    ) -> "ExtendedProblem":
        """Extend a problem without sensor errors, whose observations are not used.

        The efforts of ``measured`` give the prior deviations of compliances.
        """
        parameters = problem.parameters
        gained = () if request.factors is None else request.factors.joints
        sensors = wrench_frames, imu_frames, gained
        errors = SensorErrors.of(
            request.kinds, parameters.model, *sensors, payloads=parameters.unplaced
        )
        mean, std = _prior_errors(errors, request, measured)
        layout = error_layout(parameters, errors)
        extended = replace(
            problem,
            observations=(),
            prior=problem.prior.extended(errors.names, mean, std),
            sensor_units=errors.units,
            pseudo_measurements=padded(problem.pseudo_measurements, len(errors)),
        )
        return cls(extended, errors, layout)

    @property
    def prior_point(self) -> LinearizationPoint:
        """The prior's mean."""
        return LinearizationPoint(*self._split(self.problem.prior.mean))

    def point(self, unknowns: FloatArray) -> LinearizationPoint:
        """Return the point at which rows are linearized if the unknowns (p + s,) are nearest."""
        phi, theta = self._split(unknowns)
        if COMPLIANCE in self.errors.kinds:
            # About rigid joints, because rates of a noisy deflection would enter the motion. The
            # squares of deflections are negligible.
            theta[self.errors.places[COMPLIANCE]] = 0.0
        return LinearizationPoint(phi, theta)

    def _split(self, unknowns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the parameters (p,) and the sensor errors (r,) at the start of the log."""
        p, r = len(self.problem.parameters), len(self.errors)
        return unknowns[:p].copy(), unknowns[p : p + r].copy()

    def rows(self, point: LinearizationPoint) -> CalibratingRows:
        """Return what builds the rows of all unknowns, linearized at a point."""
        return CalibratingRows(self.problem.parameters, self.errors, point, self.drift)

    def with_drift(self, drift: SensorDrift) -> "ExtendedProblem":
        """Return the problem with changes of sensor errors as further unknowns."""
        problem, errors, p = self.problem, self.errors, len(self.problem.parameters)
        names, root = drift.names(errors), drift.covariance_factor
        std = problem.prior.std.copy()
        places = p + drift.places
        std[places] = np.hypot(std[places], drift.start_std)
        prior = problem.prior.widened(std / problem.prior.std)
        extended = replace(
            problem,
            prior=prior.extended(names, np.zeros(len(names)), np.linalg.norm(root, axis=1), root),
            sensor_units=problem.sensor_units + drift.repeated(errors.units),
            pseudo_measurements=padded(problem.pseudo_measurements, len(names)),
        )
        structure = self.layout.structure[:, np.tile(places, len(drift.knots) - 1)]
        return replace(
            self,
            problem=extended,
            layout=self.layout.extended(names, structure),
            drift=drift,
        )

    def with_row(self, row: FloatArray, target: float) -> "ExtendedProblem":
        """Return the problem with one more pseudo-measurement."""
        one = PseudoMeasurements(row[None], np.array([target]))
        rows = stacked(self.problem.pseudo_measurements, one)
        return replace(self, problem=replace(self.problem, pseudo_measurements=rows))

    def with_closure(
        self, stances: RestingSoles, point: LinearizationPoint
    ) -> PseudoMeasurements | None:
        """Return the pseudo-measurements with those of soles at rest."""
        parameters, errors = self.problem.parameters, self.errors
        closed = closure_rows(stances, parameters, errors, point)
        changes = len(self.problem.prior.mean) - len(parameters) - len(errors)
        return stacked(self.problem.pseudo_measurements, padded(closed, changes))


def calibration_windows(rate: float) -> tuple[float, float]:
    """Return the shortest and the longest window length, s, at a rate, Hz."""
    suited = suitable_windows(ALL_WINDOWS, rate)
    return suited[0], suited[-1]


def calibrate(problem: Problem, dataset: Dataset, request: SensorErrorRequest) -> Problem:
    """Return a problem with sensor errors as unknowns, linearised about the best estimate.

    The given problem has none, and its observations are not used.
    """
    segment = next(iter(dataset.segments))
    extended = ExtendedProblem.of(
        problem, segment.wrench_frames, segment.imu_frames, request, dataset.samples
    )
    parameters, errors = problem.parameters, extended.errors
    point = extended.prior_point
    p = len(parameters)
    longest = calibration_windows(segment.rate)[-1]
    scale: FloatArray | None = None
    remarks: tuple[str, ...] = ()
    stances = RestingSoles()
    alarms: tuple[str, ...] = ()
    if parameters.model.floating:
        found_stances = find_stances(dataset.segments, parameters.model)
        if not set(KINEMATIC_ERRORS).isdisjoint(errors.kinds):
            stances = found_stances
        elif alarm := contradicted_geometry(found_stances, parameters.model):
            alarms = (alarm,)
    spans = stamp_spans(dataset.segments)
    possible = SensorDrift.possible(errors, spans[0][0], spans[-1][1])
    is_empirical = problem.is_empirical and request.factors is not None
    passes = PASSES_WITH_PLACES if PLACE in errors.kinds else PASSES
    for turn in range(1, passes):
        is_last = turn == passes - 1
        wide = extended
        if is_last and possible is not None:
            wide = extended.with_drift(possible)
        (observations,) = observe(dataset.segments, wide.rows(point), wide.layout, (longest,), ())
        if is_last and wide.drift is not None:
            drift = drift_by_evidence(
                wide.drift,
                errors,
                observations,
                wide.problem.prior,
                wide.with_closure(stances, point),
                empirical=is_empirical,
                count=parameters.inertial,
            )
            if drift is not None:
                extended = extended.with_drift(drift)
            observations = observations.restricted(extended.layout.parameters)
        prior = extended.problem.prior
        pseudo_measurements = extended.with_closure(stances, point)
        if request.factors is not None and request.factors.tell_scale and scale is None:
            scale = _scale_row(request.factors, errors, prior.mean[p:], p)
            if is_undetermined(scale, observations, prior, pseudo_measurements, p):
                remarks = (open_scale_remark(parameters, dataset),)
                extended = extended.with_row(scale / ASSUMED_STD, 1 / ASSUMED_STD)
                pseudo_measurements = extended.with_closure(stances, point)
        found = posterior(
            observations,
            prior,
            pseudo_measurements,
            empirical=is_empirical,
            count=parameters.inertial,
            tolerance=POINT_CONVERGED,
        )
        point = extended.point(found.mean)
    build = extended.rows(point)
    return replace(
        extended.problem,
        observations=_final_rows(
            build, dataset, extended.layout, tuple(one.window for one in dataset.observations)
        ),
        pseudo_measurements=extended.with_closure(stances, point),
        calibrated_rows=build,
        remarks=remarks,
        alarms=alarms,
    )


def error_layout(parameters: ParameterSet, errors: SensorErrors) -> RowLayout:
    """Return the layout of the rows of a robot's parameters and its sensors' errors.

    Parameters have no effect on some coordinates if joints are exactly vertical or parallel, as in
    model files. They have if these joints are displaced.
    """
    some = np.random.default_rng(0).uniform(0.5, 1.0, len(errors)) * errors.std
    general = RowLayout.of(errors.placed(parameters, some))
    return general.extended(errors.names, errors.structure(parameters.model))


def _prior_errors(
    errors: SensorErrors, request: SensorErrorRequest, measured: Samples | Segment
) -> tuple[FloatArray, FloatArray]:
    """Return prior means and standard deviations (r,) of the sensor errors."""
    mean, std = np.zeros(len(errors)), errors.std.copy()
    if request.factors is not None:
        place = errors.places[DRIVE_GAIN]
        mean[place] = request.factors.values[errors.gained_joints]
        std[place] = request.factors.spread * np.abs(mean[place])
    if "wrench_offset" in errors.kinds:
        place = errors.places["wrench_offset"]
        for index, frame in enumerate(errors.wrench_frames):
            if frame in request.tares:
                part = slice(place.start + 6 * index, place.start + 6 * index + 6)
                mean[part], std[part] = request.tares[frame].mean, request.tares[frame].std
    if "imu_mounting" in errors.kinds:
        place = errors.places["imu_mounting"]
        for index, frame in enumerate(errors.imu_frames):
            if frame in request.mountings:
                part = slice(place.start + 3 * index, place.start + 3 * index + 3)
                found_by_checks = request.mountings[frame]
                mean[part] = found_by_checks.rotation
                std[part] = np.maximum(std[part], found_by_checks.std)
    if COMPLIANCE in errors.kinds:
        std[errors.places[COMPLIANCE]] = compliance_std(measured.effort)
    return mean, std


def compliance_std(efforts: FloatArray) -> FloatArray:
    """Return the prior deviations (J,) of compliances, rad/Nm, by the sizes of efforts (N, J)."""
    size = np.sqrt(np.mean(np.nan_to_num(efforts) ** 2, axis=0))
    std: FloatArray = DEFLECTION / np.maximum(size, max(LEAST_EFFORT * size.max(), 1e-9))
    return std


def open_scale_remark(parameters: ParameterSet, dataset: Dataset) -> str:
    """Return a remark that a log leaves the common scale open, and what would determine it."""
    if not parameters.payloads:
        return ASSUMED + WITH_PAYLOAD
    spans = stamp_spans(dataset.segments)
    first, last = spans[0][0], spans[-1][1]
    is_always = all(one.start <= first and last < one.stop for one in parameters.payloads)
    return ASSUMED + (WITHOUT_PAYLOAD if is_always else LONGER)


def _scale_row(
    factors: InitialFactors, errors: SensorErrors, mean: FloatArray, count: int
) -> FloatArray:
    """Return the row (p + r,) whose value is the common scale of factors, 1 at the first guess."""
    row = np.zeros(count + len(errors))
    place = errors.places[DRIVE_GAIN]
    row[count + place.start : count + place.stop] = factors.weights / mean[place]
    return row


def is_undetermined(
    scale: FloatArray,
    observations: Observations,
    prior: Prior,
    pseudo_measurements: PseudoMeasurements | None,
    count: int,
) -> bool:
    """Return whether the log leaves the common scale of drive gains open.

    The product of ``scale`` (p + r,) and the unknowns is the scale. The deviations of the first
    ``count`` unknowns, those of links and joints, are widened, so that they do not determine it.
    """
    wide = np.ones(len(prior.mean))
    wide[:count] = WIDE
    found = posterior(
        observations, prior.widened(wide), pseudo_measurements, tolerance=POINT_CONVERGED
    )
    return bool(np.linalg.norm(scale @ found.deviation_factor) > OPEN_SCALE)


def with_fixed_gains(problem: Problem) -> Problem:
    """Return the problem with drive gains fixed at the linearisation point, to choose terms.

    A gain of zero explains any torque without any term, so the evidence for terms is meaningful at
    given gains only.
    """
    build, prior = problem.calibrated_rows, problem.prior
    assert build is not None
    p = len(problem.parameters)
    place = build.errors.places[DRIVE_GAIN]
    gains = slice(p + place.start, p + place.stop)
    scale, mean = np.ones(len(prior.mean)), prior.mean.copy()
    scale[gains], mean[gains] = FIXED, build.linearization.theta[place]
    # Gains are independent of all others, so columns of the factor are theirs alone.
    return replace(problem, prior=replace(prior.widened(scale), mean=mean))


def without_terms(problem: Problem, dataset: Dataset, free: BoolArray) -> Problem:
    """Return the problem linearised about a point without the terms that were not chosen.

    The columns of drive gains contain the predicted torque. With the torque of terms that are no
    unknowns they would seem to know the scale of the efforts. ``free`` (p,) marks the parameters
    that are identified.
    """
    build = problem.calibrated_rows
    assert build is not None
    phi = np.where(free, build.linearization.phi, problem.prior.mean[: len(free)])
    build = replace(build, linearization=replace(build.linearization, phi=phi))
    windows = tuple(one.window for one in problem.observations)
    rows = _final_rows(build, dataset, problem.observations[0].layout, windows)
    return replace(problem, observations=rows, calibrated_rows=build)


def _final_rows(
    build: CalibratingRows, dataset: Dataset, layout: RowLayout, windows: tuple[float, ...]
) -> tuple[Observations, ...]:
    return observe(
        dataset.segments,
        build,
        layout,
        windows,
        NOISY_CHANNELS,
        candidates=build.parameters.candidates,
    )


def padded(rows: PseudoMeasurements | None, count: int) -> PseudoMeasurements | None:
    """Return pseudo-measurements with zero columns for ``count`` further unknowns."""
    if rows is None or count == 0:
        return rows
    return replace(rows, rows=np.pad(rows.rows, ((0, 0), (0, count))))
