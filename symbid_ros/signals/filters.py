"""Zero-phase low-pass filters and differentiation."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import butter, sosfiltfilt

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError

Channels = Literal["all", "thesis"]

# The thesis filters joint positions, their derivative and that one's derivative: so often its joint
# accelerations pass. Given to every channel, it leaves both sides of the equation of motion alike,
# and the least of the gyroscope's noise in the base's angular acceleration.
PASSES = 3


@dataclass(frozen=True)
class LowPass:
    """Second-order Butterworth, run forwards and backwards (Matlab's ``filtfilt``).

    Attributes
    ----------
    cutoff : float
        Hz; 0 passes everything.
    channels : {"all", "thesis"}
        "all" runs the filter ``PASSES`` times over every channel, forces included, so
        that both sides of the equation of motion lose the same band. "thesis" runs it
        once over joint positions and the body's rate before they are differentiated
        and once more over each derivative, and leaves torques, wrenches and the
        accelerometer alone (thesis, section III-E).
    """

    cutoff: float = 30.0
    channels: Channels = "all"

    def __post_init__(self) -> None:
        """Refuse a cutoff that is no frequency."""
        if not (np.isfinite(self.cutoff) and self.cutoff >= 0):
            raise DataError(f"cutoff {self.cutoff} Hz is no frequency; give 0 (no filter) or more")

    def __str__(self) -> str:
        """Return what a report says of it."""
        if self.cutoff == 0:
            return "none"
        passes = f"{PASSES} passes" if self.channels == "all" else "the thesis's passes"
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
        if self.cutoff >= rate / 2:
            raise DataError(
                f"cutoff {self.cutoff:g} Hz is not below half the rate of {rate:g} Hz; lower it"
            )
        sections = np.tile(butter(2, self.cutoff, fs=rate, output="sos"), (passes, 1))
        padding = min(len(signal) - 1, int(3 * passes * rate / self.cutoff))
        filtered: FloatArray = sosfiltfilt(sections, signal, axis=0, padlen=padding)
        return filtered

    def motion(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return a position or rate of turn as this choice treats it before derivatives."""
        return self(signal, rate, PASSES if self.channels == "all" else 1)

    def force(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return a force, torque or specific force as this choice of channels treats it."""
        return self(signal, rate, PASSES) if self.channels == "all" else signal

    def derivative(self, signal: FloatArray, rate: float) -> FloatArray:
        """Return the time derivative of a filtered signal as this choice treats it."""
        slope = differentiate(signal, rate)
        return self(slope, rate) if self.channels == "thesis" else slope

    def settling(self, rate: float) -> int:
        """Return the number of samples at either end that still feel the edge."""
        return 2 if self.cutoff == 0 else max(2, int(np.ceil(PASSES * rate / self.cutoff)))

    def stride(self, rate: float) -> int:
        """Return how many samples apart rows still carry all that passed the filter.

        Five samples per period of the cutoff: what lies above is attenuated by more
        than 99 %, so denser rows repeat one another.
        """
        return 1 if self.cutoff == 0 else max(1, int(rate / (5 * self.cutoff)))


def differentiate(signal: FloatArray, rate: float) -> FloatArray:
    """Return the central difference along the first axis, second order at the ends too."""
    slope: FloatArray = np.gradient(signal, 1.0 / rate, axis=0, edge_order=2)
    return slope
