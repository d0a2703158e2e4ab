"""Rows of the equation of motion with the sensors' gains and delays as unknowns.

A gain maps readings to true values: a 3×3 matrix A for both vectors of a wrench, M for an IMU's
specific force, a scalar g for a joint's effort. With the delay d of each sensor relative to the
joint positions, x(t) = gain x'(t + d) for a reading x', and the equation of motion

    K φ + Σ ∂(K φ)/∂a (M - 1) a' = Σ Jᵀ A f' + g τ' + delays times derivatives

is linear in φ, A - 1, M - 1, g - 1 and the delays together, except for the product of the errors
of φ and M. A wrong sign, frame or unit is therefore as exact as a small error. Errors of inertias
and joint friction are part of φ.

Offsets of the joints' encoders enter with the derivative of the equation at the model's φ. It
changes as slowly as the robot moves and is computed for few instants.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import LinkPoses, joint_axes, link_poses
from symbid_ros.dynamics.regressor import (
    Rows,
    averaged_equation_of_motion,
    equation_of_motion,
    equation_residual,
    has_linear_rows,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.block_matrices import without_zeros
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sampled_rows import SampledRows, valid_coordinates, valid_rows
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import with_filtered_friction
from symbid_ros.signals.window_averages import (
    Average,
    AveragingRows,
    average,
    extended,
    stacked,
)

CHUNK = 512
PER_SENSOR = 10  # unknowns of a wrench sensor or an IMU: its matrix row by row, then its delay
# Period at which the columns of encoder offsets are computed, ns, and step of the difference, rad.
OFFSET_PERIOD = 100_000_000
OFFSET_STEP = 1e-4


@dataclass(frozen=True)
class GainLayout:
    """Order of the unknowns: wrenches, IMUs, efforts, their delay, wrist delays, encoders.

    Attributes
    ----------
    wrench_frames, imu_frames : tuple of str
        F and I sensors.
    driven : tuple of int
        Indices of the D driven joints in the model.
    joint_names : tuple of str
        Names of the driven joints.
    measured : tuple of int
        Indices of the E revolute joints with an encoder of their own.
    wrist_sensors : mapping of str to slice
        Indices of the joints of each wrist sensor in the model, by its frame.
    """

    wrench_frames: tuple[str, ...]
    imu_frames: tuple[str, ...]
    driven: tuple[int, ...]
    joint_names: tuple[str, ...]
    measured: tuple[int, ...] = ()
    wrist_sensors: Mapping[str, slice] = field(default_factory=dict)

    @classmethod
    def of(
        cls, model: RobotModel, wrench_frames: tuple[str, ...], imu_frames: tuple[str, ...]
    ) -> "GainLayout":
        """Return the layout for a log's sensors; a fixed base needs no IMU."""
        driven = tuple(place for place, joint in enumerate(model.joints) if joint.effort > 0)
        names = tuple(model.joint_names[place] for place in driven)
        measured = tuple(
            place
            for place, joint in enumerate(model.joints)
            if joint.kind == "revolute" and place not in model.followers
        )
        imus = imu_frames if model.floating else ()
        return cls(wrench_frames, imus, driven, names, measured, model.wrist_sensors)

    def __len__(self) -> int:
        return int(self.encoders.stop)

    def wrench(self, index: int) -> slice:
        """Return the indices of a wrench sensor's A."""
        return slice(PER_SENSOR * index, PER_SENSOR * index + 9)

    def imu(self, index: int) -> slice:
        """Return the indices of an IMU's M."""
        return self.wrench(len(self.wrench_frames) + index)

    @property
    def efforts(self) -> slice:
        """The indices of the driven joints' g."""
        first = PER_SENSOR * (len(self.wrench_frames) + len(self.imu_frames))
        return slice(first, first + len(self.driven))

    @property
    def effort_delay(self) -> int:
        """The index of the delay of all efforts."""
        return int(self.efforts.stop)

    @property
    def wrist_delays(self) -> slice:
        """The indices of the wrist sensors' delays."""
        return slice(self.effort_delay + 1, self.effort_delay + 1 + len(self.wrist_sensors))

    @property
    def encoders(self) -> slice:
        """The indices of the encoders' offsets, rad."""
        return slice(self.wrist_delays.stop, self.wrist_delays.stop + len(self.measured))

    @cached_property
    def is_encoder(self) -> BoolArray:
        """(r,) which unknowns are offsets of encoders."""
        is_encoder: BoolArray = np.arange(len(self)) >= self.encoders.start
        return is_encoder

    @cached_property
    def is_delay(self) -> BoolArray:
        """(r,) which unknowns are delays."""
        delay = np.zeros(len(self), dtype=bool)
        delay[PER_SENSOR - 1 : self.efforts.start : PER_SENSOR] = delay[self.effort_delay] = True
        delay[self.wrist_delays] = True
        return delay

    @cached_property
    def is_imu(self) -> BoolArray:
        """(r,) which unknowns belong to an IMU's matrix."""
        place = np.arange(len(self))
        first = PER_SENSOR * len(self.wrench_frames)
        is_imu: BoolArray = (place >= first) & (place < self.efforts.start) & ~self.is_delay
        return is_imu

    def structure(self, model: RobotModel) -> BoolArray:
        """Return which coordinates (n, r) each unknown affects."""
        first = 6 * model.floating
        affects = np.zeros((model.dof, len(self)), dtype=bool)
        for index, frame in enumerate(self.wrench_frames):
            columns = slice(PER_SENSOR * index, PER_SENSOR * (index + 1))
            affects[:first, columns] = True
            affects[first:, columns] = model.ancestors[:, model.loaded_link(frame)][:, None]
        affects[:, PER_SENSOR * len(self.wrench_frames) : self.efforts.start] = True
        rows, columns_ = self._efforts(model)
        affects[rows, columns_] = affects[rows, self.effort_delay] = True
        for own, column in self._wrist_sensors(model):
            affects[own, column] = True
        # A joint's position matters to the joints that carry it and to those that it carries.
        carries = model.ancestors[:, 1:]
        related = carries | carries.T | bool(model.followers)
        # Joints between the base and an IMU matter to the base's motion.
        for frame in self.imu_frames:
            related |= model.ancestors[:, model.frame(frame).link]
        affects[:first, self.encoders] = True
        affects[first:, self.encoders] = related[:, list(self.measured)]
        return affects

    def _efforts(self, model: RobotModel) -> tuple[IntArray, IntArray]:
        """Return the coordinates of the driven joints and the indices of their gains."""
        driven = np.array(self.driven, dtype=np.int64)
        return 6 * model.floating + driven, self.efforts.start + np.arange(len(driven))

    def _wrist_sensors(self, model: RobotModel) -> Iterator[tuple[slice, int]]:
        """Yield the coordinates of each wrist sensor and the index of its delay."""
        first = 6 * model.floating
        for index, joints in enumerate(self.wrist_sensors.values()):
            yield slice(first + joints.start, first + joints.stop), self.wrist_delays.start + index

    def columns(self, parameters: ParameterSet, readings: SensorSamples) -> FloatArray:
        """Return C (N, n, r), the derivative of y by each unknown."""
        model, count, sensors = parameters.model, len(readings), len(self.wrench_frames)
        C = np.zeros((count, model.dof, len(self)))
        poses = link_poses(model, readings.position)
        time = (readings.stamp - readings.stamp[0]) * 1e-9

        def slope(values: FloatArray) -> FloatArray:
            return _slope(values, time)

        parts = np.zeros((count, model.dof, self.efforts.start // PER_SENSOR, PER_SENSOR))
        matrices = parts[..., :9].reshape(*parts.shape[:3], 3, 3)  # a view
        if sensors:
            felt = contact_jacobian(model, self.wrench_frames, poses).transpose(0, 2, 1)
            felt = felt.reshape(count, model.dof, sensors, 2, 3)
            read = readings.wrenches.reshape(count, sensors, 2, 3)
            matrices[:, :, :sensors] = np.einsum("tnfci,tfck->tnfik", felt, read, optimize=True)
            parts[:, :, :sensors, 9] = np.einsum(
                "tnfci,tfci->tnf", felt, slope(read), optimize=True
            )
        if self.imu_frames:
            force_jacobian = specific_force_jacobian(parameters, poses)
            for index, frame in enumerate(self.imu_frames):
                mount = model.frame(frame)
                axes = poses.rotation[:, mount.link] @ mount.rotation / len(self.imu_frames)
                read = readings.specific_force[:, index]
                matrix = np.einsum("tnc,tci,tk->tnik", force_jacobian, axes, read, optimize=True)
                matrices[:, :, sensors + index] = -matrix
                late = _imu_derivative(readings, index, slope)
                change = equation_residual(parameters, at_base(late, model), parameters.values)
                parts[:, :, sensors + index, 9] = change
        C[:, :, : self.efforts.start] = parts.reshape(count, model.dof, -1)
        rows_, columns_ = self._efforts(model)
        effort = np.nan_to_num(readings.effort[:, list(self.driven)])
        C[:, rows_, columns_] = effort
        C[:, rows_, self.effort_delay] = slope(effort)
        for own, column in self._wrist_sensors(model):
            joints = slice(own.start - 6 * model.floating, own.stop - 6 * model.floating)
            C[:, own, column] = slope(np.nan_to_num(readings.effort[:, joints]))
        C[:, :, self.encoders] = self._encoder_columns(parameters, readings)
        return C

    def _encoder_columns(self, parameters: ParameterSet, readings: SensorSamples) -> FloatArray:
        """Return the derivative (N, n, E) of y - K φ by the encoders' offsets."""
        model = parameters.model
        shape = (len(readings), model.dof, len(self.measured))
        if not self.measured:
            return np.zeros(shape)
        period = readings.stamp // OFFSET_PERIOD
        starts = np.flatnonzero(np.diff(period, prepend=period[0] - 1))
        means = readings.averaged(starts)
        # Rows of joints whose effort was not measured are not valid, but a NaN would spread.
        means = replace(means, effort=np.nan_to_num(means.effort))
        count, repeats = len(means), len(self.measured) + 1
        shifted = means[np.tile(np.arange(count), repeats)]
        position = shifted.position.reshape(repeats, count, -1).copy()
        for index, joint in enumerate(self.measured):
            position[index + 1, :, joint] -= OFFSET_STEP
        shifted = replace(shifted, position=position.reshape(repeats * count, -1))
        # Forces of one robot take a fraction of the time and memory of rows in all parameters.
        residual = equation_residual(parameters, at_base(shifted, model), parameters.values)
        residual = residual.reshape(repeats, count, model.dof)
        at_means = (residual[1:] - residual[0]).transpose(1, 2, 0) / OFFSET_STEP
        if count == 1:
            return np.broadcast_to(at_means, shape)
        place = np.interp(readings.stamp, means.stamp, np.arange(count))
        before = np.minimum(place.astype(int), count - 2)
        share = (place - before)[:, None, None]
        columns: FloatArray = at_means[before] * (1 - share) + at_means[before + 1] * share
        return columns


def specific_force_jacobian(parameters: ParameterSet, poses: LinkPoses) -> FloatArray:
    """Return ∂(K φ)/∂a (N, n, 3) by the specific force a in base axes.

    For a joint with axis (s; v) that carries mass M with first moment c about the base's origin,
    the generalized force is s·(c × a) + M v·a.
    """
    model = parameters.model
    mass = model.phi[:, 0]
    first = mass[:, None] * poses.position + np.einsum(
        "nlij,lj->nli", poses.rotation, model.phi[:, 1:4]
    )
    axes = joint_axes(model, poses)
    carries = model.ancestors.astype(np.float64)
    carried = np.einsum("jl,nli->nji", carries, first)
    felt = np.cross(axes[..., :3], carried) + (carries @ mass)[:, None] * axes[..., 3:]
    if not model.floating:
        return felt
    unit = np.broadcast_to(np.eye(3), (len(felt), 3, 3))
    moment = np.cross(unit, first.sum(axis=1)[:, None])
    return np.concatenate([moment, mass.sum() * unit, felt], axis=1)


def _slope(values: FloatArray, time: FloatArray) -> FloatArray:
    """Return the derivative of uniformly sampled values (N, ...): of fourth order, but at ends."""
    if len(time) < 2:
        return np.zeros_like(values)
    slope: FloatArray = np.gradient(values, time, axis=0)
    if len(time) > 4:
        inner = 8 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])
        slope[2:-2] = inner * ((len(time) - 1) / (12 * (time[-1] - time[0])))
    return slope


