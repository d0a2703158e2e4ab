"""Rows of a log with the columns of effects that may explain what an estimate leaves.

Effects are terms of joints that were not identified, effects that no option models, and sensor
errors, linearised about the estimate.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SENSOR_ERROR_KINDS, TERMS, UNSEEN_WITH_CONTACTS
from symbid_ros.dynamics.friction import (
    coulomb_column,
    creeping_column,
    friction_state,
    leading_column,
    stribeck_column,
)
from symbid_ros.dynamics.kinematics import link_poses, rotate
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.dynamics.upright import upward
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.terms.further_terms import is_too_short
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.warming import Course, courses_of
from symbid_ros.signals.calibrating_rows import (
    CalibratingRows,
    LinearizationPoint,
    interpolated_columns,
)
from symbid_ros.signals.sampled_rows import RowBuilder, SampledRows
from symbid_ros.signals.segments import Segment, stamp_spans
from symbid_ros.signals.sensor_errors import COMPLIANCE, IMU_BIAS, SensorErrors
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import block_length, windowed_rows

# Stretches of a log are dealt to this many groups, each predicted from the others. They last a
# second, or twice the window if that is longer.
GROUPS = 4
SHORTEST, WINDOWS_EACH = 1.0, 2
# Columns of a support without a sensor.
SUPPORT = 4
# Number of cosines over the log by which each component of a wrist sensor drifts: they hold nine
# tenths of the variance of a random walk.
DRIFT = 6
# Most blocks that are used, evenly spread over the log; the motion varies little beyond.
MOST_BLOCKS = 40


@dataclass(frozen=True)
class Candidate:
    """Columns of a possible cause.

    Attributes
    ----------
    kind : str
        Key of ``EFFECTS``.
    owners : tuple of str
        Joint or sensor frame of each of the m columns.
    columns : (N, n, m) float64
    std : (m,) float64 or None
        Typical size of the coefficients, if they have one.
    """

    kind: str
    owners: tuple[str, ...]
    columns: FloatArray
    std: FloatArray | None = None


@dataclass(frozen=True)
class CandidateRows:
    """Rows of a log with the columns of all candidates.

    Attributes
    ----------
    model : RobotModel
    K : (N, n, p) float64
        Of the unknowns that were identified, in deviations of the prior.
    residual : (N, n) float64
        At the prior's mean.
    error : (N, n) float64
        At the estimate.
    candidates : tuple of Candidate
    speed, force : (N, n) float64
        Mean speed of each joint, and its measured force.
    valid : (N, n) bool
    group : (N,) int
        Group of each row.
    covariance : (n, n) float64
        Σ with which the estimate weights rows.
    rate : float
        Rate of the log, Hz.
    stamp : (N,) int64
        ns.
    span : (int, int)
        First and last stamp of the log, ns.
    """

    model: RobotModel
    K: FloatArray
    residual: FloatArray
    error: FloatArray
    candidates: tuple[Candidate, ...]
    speed: FloatArray
    force: FloatArray
    valid: BoolArray
    group: IntArray
    covariance: FloatArray
    rate: float
    stamp: IntArray
    span: tuple[int, int]

    @classmethod
    def of(cls, loaded: LoadedProblem, found: Identification) -> "CandidateRows | None":
        """Build the rows over the longest windows; None if the log is too short."""
        solved = loaded.solved
        problem = solved.problem
        segments = loaded.dataset.segments
        first = next(iter(segments), None)
        if first is None:
            return None
        build = CandidateBuilder.of(problem.row_builder, found, problem.parameters, first)
        build = replace(build, courses=courses_of(stamp_spans(segments)))
        window = problem.observations[-1].window
        slips = problem.choice is not None and problem.choice.slips
        parts = []
        period = round(1e9 * max(SHORTEST, WINDOWS_EACH * window))
        for segment in _some_blocks(segments):
            for (block,) in windowed_rows(segment, build, (window,), ()):
                one = block.slipping() if slips else block
                parts.append((one.mean.K, one.mean.y, one.valid, one.stamp))
        if not parts:
            return None
        K, y, valid, stamp = (np.concatenate(each) for each in zip(*parts, strict=True))
        group = stamp // period % GROUPS
        if len(np.unique(group)) < GROUPS:
            return None
        prior = solved.posterior.prior
        count = len(prior.mean)
        return cls(
            problem.parameters.model,
            K[:, :, :count] @ prior.covariance_factor(),
            y - K[:, :, :count] @ prior.mean,
            y - K[:, :, :count] @ found.unknowns,
            tuple(build.candidates(K)),
            K[:, :, -1],
            y,
            valid,
            group,
            solved.posterior.covariance,
            first.rate,
            stamp,
            build.span,
        )


@dataclass(frozen=True)
class _FurtherErrors:
    """Rows in a robot's parameters, biases of its IMUs and further errors, a ``RowBuilder``."""

    build: CalibratingRows
    errors: SensorErrors
    point: LinearizationPoint

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        corrected = self.build.errors.corrected(readings, self.build.linearization.theta)
        start = 0
        for part in self.build(readings):
            here = corrected[start : start + len(part.stamp)]
            start += len(part.stamp)
            C = interpolated_columns(self.build.parameters, self.errors, self.point, here)
            rows = Rows(np.concatenate([part.rows.K, -C], axis=2), part.rows.y)
            yield replace(part, rows=rows)


