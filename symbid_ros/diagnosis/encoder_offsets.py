"""Offsets of encoders that gravity and motion show, under a model with uncertain inertias.

A wrong zero of a joint turns everything that the joint carries, and the gravity on it. Inertias
that are off by a quarter change its load differently. An offset of a joint whose axis is vertical
on a fixed base changes nothing and is not found.
"""

from collections.abc import Iterator

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.gain_problem import (
    PINNED,
    UNMODELLED,
    GainEstimate,
    GainProblem,
    estimate_of,
)
from symbid_ros.diagnosis.gains import select_nonzero

# Prior standard deviations of an offset, rad, of a gain, and of a delay, s.
OFFSET_STD, GAIN_STD, DELAY_STD = 0.3, 0.05, 0.01
# Smaller offsets, rad, are errors of calibration, which `sensor_errors` identifies.
SMALLEST = np.radians(3.0)
DEVIATIONS = 5.0
TURNS = 2


def estimate_offsets(problem: GainProblem, left: FloatArray) -> GainEstimate:
    """Return the most probable offsets of encoders, with gains close to one.

    Rows are weighted as for the gains, but ten count as one, because friction that is not modelled
    varies as slowly as the motion.

    Parameters
    ----------
    problem : GainProblem
    left : (n,) float64
        Mean square residual of each coordinate to start with.
    """
    rows, gains = problem.rows, problem.gains
    std = np.select(
        [gains.is_encoder, gains.is_delay, gains.is_imu], [OFFSET_STD, DELAY_STD, PINNED], GAIN_STD
    )
    floor = problem.floor
    for _ in range(TURNS):
        at, deviation = problem.solve(std, UNMODELLED * (left + floor))
        left = rows.residual_squares(at)
    return estimate_of(problem, at, deviation, left)


def offset_findings(
    topic: str, names: tuple[str, ...], estimate: GainEstimate
) -> Iterator[Finding]:
    """Yield a finding for each joint whose zero is wrong.

    Parameters
    ----------
    topic : str
        Topic of the joint states.
    names : tuple of str
        Names of the model's joints.
    estimate : GainEstimate
        By :func:`estimate_offsets`.
    """
    gains = estimate.sensors
    found = select_nonzero(estimate, gains.is_encoder)
    for index, joint in enumerate(gains.measured):
        offset, std = found.get(gains.encoders.start + index, (0.0, 0.0))
        if abs(offset) <= max(SMALLEST, DEVIATIONS * std):
            continue
        degrees, deviation = np.degrees([offset, std]).tolist()
        yield Finding.of(
            topic,
            Kind.ENCODER_OFFSET,
            f"position of {names[joint]} reads {abs(degrees):.0f} ± {deviation:.1g} degrees too "
            f"{'much' if degrees > 0 else 'little'} according to the efforts; correct the joint's "
            "zero in the driver, or its origin in the model",
            {"offset_deg": degrees, "offset_std_deg": deviation},
            Severity.WARNING,
        )
