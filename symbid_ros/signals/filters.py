"""Zero-phase smoothing and differentiation for rows at single samples, and causal filters.

SciPy's filters are imported when they are used. That takes half a second, and the rows of fast logs
need none of them.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Channels
from symbid_ros.errors import DataError

# The thesis filters joint positions and both of their derivatives, so its joint accelerations pass
# three filters. The same number of passes on every channel treats both sides of the equation of
# motion equally and reduces the gyroscope's noise in the base's angular acceleration most.
PASSES = 3


def _scipy_signal() -> Any:
    import scipy.signal  # noqa: PLC0415

    return scipy.signal


def check_cutoff(cutoff: float) -> None:
    """Raise an error if the cutoff is negative, NaN or infinite."""
    if not (np.isfinite(cutoff) and cutoff >= 0):
        raise DataError(
            f"cutoff must be 0 (no filter) or a positive frequency, got {cutoff} Hz", "E317"
        )


def butterworth(cutoff: float, rate: float) -> FloatArray:
    """Return the sections (1, 6) of the second-order low-pass, cutoff and rate in Hz.

    Raises
    ------
    DataError
        When the cutoff is not below half the sampling rate.
    """
    if cutoff >= rate / 2:
        raise DataError(
            f"cutoff {cutoff:g} Hz is not below half the rate of {rate:g} Hz; lower it", "E317"
        )
    return np.asarray(_scipy_signal().butter(2, cutoff, fs=rate, output="sos"), dtype=np.float64)


class Smoothing(Protocol):
    """Filter and differentiator of noisy, uniformly sampled channels."""

    def motion(self, signal: FloatArray, rate: float, order: int) -> tuple[FloatArray, ...]:
        """Return a position or angular velocity and its first ``order`` derivatives."""

    def force(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return a force, torque or specific force."""

    def settling(self, rate: float) -> int:
        """Return the number of samples at each end until the filter has settled."""

    def stride(self, rate: float) -> int:
        """Return the spacing of rows, in samples, that keeps all information in the passband."""


