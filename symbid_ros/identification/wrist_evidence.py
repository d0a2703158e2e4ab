"""Evidence about wrist force/torque sensors: their sign, and sensors that are not named."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.regressor import Samples, equation_of_motion
from symbid_ros.errors import DataError, ModelError
from symbid_ros.estimation.information import Information
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import reversed_sensor, sensor_names, with_wrist_sensors

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
            factor = rows.coordinate_factor(coordinate)
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


def unnamed_sensors(model: RobotModel, samples: Samples) -> Iterator[tuple[str, float, float]]:
    """Yield wrench frames whose force is that of a rigid body fixed to them.

    Parameters
    ----------
    model : RobotModel
        Robot whose base is fixed.
    samples : Samples
        Motion and readings at some instants.

    Yields
    ------
    frame : str
        With a minus before it if the sensor reads the force of the robot on the body.
    mass : float
        Of the body, kg.
    share : float
        Of the force's variance that the body explains.
    """
    samples = samples[:: max(1, len(samples) // MOST_SAMPLES)]
    if model.floating or len(samples) < FEWEST_SAMPLES:
        return
    for index, frame in enumerate(samples.wrench_frames):
        force = samples.wrenches[:, index, 3:]
        change = force - force.mean(axis=0)
        size = float(np.sum(change**2))
        if size < len(force) * LEAST_CHANGE**2:
            continue
        try:
            divided = with_wrist_sensors(model, [f"{frame}:{_unused(model)}"])
        except ModelError:
            continue
        parameters = ParameterSet(divided)
        ((place, columns, masses),) = _sensor_columns(parameters)
        rows = equation_of_motion(parameters, _in_columns_of(divided, model, samples))
        A = rows.K[:, place.start + 3 : place.stop][:, :, columns].reshape(-1, len(columns))
        mass, std = _mass(A, -force.ravel(), masses, force.size)
        left = _residual(A, -force.ravel())
        share = 1 - left / size
        if share > RIGID and abs(mass) > max(LEAST_MASS, DEVIATIONS * std):
            yield (frame if mass > 0 else f"-{frame}"), abs(mass), share


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


def _in_columns_of(divided: RobotModel, model: RobotModel, samples: Samples) -> Samples:
    """Return samples of the robot with a sensor from those of the same robot without."""
    joints = [divided.joint_names.index(name) for name in model.joint_names]
    empty = np.zeros((len(samples), len(divided.joints)))

    def placed(values: FloatArray) -> FloatArray:
        columns = empty.copy()
        columns[:, joints] = values
        return columns

    return replace(
        samples,
        position=placed(samples.position),
        velocity=placed(samples.velocity),
        acceleration=placed(samples.acceleration),
        effort=empty,
        wrenches=np.zeros((len(samples), 0, 6)),
        wrench_frames=(),
    )
