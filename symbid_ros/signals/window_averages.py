"""Averages of rows over Hann windows."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array, vstack

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.sampled_rows import CombinedCoordinates, RowBuilder, SampledRows
from symbid_ros.signals.sensor_samples import SensorSamples


def window_centres(span: int, windows: Sequence[float]) -> list[FloatArray]:
    """Return the centres of half-overlapping windows of each length in ``span`` ns, s."""
    last = span * 1e-9
    return [np.arange(length / 2, last - length / 2 + 1e-9, length / 2) for length in windows]


def hann_weights(readings: SensorSamples, centres: FloatArray, length: float) -> csr_array:
    """Return the weights (W, N) of samples in Hann windows around the centres (W,), s."""
    since = readings.stamp - readings.stamp[0]
    return _hann_weights(since.tobytes(), centres.tobytes(), length)


@lru_cache(maxsize=8)
def _hann_weights(since: bytes, middles: bytes, length: float) -> csr_array:
    """Return the weights of samples at int64 times, ns, which most blocks of a log share."""
    time = np.frombuffer(since, dtype=np.int64) * 1e-9
    centres = np.frombuffer(middles)
    first = np.searchsorted(time, centres - length / 2, side="right")
    last = np.searchsorted(time, centres + length / 2, side="left")
    rows = np.repeat(np.arange(len(centres)), last - first)
    ends = np.cumsum(last - first)
    columns = np.arange(ends[-1] if len(ends) else 0)
    columns = columns - np.repeat(ends - (last - first) - first, last - first)
    values = np.cos(np.pi * (time[columns] - centres[rows]) / length) ** 2
    total = np.bincount(rows, values, minlength=len(centres))
    values /= total[rows]
    return csr_array((values, (rows, columns)), shape=(len(centres), len(time)))


def stacked(weights: Sequence[csr_array]) -> csr_array:
    """Return the weights (ΣW, N) of windows one after another."""
    return weights[0] if len(weights) == 1 else csr_array(vstack(weights))


@dataclass(frozen=True)
class Average:
    """Sums over windows: K (W, n, p), y (W, n), and shares of weight that is valid or slips."""

    K: FloatArray
    y: FloatArray
    valid: FloatArray
    slips: FloatArray | None
    combined: CombinedCoordinates | None


class AveragingRows(ABC):
    """A ``RowBuilder`` that can also average rows, which may need no rows of single samples."""

    @abstractmethod
    def __call__(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of sensor samples."""

    @abstractmethod
    def averages(self, readings: SensorSamples, weights: Sequence[csr_array]) -> list[Average]:
        """Return averages over windows with weights (W, N) each."""


def averages_of(
    build: RowBuilder, readings: SensorSamples, weights: Sequence[csr_array]
) -> list[Average]:
    """Return the averages of the rows of sensor samples over windows with weights (W, N) each."""
    if isinstance(build, AveragingRows):
        return build.averages(readings, weights)
    return average(build(readings), weights)


def average(parts: Iterator[SampledRows], weights: Sequence[csr_array]) -> list[Average]:
    """Return the averages of rows over windows with weights (W, N) each."""
    sums: list[Average] = []
    start = 0
    for part in parts:
        count, n, p = part.rows.K.shape
        columns = slice(start, start + count)
        terms = []
        for weight in weights:
            some = weight if count == weight.shape[1] else weight[:, columns]
            slips = None if part.slips is None else some @ part.slips
            combined = None if part.combined is None else part.combined.averaged(some)
            shape = some.shape[0], n, p
            K = (some @ part.rows.K.reshape(count, n * p)).reshape(shape) if p else np.empty(shape)
            terms.append(Average(K, some @ part.rows.y, some @ part.valid, slips, combined))
        sums = terms if not sums else [_add(a, b) for a, b in zip(sums, terms, strict=True)]
        start += count
    return sums


def _add(a: Average, b: Average) -> Average:
    slips = None if a.slips is None or b.slips is None else a.slips + b.slips
    combined = None if a.combined is None or b.combined is None else a.combined + b.combined
    return Average(a.K + b.K, a.y + b.y, a.valid + b.valid, slips, combined)


def extended(averages: Sequence[Average], K: FloatArray) -> list[Average]:
    """Return averages with more columns K (ΣW, n, p), one after another, before their own."""
    starts = np.cumsum([len(one.y) for one in averages])[:-1]
    return [
        replace(one, K=np.concatenate([part, one.K], axis=2) if one.K.shape[2] else part)
        for one, part in zip(averages, np.split(K, starts), strict=True)
    ]
