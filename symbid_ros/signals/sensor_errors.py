"""Calibration errors of the sensors as unknowns of the equation of motion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SENSOR_ERROR_KINDS
from symbid_ros.dynamics.placements import displaced
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sensor_samples import SensorSamples

# Typical calibration errors: standard deviations per component.
DEVIATIONS = {
    "wrench_offset": (0.2,) * 3 + (2.0,) * 3,  # Nm, N
    "wrench_gain": (0.006,) * 6,
    "wrench_position": (0.0015,) * 3,  # m
    "torque_gain": (0.016,),
    "imu_mounting": (np.radians(0.15),) * 3,
    "imu_bias": (0.002,) * 3 + (0.02,) * 3,  # rad/s, m/s²
    "encoder_offset": (np.radians(0.11),),
    "compliance": (1e-4,),  # rad/Nm; logs replace it by one in proportion to the efforts
    "sensor_delay": (0.005,),  # s
    # Uniform errors of up to 2 mm and 0.3 degrees.
    "link_length": (0.0012,) * 3,  # m
    "joint_axis": (np.radians(0.17),) * 3,
    "frame_pose": (np.radians(0.17),) * 3,  # of wrench sensors; IMUs have that of wrench_position
    "drive_gain": (1.0,),  # relative to the first guess
    "payload_place": (0.1,) * 3,  # m
}
UNITS = {
    "wrench_offset": ("Nm",) * 3 + ("N",) * 3,
    "wrench_gain": ("1",) * 6,
    "wrench_position": ("m",) * 3,
    "torque_gain": ("1",),
    "imu_mounting": ("rad",) * 3,
    "imu_bias": ("rad/s",) * 3 + ("m/s^2",) * 3,
    "encoder_offset": ("rad",),
    "compliance": ("rad/Nm",),
    "sensor_delay": ("s",),
    "link_length": ("m",) * 3,
    "joint_axis": ("rad",) * 3,
    "frame_pose": ("rad",) * 3,
    "drive_gain": ("1",),
    "payload_place": ("m",) * 3,
}
DRIVE_GAIN, COMPLIANCE, DELAY = "drive_gain", "compliance", "sensor_delay"
IMU_BIAS = "imu_bias"
PLACE = "payload_place"
LENGTH, AXIS, FRAME = "link_length", "joint_axis", "frame_pose"
# Owner of the delay of all efforts.
EFFORTS = "efforts"
KINDS = SENSOR_ERROR_KINDS
ALL_KINDS = (*KINDS, DRIVE_GAIN, PLACE)

_AXES = {1: ("",), 3: ("_x", "_y", "_z")}
_PAIRS = {
    "wrench_offset": ("moment", "force"),
    "wrench_gain": ("moment", "force"),
    "imu_bias": ("gyroscope", "accelerometer"),
}


@dataclass(frozen=True)
class SensorErrors:
    """Order of the unknown errors of a log's sensors.

    Attributes
    ----------
    kinds : tuple of str
        Subset of :data:`KINDS`.
    wrench_frames, imu_frames : tuple of str
        Frames of the sensors.
    joints : tuple of str
        All joints, in the model's order.
    driven : (J,) bool
        Joints whose torque is measured.
    gained : tuple of str
        Joints whose efforts have an unknown unit: torque = factor × effort.
    payloads : tuple of str
        Names of the payloads whose places are unknown.
    wrist_sensors : mapping of str to slice
        Indices of the joints of each wrist sensor, by its frame.
    """

    kinds: tuple[str, ...]
    wrench_frames: tuple[str, ...]
    imu_frames: tuple[str, ...]
    joints: tuple[str, ...]
    driven: BoolArray
    gained: tuple[str, ...] = ()
    payloads: tuple[str, ...] = ()
    wrist_sensors: Mapping[str, slice] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        kinds: Sequence[str],
        model: RobotModel,
        wrench_frames: tuple[str, ...],
        imu_frames: tuple[str, ...],
        gained: tuple[str, ...] = (),
        *,
        payloads: tuple[str, ...] = (),
    ) -> "SensorErrors":
        """Return the unknowns of the sensors that a log has."""
        return cls(
            tuple(kind for kind in ALL_KINDS if kind in kinds),
            wrench_frames,
            imu_frames if model.floating else (),
            model.joint_names,
            np.array([joint.effort > 0 for joint in model.joints], dtype=bool),
            gained,
            payloads,
            model.wrist_sensors,
        )

    def _owners(self, kind: str) -> tuple[str, ...]:
        if kind.startswith("wrench"):
            return self.wrench_frames
        if kind.startswith("imu"):
            return self.imu_frames
        if kind == DELAY:
            efforts = (EFFORTS,) if self.driven.any() else ()
            return (*self.imu_frames, *self.wrench_frames, *self.wrist_sensors, *efforts)
        if kind == FRAME:
            return (*self.wrench_frames, *self.imu_frames)
        if kind == "torque_gain":
            return tuple(name for name, used in zip(self.joints, self.driven, strict=True) if used)
        return {DRIVE_GAIN: self.gained, PLACE: self.payloads}.get(kind, self.joints)

    def _meaning(self, kind: str, owner: str) -> str:
        """Return the kind whose deviations and units an error has.

        Of a frame's pose only that half is an unknown which is no kind by itself: rotations of
        wrench sensors, and positions of IMUs.
        """
        return "wrench_position" if kind == FRAME and owner in self.imu_frames else kind

    @cached_property
    def places(self) -> dict[str, slice]:
        """Indices of each kind's unknowns in θ."""
        ends = np.cumsum([len(DEVIATIONS[k]) * len(self._owners(k)) for k in self.kinds]).tolist()
        return {
            kind: slice(end - len(DEVIATIONS[kind]) * len(self._owners(kind)), end)
            for kind, end in zip(self.kinds, ends, strict=True)
        }

    @cached_property
    def names(self) -> tuple[str, ...]:
        """``<frame or joint>/<kind>[_<channel>]`` of the r unknowns."""
        return tuple(
            f"{owner}/{name}"
            for kind in self.kinds
            for owner in self._owners(kind)
            for name in _component_names(kind)
        )

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI unit of each unknown."""
        return tuple(
            unit
            for kind in self.kinds
            for owner in self._owners(kind)
            for unit in UNITS[self._meaning(kind, owner)]
        )

    @cached_property
    def std(self) -> FloatArray:
        """(r,) prior standard deviations."""
        return np.array(
            [
                std
                for kind in self.kinds
                for owner in self._owners(kind)
                for std in DEVIATIONS[self._meaning(kind, owner)]
            ]
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def groups(self) -> Iterator[tuple[str, str, slice]]:
        """Each sensor, kind of its error, and indices in θ of the error's components."""
        for kind, place in self.places.items():
            size = len(DEVIATIONS[kind])
            for index, owner in enumerate(self._owners(kind)):
                start = place.start + size * index
                yield owner, kind, slice(start, start + size)

    @property
    def gained_joints(self) -> list[int]:
        """Indices of the joints whose efforts have an unknown unit."""
        return [self.joints.index(name) for name in self.gained]

    def of_kind(self, kind: str, theta: FloatArray) -> FloatArray:
        """Return one kind's errors (owners, components) from θ (r,); zero if not estimated."""
        shape = (len(self._owners(kind)), len(DEVIATIONS[kind]))
        values = theta[self.places[kind]] if kind in self.kinds else np.zeros(shape)
        return values.reshape(shape)

    def structure(self, model: RobotModel) -> BoolArray:
        """Return which coordinates (n, r) each unknown affects."""
        first = 6 * model.floating
        affects = np.ones((model.dof, len(self)), dtype=bool)
        if model.contacts is not None:  # rows combine all coordinates that feel a contact
            return affects
        for kind, place in self.places.items():
            size = len(DEVIATIONS[kind])
            for index, owner in enumerate(self._owners(kind)):
                columns = slice(place.start + size * index, place.start + size * (index + 1))
                if kind.startswith("wrench") or (
                    kind in (DELAY, FRAME) and owner in self.wrench_frames
                ):
                    carried = model.ancestors[:, model.loaded_link(owner)]
                    affects[first:, columns] = carried[:, None]
                elif kind in ("torque_gain", DRIVE_GAIN):
                    affects[:, columns] = False
                    affects[first + self.joints.index(owner), columns] = True
                elif kind == DELAY and owner == EFFORTS:
                    affects[:, columns] = False
                    affects[first + np.flatnonzero(self.driven), columns] = True
                elif kind == DELAY and owner in self.wrist_sensors:
                    own = self.wrist_sensors[owner]
                    affects[:, columns] = False
                    affects[first + own.start : first + own.stop, columns] = True
        return affects

    def placed(self, parameters: ParameterSet, theta: FloatArray) -> ParameterSet:
        """Return the parameters of the robot whose joints and payloads are displaced by θ (r,)."""
        if PLACE in self.kinds:
            place = dict(zip(self.payloads, self.of_kind(PLACE, theta), strict=True))
            moved = [
                one if one.frame is None else one.moved(place[one.name])
                for one in parameters.payloads
            ]
            parameters = replace(parameters, payloads=tuple(moved))
        screws = np.zeros((len(self.joints), 6))
        screws[:, 3:] = self.of_kind(LENGTH, theta)
        screws[:, :3] = _across_axes(parameters.model, self.of_kind(AXIS, theta))
        if not screws.any():
            return parameters
        return replace(parameters, model=displaced(parameters.model, screws))

    def fill_placements(
        self, columns: FloatArray, by_screws: FloatArray, model: RobotModel, theta: FloatArray
    ) -> None:
        """Fill the columns (N, m, r) of joints' placements, from derivatives by their screws.

        Parameters
        ----------
        columns : (N, m, r) float64
        by_screws : (N, m, J, 6) float64
            Derivatives by screws of the displaced joints, as :func:`displacement_columns`.
        model : RobotModel
            Without displacements.
        theta : (r,) float64
        """
        shape = (*columns.shape[:2], -1)
        if LENGTH in self.kinds:
            columns[:, :, self.places[LENGTH]] = by_screws[..., 3:].reshape(shape)
        if AXIS in self.kinds:
            turns = _across_axes(model, self.of_kind(AXIS, theta))
            slopes = left_jacobian(turns) @ _axis_complements(model)
            turned = (by_screws[..., None, :3] @ slopes)[..., 0, :]
            columns[:, :, self.places[AXIS]] = turned.reshape(shape)

    def fill_payloads(
        self, columns: FloatArray, K: FloatArray, placed: ParameterSet, stamp: IntArray
    ) -> None:
        """Fill the columns (N, n, r) of payloads' places, from K (N, n, p) of the placed robot."""
        for payload in placed.payloads:
            if payload.frame is None:
                continue
            first = 10 * int(np.searchsorted(placed.links, payload.link))
            start = self.places[PLACE].start + 3 * self.payloads.index(payload.name)
            slope = K[:, :, first : first + 10] @ payload.place_slope()
            carried = payload.is_carried(stamp)[:, None, None]
            columns[:, :, start : start + 3] -= carried * slope

    def realigned(self, readings: SensorSamples, theta: FloatArray) -> SensorSamples:
        """Return the samples without the delays of θ (r,) relative to the joints' positions."""
        delays = self.of_kind(DELAY, theta)[:, 0]
        if not delays.any():
            return readings
        imus, wrenches = len(self.imu_frames), len(self.wrench_frames)

        def moved(values: FloatArray, late: FloatArray) -> FloatArray:
            each = [_advanced(values[:, i], readings.stamp, one) for i, one in enumerate(late)]
            return np.stack(each, axis=1) if each else values

        realigned = replace(
            readings, wrenches=moved(readings.wrenches, delays[imus : imus + wrenches])
        )
        # The readings of a wrist sensor are the efforts of its joints.
        late = np.full(len(self.joints), delays[-1] if self.driven.any() else 0.0)
        for delay, own in zip(delays[imus + wrenches :], self.wrist_sensors.values(), strict=False):
            late[own] = delay
        effort = readings.effort.copy()
        for one in np.unique(late).tolist():
            effort[:, late == one] = _advanced(effort[:, late == one], readings.stamp, one)
        realigned = replace(realigned, effort=effort)
        if not imus:
            return realigned
        return replace(
            realigned,
            angular_velocity=moved(readings.angular_velocity, delays[:imus]),
            angular_acceleration=moved(readings.angular_acceleration, delays[:imus]),
            specific_force=moved(readings.specific_force, delays[:imus]),
        )

    def corrected(self, readings: SensorSamples, theta: FloatArray) -> SensorSamples:
        """Return the samples corrected for the errors θ (r,)."""
        readings = self.realigned(readings, theta)
        gain = np.zeros(len(self.joints))
        gain[self.driven] = self.of_kind("torque_gain", theta)[:, 0]
        factor = np.ones(len(self.joints))
        if DRIVE_GAIN in self.kinds:
            factor[self.gained_joints] = theta[self.places[DRIVE_GAIN]]
        wrenches = (readings.wrenches - self.of_kind("wrench_offset", theta)) / (
            1 + self.of_kind("wrench_gain", theta)
        )
        wrenches[:, :, :3] += np.cross(self.of_kind("wrench_position", theta), wrenches[:, :, 3:])
        frames = self.of_kind(FRAME, theta)
        if frames.any():
            plates = Rotation.from_rotvec(frames[: len(self.wrench_frames)]).as_matrix()
            pairs = wrenches.reshape(*wrenches.shape[:2], 2, 3)
            wrenches = np.einsum("fij,nfkj->nfki", plates, pairs).reshape(wrenches.shape)
        mounting, bias = self.of_kind("imu_mounting", theta), self.of_kind(IMU_BIAS, theta)
        readings = _behind_gears(readings, self.of_kind(COMPLIANCE, theta)[:, 0])
        corrected = replace(
            readings,
            position=readings.position - self.of_kind("encoder_offset", theta)[:, 0],
            effort=factor * readings.effort / (1 + gain),
            wrenches=wrenches,
        )
        if not self.imu_frames:
            return corrected
        turns = Rotation.from_rotvec(mounting).as_matrix()

        def in_frame(vectors: FloatArray) -> FloatArray:
            rotated = [vectors[:, imu] @ turn.T for imu, turn in enumerate(turns)]
            return np.stack(rotated, axis=1)

        omega = in_frame(readings.angular_velocity - bias[:, :3])
        alpha = in_frame(readings.angular_acceleration)
        force = in_frame(readings.specific_force - bias[:, 3:])
        if frames.any():
            lever = np.broadcast_to(frames[len(self.wrench_frames) :], omega.shape)
            force -= np.cross(alpha, lever) + np.cross(omega, np.cross(omega, lever))
        return replace(
            corrected, angular_velocity=omega, angular_acceleration=alpha, specific_force=force
        )


