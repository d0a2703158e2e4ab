"""Velocities as a controller gets them: filtered while time goes on, hence late."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import sosfilt, sosfilt_zi

from symbid_ros.arrays import FloatArray
from symbid_ros.signals.filters import butterworth, check_cutoff

# Periods of the cutoff after which the second-order filter has forgotten its start to 2e-4.
SETTLED = 2.0


@dataclass(frozen=True)
class CausalLowPass:
    """Second-order Butterworth run forwards alone, as a low-level estimator does.

    Below its cutoff it delays by about 0.225 / cutoff seconds.

    Attributes
    ----------
    cutoff : float
        Hz; 0 passes everything.
    """

    cutoff: float = 50.0

    def __post_init__(self) -> None:
        """Refuse a cutoff that is no frequency."""
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
        start = sosfilt_zi(sections)[:, :, None] * flat[0]
        filtered: FloatArray = sosfilt(sections, flat, axis=0, zi=start)[0].reshape(signal.shape)
        return filtered

    def velocity(self, position: FloatArray, rate: float) -> FloatArray:
        """Return the filtered backward difference of positions (N, ...); it starts with zero."""
        return self(np.diff(position, axis=0, prepend=position[:1]) * rate, rate)

    def settling(self, rate: float) -> int:
        """Return the number of samples at the start that still feel it."""
        return 1 if self.cutoff == 0 else int(np.ceil(SETTLED * rate / self.cutoff)) + 1
