"""The bound with unknown motion against Monte Carlo runs of maximum likelihood on a spring."""

import numpy as np
import pytest
from noise_bound import information
from scipy.optimize import least_squares

RATE, COUNT, BLOCK = 100.0, 4096, 256
TRUTH = np.array([2.0, 300.0])  # mass, kg, and stiffness, N/m
NOISE = 1e-3, 0.5  # of positions, m, and forces, N


def response(values, frequency):
    """Return the force per position of a mass on a spring."""
    return values[1] - values[0] * (2 * np.pi * frequency) ** 2


def test_maximum_likelihood_reaches_the_bound_of_unknown_motion():
    rng = np.random.default_rng(0)
    frequency = np.fft.rfftfreq(COUNT, 1 / RATE)
    size = np.where((frequency > 0.5) & (frequency < 4), 1.0, 0.0)
    position = np.fft.irfft(size * np.exp(2j * np.pi * rng.random(len(frequency))), COUNT)
    position *= 0.05 / position.std()
    spectrum = np.fft.rfft(position)
    second = np.fft.irfft(-((2 * np.pi * frequency) ** 2) * spectrum, COUNT)
    K = np.column_stack([second, position])[:, None]

    def noise(at):
        channels = [NOISE[0] * response(TRUTH, at), np.full(len(at), -NOISE[1])]
        return np.stack(channels, axis=1)[:, None].astype(complex)

    starts = range(0, COUNT - BLOCK + 1, BLOCK // 2)
    parts = [information(K[one : one + BLOCK], RATE, noise, (0.0, 2.0, 51.0)) for one in starts]
    bound = np.linalg.inv(np.sum(parts, axis=(0, 1)))
    true_force = np.fft.rfft(K[:, 0] @ TRUTH)
    scale = np.sqrt(COUNT / 2)

    def estimate():
        errors = scale * (rng.normal(size=(4, len(frequency))))
        read = spectrum + NOISE[0] * (errors[0] + 1j * errors[1])
        force = true_force + NOISE[1] * (errors[2] + 1j * errors[3])

        def residual(values):
            # The positions are profiled out, one for each frequency.
            h = response(values, frequency)
            left = (force - h * read) / np.hypot(NOISE[1], h * NOISE[0]) / scale
            return np.concatenate([left.real, left.imag])

        return least_squares(residual, TRUTH, x_scale=TRUTH).x

    found = np.array([estimate() for _ in range(300)]) - TRUTH
    # Half of 300 squares' relative deviation is 4 %, and the ends of the log lack a window.
    ratio = np.diag(found.T @ found / 300) / np.diag(bound)
    assert ratio == pytest.approx(1.0, abs=0.25)
