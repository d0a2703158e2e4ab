"""Rows of motion faster than the windows, in bands of frequencies.

A Hann window times exp(-iωt) averages a band around the frequency ω, and the equation of motion
holds for these averages too. At such frequencies accelerations are noisy: the noise of an encoder
grows with the square of the frequency, that of a gyroscope in proportion.

The rows answer linearly to the noise of each channel. Accelerations and forces matter alone: what
noise does through postures and rates is less by orders of magnitude.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.decimation import derivatives, difference, power_spectrum
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sampled_rows import least_slipping
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import WINDOWS, equation_rows, free_of_stops
from symbid_ros.signals.window_averages import hann_weights, window_centres

ComplexArray = NDArray[np.complex128]

# Seconds. Short windows, in which the posture hardly changes.
LENGTH = WINDOWS[0]
# Centres of the bands are this far apart, Hz, as far as a Hann window's main lobe reaches. The
# lowest band begins where windows without a frequency end.
SPACING = 2 / LENGTH
# Share of the sampling rate up to which bands have their centres. Above it, the instants at which
# a driver reads its sensors within a period matter.
HIGHEST = 0.125
# Cutoff of the low-pass, which all channels pass, as a share of the rate, and the periods of it
# that are discarded at both ends of a block.
CUTOFF, SETTLING = 0.3, 24
# Parts of the spectrum above the bands from which noise is told, and fits to them.
PARTS, REWEIGHTINGS = 8, 4
# Bytes of the responses that are computed at once.
AT_ONCE = 32 << 20


@dataclass(frozen=True)
class Bands:
    """Bands of frequencies at a sampling rate.

    Attributes
    ----------
    rate : float
        Hz.
    """

    rate: float

    def __len__(self) -> int:
        return int(HIGHEST * self.rate / SPACING)

    @property
    def low_pass(self) -> LowPass:
        """What all channels pass."""
        return LowPass(CUTOFF * self.rate, passes=1)

    @property
    def frequencies(self) -> FloatArray:
        """Centres (B,), Hz."""
        return SPACING * np.arange(1, len(self) + 1, dtype=np.float64)

    @cached_property
    def noise(self) -> tuple[float, FloatArray]:
        """Variance of an average of white noise, and factors (B, 3) of its derivatives' deviation.

        The deviation of the derivative of order k is about (2π f)ᵏ times as large, with a frequency
        f near the band's centre, as noise grows within the band.
        """
        count = round(LENGTH * self.rate)
        time = (np.arange(count) - (count - 1) / 2) / self.rate
        window = np.cos(np.pi * time / LENGTH) ** 2
        window /= window.sum()
        power = float(window @ window)
        size = 64 * count
        frequency = np.asarray(np.fft.fftfreq(size, 1 / self.rate), dtype=np.float64)
        slope = difference(frequency, self.rate)
        factors = np.ones((len(self), 3))
        for index, centre in enumerate(self.frequencies):
            spectrum = np.abs(np.fft.fft(window * np.exp(2j * np.pi * centre * time), size)) ** 2
            for order in (1, 2):
                mean = spectrum @ slope ** (2 * order) / spectrum.sum()
                factors[index, order] = np.sqrt(mean)
        return power, factors

    def derivative(self, channels: "Channels", band: int) -> ComplexArray:
        """Return what the derivatives of channels are in a band, as factors (c,) of their noise."""
        factors: ComplexArray = 1j**channels.order * self.noise[1][band, channels.order]
        return factors


@dataclass(frozen=True)
class Channels:
    """The noisy channels of a robot's sensors, in this order.

    Attributes
    ----------
    joints, imus, wrenches : int
        Encoders; gyroscopes and accelerometers of three axes each; efforts of all joints; wrench
        sensors of six axes.
    """

    joints: int
    imus: int
    wrenches: int

    def __len__(self) -> int:
        return self.motion + self.joints + 6 * self.wrenches

    @property
    def motion(self) -> int:
        """Number of channels that tell the motion; those of forces follow."""
        return self.joints + 6 * self.imus

    @property
    def order(self) -> NDArray[np.int64]:
        """Derivative (c,) of the channel that the equation of motion contains."""
        gyroscopes = 3 * self.imus
        order = np.zeros(len(self), dtype=np.int64)
        order[: self.joints], order[self.joints : self.joints + gyroscopes] = 2, 1
        return order

    def values(self, segment: Segment) -> FloatArray:
        """Return the readings (M, c) of a segment."""
        parts = [segment.position, segment.angular_velocity, segment.linear_acceleration]
        parts += [segment.effort, segment.wrenches]
        return np.concatenate([part.reshape(len(segment), -1) for part in parts], axis=1)

    def units(self, at: SensorSamples) -> SensorSamples:
        """Return (1 + c) N samples in the postures of N others: at rest, then one for each channel.

        In the latter the channel's derivative, or the channel if it is not differentiated, is one.
        """
        count = 1 + len(self)
        none = at.position[:1] * 0
        value = np.zeros((count, 1, len(self)))
        value[1:, 0] = np.eye(len(self))
        ends = np.cumsum([self.joints, 3 * self.imus, 3 * self.imus, self.joints])
        parts = [
            np.repeat(part, len(at), axis=1).reshape(count * len(at), -1)
            for part in np.split(value, ends, axis=2)
        ]
        still = np.broadcast_to(none, (count * len(at), self.joints))
        axes = (-1, self.imus, 3)
        return replace(
            at,
            stamp=np.tile(at.stamp, count),
            position=np.tile(at.position, (count, 1)),
            velocity=still,
            acceleration=parts[0],
            effort=parts[3],
            angular_velocity=np.zeros((count * len(at), self.imus, 3)),
            angular_acceleration=parts[1].reshape(axes),
            specific_force=parts[2].reshape(axes),
            wrenches=parts[4].reshape(-1, self.wrenches, 6),
            recorded=None,
        )


@dataclass(frozen=True)
class Responses:
    """What the channels do to the rows in N windows.

    Attributes
    ----------
    K : (N, m, n, p) float64
        Change of K with the m channels that tell the motion.
    y : (N, c, n) float64
        Change of y with all channels.
    """

    K: FloatArray
    y: FloatArray

    def of_residual(self, phi: FloatArray) -> FloatArray:
        """Return the change (N, n, c) of K φ - y with all channels."""
        change = -self.y
        change[:, : self.K.shape[1]] += self.K @ phi
        return change.transpose(0, 2, 1)


@dataclass(frozen=True)
class FastRows:
    """Rows of a block in each window and band.

    Attributes
    ----------
    parameters : ParameterSet
        The p columns.
    bands : Bands
    channels : Channels
    noise : (c,) float64
        Variances of each channel's noise; those of forces and accelerometers at most.
    K : (W, B, n, p) complex64
        Averages, not counting the noise of accelerations.
    y : (W, B, n) complex128
    valid : (W, n) bool
        Coordinates that are used.
    at : SensorSamples
        The W postures in the middle of the windows.
    """

    parameters: ParameterSet
    bands: Bands
    channels: Channels
    noise: FloatArray
    K: NDArray[np.complex64]
    y: ComplexArray
    valid: BoolArray
    at: SensorSamples

    @classmethod
    def of(cls, block: Segment, parameters: ParameterSet, bands: Bands) -> "FastRows | None":
        """Return the rows of a block; None if it is too short."""
        edge = int(SETTLING / CUTOFF)
        if len(block) <= 2 * edge + LENGTH * block.rate:
            return None
        readings = _readings(block, bands.low_pass)[edge : len(block) - edge]
        (centres,) = window_centres(readings.stamp[-1] - readings.stamp[0], [LENGTH])
        hann = hann_weights(readings, centres, LENGTH)
        time = (readings.stamp - readings.stamp[0]) * 1e-9
        since = time[hann.indices] - np.repeat(centres, np.diff(hann.indptr))
        weights = [hann]
        for frequency in bands.frequencies:
            phase = 2 * np.pi * frequency * since
            for wave in (np.cos(phase), -np.sin(phase)):
                weight = hann.copy()
                weight.data = hann.data * wave
                weights.append(weight)
        mean, *parts = equation_rows(parameters).averages(readings, weights)
        waves = list(zip(parts[::2], parts[1::2], strict=True))
        K = np.stack(
            [one.K.astype(np.float32) + 1j * two.K.astype(np.float32) for one, two in waves]
        )
        y = np.stack([one.y + 1j * two.y for one, two in waves])
        middle = np.searchsorted(time, centres)
        stamp = readings.stamp[0] + np.rint(1e9 * centres).astype(np.int64)
        is_free = free_of_stops(block, stamp, LENGTH, mean)
        channels = Channels(
            block.position.shape[1], len(block.imu_frames), len(block.wrench_frames)
        )
        return cls(
            parameters,
            bands,
            channels,
            noise_below_motion(channels.values(block), block.rate),
            K.swapaxes(0, 1).astype(np.complex64),
            y.swapaxes(0, 1),
            (mean.valid > least_slipping(LENGTH)) & is_free,
            readings[middle],
        )

    def __len__(self) -> int:
        return len(self.at)

    def __getitem__(self, some: slice) -> "FastRows":
        """Return the rows of some windows."""
        return replace(
            self, K=self.K[some], y=self.y[some], valid=self.valid[some], at=self.at[some]
        )

    def parts(self) -> Iterator["FastRows"]:
        """Yield the rows of few windows at a time, for what needs their responses."""
        _, _, n, p = self.K.shape
        size = max(1, AT_ONCE // (8 * n * p * (1 + len(self.channels))))
        for start in range(0, len(self), size):
            yield self[start : start + size]

    def residuals(self, phi: FloatArray) -> ComplexArray:
        """Return K φ - y (W, B, n); zero where rows are not used."""
        residuals: ComplexArray = (self.K @ phi - self.y) * self.valid[:, None]
        return residuals

    def responses(self) -> Responses:
        """Return what the channels do to the rows of each window."""
        parameters, count = self.parameters, len(self)
        units = self.channels.units(self.at)
        rows = equation_of_motion(parameters, at_base(units, parameters.model))
        K = rows.K.reshape(-1, count, *rows.K.shape[1:])
        y = np.nan_to_num(rows.y).reshape(-1, count, rows.y.shape[1])
        K, y = K[1 : 1 + self.channels.motion] - K[:1], y[1:] - y[:1]
        return Responses(
            K.swapaxes(0, 1) * self.valid[:, None, :, None],
            y.swapaxes(0, 1) * self.valid[:, None],
        )


def noise_below_motion(signals: FloatArray, rate: float) -> FloatArray:
    """Return the variances (c,) of white noise in signals (M, c) with motion at all frequencies.

    The spectrum of motion falls with the second or fourth power of the frequency.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - loads slowly, and is seldom needed

    frequency, power = power_spectrum(signals, rate)
    edges = np.searchsorted(frequency, np.linspace(HIGHEST * rate, rate / 2, PARTS + 1))
    parts = [slice(*ends) for ends in pairwise(edges.tolist())]
    means = np.array([power[part].mean(axis=0) for part in parts])
    relative = frequency / (rate / 2)
    shapes = np.array([[np.mean(relative[part] ** -k) for k in (0.0, 2.0, 4.0)] for part in parts])
    found = np.zeros(signals.shape[1])
    for index, mean in enumerate(means.T):
        if np.all(mean > 0):  # neither constant nor lost
            fit = mean
            for _ in range(REWEIGHTINGS):
                share, _ = nnls(shapes / fit[:, None], mean / fit)
                fit = shapes @ share
            found[index] = share[0]
    return found


def _readings(block: Segment, low_pass: LowPass) -> SensorSamples:
    """Return the samples of a block with derivatives for all bands."""

    def motion(signal: FloatArray, order: int) -> tuple[FloatArray, ...]:
        return derivatives(signal, low_pass, block.rate, order)

    position, velocity, acceleration = motion(block.position, 2)
    angular_velocity, angular_acceleration = motion(block.angular_velocity, 1)
    return SensorSamples(
        stamp=block.stamp,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=motion(block.effort, 0)[0],
        angular_velocity=angular_velocity,
        angular_acceleration=angular_acceleration,
        specific_force=motion(block.linear_acceleration, 0)[0],
        wrenches=motion(block.wrenches, 0)[0],
        imu_frames=block.imu_frames,
        wrench_frames=block.wrench_frames,
        touching=block.touching,
    )
