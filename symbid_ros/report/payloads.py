"""Payloads behind wrist sensors in the form that robot controllers ask for, with deviations."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import PARAMETERS, com_from_phi, transform_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import links_beyond
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
    note : str
        Which links that move beyond the sensor are included, such as fingers; empty if none.
    """

    sensor: str
    link: str
    rows: tuple[tuple[str, str, str], ...]
    note: str = ""


def payloads(
    estimate: Estimate,
    deviations: FloatArray | None,
    parameters: ParameterSet | None = None,
    posture: FloatArray | None = None,
) -> tuple[Payload, ...]:
    """Return the payload behind each wrist sensor.

    Parameters
    ----------
    estimate : Estimate
    deviations : (p, r) float64 or None
        L of the covariance L Lᵀ of its parameters; None if there is none.
    parameters : ParameterSet, optional
        The same parameters; without them, links that move beyond the sensor are left out.
    posture : (J,) float64, optional
        Joint positions at which these are, rad or m; by default zeros.
    """
    found = []
    for sensor in estimate.wrist_sensors:
        frame, _, link = sensor.removeprefix("-").partition(":")
        first = estimate.names.index(f"{link}/{PARAMETERS[0]}")
        sums = np.zeros((len(PARAMETERS), len(estimate.names)))
        sums[:, first : first + len(PARAMETERS)] = np.eye(len(PARAMETERS))
        note = ""
        if parameters is not None:
            moving = _add_moving_links(sums, parameters, frame, posture)
            place = "at zero" if posture is None else "at the mean position in the log"
            note = f"It includes {', '.join(moving)} {place}." if moving else ""
        phi = sums @ estimate.value
        if phi[0] <= 0:
            continue
        std = np.zeros(len(PARAMETERS))
        if deviations is not None:
            std = np.linalg.norm(_jacobian(phi) @ sums @ deviations, axis=1)
        rows = [
            (name, with_std(float(factor * value), float(factor * each)).replace("-", "−"), unit)
            for (name, factor, unit), value, each in zip(
                _quantities(), _controller_form(phi), std, strict=True
            )
        ]
        found.append(Payload(frame, link, tuple(rows), note))
    return tuple(found)


def _add_moving_links(
    sums: FloatArray, parameters: ParameterSet, frame: str, posture: FloatArray | None
) -> tuple[str, ...]:
    """Add the links that move beyond a sensor to the sums (10, p) of its payload; return them."""
    model = parameters.model
    own, *moving = links_beyond(model, frame)
    position = np.zeros(len(model.joints)) if posture is None else posture
    poses = link_poses(model, model.apply_mimics(position[None]))
    rotation, place = poses.rotation[0], poses.position[0]
    column = {int(link): 10 * index for index, link in enumerate(parameters.links)}
    for link in (one for one in moving if one in column):
        turn, shift = rotation[own].T @ rotation[link], rotation[own].T @ (place[link] - place[own])
        sums[:, column[link] : column[link] + 10] = np.stack(
            [transform_phi(unit, turn, shift) for unit in np.eye(10)], axis=1
        )
    return tuple(model.link_names[link] for link in moving)


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