@dataclass(frozen=True)
class LowPass:
    """Second-order Butterworth, run forwards and backwards (Matlab's ``filtfilt``).

    Attributes
    ----------
    cutoff : float
        Hz; 0 passes everything.
    channels : {"all", "thesis"}
        "all" runs the filter ``passes`` times over every channel, including forces, so
        that both sides of the equation of motion lose the same band. "thesis" runs it
        once over joint positions and the body's rate before they are differentiated
        and once more over each derivative, and does not filter torques, wrenches and the
        accelerometer (thesis, section III-E).
    passes : int
        Number of filter passes over every channel if ``channels`` is "all".
    """

    cutoff: float = 30.0
    channels: Channels = "all"
    passes: int = PASSES

    def __post_init__(self) -> None:
        """Raise an error for an invalid cutoff."""
        check_cutoff(self.cutoff)

    def __str__(self) -> str:
        """Return the description for reports."""
        if self.cutoff == 0:
            return "none"
        passes = f"{self.passes} passes" if self.channels == "all" else "the thesis's passes"
        return f"second-order Butterworth at {self.cutoff:g} Hz, zero phase, {passes}"

    def __call__(self, signal: FloatArray, rate: float, passes: int = 1) -> FloatArray:
        """Return the signal filtered ``passes`` times, time along the first axis.

        Raises
        ------
        DataError
            When the cutoff is not below half the sampling rate.
        """
        if self.cutoff == 0 or signal.size == 0:
            return signal
        sections = np.tile(butterworth(self.cutoff, rate), (passes, 1))
        padding = min(len(signal) - 1, int(3 * passes * rate / self.cutoff))
        filtered: FloatArray = _scipy_signal().sosfiltfilt(sections, signal, axis=0, padlen=padding)
        return filtered

    def motion(self, signal: FloatArray, rate: float, order: int) -> tuple[FloatArray, ...]:
        """Return a position or angular velocity and its first ``order`` derivatives.

        Time runs along the first axis. The filtering depends on ``channels``.
        """
        filtered = [self(signal, rate, self.passes if self.channels == "all" else 1)]
        for _ in range(order):
            slope = differentiate(filtered[-1], rate)
            filtered.append(self(slope, rate) if self.channels == "thesis" else slope)
        return tuple(filtered)

    def force(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return a force, torque or specific force, filtered if ``channels`` is "all"."""
        return self(signal, rate, self.passes) if self.channels == "all" else signal

    def settling(self, rate: float) -> int:
        """Return the number of samples at each end until the filter has settled."""
        passes = self.passes if self.channels == "all" else PASSES
        return 2 if self.cutoff == 0 else max(2, int(np.ceil(passes * rate / self.cutoff)))

    def stride(self, rate: float) -> int:
        """Return the spacing of rows, in samples, that keeps all information in the passband.

        Five samples per period of the cutoff: what lies above is attenuated by more
        than 99 %, so denser rows are redundant.
        """
        return 1 if self.cutoff == 0 else max(1, int(rate / (5 * self.cutoff)))


@dataclass(frozen=True)
class SavitzkyGolay:
    """A polynomial fitted around every sample, which also gives the derivatives.

    Savitzky and Golay 1964. All channels use the same window and degree.

    Attributes
    ----------
    window : float
        Seconds.
    degree : int
        Degree of the polynomial, at least 2 for second derivatives.
    """

    window: float = 0.081
    degree: int = 3

    def __post_init__(self) -> None:
        """Raise an error for an invalid window or degree."""
        if not (np.isfinite(self.window) and self.window > 0 and self.degree >= 2):
            raise DataError(
                f"Savitzky-Golay window {self.window} s, degree {self.degree}: give a positive "
                "window and a degree of at least 2",
                "E317",
            )

    def __str__(self) -> str:
        """Return the description for reports."""
        return f"Savitzky-Golay, {1e3 * self.window:g} ms, degree {self.degree}"

    def motion(self, signal: FloatArray, rate: float, order: int) -> tuple[FloatArray, ...]:
        """Return a position or angular velocity and its first ``order`` derivatives."""
        return tuple(self._fit(signal, rate, derivative) for derivative in range(order + 1))

    def force(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return a force, torque or specific force."""
        return self._fit(signal, rate, 0)

    def _fit(self, signal: FloatArray, rate: float, derivative: int) -> FloatArray:
        length = self._length(rate)
        if signal.size == 0:
            return signal
        if length > len(signal):
            raise DataError(
                f"a Savitzky-Golay window of {self.window:g} s is longer than a segment of "
                f"{len(signal) / rate:.3g} s; shorten the window or record longer",
                "E318",
            )
        # SciPy fits the ends by least squares, which do not accept NaN of unmeasured efforts.
        columns = signal.reshape(len(signal), -1)
        finite = np.isfinite(columns).all(axis=0)
        fitted = np.full(columns.shape, np.nan)
        if finite.any():
            fitted[:, finite] = _scipy_signal().savgol_filter(
                columns[:, finite], length, self.degree, derivative, 1 / rate, axis=0
            )
        return fitted.reshape(signal.shape)

    def _length(self, rate: float) -> int:
        """Return the window in samples: odd, and long enough for the polynomial."""
        half = max(round(self.window * rate / 2), (self.degree + 2) // 2)
        return 2 * half + 1

    def settling(self, rate: float) -> int:
        """Return the number of samples at each end whose window exceeds the segment."""
        return self._length(rate) // 2

    def stride(self, rate: float) -> int:
        """Return how many samples apart rows are taken: four per window."""
        return max(1, self._length(rate) // 4)


def differentiate(signal: FloatArray, rate: float) -> FloatArray:
    """Return the central difference along the first axis, second order at the ends too."""
    if not len(signal):
        return signal
    slope: FloatArray = np.gradient(signal, 1.0 / rate, axis=0, edge_order=2)
    return slope


def row_inflation(smoothing: Smoothing, rate: float) -> float:
    """Return the number of rows, one stride apart, per independent row.

    Filtered white noise is correlated between rows. The factor is the sum of its autocorrelation
    over the rows, computed from the filter's impulse response.
    """
    half = 4 * max(smoothing.settling(rate), 1) + 8
    impulse = np.zeros((2 * half + 1, 1))
    impulse[half] = 1.0
    response = smoothing.force(impulse, rate)[:, 0]
    correlation = np.correlate(response, response, mode="full")
    middle = len(response) - 1
    lagged = correlation[middle % smoothing.stride(rate) :: smoothing.stride(rate)]
    return float(max(lagged.sum() / correlation[middle], 1.0))


# Periods of the cutoff after which the filter's transient has decayed to 2e-4.
SETTLED = 2.0


@dataclass(frozen=True)
class CausalLowPass:
    """Second-order Butterworth run forwards only, as in a real-time estimator.

    Below its cutoff it delays by about 0.225 / cutoff seconds.

    Attributes
    ----------
    cutoff : float
        Hz; 0 passes everything.
    """

    cutoff: float = 50.0

    def __post_init__(self) -> None:
        """Raise an error for an invalid cutoff."""
        check_cutoff(self.cutoff)

    def __call__(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return the signal (N, ...) filtered along time, starting from its first value at rest.

        Raises
        ------
        DataError
            When the cutoff is not below half the sampling rate.
        """
        if self.cutoff == 0 or signal.size == 0:
            return signal
        sections = butterworth(self.cutoff, rate)
        flat = signal.reshape(len(signal), -1)
        start = _scipy_signal().sosfilt_zi(sections)[:, :, None] * flat[0]
        filtered, _ = _scipy_signal().sosfilt(sections, flat, axis=0, zi=start)
        return np.asarray(filtered.reshape(signal.shape), dtype=np.float64)

    def velocity(self, position: FloatArray, rate: float) -> FloatArray:
        """Return the filtered backward difference of positions (N, ...); it starts with zero."""
        return self(np.diff(position, axis=0, prepend=position[:1]) * rate, rate)

    def settling(self, rate: float) -> int:
        """Return the number of samples at the start until the filter has settled."""
        return 1 if self.cutoff == 0 else int(np.ceil(SETTLED * rate / self.cutoff)) + 1
