"""Errors of sensors that change slowly during a log: random walks of offsets and biases.

The change since the start of the log is an unknown at knots a minute apart, linear between them and
constant beyond them. Predictions of later data thus use the value at the end.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.signals.sensor_errors import SensorErrors

# Errors that warmth changes.
DRIFTING_KINDS = "wrench_offset", "imu_bias"
MINUTE = 60_000_000_000  # ns
# Shorter logs have constant errors. Longer ones than the most knots cover have knots farther apart.
SHORTEST, MOST_KNOTS = 2 * MINUTE, 6
# Variance of the value at the start of a line fitted to a random walk, about the walk's start, over
# the variance of the walk's step from knot to knot (docs/theory.md).
START_VARIANCE = 2 / 15

_MARK = "_drift_"


@dataclass(frozen=True)
class SensorDrift:
    """Random walks of some sensor errors.

    Attributes
    ----------
    places : (d,) int
        Errors that drift, among all r errors θ.
    std : (d,) float64
        Standard deviation of their change in a minute.
    knots : (K + 1,) int64
        Stamps of the start and of K knots, ns.
    """

    places: IntArray
    std: FloatArray
    knots: IntArray

    @classmethod
    def possible(cls, errors: SensorErrors, start: int, stop: int) -> "SensorDrift | None":
        """Return walks that change each error by its prior deviation in a minute.

        None if the log from ``start`` to ``stop``, ns, is short, or its sensors do not drift.
        """
        kinds = [kind for kind in DRIFTING_KINDS if kind in errors.kinds]
        places = np.array([i for kind in kinds for i in _places(errors, kind)], dtype=np.int64)
        if stop - start < SHORTEST or len(places) == 0:
            return None
        count = min(round((stop - start) / MINUTE), MOST_KNOTS)
        knots = np.linspace(start, stop, count + 1).round().astype(np.int64)
        return cls(places, errors.std[places], knots)

    def scaled(self, factors: FloatArray) -> "SensorDrift | None":
        """Return the walks with deviations times ``factors`` (d,); None if all are zero."""
        some = factors > 0
        if not some.any():
            return None
        return replace(self, places=self.places[some], std=(factors * self.std)[some])

    def factors(self, errors: SensorErrors, by_kind: dict[str, float]) -> FloatArray:
        """Return each walk's factor (d,) from those of the kinds; zero for other kinds."""
        factors = np.zeros(len(self.places))
        for kind, factor in by_kind.items():
            factors[np.isin(self.places, _places(errors, kind))] = factor
        return factors

    def names(self, errors: SensorErrors) -> tuple[str, ...]:
        """Return the names of the K d changes, knot by knot: ``<error>_drift_<seconds>s``."""
        seconds = np.rint(1e-9 * (self.knots[1:] - self.knots[0])).astype(int)
        return tuple(
            f"{errors.names[place]}{_MARK}{second}s" for second in seconds for place in self.places
        )

    def repeated(self, values: Sequence[str]) -> tuple[str, ...]:
        """Return one of ``values`` of the r errors for each of the K d changes."""
        return tuple(values[place] for _ in self.knots[1:] for place in self.places)

    @property
    def covariance_factor(self) -> FloatArray:
        """(K d, K d) lower triangular L with the prior covariance L Lᵀ of the changes."""
        steps = np.sqrt(np.diff(self.knots) / MINUTE)
        sums = np.tril(np.tile(steps, (len(steps), 1)))
        return np.asarray(np.kron(sums, np.diag(self.std)), dtype=np.float64)

    @property
    def start_std(self) -> FloatArray:
        """(d,) deviation of an error at the first knot from what a tare before the log says.

        The line from the first knot to the next follows a minute of the walk, not its start.
        """
        step = float(self.knots[1] - self.knots[0]) / MINUTE
        std: FloatArray = np.sqrt(START_VARIANCE * step) * self.std
        return std

    def columns(self, constant: FloatArray, stamp: IntArray) -> FloatArray:
        """Return the columns (N, n, K d) of the changes from those of the errors (N, n, r)."""
        unit = np.eye(len(self.knots))
        shares = np.stack([np.interp(stamp, self.knots, each) for each in unit[1:]], axis=1)
        some = constant[:, :, None, self.places] * shares[:, None, :, None]
        columns: FloatArray = some.reshape(*some.shape[:2], -1)
        return columns


def _places(errors: SensorErrors, kind: str) -> range:
    place = errors.places[kind]
    return range(place.start, place.stop)


def is_drift(name: str) -> bool:
    """Return whether an unknown is the change of an error, by its name."""
    return _MARK in name


def final_drifts(names: Sequence[str]) -> dict[str, int]:
    """Return, by errors that drift, the index of their change until the end of the log."""
    # Knots are in the order of time.
    return {name.partition(_MARK)[0]: index for index, name in enumerate(names) if is_drift(name)}
