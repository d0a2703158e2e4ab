"""Payloads behind wrist sensors in the form that robot controllers ask for, with deviations."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import PARAMETERS, com_from_phi
from symbid_ros.report.formatting import with_std

_UPPER = np.triu_indices(3)
_STEP = 1e-6  # of a finite difference, relative to each parameter


@dataclass(frozen=True)
class Payload:
    """What a wrist sensor carries.

    Attributes
    ----------
    sensor, link : str
        Frame of the sensor, and link whose axes the numbers use.
    rows : tuple of (str, str, str)
        Quantity, value with its standard deviation, and unit.
    """

    sensor: str
    link: str
    rows: tuple[tuple[str, str, str], ...]


def payloads(estimate: Estimate, deviations: FloatArray | None) -> tuple[Payload, ...]:
    """Return the payload behind each wrist sensor.

    Parameters
    ----------
    estimate : Estimate
    deviations : (p, r) float64 or None
        L of the covariance L Lᵀ of its parameters; None if there is none.
    """
    found = []
    for sensor in estimate.wrist_sensors:
        frame, _, link = sensor.removeprefix("-").partition(":")
        first = estimate.names.index(f"{link}/{PARAMETERS[0]}")
        own = slice(first, first + len(PARAMETERS))
        phi = estimate.value[own]
        if phi[0] <= 0:
            continue
        std = np.zeros(len(PARAMETERS))
        if deviations is not None:
            std = np.linalg.norm(_jacobian(phi) @ deviations[own], axis=1)
        rows = [
            (name, with_std(float(factor * value), float(factor * each)).replace("-", "−"), unit)
            for (name, factor, unit), value, each in zip(
                _quantities(), _controller_form(phi), std, strict=True
            )
        ]
        found.append(Payload(frame, link, tuple(rows)))
    return tuple(found)


def _quantities() -> list[tuple[str, float, str]]:
    """Return the name of each number, its factor and its unit."""
    axes = zip(*_UPPER, strict=True)
    return [
        ("mass", 1.0, "kg"),
        *((f"centre of mass {axis}", 1e3, "mm") for axis in "xyz"),
        *((f"inertia {'xyz'[row]}{'xyz'[column]}", 1.0, "kg m²") for row, column in axes),
    ]


def _controller_form(phi: FloatArray) -> FloatArray:
    """Return mass, centre of mass and inertia about it (10,) for parameters (10,)."""
    mass, com, inertia = com_from_phi(phi)
    return np.concatenate([[mass], com, inertia[_UPPER]])


def _jacobian(phi: FloatArray) -> FloatArray:
    """Return the derivatives (10, 10) of the controller's form by the parameters."""
    steps = np.diag(_STEP * np.maximum(np.abs(phi), 1e-3 * phi[0]))
    return np.stack(
        [
            (_controller_form(phi + step) - _controller_form(phi - step)) / (2 * step.sum())
            for step in steps
        ],
        axis=1,
    )
