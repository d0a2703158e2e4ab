"""Evidence about wrist force/torque sensors: their sign, and sensors that are not named."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError, ModelError
from symbid_ros.estimation.information import Information, stacked_factor
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import (
    reversed_sensor,
    sensor_names,
    with_wrist_sensors,
    without_wrist_sensors,
)

# Deviations of the mass beyond a sensor, below zero, that show that its sign is wrong.
DEVIATIONS = 5.0
# Share of a force's variance that a rigid body explains, from which the force is no contact.
RIGID = 0.9
# Least root mean square change of such a force, N, and least mass, kg.
LEAST_CHANGE, LEAST_MASS = 1.0, 0.1
FEWEST_SAMPLES = 50
MOST_SAMPLES = 2000


def reversed_sensors(rows: Information, parameters: ParameterSet) -> tuple[str, ...]:
    """Return the wrist sensors beyond which the mass would be negative, as ``FRAME:LINK``."""
    model = parameters.model
    found = []
    names = sensor_names(model)
    for name, (place, columns, masses) in zip(names, _sensor_columns(parameters), strict=True):
        forces = 6 * model.floating + np.arange(place.start + 3, place.stop)
        blocks = []
        for coordinate in forces.tolist():
            factor = rows.coordinate_factors[coordinate]
            block = np.zeros((len(factor), len(parameters) + 1))
            block[:, [*rows.layout.columns[coordinate], -1]] = factor
            blocks.append(block)
        stacked = np.concatenate(blocks)
        mass, std = _mass(stacked[:, columns], stacked[:, -1], masses, 3 * rows.samples)
        if mass < -DEVIATIONS * std:
            found.append(name)
    return tuple(found)


def check_signs(rows: Information, parameters: ParameterSet) -> None:
    """Check that the mass beyond each wrist sensor is not negative.

    Raises
    ------
    DataError
        When it is.
    """
    wrong = reversed_sensors(rows, parameters)
    if wrong:
        raise DataError(
            f"live topics: the mass beyond {wrong[0].removeprefix('-')} is negative, so the sign "
            f"of its wrench is wrong; restart with `wrist_sensor` {reversed_sensor(wrong[0])}",
            "E325",
        )


class PayloadEvidence:
    """Tells whether the force through a wrench sensor is that of a rigid body beyond it.

    Rows of the force are folded into a triangular factor, so that logs of any length fit.

    Parameters
    ----------
    model : RobotModel
    frame : str
        Frame of a sensor, named as a wrist sensor of the robot or not.

    Raises
    ------
    ModelError
        When no body can be fixed to the frame.
    """

    def __init__(self, model: RobotModel, frame: str) -> None:
        self.frame, self.is_named = frame, frame in model.wrist_sensors
        if self.is_named:
            self._model = model
        else:
            rigid = without_wrist_sensors(model)
            self._model = with_wrist_sensors(rigid, [f"{frame}:{_unused(rigid)}"])
        self._parameters = ParameterSet(self._model)
        places = list(self._model.wrist_sensors)
        columns = list(_sensor_columns(self._parameters))
        self._place, self._columns, self._masses = columns[places.index(frame)]
        joints = self._model.moving_joints
        self._recorded = [model.joint_names.index(self._model.joint_names[one]) for one in joints]
        self._factor = np.zeros((0, len(self._columns) + 1))
        self._samples = 0

    def add(self, samples: Samples) -> None:
        """Add readings of the robot that the evidence was made for."""
        if not len(samples):
            return
        rows = equation_of_motion(self._parameters, self._divided(samples))
        first = 6 * self._model.floating + self._place.start + 3
        forces = slice(first, first + 3)
        A = rows.K[:, forces][:, :, self._columns].reshape(-1, len(self._columns))
        block = np.column_stack([A, rows.y[:, forces].ravel()])
        self._factor = stacked_factor(self._factor, block)
        self._samples += len(samples)

    def mass(self) -> tuple[float, float]:
        """Return the mass beyond the sensor and its standard deviation, kg.

        It is negative if the sensor reads the force with the opposite sign.
        """
        A, y = self._factor[:, :-1], self._factor[:, -1]
        return _mass(A, y, self._masses, 3 * self._samples)

    @property
    def is_reversed(self) -> bool:
        """Whether the mass is negative beyond doubt."""
        if self._samples < FEWEST_SAMPLES:
            return False
        mass, std = self.mass()
        return mass < -DEVIATIONS * std

    @property
    def share(self) -> float:
        """Share of the force's variance that a rigid body explains; 0 if it hardly changes."""
        A, y = self._factor[:, :-1], self._factor[:, -1]
        change = _residual(A[:, -3:], y)  # about the offsets of the force
        if self._samples < FEWEST_SAMPLES or change < self._samples * LEAST_CHANGE**2:
            return 0.0
        return 1 - _residual(A, y) / change

    @property
    def is_payload(self) -> bool:
        """Whether a body fixed to the sensor explains the force."""
        if self.share <= RIGID:
            return False
        mass, std = self.mass()
        return abs(mass) > max(LEAST_MASS, DEVIATIONS * std)

    @property
    def sensor(self) -> str:
        """The frame, with a minus before it if the sensor reads the force on the body."""
        return f"-{self.frame}" if self.mass()[0] < 0 else self.frame

    @property
    def other_sign(self) -> str:
        """How to name the sensor, ``FRAME:LINK``, with the opposite sign."""
        names = dict(zip(self._model.wrist_sensors, sensor_names(self._model), strict=True))
        return reversed_sensor(names[self.frame])

    def _divided(self, samples: Samples) -> Samples:
        """Return samples of the robot that is divided at the sensor."""
        if self.is_named:
            return samples
        index = samples.wrench_frames.index(self.frame)
        others = [place for place in range(len(samples.wrench_frames)) if place != index]
        moving = list(self._model.moving_joints)

        def placed(values: FloatArray) -> FloatArray:
            columns = np.zeros((len(samples), len(self._model.joints)))
            columns[:, moving] = values[:, self._recorded]
            return columns

        effort = placed(np.zeros_like(samples.effort))
        # A joint's effort acts on what lies beyond it, a reading on what lies before.
        effort[:, self._place] = -samples.wrenches[:, index]
        return replace(
            samples,
            position=placed(samples.position),
            velocity=placed(samples.velocity),
            acceleration=placed(samples.acceleration),
            effort=effort,
            wrenches=samples.wrenches[:, others],
            wrench_frames=tuple(samples.wrench_frames[place] for place in others),
        )


