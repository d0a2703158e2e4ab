"""A robot with wrist sensors as one whose sensors are rigid, for comparisons with the truth."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.model.coupling import couplings_in
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.ripple import ripples_in
from symbid_ros.model.warming import warming_in
from symbid_ros.model.wrist_sensors import without_wrist_sensors


@dataclass(frozen=True)
class RigidSensors:
    """Parameters of a robot without the joints of its wrist sensors.

    Attributes
    ----------
    parameters : ParameterSet
        The q parameters of the robot whose links on both sides of a sensor are one.
    matrix : (q, p) float64
        Maps the p parameters of the robot with sensors to these; offsets are left out.
    """

    parameters: ParameterSet
    matrix: FloatArray

    @classmethod
    def of(cls, parameters: ParameterSet) -> "RigidSensors":
        """Return the parameters of the same robot without wrist sensors."""
        model = parameters.model
        if not model.wrist_sensors:
            return cls(parameters, np.eye(len(parameters)))
        rigid = without_wrist_sensors(model)
        side = {model.joint_names[joint] for joint in parameters.link_side}
        names = parameters.names
        found = replace(
            parameters,
            model=rigid,
            couplings=couplings_in(names, rigid) if parameters.couplings else (),
            ripples=ripples_in(names, rigid),
            warming=warming_in(names, rigid, parameters.courses),
            link_side=tuple(i for i, name in enumerate(rigid.joint_names) if name in side),
            reference=None,
        )
        matrix = np.zeros((len(found), len(parameters)))
        for column in range(parameters.inertial):
            unit = np.zeros((len(parameters.links), 10))
            unit.flat[column] = 1.0
            phi = np.zeros((len(model.links), 10))
            phi[parameters.links] = unit
            merged = without_wrist_sensors(model.with_phi(phi)).phi[found.links]
            matrix[: found.inertial, column] = merged.ravel()
        for row, name in enumerate(found.names[found.inertial :], found.inertial):
            matrix[row, names.index(name)] = 1.0
        if parameters.reference is not None:
            inertial = matrix[: found.inertial, : parameters.inertial]
            found = replace(found, reference=inertial @ parameters.reference)
        return cls(found, matrix)