def _imu_derivative(
    readings: SensorSamples, index: int, slope: Callable[[FloatArray], FloatArray]
) -> SensorSamples:
    """Return the time derivative of one IMU's accelerations, with zero for all other readings."""
    zeros = np.zeros_like(readings.position)
    omega, alpha, force = (np.zeros_like(readings.specific_force) for _ in range(3))
    alpha[:, index] = slope(readings.angular_acceleration[:, index])
    force[:, index] = slope(readings.specific_force[:, index])
    return replace(
        readings,
        velocity=zeros,
        acceleration=zeros,
        effort=zeros,
        wrenches=np.zeros_like(readings.wrenches),
        angular_velocity=omega,
        angular_acceleration=alpha,
        specific_force=force,
    )


@dataclass(frozen=True)
class GainRows(AveragingRows):
    """Builds rows [K, -C] [φ; θ] = y.

    Attributes
    ----------
    parameters : ParameterSet
        φ.
    gains : GainLayout
        θ.
    further : callable, optional
        Returns further columns (N, n, m) of a layout, a model and sensor samples.
    """

    parameters: ParameterSet
    gains: GainLayout
    further: Callable[[GainLayout, RobotModel, SensorSamples], FloatArray] | None = None

    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""
        further = self._further(readings)
        for start in range(0, len(readings), CHUNK):
            part = readings[start : start + CHUNK]
            samples = at_base(part, self.parameters.model)
            rows = equation_of_motion(self.parameters, samples)
            gains = self.gains.columns(self.parameters, part)
            K = np.concatenate([rows.K, -gains, -further[start : start + CHUNK]], axis=2)
            yield valid_rows(part.stamp, Rows(K, rows.y), self._valid(samples))

    def averages(self, readings: SensorSamples, weights: Sequence[csr_array]) -> list[Average]:
        """Return averages over windows, of K without rows of single samples if possible."""
        parameters = self.parameters
        if not has_linear_rows(parameters):
            return average(self(readings), weights)
        samples = at_base(readings, parameters.model)
        samples = with_filtered_friction(samples, parameters, readings.recorded)
        K, y = averaged_equation_of_motion(parameters, samples, stacked(weights))
        gains = self.gains.columns(parameters, readings)
        rows = Rows(np.concatenate([gains, self._further(readings)], axis=2), y)
        of_gains = average(iter([valid_rows(readings.stamp, rows, self._valid(samples))]), weights)
        return extended([replace(one, K=-one.K) for one in of_gains], K)

    def _further(self, readings: SensorSamples) -> FloatArray:
        model = self.parameters.model
        if self.further is None:
            return np.zeros((len(readings), model.dof, 0))
        return self.further(self.gains, model, readings)

    def _valid(self, samples: Samples) -> BoolArray:
        """Return which coordinates (N, n) are checked.

        The drive of an arm's joint at rest may read anything up to its dry friction. On robots that
        stand, where joints hardly move, the other sensors tell what a joint carries.
        """
        parameters = self.parameters
        if parameters.model.floating:
            return np.ones((len(samples), parameters.model.dof), dtype=bool)
        return valid_coordinates(parameters, samples.velocity)


