"""Scale errors of an IMU that gravity shows, without a model.

Over a window of some seconds a robot's mean acceleration is small. The specific force, turned into
the axes of the window's start by the angular velocity, then averages to the length of gravity. And
the averages over the window's first and second half have the same direction, if the angular
velocity has the right scale.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.signals.streams import ImuStream

GRAVITY = 9.81  # m/s²
WINDOW = 4.0  # s
STEP = 0.02  # s over which rotations are composed
FEWEST_WINDOWS = 4
# Gravity differs by 0.3 % on Earth, and a calibrated accelerometer by another 0.3 %.
ACCELEROMETER_ERROR = 0.006
# Calibrated gyroscopes differ by less than 1 %. Soft soles and rolling feet explain 5 %.
GYROSCOPE_ERROR = 0.05
DEVIATIONS = 5.0
# A mean specific force below this share of gravity is not a gain error: gravity was removed.
LEAST_OF_GRAVITY = 0.5
# Half-overlapped windows: each mean counts for this share.
INDEPENDENT = 0.75
# Usual bias of a gyroscope, rad/s.
BIAS = 0.01


@dataclass
class GravityMoments:
    """Mean specific force over windows, and how it depends on the gyroscope's gain and bias.

    Attributes
    ----------
    lengths : list of float
        Length of each window's mean specific force, m/s².
    normal : (5, 5) float64
        Moments of the rows [D, d]: D (3, 4) derivatives of the turn of gravity within a window by
        the gyroscope's inverse gain and its bias, and d (3,) that turn.
    """

    lengths: list[float] = field(default_factory=list)
    normal: FloatArray = field(default_factory=lambda: np.zeros((5, 5)))

    def add(self, imu: ImuStream) -> None:
        """Add the messages of a slice, in the order of their stamps."""
        is_known = np.isfinite(imu.angular_velocity).all(axis=1)
        is_known &= np.isfinite(imu.linear_acceleration).all(axis=1)
        stamp = imu.stamp[is_known]
        if len(stamp) < FEWEST_WINDOWS or stamp[-1] == stamp[0]:
            return
        time = (stamp - stamp[0]) * 1e-9
        bins = int(time[-1] / STEP)
        half = round(WINDOW / STEP / 2)
        windows = bins // half - 1
        if windows < 1:
            return
        rate = _binned(time, imu.angular_velocity[is_known], bins)
        force = _binned(time, imu.linear_acceleration[is_known], bins)
        place = half * np.arange(windows)[:, None] + np.arange(2 * half)
        rate, force = rate[place], force[place]
        rotation = _rotations(rate)
        turned = np.einsum("wtij,wtj->wti", rotation, force)
        whole = np.hanning(2 * half + 2)[1:-1]
        mean = np.einsum("t,wti->wi", whole / whole.sum(), turned)
        self.lengths += np.linalg.norm(mean, axis=1).tolist()
        # Small changes of the rate turn the forces by their integral from the middle.
        changes = np.concatenate(
            [rotation, np.einsum("wtij,wtj->wti", rotation, rate)[..., None]], axis=3
        )
        angle = STEP * np.cumsum(changes, axis=1)
        angle -= angle[:, half - 1 : half] + 0.5 * STEP * (changes - changes[:, half - 1 : half])
        moved = np.cross(angle, turned[..., None], axis=2)
        rows = np.concatenate([moved[..., [3, 0, 1, 2]], turned[..., None]], axis=3)
        part = np.hanning(half + 2)[1:-1]
        weight = np.append(-part, part) / part.sum()
        between = np.einsum("t,wtic->wic", weight, rows).reshape(-1, 5)
        self.normal += between.T @ between

    @property
    def is_known(self) -> bool:
        """Whether there are enough windows."""
        return len(self.lengths) >= FEWEST_WINDOWS

    @property
    def length(self) -> tuple[float, float]:
        """Mean length of the specific force and its standard deviation, m/s²."""
        lengths = np.array(self.lengths)
        spread = lengths.std(ddof=1) / np.sqrt(INDEPENDENT * len(lengths))
        return float(lengths.mean()), float(spread)

    @property
    def gyroscope(self) -> tuple[float, float]:
        """Gain of the gyroscope relative to the turn of gravity and its standard deviation."""
        D, d = self.normal[:4, :4], self.normal[:4, 4]
        precision = np.diag([1.0, *np.full(3, BIAS**-2)])
        rows = 3 * INDEPENDENT * len(self.lengths)
        left = float(self.normal[4, 4])
        for _ in range(3):
            weight = rows / max(left, 1e-12)
            covariance = np.linalg.inv(weight * D + precision)
            at = -covariance @ (weight * d)
            left = float(self.normal[4, 4] + 2 * at @ d + at @ D @ at)
        inverse = 1 + at[0]
        return float(1 / inverse), float(np.sqrt(covariance[0, 0]) / inverse**2)


def _binned(time: FloatArray, values: FloatArray, bins: int) -> FloatArray:
    """Return the means (bins, 3) of values (N, 3) over consecutive steps."""
    place = (time / STEP).astype(int)
    inside = place < bins
    count = np.bincount(place[inside], minlength=bins)
    sums = np.stack(
        [np.bincount(place[inside], one[inside], minlength=bins) for one in values.T], axis=1
    )
    filled = count > 0
    means = sums[filled] / count[filled, None]
    at = np.arange(bins)
    return np.stack([np.interp(at, at[filled], one) for one in means.T], axis=1)


def _rotations(rate: FloatArray) -> FloatArray:
    """Return the rotations (W, T, 3, 3) from each instant to the middle of W windows."""
    windows, length = rate.shape[:2]
    # Half a step before and after each instant.
    half = Rotation.from_rotvec(0.5 * STEP * rate.reshape(-1, 3)).as_matrix()
    half = half.reshape(windows, length, 3, 3)
    rotation = np.empty_like(half)
    middle = length // 2
    later = earlier = np.broadcast_to(np.eye(3), (windows, 3, 3))
    for step in range(middle):
        after, before = half[:, middle + step], half[:, middle - 1 - step]
        rotation[:, middle + step] = at = later @ after
        later = at @ after
        rotation[:, middle - 1 - step] = at = earlier @ before.swapaxes(1, 2)
        earlier = at @ before.swapaxes(1, 2)
    return rotation


def accelerometer_findings(topic: str, moments: GravityMoments) -> list[Finding]:
    """Return a finding if the accelerometer's mean length is not gravity's."""
    if not moments.is_known:
        return []
    mean, std = moments.length
    error = mean / GRAVITY - 1
    if mean + DEVIATIONS * std < LEAST_OF_GRAVITY * GRAVITY:
        return [
            Finding.of(
                topic,
                Kind.GRAVITY,
                f"linear_acceleration averages {mean:.3g} m/s² over windows of {WINDOW:g} s, it "
                "lacks gravity, or the gyroscope is wrong; give the raw specific force, +9.81 "
                "upwards at rest (REP-145)",
                {"mean_m_s2": mean},
            )
        ]
    if abs(error) <= max(ACCELEROMETER_ERROR, DEVIATIONS * std / GRAVITY):
        return []
    return [
        Finding.of(
            topic,
            Kind.ACCELEROMETER_GAIN,
            f"linear_acceleration averages {mean:.3f} ± {std:.1g} m/s² over windows of "
            f"{WINDOW:g} s, {100 * error:+.1f} % from gravity's {GRAVITY}; calibrate the "
            "accelerometer's gain and bias",
            {"mean_m_s2": mean, "std_m_s2": std, "gain": 1 + error},
            Severity.WARNING,
        )
    ]


def proportional_gain(
    expected: float, product: float, read: float, independent: float
) -> tuple[float, float]:
    """Return the gain of readings relative to what is expected, and its standard deviation.

    Both have errors. The regressions of readings on expected values and the reverse are bounds for
    the gain; the one closer to 1 is returned.

    Parameters
    ----------
    expected, product, read : float
        Sums of squares of expected values, of products, and of squares of readings.
    independent : float
        Number of independent readings.
    """
    low, high = product / expected, read / max(product, 1e-30)
    gain = float(np.clip(1.0, low, high))
    left = max(1 - product**2 / max(expected * read, 1e-30), 0.0)
    return gain, float(gain * np.sqrt(left / max(independent, 1.0)))


def gyroscope_findings(topic: str, gain: float, std: float, reference: str) -> list[Finding]:
    """Return a finding if a gyroscope's gain differs from one by more than its uncertainty."""
    if abs(gain - 1) <= GYROSCOPE_ERROR + DEVIATIONS * std:
        return []
    return [
        Finding.of(
            topic,
            Kind.GYROSCOPE_GAIN,
            f"angular_velocity is {gain:.3f} ± {std:.1g} times {reference}; calibrate the "
            "gyroscope's gain",
            {"gain": gain, "gain_std": std},
            Severity.WARNING,
        )
    ]