def _behind_gears(readings: SensorSamples, compliance: FloatArray) -> SensorSamples:
    """Return the motion behind gears that bend under the efforts, from that of the motors.

    With compliance c (J,) and effort τ a link's position is q - cτ, and its rates are the
    derivatives (Spong 1987, Modeling and control of elastic joint robots, ASME J. Dyn. Syst. Meas.
    Control 109).
    """
    if not compliance.any():
        return readings
    deflection = compliance * np.nan_to_num(readings.effort)
    rates, time = [deflection], 1e-9 * (readings.stamp - readings.stamp[0])
    for _ in range(2):
        last = rates[-1]
        rates.append(np.gradient(last, time, axis=0) if len(time) > 1 else np.zeros_like(last))
    return replace(
        readings,
        position=readings.position - rates[0],
        velocity=readings.velocity - rates[1],
        acceleration=readings.acceleration - rates[2],
    )


def _advanced(values: FloatArray, stamp: IntArray, delay: float) -> FloatArray:
    """Return what a late sensor reports ``delay`` later, so that its readings are in time.

    A cubic polynomial through four neighbours interpolates uniform samples (Lagrange), which are
    low-passed, so that it is exact for practical purposes. The first and last values are repeated.

    Parameters
    ----------
    values : (N, ...) float64
        NaN affects its neighbours only.
    stamp : (N,) int64
        Nanoseconds, nearly uniform.
    delay : float
        Seconds; negative if the sensor's stamps are late.
    """
    count = len(values)
    if delay == 0 or count < 2:
        return values
    time = 1e-9 * (stamp - stamp[0])
    place = np.interp(time + delay, time, np.arange(count))
    width = min(4, count)
    first = np.clip(np.floor(place).astype(np.int64) + 1 - width // 2, 0, count - width)
    place -= first
    weights = np.ones((count, width))
    for one in range(width):
        for other in range(width):
            if one != other:
                weights[:, one] *= (place - other) / (one - other)
    realigned: FloatArray = np.einsum(
        "nk,nk...->n...", weights, values[first[:, None] + np.arange(width)]
    )
    return realigned


def _component_names(kind: str) -> tuple[str, ...]:
    if kind in _PAIRS:
        return tuple(f"{kind}_{part}{axis}" for part in _PAIRS[kind] for axis in _AXES[3])
    return tuple(f"{kind}{axis}" for axis in _AXES[len(DEVIATIONS[kind])])


def _axis_complements(model: RobotModel) -> FloatArray:
    """Return the projections (J, 3, 3) onto the plane across each joint's axis, parent's axes."""
    axes = np.array([joint.rotation @ joint.axis for joint in model.joints]).reshape(-1, 3)
    complements: FloatArray = np.eye(3) - axes[:, :, None] * axes[:, None]
    return complements


def _across_axes(model: RobotModel, turns: FloatArray) -> FloatArray:
    """Return rotation vectors (J, 3) without their parts about the joints' axes.

    A rotation about a joint's axis is its encoder's offset.
    """
    across: FloatArray = (_axis_complements(model) @ turns[:, :, None])[..., 0]
    return across


def left_jacobian(turns: FloatArray) -> FloatArray:
    """Return the rotation (..., 3, 3) of exp(ρ) per change of small ρ (..., 3), to second order."""
    cross = np.cross(turns[..., None, :], np.eye(3)).swapaxes(-1, -2)
    jacobian: FloatArray = np.eye(3) + cross / 2 + cross @ cross / 6
    return jacobian