def payload_evidence(model: RobotModel, frames: Sequence[str]) -> tuple[PayloadEvidence, ...]:
    """Return the evidence to collect about wrench sensors: named ones, and others of an arm.

    The feet of a floating base carry its weight, which looks like a payload's.
    """
    found = []
    for frame in frames:
        if model.floating and frame not in model.wrist_sensors:
            continue
        with suppress(ModelError):  # no body can be fixed there
            found.append(PayloadEvidence(model, frame))
    return tuple(found)


def unnamed_sensors(model: RobotModel, samples: Samples) -> Iterator[PayloadEvidence]:
    """Yield the wrench sensors of an arm whose force is that of a rigid body fixed to them.

    Parameters
    ----------
    model : RobotModel
    samples : Samples
        Motion and readings at some instants.
    """
    samples = samples[:: max(1, len(samples) // MOST_SAMPLES)]
    for evidence in payload_evidence(model, samples.wrench_frames):
        evidence.add(samples)
        if evidence.is_payload:
            yield evidence


def _sensor_columns(parameters: ParameterSet) -> Iterator[tuple[slice, IntArray, IntArray]]:
    """Yield the joints of each sensor, the columns that load it, and the masses among these."""
    model = parameters.model
    offset = parameters.sensor_offsets.start
    links = parameters.links.tolist()
    for place in model.wrist_sensors.values():
        beyond = [index for index, one in enumerate(links) if model.ancestors[place.start, one]]
        inertial = (10 * np.array(beyond)[:, None] + np.arange(10)).ravel()
        columns = np.concatenate([inertial, np.arange(offset, offset + 6)])
        yield place, columns, 10 * np.arange(len(beyond))
        offset += 6


def _mass(A: FloatArray, y: FloatArray, masses: IntArray, count: float) -> tuple[float, float]:
    """Return the sum of the masses in the least squares solution of A x = y, and its deviation.

    ``count`` is the number of rows of which A and y may be a triangular factor.
    """
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    kept = s > 1e-6 * s.max(initial=0.0)
    inverse = Vt[kept].T / s[kept]
    x = inverse @ (U[:, kept].T @ y)
    left = float(np.sum((y - A @ x) ** 2))
    std = np.linalg.norm(inverse[masses].sum(axis=0)) * np.sqrt(left / max(count, 1.0))
    return float(x[masses].sum()), float(std)


def _residual(A: FloatArray, y: FloatArray) -> float:
    x, *_ = np.linalg.lstsq(A, y, rcond=1e-6)
    return float(np.sum((y - A @ x) ** 2))


def _unused(model: RobotModel) -> str:
    names = {*model.link_names, *(frame.name for frame in model.frames)}
    name = "payload"
    while name in names:
        name += "_"
    return name
