"""Sensor errors identified along with the robot, and the tare that makes that possible."""

import logging
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import PseudoMeasurements, posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.dataset import Dataset, observe
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log
from symbid_ros.signals.noise_floor import FORCES, MOTION
from symbid_ros.signals.sensor_errors import LinearizationPoint, SensorErrors, calibrating_rows
from symbid_ros.signals.weak_form import ALL_WINDOWS, RowBuilder, suited_windows

logger = logging.getLogger(__name__)

# A sensor that reads more than this in a tare carries something.
UNLOADED = 20.0  # N

# One pass with the pilot at the prior, then Gauss-Newton.
PASSES = 3
# A pilot need not be exact.
PILOT_SETTLED = 1e-2


@dataclass(frozen=True)
class Tare:
    """What an unloaded wrench sensor reads.

    Attributes
    ----------
    mean, std : (6,) float64
        Moment and force, and how well their means are known, Nm and N.
    """

    mean: FloatArray
    std: FloatArray


def read_tare(log: Log) -> dict[str, Tare]:
    """Return, by frame, what the unloaded wrench sensors of a log read.

    Raises
    ------
    DataError
        When every one of them carries something, or a reading is not finite.
    """
    streams = log.streams()
    tares = {}
    for wrench in streams.wrenches:
        readings = np.concatenate([wrench.torque, wrench.force], axis=1)
        if not np.all(np.isfinite(readings)):
            raise DataError(f"{streams.source}: {wrench.topic} has a reading that is not finite")
        mean = readings.mean(axis=0)
        if np.linalg.norm(mean[3:]) > UNLOADED:
            logger.warning(
                "%s: %s reads %.0f N and is not unloaded: not tared",
                streams.source,
                wrench.topic,
                np.linalg.norm(mean[3:]),
            )
            continue
        std = readings.std(axis=0) / np.sqrt(len(readings))
        # Rounding to a sensor's step can hide all noise; the step is not known.
        tares[wrench.frame_id] = Tare(mean, np.maximum(std, 1e-4))
    if not tares:
        raise DataError(
            f"{streams.source}: no wrench sensor here is unloaded, so none can be tared; record "
            "their topics with nothing touching them"
        )
    return tares


@dataclass(frozen=True)
class Wanted:
    """Which sensor errors are to be unknowns.

    Attributes
    ----------
    kinds : tuple of str
        Of :data:`symbid_ros.signals.sensor_errors.KINDS`.
    tares : dict of str to Tare
        What is known of wrench sensors, by frame.
    """

    kinds: tuple[str, ...]
    tares: dict[str, Tare]


@dataclass(frozen=True)
class Calibrated:
    """A log's rows with its sensors' errors as unknowns.

    Attributes
    ----------
    errors : SensorErrors
        What the columns after the robot's are.
    prior : Prior
        Of the robot's parameters and the sensors' errors.
    observations : tuple of Observations
        About the last pilot.
    pseudo_measurements : PseudoMeasurements or None
        Weighing and symmetry, for all these unknowns.
    rows : RowBuilder
        Builds the rows of all these unknowns, about the last pilot.
    """

    errors: SensorErrors
    prior: Prior
    observations: tuple[Observations, ...]
    pseudo_measurements: PseudoMeasurements | None
    rows: RowBuilder


def calibrate(
    record: Dataset,
    parameters: ParameterSet,
    prior: Prior,
    wanted: "Wanted",
    pseudo_measurements: PseudoMeasurements | None,
) -> Calibrated:
    """Make the errors of a log's sensors unknowns, linearised about the best estimate.

    Parameters
    ----------
    record : Dataset
        The log.
    parameters : ParameterSet
        The robot's p parameters.
    prior : Prior
        Of these.
    wanted : Wanted
        Which errors, and what is known of them.
    pseudo_measurements : PseudoMeasurements, optional
        Weighing and symmetry of the robot.
    """
    segment = next(iter(record.segments))
    errors = SensorErrors.of(
        wanted.kinds, parameters.model, segment.wrench_frames, segment.imu_frames
    )
    mean, std = np.zeros(len(errors)), errors.std.copy()
    if "plate_offset" in errors.kinds:
        place = errors.places["plate_offset"]
        for index, frame in enumerate(errors.wrench_frames):
            if frame in wanted.tares:
                part = slice(place.start + 6 * index, place.start + 6 * index + 6)
                mean[part], std[part] = wanted.tares[frame].mean, wanted.tares[frame].std
    extended = prior.extended(errors.names, mean, std)
    layout = RowLayout.of(parameters).extended(errors.names, errors.structure(parameters.model))
    p = len(parameters)
    pilot = LinearizationPoint(prior.mean, mean)
    rows = _padded(pseudo_measurements, len(errors))
    # Sensor errors and slow motion are told apart over long windows only.
    suited = suited_windows(ALL_WINDOWS, segment.rate)
    shortest, longest = suited[0], suited[-1]
    for _ in range(PASSES - 1):
        build = calibrating_rows(parameters, errors, pilot)
        (observations,) = observe(record.segments, build, layout, (longest,), ())
        found = posterior(
            observations, extended, rows, count=parameters.inertial, tolerance=PILOT_SETTLED
        )
        pilot = LinearizationPoint(found.mean[:p], found.mean[p:])
    build = calibrating_rows(parameters, errors, pilot)
    observed = observe(record.segments, build, layout, (shortest, longest), MOTION + FORCES)
    return Calibrated(errors, extended, observed, rows, build)


def _padded(pseudo_measurements: PseudoMeasurements | None, more: int) -> PseudoMeasurements | None:
    """Return rows that say nothing of ``more`` further unknowns."""
    if pseudo_measurements is None or more == 0:
        return pseudo_measurements
    return PseudoMeasurements(
        np.pad(pseudo_measurements.rows, ((0, 0), (0, more))), pseudo_measurements.targets
    )
