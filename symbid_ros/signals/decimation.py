"""Low-pass, differentiation and reduction of the sampling rate in one linear step.

After the low-pass, a signal sampled at 1 kHz holds few instants that are independent. Rows of the
equation of motion are costly, so they are built at a lower rate. Averages over windows then equal
those at the full rate, apart from what lies above the new rate minus the windows' passband: an
additional anti-alias filter removes it (Oppenheim and Schafer, Discrete-Time Signal Processing,
section 4.6). All filters have zero phase, and their product is one short kernel.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.filters import LowPass

# Rows per period of the low-pass's cutoff, and per shortest window, that are kept at least.
ROWS_PER_PERIOD = 2.5
ROWS_PER_WINDOW = 12
# Periods of the low-pass's cutoff at which the impulse response of one pass has decayed by 80⁴.
REACH = 4
# Of the Kaiser window: the anti-alias filter attenuates by 80 dB.
ATTENUATION, SHAPE = 80.0, 7.857
GROUP = 16  # outputs of one matrix product


def decimation_stride(rate: float, cutoff: float, window: float) -> int:
    """Return the number of samples per row.

    Parameters
    ----------
    rate : float
        Sampling rate, Hz.
    cutoff : float
        Of the low-pass, Hz.
    window : float
        Length of the shortest window over which rows are averaged, s.
    """
    return max(1, int(rate / max(ROWS_PER_PERIOD * cutoff, ROWS_PER_WINDOW / window)))


@dataclass(frozen=True)
class Decimator:
    """Zero-phase low-pass, derivatives and every ``stride``-th sample of uniform signals.

    Attributes
    ----------
    rate : float
        Sampling rate of the signals, Hz.
    stride : int
        Samples from one output to the next.
    low_pass : LowPass
        Butterworth low-pass; its passband is kept.
    protected : float
        Frequency up to which nothing may alias, Hz.
    edge : int
        Samples at each end without output, in which the kernel settles.
    """

    rate: float
    stride: int
    low_pass: LowPass
    protected: float
    edge: int

    def motion(self, signal: FloatArray, order: int) -> tuple[FloatArray, ...]:
        """Return a signal (M, ...) and its first ``order`` derivatives, (N, ...) each."""
        return self._outputs(signal, order, self.stride, self.edge)

    def force(self, signal: FloatArray) -> FloatArray:
        """Return a signal (M, ...) without derivatives, (N, ...)."""
        return self.motion(signal, 0)[0]

    def every(self, signal: FloatArray, order: int) -> tuple[FloatArray, ...]:
        """Return a filtered signal and its derivatives at all M instants."""
        return self._outputs(signal, order, 1, 0)

    def _outputs(
        self, signal: FloatArray, order: int, stride: int, edge: int
    ) -> tuple[FloatArray, ...]:
        count = -(-(len(signal) - 2 * edge) // stride)
        flat = signal.reshape(len(signal), -1)
        matrix = _toeplitz(self, order, stride)
        reach = (matrix.shape[1] - stride * (GROUP - 1)) // 2
        groups = -(-count // GROUP)
        # The first output is at `edge`; an odd extension continues the signal beyond its ends.
        first = reach - edge
        last = edge + stride * (GROUP * groups - 1) + reach + 1 - len(flat)
        padded = _odd_extension(flat, max(first, 0), max(last, 0))[max(-first, 0) :]
        step = stride * GROUP
        parts = sliding_window_view(padded, matrix.shape[1], axis=0)[: step * groups : step]
        outputs = matrix @ parts.swapaxes(1, 2)
        shape = (order + 1, groups, GROUP, flat.shape[1])
        outputs = outputs.reshape(groups, order + 1, GROUP, -1).swapaxes(0, 1).reshape(shape)
        return tuple(
            one.reshape(groups * GROUP, -1)[:count].reshape(count, *signal.shape[1:])
            for one in outputs
        )


def _odd_extension(signal: FloatArray, before: int, after: int) -> FloatArray:
    """Return a signal (M, c) continued by its point reflections at both ends."""
    reach = len(signal) - 1
    first, last = min(before, reach), min(after, reach)
    parts = [
        np.repeat(2 * signal[:1] - signal[first : first + 1], before - first, axis=0),
        2 * signal[:1] - signal[first:0:-1],
        signal,
        2 * signal[-1:] - signal[-2 : -2 - last : -1],
        np.repeat(2 * signal[-1:] - signal[-1 - last : reach + 1 - last], after - last, axis=0),
    ]
    return np.concatenate(parts)


@lru_cache(maxsize=64)
def _toeplitz(decimator: Decimator, order: int, stride: int) -> FloatArray:
    """Return the matrix of ``GROUP`` outputs of a signal and its derivatives, one after another."""
    kernels = _kernels(decimator, order)
    length = len(kernels[-1])
    matrix = np.zeros(((order + 1) * GROUP, length + stride * (GROUP - 1)))
    for derivative, kernel in enumerate(kernels):
        margin = (length - len(kernel)) // 2
        for output in range(GROUP):
            start = output * stride + margin
            matrix[derivative * GROUP + output, start : start + len(kernel)] = kernel
    return matrix


def _kernels(decimator: Decimator, order: int) -> list[FloatArray]:
    """Return the weights of the samples around an output, of each derivative."""
    rate, reach = decimator.rate, _reach(decimator.low_pass, decimator.rate)
    impulse = np.fft.irfft(_response(decimator.low_pass, rate, 8 * reach))
    kernel = np.concatenate([impulse[-reach:], impulse[: reach + 1]])
    kernel = np.convolve(kernel / kernel.sum(), _anti_alias(decimator))
    kernels = [kernel]
    for _ in range(order):
        kernels.append(np.convolve(kernels[-1], [-0.5 * rate, 0.0, 0.5 * rate]))
    return kernels


def _reach(low_pass: LowPass, rate: float) -> int:
    """Return the number of samples in which the response to an impulse decays."""
    return int(np.ceil((REACH + low_pass.passes - 1) * rate / low_pass.cutoff))


def _response(low_pass: LowPass, rate: float, count: int) -> FloatArray:
    """Return the response, forwards and backwards, at the frequencies of a real FFT."""
    # The bilinear transform maps half the rate to infinity.
    angle = np.minimum(np.arange(count // 2 + 1) / count, 0.5 - 1e-9)
    ratio = np.tan(np.pi * angle) / np.tan(np.pi * low_pass.cutoff / rate)
    response: FloatArray = (1 + ratio**4) ** -float(low_pass.passes)
    return response


def low_passed(signal: FloatArray, low_pass: LowPass, rate: float) -> FloatArray:
    """Return a long signal (M, ...), low-passed with zero phase by FFT."""
    return derivatives(signal, low_pass, rate, 0)[0]


def derivatives(
    signal: FloatArray, low_pass: LowPass, rate: float, order: int
) -> tuple[FloatArray, ...]:
    """Return a long signal (M, ...), low-passed with zero phase by FFT, and its derivatives.

    Derivatives are differences over one period around each sample. A control loop or a simulator
    holds its forces for a period, and the second difference of positions is the mean acceleration
    around a sample. Derivatives that are exact for continuous motion are larger.
    """
    reach, count = _reach(low_pass, rate), len(signal)
    padded = _odd_extension(signal.reshape(count, -1), reach, reach)
    spectrum = np.fft.rfft(padded, axis=0)
    spectrum *= _response(low_pass, rate, len(padded))[:, None]
    frequency = np.asarray(np.fft.rfftfreq(len(padded), 1 / rate), dtype=np.float64)
    slope = 1j * difference(frequency, rate)[:, None]
    found = []
    for power in range(order + 1):
        values = np.fft.irfft(slope**power * spectrum if power else spectrum, len(padded), axis=0)
        found.append(values[reach : reach + count].reshape(signal.shape))
    return tuple(found)


def difference(frequency: FloatArray, rate: float) -> FloatArray:
    """Return the gain (F,) of differences over a period at frequencies (F,), Hz, in 1/s.

    It is 2π times the frequency far below the rate.
    """
    return np.asarray(2 * rate * np.sin(np.pi * frequency / rate))


def power_spectrum(channel: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (F,), Hz, and the power (F, c) of signals (N, c), flat for white noise."""
    count = len(channel)
    window = np.hanning(count + 2)[1:-1, None]
    spectrum = np.fft.rfft((channel - channel.mean(axis=0)) * window, axis=0)
    frequency = np.asarray(np.fft.rfftfreq(count, 1 / rate), dtype=np.float64)
    return frequency, np.abs(spectrum) ** 2 / np.sum(window**2)


def _anti_alias(decimator: Decimator) -> FloatArray:
    """Return the windowed sinc that passes the low-pass's cutoff and stops what would alias."""
    if decimator.stride == 1:
        return np.ones(1)
    rate, passed = decimator.rate, decimator.low_pass.cutoff
    stopped = rate / decimator.stride - decimator.protected
    width = 2 * np.pi * (stopped - passed) / rate
    half = int(np.ceil((ATTENUATION - 8) / (2.285 * width) / 2))
    lags = np.arange(-half, half + 1)
    middle = (passed + stopped) / rate
    kernel: FloatArray = np.sinc(middle * lags) * np.kaiser(2 * half + 1, SHAPE)
    kernel /= kernel.sum()
    return kernel