@dataclass(frozen=True)
class CandidateBuilder:
    """Builds rows with the columns of all candidates, a ``RowBuilder``.

    Columns that need the effort use the one that the estimate predicts: the measured effort
    contains the residual, and would explain itself.

    Attributes
    ----------
    build : RowBuilder
        Of the identified unknowns, and of the sensor errors unless they are among those.
    parameters : ParameterSet
    unknowns : (k,) float64
        The identified unknowns.
    errors : SensorErrors or None
        The sensor errors that follow them.
    terms : tuple of str
        Joint terms that were not identified.
    courses : tuple of (int, int)
        First and last stamp of each part of the log, ns.
    """

    build: RowBuilder
    parameters: ParameterSet
    unknowns: FloatArray
    errors: SensorErrors | None
    terms: tuple[str, ...]
    courses: tuple[Course, ...] = ((0, 0),)

    @classmethod
    def of(
        cls, build: RowBuilder, found: Identification, parameters: ParameterSet, segment: Segment
    ) -> "CandidateBuilder":
        """Return the builder that adds candidates to the unknowns that were identified."""
        # Terms that the data rejected need not be tried again.
        terms = () if found.estimate.joint_terms is not None else TERMS
        missing = tuple(term for term in terms if term not in parameters.terms)
        errors = None
        if not isinstance(build, CalibratingRows) or build.errors.kinds == (IMU_BIAS,):
            # Columns of measured efforts would explain their own residuals: see ``effects``.
            left_out = {"torque_gain"}
            others = segment.wrench_frames or segment.imu_frames or parameters.model.wrist_sensors
            if not others:
                left_out.add("sensor_delay")
            if parameters.model.contacts is not None:
                left_out.update(UNSEEN_WITH_CONTACTS)
            if isinstance(build, CalibratingRows):
                left_out.update(build.errors.kinds)
            kinds = [kind for kind in SENSOR_ERROR_KINDS if kind not in left_out]
            errors = SensorErrors.of(
                kinds, parameters.model, segment.wrench_frames, segment.imu_frames
            )
            phi = found.unknowns[: len(parameters)]
            point = LinearizationPoint(phi, np.zeros(len(errors)))
            if isinstance(build, CalibratingRows):
                build = _FurtherErrors(build, errors, point)
            else:
                build = CalibratingRows(parameters, errors, point)
        return cls(build, parameters, found.unknowns, errors, missing)

    @property
    def span(self) -> tuple[int, int]:
        """First and last stamp of the log, ns."""
        return self.courses[0][0], self.courses[-1][1]

    @property
    def effects(self) -> tuple[str, ...]:
        """Kinds with one column for each joint; a delay's also serve for all efforts together.

        Without foot sensors there are none, because each effort then enters several rows.
        """
        if self.parameters.model.contacts is not None:
            return ()
        gain = () if self.errors is None else ("torque_gain",)
        warming = () if is_too_short(self.courses) else ("warming",)
        return (*self.terms, "quadratic", *warming, "delay", *gain)

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        parts = list(self.build(readings))
        if not parts:
            return
        first, known = 6 * self.parameters.model.floating, len(self.unknowns)
        residual = [part.rows.y - part.rows.K[:, :, :known] @ self.unknowns for part in parts]
        measured = np.nan_to_num(readings.effort)
        # A joint without a drive has no effort to predict.
        is_driven = np.any(measured != 0, axis=0)
        effort = (measured - np.concatenate(residual)[:, first:]) * is_driven
        own = self._own_columns(readings, effort)
        support = self._support_columns(readings)
        start = 0
        for part in parts:
            count, n, _ = part.rows.K.shape
            here = slice(start, start + count)
            columns = np.zeros((count, n, SUPPORT + own.shape[2]))
            columns[:, :first, :SUPPORT] = support[here]
            columns[:, first:, SUPPORT:] = own[here]
            drift = self._drift_columns(readings.stamp[here])
            K = np.concatenate([part.rows.K, drift, columns], axis=2)
            yield replace(part, rows=Rows(K, part.rows.y))
            start += count

    def _own_columns(self, readings: SensorSamples, effort: FloatArray) -> FloatArray:
        """Return (N, J, k) the columns of ``effects``, and the speed."""
        velocity, joints = readings.velocity, self.parameters.model.joints
        effort = np.nan_to_num(effort)  # joints whose effort was not measured have no rows
        slips = coulomb_column(velocity, joints)
        rate = np.zeros_like(effort)
        if len(readings) > 1:
            rate = np.gradient(effort, float(np.diff(readings.stamp).mean()) * 1e-9, axis=0)
        columns = {
            "viscous": velocity,
            "coulomb": slips,
            "armature": readings.acceleration,
            "offset": np.ones_like(velocity),
            "stribeck": stribeck_column(velocity, joints),
            "quadratic": velocity * np.abs(velocity),
            "load": slips * np.abs(effort),
            "presliding": friction_state(readings.position, joints) - slips,
            "stiffness": readings.position,
            "lead": leading_column(velocity, readings.acceleration, joints) - slips,
            "creep": creeping_column(velocity, readings.acceleration, joints) - slips,
            "warming": velocity * self._elapsed(readings.stamp)[:, None],
            "delay": rate,
            "torque_gain": effort,
        }
        return np.stack([*(columns[kind] for kind in self.effects), np.abs(velocity)], axis=2)

    def _support_columns(self, readings: SensorSamples) -> FloatArray:
        """Return (N, 6, 4) the wrench of a constant vertical force; zero rows on a fixed base.

        The columns are a force at the base's origin, its moment if it acts at the mean of the feet,
        which rest in the world, and moments about horizontal axes, by which it acts beside them.
        Without sensors at the feet they are zero.
        """
        model = self.parameters.model
        columns = np.zeros((len(readings), 6 * model.floating, SUPPORT))
        frames = [model.frame(name) for name in readings.wrench_frames]
        if not model.floating or not frames:
            return columns
        samples = at_base(readings, model)
        up = upward(samples)
        poses = link_poses(model, samples.position)
        feet = [
            poses.position[:, one.link] + rotate(poses.rotation[:, one.link], one.translation)
            for one in frames
        ]
        sideways = np.cross(up, [1.0, 0.0, 0.0])
        columns[:, 3:, 0] = up
        columns[:, :3, 1] = np.cross(np.mean(feet, axis=0), up)
        columns[:, :3, 2] = sideways
        columns[:, :3, 3] = np.cross(up, sideways)
        return columns

    @property
    def _sensor_rows(self) -> list[tuple[str, int]]:
        """Frame and coordinate of each component of the wrist sensors."""
        model = self.parameters.model
        return [
            (frame, 6 * model.floating + joint)
            for frame, place in model.wrist_sensors.items()
            for joint in range(place.start, place.stop)
        ]

    def _drift_columns(self, stamp: IntArray) -> FloatArray:
        """Return (N, n, k) slow changes of the offset of each component of the wrist sensors."""
        rows, n = self._sensor_rows, self.parameters.model.dof
        orders = np.arange(1, DRIFT + 1)
        changes = np.cos(np.pi * orders * (self._elapsed(stamp)[:, None] + 0.5))
        columns = np.zeros((len(stamp), n, len(rows), DRIFT))
        for index, (_, row) in enumerate(rows):
            columns[:, row, index] = changes
        return columns.reshape(len(stamp), n, -1)

    def _elapsed(self, stamp: IntArray) -> FloatArray:
        """Return the time (N,) since the middle of the log, as shares of the log."""
        first, last = self.span
        elapsed: FloatArray = (stamp - first) / max(last - first, 1) - 0.5
        return elapsed

    def candidates(self, K: FloatArray) -> list["Candidate"]:
        """Return the candidates whose columns in rows K are not zero."""
        model, known = self.parameters.model, len(self.unknowns)
        first, joints = 6 * model.floating, model.joint_names
        found = []
        own = K.shape[2] - len(self.effects) - 1
        found.append(Candidate("support", ("base",), K[:, :, own - SUPPORT : own]))
        if rows := self._sensor_rows:
            owners = tuple(frame for frame, _ in rows for _ in range(DRIFT))
            start = own - SUPPORT - len(owners)
            found.append(Candidate("sensor_drift", owners, K[:, :, start : own - SUPPORT]))
        for index, kind in enumerate(self.effects):
            column = K[:, :, own + index, None]
            diagonal = np.eye(len(joints), model.dof, first).T
            single = kind
            if kind == "delay":
                found.append(Candidate(kind, ("efforts",), column))
                single = "effort_delay"
            found.append(Candidate(single, joints, column * diagonal))
        if self.errors is not None:
            for kind, place in self.errors.places.items():
                owners = tuple(name.rpartition("/")[0] for name in self.errors.names[place])
                columns = K[:, :, known + place.start : known + place.stop]
                std = None if kind == COMPLIANCE else self.errors.std[place]
                found.append(Candidate(kind, owners, columns, std))
        return [one for one in found if np.any(one.columns)]


def _some_blocks(segments: Iterable[Segment]) -> Iterator[Segment]:
    """Yield blocks of segments, evenly spread."""
    blocks = []
    for segment in segments:
        numbers = segment.stamp // block_length(segment.rate)
        edges = np.searchsorted(numbers, np.arange(numbers[0], numbers[-1] + 2)).tolist()
        blocks += [(segment, start, stop) for start, stop in pairwise(edges) if stop > start]
    stride = max(1, -(-len(blocks) // MOST_BLOCKS))
    for segment, start, stop in blocks[::stride]:
        yield segment.cut(start, stop)
