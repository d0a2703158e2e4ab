"""Accumulates the statistics of a log for the checks against a model."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import SIMULATED_TERMS, TERMS, Term
from symbid_ros.diagnosis.common_scale import ScaleEvidence, model_density
from symbid_ros.diagnosis.effort_lags import LAGS, LaggedRows, lagged_efforts
from symbid_ros.diagnosis.gain_problem import GainProblem
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout, GainRows
from symbid_ros.diagnosis.stance_gyro_check import StanceGyroMoments
from symbid_ros.diagnosis.unloaded_sensors import UnloadedSensors
from symbid_ros.diagnosis.wrist_evidence import payload_evidence
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.prior import DEFAULT_PERCENT, Prior, model_prior
from symbid_ros.estimation.prior_std import body_std
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.decimation import Decimator
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment, cut_to
from symbid_ros.signals.sensor_noise import noise_deviation
from symbid_ros.signals.sensor_samples import probed
from symbid_ros.signals.weak_form import ALL_WINDOWS, block_length, suitable_windows, windowed_rows

# The first that suits the rate is used. It is long enough to average out vibration and short enough
# for short logs.
WINDOWS = ALL_WINDOWS[1:]
# The rate of the rows suffices for windows of this length, s. At the lower rate that suffices for
# signals in longer windows, products of rates with much noise, as that of jitter, alias.
SHORTEST = 0.1
# Rate, Hz, that is sufficient for these windows, and its share that the low-pass keeps.
RATE, PASSED = 250.0, 0.2
# A wrench sensor is loaded if its root mean square force exceeds these shares of the most loaded
# sensor's and of the weight.
LEAST_LOAD, LEAST_SHARE = 0.1, 0.01
# Friction that grows with the load would be taken for a gain, so it is not among the terms here.
CHECKED_TERMS: tuple[Term, ...] = tuple(
    term for term in TERMS if term not in ("load", *SIMULATED_TERMS)
)
# Seconds between the samples that tell whether a wrench is that of a payload, and between those of
# the postures that tell how noise of wrenches loads the joints.
PAYLOAD_PERIOD = POSTURE_PERIOD = 0.2
# Variance of averages of white noise over a Hann window, times its number of samples.
HANN = 1.5
# Rows are built from all of the first blocks, and from ever fewer of the later ones.
DENSE = 25


class ModelStatistics:
    """Accumulates the statistics for the checks against a model in constant memory.

    Parameters
    ----------
    model : RobotModel
        The robot with nominal inertias.
    wrench_frames, imu_frames : sequence of str
        Frames of the log's sensors.

    Raises
    ------
    ModelError
        When the model has no mass.

    Attributes
    ----------
    parameters : ParameterSet
        Parameters of links and drives: inertias, friction, rotor inertias and offsets.
    prior : Prior
        Prior of the links: the model's values ±25 %.
    gains : GainLayout
        Layout of the unknown gains and delays.
    standing : tuple of StanceGyroMoments
        Moments of each IMU.
    payloads : tuple of PayloadEvidence
        Of the wrist sensors, and of an arm's other wrench sensors.
    unloaded : UnloadedSensors
        What the sensors of a floating robot's feet read in the air.
    """

    def __init__(
        self, model: RobotModel, wrench_frames: Sequence[str], imu_frames: Sequence[str]
    ) -> None:
        model.require_mass()
        self.model = model
        self.parameters = ParameterSet(model, CHECKED_TERMS)
        links = ParameterSet(model)
        self.prior: Prior = model_prior(links).marginal(links.names[: links.inertial])
        self.gains = GainLayout.of(model, tuple(wrench_frames), tuple(imu_frames))
        of_gains = self.gains.structure(model)
        delayed = of_gains[:, [self.gains.effort_delay] * len(LAGS)]
        structure = np.hstack([RowLayout.of(self.parameters).structure, of_gains, delayed])
        self._lagged = LaggedRows(
            CoordinateRows(model.coordinates, model.coordinate_units, structure),
            len(self.parameters.values) + self.gains.effort_delay,
        )
        self._rows: CoordinateRows | None = None
        self.standing = tuple(
            StanceGyroMoments(model, index)
            for index in range(len(imu_frames) if model.floating else 0)
        )
        self.payloads = payload_evidence(model, [*model.wrist_sensors, *wrench_frames])
        feet = tuple(wrench_frames) if model.floating else ()
        self.unloaded = UnloadedSensors(feet, self.weight)
        self._build = GainRows(self.parameters, self.gains, lagged_efforts)
        self._row_sum = np.zeros((model.dof, len(self.prior.names)))
        self._samples = self._blocks = 0
        self._force_square = np.zeros(len(wrench_frames))
        self._force_sum = np.zeros((len(wrench_frames), 3))
        self._noise_square = np.zeros((len(wrench_frames), 6))
        # Squares of the joints' loads by noise of each wrench, for one sample per second.
        self._load_noise = np.zeros((len(wrench_frames), len(model.joints)))
        self._effort_noise = np.zeros(len(model.joints))  # likewise, of the efforts
        self._window = np.inf

    def add(self, segment: Segment) -> None:
        """Add a segment; segments must be cut at multiples of a block."""
        for one in self.standing:
            one.add(segment)
        if self.payloads:
            samples = probed(segment, self.model, PAYLOAD_PERIOD)
            for evidence in self.payloads:
                evidence.add(samples)
        self.unloaded.add(segment)
        force = segment.wrenches[:, :, 3:]
        self._samples += len(segment)
        self._force_square += np.sum(force**2, axis=(0, 2))
        self._force_sum += force.sum(axis=0)
        noise = noise_deviation(segment.wrenches.reshape(len(segment), -1), segment.rate)
        self._noise_square += len(segment) * noise.reshape(-1, 6) ** 2
        self._add_load_noise(segment, noise)
        # Efforts of joints without any are NaN.
        effort_noise = noise_deviation(np.nan_to_num(segment.effort), segment.rate)
        self._effort_noise += len(segment) / segment.rate * effort_noise**2
        segment = _downsample(segment)
        length = block_length(segment.rate)
        windows = suitable_windows(WINDOWS, segment.rate)[:1]
        if not windows:
            return
        self._window = windows[0]
        for block in range(int(segment.stamp[0]) // length, int(segment.stamp[-1]) // length + 1):
            self._blocks += 1
            if not is_taken(self._blocks, DENSE):
                continue
            for part in cut_to([segment], block * length, (block + 1) * length):
                for (rows,) in windowed_rows(part, self._build, windows, (), shortest=SHORTEST):
                    self._lagged.rows.fold(rows.mean)
                    self._row_sum += rows.mean.K[:, :, : len(self.prior.names)].sum(axis=0)

    def _add_load_noise(self, segment: Segment, noise: FloatArray) -> None:
        """Add the squares of the joints' loads by white noise (6 F,) of the wrenches."""
        if not self.gains.wrench_frames:
            return
        stride = max(1, int(POSTURE_PERIOD * segment.rate))
        poses = link_poses(self.model, self.model.apply_mimics(segment.position[::stride]))
        jacobian = contact_jacobian(self.model, self.gains.wrench_frames, poses)
        joints = jacobian[:, :, 6 * self.model.floating :]
        squares = np.mean((joints * noise[:, None]) ** 2, axis=0)
        of_sensors = squares.reshape(len(self.gains.wrench_frames), 6, -1).sum(axis=1)
        self._load_noise += len(segment) / segment.rate * of_sensors

    @property
    def rows(self) -> CoordinateRows:
        """Accumulated rows in all unknowns."""
        if self._rows is None or self._rows.samples != self._lagged.rows.samples:
            self._rows = self._lagged.unshifted
        return self._rows

    @property
    def problem(self) -> GainProblem:
        """The estimation problem of the gains and delays."""
        problem = GainProblem.of(self.rows, self.parameters, self._body_std, self.gains)
        of_window = HANN / self._window / max(self._samples, 1)
        return replace(
            problem,
            lagged=self._lagged,
            load_noise=of_window * self._load_noise,
            effort_noise=of_window * self._effort_noise,
        )

    @property
    def _body_std(self) -> FloatArray:
        """(p,) deviations of inertias of which every moment is uniform within ±25 %.

        A centre of mass on an axis, as of a symmetrical trunk in a model file, may then be off by
        as much of the link's size.
        """
        links = self.parameters.link_phi(self.prior.mean)
        std = np.concatenate([body_std(phi, DEFAULT_PERCENT) for phi in links])
        return np.asarray(np.maximum(std, self.prior.std))

    @property
    def weight(self) -> float:
        """Weight of the model, N."""
        return float(np.linalg.norm(self.model.gravity) * self.model.phi[:, 0].sum())

    @property
    def loads(self) -> FloatArray:
        """Root mean square force (F,) of each wrench sensor, N."""
        return np.sqrt(self._force_square / max(self._samples, 1))

    @property
    def is_loaded(self) -> BoolArray:
        """Which of F wrench sensors carry enough load to be checked.

        The limit is relative to the sensors as well, because of wrong units.
        """
        largest = min(float(self.loads.max(initial=0.0)), self.weight)
        return np.asarray(self.loads > max(LEAST_LOAD * largest, LEAST_SHARE * self.weight))

    @property
    def mean_forces(self) -> FloatArray:
        """Mean force (F, 3) of each wrench sensor in its frame, N."""
        return self._force_sum / max(self._samples, 1)

    @property
    def carried(self) -> float:
        """RMS force of all wrench sensors of a floating robot together, N."""
        return float(np.sqrt(np.sum(self.rows.target_squares[3:6])))

    @property
    def scale_evidence(self) -> ScaleEvidence:
        """What tells a unit of the efforts from one of the model's masses."""
        joints = [self.model.joints[place] for place in self.gains.driven]
        shares = [one / joint.effort for one, joint in zip(self.efforts, joints, strict=True)]
        return ScaleEvidence(model_density(self.model.phi), max(shares, default=0.0))

    @property
    def effort_limits(self) -> dict[str, tuple[float, float]]:
        """RMS effort of each driven joint, and the model's limit, Nm or N."""
        joints = [self.model.joints[place] for place in self.gains.driven]
        return {
            joint.name: (effort, joint.effort)
            for joint, effort in zip(joints, self.efforts, strict=True)
        }

    @property
    def efforts(self) -> list[float]:
        """RMS efforts of the driven joints, Nm or N."""
        first = self.model.dof - len(self.model.joints)
        start = len(self.parameters.values) + self.gains.efforts.start
        return [
            float(np.sqrt(self.rows.column_squares(first + place, start + index)))
            for index, place in enumerate(self.gains.driven)
        ]

    @property
    def moving_shares(self) -> FloatArray:
        """Share of the time (d,) in which each driven joint moves."""
        first = self.model.dof - len(self.model.joints)
        columns = self.parameters.term_columns["coulomb"]
        found = np.zeros(len(self.model.joints))
        for column, joint in enumerate(self.parameters.joints.tolist(), start=columns.start):
            found[joint] = self.rows.column_squares(first + joint, column)
        return found[[*self.gains.driven]]

    @property
    def wrench_noise(self) -> tuple[float, float]:
        """White noise of the noisiest wrench sensor: of its torque, Nm, and of its force, N."""
        noise = np.sqrt(self._noise_square / max(self._samples, 1))
        torque, force = (float(part.max(initial=0.0)) for part in (noise[:, :3], noise[:, 3:]))
        return torque, force

    @property
    def mean_row(self) -> FloatArray:
        """Mean regressor (n, p): the information of a robot at rest."""
        return self._row_sum / max(self.rows.samples, 1)


def _downsample(segment: Segment) -> Segment:
    """Return a segment at the lower rate that is sufficient for the windows."""
    stride = int(segment.rate / RATE)
    if stride < 2:
        return segment
    low_pass = LowPass(PASSED * segment.rate / stride, passes=1)
    downsample = Decimator(segment.rate, stride, low_pass, low_pass.cutoff, 0).force
    starts = np.arange(0, len(segment), stride)
    stopped = segment.stopped
    return replace(
        segment,
        stamp=segment.stamp[::stride],
        stopped=None if stopped is None else np.logical_or.reduceat(stopped, starts),
        rate=segment.rate / stride,
        position=downsample(segment.position),
        effort=downsample(segment.effort),
        angular_velocity=downsample(segment.angular_velocity),
        linear_acceleration=downsample(segment.linear_acceleration),
        wrenches=downsample(segment.wrenches),
    )


def is_taken(block: int, dense: int) -> bool:
    """Return whether rows are built from a block, counted from 1: of all of the ``dense`` first."""
    return _taken_before(block + 1, dense) > _taken_before(block, dense)


def _taken_before(block: int, dense: int) -> int:
    return block if block <= dense else int(dense * (1 + math.log(block / dense)))
