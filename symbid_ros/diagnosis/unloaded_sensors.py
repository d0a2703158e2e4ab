"""Offsets of wrench sensors of feet, from the times in which nothing touches them.

Whether a foot is in the air follows from its sensor alone: it reads almost nothing, and the same in
each such time, although at other times it carries the robot.
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.signals.segments import Segment

# Length, s, of the parts of a log that are judged, and how many are left out at each end of a time
# in the air, where a foot brushes the ground.
PART, EDGE = 0.05, 3
# A sensor that reads less than this share of the robot's weight, and less than this, N, may be
# unloaded. One that never reads this share carries no robot, but for example a tool.
UNLOADED_SHARE, UNLOADED, LOADED_SHARE = 0.05, 20.0, 0.2
# Parts of a time in the air, at least, and deviations of white noise from their median at which a
# part is left out, because something still touches the foot.
FEWEST, OUTLIER = 4, 3.0
# Share of the parts that must agree: the force on a foot that hardly touches the ground varies.
AGREEING = 0.5
# Feet, at least, of which all but one show that the robot walks.
FEWEST_FEET = 3
# Scatter of the times in the air over that of white noise, above which the offset itself changes.
WHITE = 2.0
# Variance of a median over that of a mean.
MEDIAN = np.pi / 2
# A deviation of the mean is at least this, as rounding may hide all noise; N and Nm.
LEAST_STD = 1e-4
# Smallest offsets that are reported, N and Nm, and in deviations.
SMALLEST_FORCE, SMALLEST_MOMENT, DEVIATIONS = 0.2, 0.02, 5.0


@dataclass(frozen=True)
class UnloadedReading:
    """What a wrench sensor reads while nothing touches it.

    Attributes
    ----------
    mean, std : (6,) float64
        Of moment and force, and standard deviation of this mean, Nm and N.
    seconds : float
        Time in the air that was used.
    """

    mean: FloatArray
    std: FloatArray
    seconds: float

    def finding(self, topic: str) -> Finding | None:
        """Return the finding of an offset; None if it is too small to matter."""
        least = np.repeat([SMALLEST_MOMENT, SMALLEST_FORCE], 3)
        if not np.any(np.abs(self.mean) > np.maximum(least, DEVIATIONS * self.std)):
            return None
        moment, force = self.mean[:3], self.mean[3:]
        names = [f"{kind}_{axis}" for kind in ("moment", "force") for axis in "xyz"]
        units = ["nm"] * 3 + ["n"] * 3
        figures = {
            f"{name}_{unit}": float(value)
            for name, unit, value in zip(names, units, self.mean, strict=True)
        }
        return Finding.of(
            topic,
            Kind.WRENCH_OFFSET,
            f"reads {np.linalg.norm(force):.2g} N and {np.linalg.norm(moment):.2g} Nm while the "
            f"foot is in the air ({self.seconds:.1f} s); tare the sensor, or give "
            "`sensor_errors` wrench_offset",
            figures | {"unloaded_s": self.seconds},
            Severity.WARNING,
        )


class UnloadedSensors:
    """Accumulates what wrench sensors read while nothing touches them.

    Parameters
    ----------
    frames : tuple of str
        Of the F sensors.
    weight : float
        Of the robot, N.
    """

    def __init__(self, frames: tuple[str, ...], weight: float) -> None:
        self._frames, self._weight = frames, weight
        self._largest, self._least = np.zeros(len(frames)), np.full(len(frames), np.inf)
        # For each sensor and time in the air the mean (6,), its variance if noise is white, and the
        # number of parts.
        self._times: list[list[tuple[FloatArray, FloatArray, int]]] = [[] for _ in frames]
        self._length = 0.0

    def add(self, segment: Segment) -> None:
        """Add a segment."""
        size = max(round(PART * segment.rate), 2)
        count = len(segment) // size
        if count <= 2 * EDGE or not self._frames:
            return
        self._length = size / segment.rate
        parts = segment.wrenches[: count * size].reshape(count, size, len(self._frames), 6)
        mean, noise = parts.mean(axis=1), parts.var(axis=1, ddof=1) / size
        force = np.linalg.norm(mean[:, :, 3:], axis=2)
        self._largest = np.maximum(self._largest, force.max(axis=0))
        self._least = np.minimum(self._least, force.min(axis=0))
        is_light = force < min(UNLOADED, UNLOADED_SHARE * self._weight)
        for index, times in enumerate(self._times):
            edges = np.flatnonzero(np.diff(np.pad(is_light[:, index], 1).astype(int)))
            for start, stop in zip(edges[::2] + EDGE, edges[1::2] - EDGE, strict=True):
                if stop - start < FEWEST:
                    continue
                found = _median(mean[start:stop, index], noise[start:stop, index])
                if found[2] > AGREEING * (stop - start):
                    times.append(found)

    def readings(self) -> dict[str, UnloadedReading]:
        """Return the readings of the sensors that were in the air, by frame."""
        found = {}
        for frame, times, largest in zip(self._frames, self._times, self._largest, strict=True):
            if not times or largest < LOADED_SHARE * self._weight:
                continue
            means, variances, counts = map(np.array, zip(*times, strict=True))
            share = (counts / counts.sum())[:, None]
            mean, white = np.sum(share * means, axis=0), np.sum(share**2 * variances, axis=0)
            scatter = np.sqrt(np.mean((means - mean) ** 2 / variances, axis=0))
            std = np.where(scatter > WHITE, means.std(axis=0), np.sqrt(white))
            std = np.maximum(std, LEAST_STD)
            found[frame] = UnloadedReading(mean, std, float(counts.sum()) * self._length)
        return found

    def suspect_force(self) -> tuple[str, float]:
        """Return the one sensor that always reads a force, and the least of it, N.

        All others are unloaded at times. Its foot may be too, and the reading is an offset. The
        name is empty if there is no such sensor.
        """
        is_loaded = self._least >= UNLOADED_SHARE * self._weight
        if np.count_nonzero(is_loaded) != 1 or len(self._frames) < FEWEST_FEET:
            return "", 0.0
        index = int(np.argmax(is_loaded))
        return self._frames[index], float(self._least[index])


def _median(parts: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return the median of parts (k, 6) without outliers, its variance and the number of parts."""
    white = np.sqrt(np.median(noise, axis=0)) + LEAST_STD
    distance = np.abs(parts - np.median(parts, axis=0)) / white
    kept = np.all(distance <= OUTLIER, axis=1)
    kept |= np.argmin(distance.max(axis=1)) == np.arange(len(parts))
    count = int(kept.sum())
    return np.median(parts[kept], axis=0), MEDIAN * white**2 / count, count
