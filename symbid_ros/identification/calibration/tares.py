"""Tares: readings of unloaded wrench sensors, which give priors of their offsets."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError
from symbid_ros.signals.log import Log
from symbid_ros.signals.streams import WrenchStream

logger = logging.getLogger(__name__)

# A sensor that reads more than this in a tare is loaded.
UNLOADED = 20.0  # N


@dataclass(frozen=True)
class Tare:
    """What an unloaded wrench sensor reads.

    Attributes
    ----------
    mean, std : (6,) float64
        Mean of moment and force, and the standard deviation of this mean, Nm and N.
    """

    mean: FloatArray
    std: FloatArray


def read_tare(log: Log) -> dict[str, Tare]:
    """Return the readings of the unloaded wrench sensors of a log, by frame.

    Raises
    ------
    DataError
        When every sensor is loaded, or a reading is NaN or infinite.
    """
    streams = log.streams()
    return tares_of(streams.wrenches, streams.source)


def tares_of(wrenches: Iterable[WrenchStream], source: str) -> dict[str, Tare]:
    """Return what :func:`read_tare` does, from streams of a log or of topics named ``source``."""
    tares = {}
    for wrench in wrenches:
        readings = np.concatenate([wrench.torque, wrench.force], axis=1)
        if not np.all(np.isfinite(readings)):
            raise DataError(
                f"{source}: {wrench.topic} has a NaN or infinite reading; record the `tare` again",
                "E515",
            )
        mean = readings.mean(axis=0)
        if np.linalg.norm(mean[3:]) > UNLOADED:
            logger.warning(
                "%s: %s reads %.0f N, so it is loaded and not tared",
                source,
                wrench.topic,
                np.linalg.norm(mean[3:]),
            )
            continue
        std = readings.std(axis=0) / np.sqrt(len(readings))
        # Rounding to the sensor's resolution, which is unknown, can hide all noise.
        tares[wrench.frame_id] = Tare(mean, np.maximum(std, 1e-4))
    if not tares:
        raise DataError(
            f"{source}: no unloaded wrench sensor; record the topics of the sensors with nothing "
            "touching them for the `tare`",
            "E514",
        )
    return tares