@dataclass
class CoordinateRows:
    """Triangular factors of [K_i y_i], one for each of n coordinates.

    Attributes
    ----------
    coordinates : tuple of str
        Their names.
    units : tuple of str
        Units of their forces, Nm or N.
    structure : (n, q) bool
        Which of q unknowns affect each coordinate.
    samples : int
        Rows folded into each factor.
    """

    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    structure: BoolArray
    samples: int = 0
    _columns: list[IntArray] = field(init=False)
    _factors: list[FloatArray] = field(init=False)
    _moments: list[FloatArray] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Allocate empty factors."""
        self._columns = [np.flatnonzero(row) for row in self.structure]
        widths = [len(columns) + 1 for columns in self._columns]
        self._factors = [np.zeros((width, width), order="F") for width in widths]

    def fold(self, rows: Rows) -> None:
        """Add N rows of every coordinate."""
        self._moments = None
        for index, columns in enumerate(self._columns):
            block = np.empty((len(rows.y), len(columns) + 1), order="F")
            block[:, :-1] = rows.K[:, index, columns]
            block[:, -1] = rows.y[:, index]
            # LAPACK's tpqrt exploits the zeros of the triangle.
            self._factors[index], _, _, _ = lapack.dtpqrt(
                0, min(32, len(columns) + 1), self._factors[index], block, True, True
            )
        self.samples += len(rows.y)

    def combined(self, change: FloatArray, shift: FloatArray | None = None) -> "CoordinateRows":
        """Return the rows [K T, y - K s] for T (q, m) and s (q,)."""
        chosen = CoordinateRows(
            self.coordinates, self.units, self.structure @ (change != 0), self.samples
        )
        for index, (columns, own) in enumerate(zip(self._columns, self._factors, strict=True)):
            new = own[:, :-1] @ without_zeros(change[np.ix_(columns, chosen._columns[index])])
            target = own[:, -1] if shift is None else own[:, -1] - own[:, :-1] @ shift[columns]
            chosen._factors[index] = np.column_stack([new, target])
        return chosen

    def moment(self, weight: FloatArray) -> FloatArray:
        """Return Σ [K y]ᵀ [K y] (q + 1, q + 1) of all rows with weights (n,).

        It has half the digits of :meth:`whitened` and takes a small part of its time.
        """
        if self._moments is None:
            self._moments = [factor.T @ factor for factor in self._factors]
        q = self.structure.shape[1]
        total = np.zeros((q + 1, q + 1))
        for columns, moment, one in zip(self._columns, self._moments, weight, strict=True):
            place = np.append(columns, q)
            total[np.ix_(place, place)] += one * moment
        return total

    def pull(self, unknowns: FloatArray, weight: FloatArray) -> FloatArray:
        """Return Σ Kᵀ (y - K x) (q,) of all rows with weights (n,), for x (q,), in all digits."""
        total = np.zeros(self.structure.shape[1])
        for columns, factor, one in zip(self._columns, self._factors, weight, strict=True):
            left = factor[:, -1] - factor[:, :-1] @ unknowns[columns]
            total[columns] += one * (factor[:, :-1].T @ left)
        return total

    def whitened(self, deviation: FloatArray) -> FloatArray:
        """Return the triangular factor (q + 1, q + 1) of all rows divided by deviations (n,)."""
        q = self.structure.shape[1]
        stacked = np.zeros((sum(map(len, self._factors)), q + 1))
        first = 0
        for columns, factor, scale in zip(self._columns, self._factors, deviation, strict=True):
            rows = slice(first, first + len(factor))
            stacked[rows, columns] = factor[:, :-1] / scale
            stacked[rows, q] = factor[:, -1] / scale
            first += len(factor)
        return stacked_factor(stacked)

    def residual_squares(self, unknowns: FloatArray) -> FloatArray:
        """Return the mean squares (n,) of y - K x for x (q,)."""
        squares = [
            np.sum((factor[:, -1] - factor[:, :-1] @ unknowns[columns]) ** 2)
            for columns, factor in zip(self._columns, self._factors, strict=True)
        ]
        return np.array(squares) / max(self.samples, 1)

    def factor(self, coordinate: int) -> FloatArray:
        """Return the triangular factor (w, q + 1) of a coordinate's rows [K y], all columns."""
        columns, own = self._columns[coordinate], self._factors[coordinate]
        factor = np.zeros((len(own), self.structure.shape[1] + 1))
        factor[:, columns], factor[:, -1] = own[:, :-1], own[:, -1]
        return factor

    @property
    def target_squares(self) -> FloatArray:
        """Mean squares (n,) of y."""
        return self.residual_squares(np.zeros(self.structure.shape[1]))

    def column_squares(self, coordinate: int, unknown: int) -> float:
        """Return the mean square of one unknown's column in one coordinate's rows."""
        place = int(np.searchsorted(self._columns[coordinate], unknown))
        column = self._factors[coordinate][:, place]
        return float(column @ column) / max(self.samples, 1)
