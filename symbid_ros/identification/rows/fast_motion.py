"""Information in motion that is faster than the windows, such as vibration.

Encoders and gyroscopes hardly resolve fast accelerations, but through the model the forces show
them. In a band of frequencies the residual of a row is r = K φ - y = T ε, with the noise ε of all
channels, of covariance S. Given r, the most probable noise is S Tᴴ C⁻¹ r, C = T S Tᴴ. Without it,
K becomes K̂, whose remaining noise is independent of r. So the score -K̂ᴴ C⁻¹ r is unbiased, although
K contains noise many times its signal, and K̂ᴴ C⁻¹ K̂, less what noise adds to it, is the information
(the profile likelihood of the errors-in-variables model; Fuller 1987, Measurement Error Models,
chapter 2). K̂ and C depend on φ, so that a few Gauss-Newton steps start from the estimate of slow
motion.

S is estimated from the same residuals by expectation maximisation (Dempster, Laird and Rubin 1977,
J. R. Statist. Soc. B 39(1)). A robot whose forces are not explained at these frequencies, such as a
flexible one, thus gets noisy forces, and its fast motion little weight. Bands whose score
contradicts the slow motion are not used.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import SLIDING_TERMS
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.rows.window_comparison import COMPARABLE
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.signals.fast_rows import LENGTH, SPACING, Bands, ComplexArray, FastRows
from symbid_ros.signals.segments import RemoteSegments, Segment
from symbid_ros.signals.weak_form import BLOCK, INFLATION, cut_into_blocks

logger = logging.getLogger(__name__)

# Bytes of rows that are kept; of a longer log, blocks at equal distances are used.
MOST_KEPT = 64 << 20
# A block contains fast motion if the power of the efforts in the bands exceeds that of their noise
# by this factor, in the mean over the joints.
FAST = 10.0
PARTS = 4  # of a block, in at least half of which there is fast motion
# Information, in bits, from which fast motion is used.
LEAST_BITS = 3.0
# Mean square of a band's normalised score, above which it contradicts the slow motion.
CONTRADICTION = 3.0
# Information in posterior deviations, below which a direction cannot show a contradiction.
INFORMATIVE = 0.05
# Averages over a Hann window of N samples have 1.5/N of the variance of white noise.
HANN = 1.5
# Relative deviation of the variances of the motion's noise, which vibrations hide.
SPREAD = 0.1
STEPS, MAXIMISATIONS, RELAXATION = 4, 30, 1.8
# Windows from which the noise is estimated, at most.
MOST_WINDOWS = 300
# Relative difference of rates with the same bands.
SAME_RATE = 0.01
# Share of the mean variance that keeps covariances definite, and variances of unused coordinates.
ROUNDING, UNUSED = 1e-9, 1e6


def with_fast_motion(solved: SolvedProblem, dataset: Dataset) -> SolvedProblem:
    """Return the solution that uses fast motion too, if the log of a floating robot contains any.

    Joint terms are those of the given solution.
    """
    rows = tuple(_fast_rows(solved, dataset))
    if not rows:
        return solved
    rate = rows[0].bands.rate  # another log may have another rate, and other bands
    rows = tuple(one for one in rows if np.isclose(one.bands.rate, rate, rtol=SAME_RATE))
    try:
        return _solved(_FastMotion.of(rows, solved), solved, dataset.source)
    except np.linalg.LinAlgError:  # readings without noise
        logger.info("%s: the noise of fast motion cannot be estimated", dataset.source)
        return solved


def _solved(motion: "_FastMotion", solved: SolvedProblem, source: str) -> SolvedProblem:
    slow, found = solved.posterior, solved
    scores = motion.scores(slow.mean, len(motion.bands))
    used = _consistent(scores, slow.deviation_factor)
    bits = _bits(scores[:used], slow.deviation_factor, slow.prior.std)
    if bits < LEAST_BITS:
        return solved
    for step in range(STEPS):
        before = found.posterior.mean
        if step:
            scores = motion.scores(before, used)
        measurements = _together(scores[:used]).measurements(before, slow.prior.std)
        found = solved.with_measurements(measurements)
        change = found.posterior.factor @ (found.posterior.mean - before)
        if change @ change < COMPARABLE**2 * len(change):
            break
    highest = motion.bands.frequencies[used - 1]
    logger.info("%s: fast motion up to %.0f Hz adds %.0f bits", source, highest, bits)
    return found


@dataclass(frozen=True)
class Score:
    """Score function of rows: the gradient of their log likelihood near a point.

    Attributes
    ----------
    gradient : (p,) float64
        Of the log likelihood at the point.
    slope : (p, p) float64
        How much the gradient falls with the parameters.
    covariance : (p, p) float64
        Of the gradient: the slope, and what noise in the regressor adds.
    """

    gradient: FloatArray
    slope: FloatArray
    covariance: FloatArray

    @classmethod
    def zero(cls, count: int) -> "Score":
        """Return the score of no rows about ``count`` parameters."""
        return cls(np.zeros(count), np.zeros((count, count)), np.zeros((count, count)))

    def measurements(self, phi: FloatArray, scale: FloatArray) -> PseudoMeasurements:
        """Return the score at φ (p,) as measurements; parameters without a ``scale`` are known."""
        free = scale > 0
        unit = np.where(free, scale, 0.0)
        values, V = np.linalg.eigh(self.covariance * np.outer(unit, unit))
        some = values > ROUNDING * values[-1]
        whitening = (V[:, some] * unit[:, None] / np.sqrt(values[some])).T
        rows = np.where(free, whitening @ self.slope, 0.0)
        return PseudoMeasurements(rows, rows @ phi + whitening @ self.gradient)

    def contradiction(self, factor: FloatArray) -> float:
        """Return the mean square of the normalised gradient at the mean of a posterior.

        It is about one if rows and posterior, of covariance L Lᵀ, agree.
        """
        # The gradient varies by noise and by the error of the mean.
        slope = factor.T @ self.slope @ factor
        values, V = np.linalg.eigh(factor.T @ self.covariance @ factor + slope @ slope)
        some = values > INFORMATIVE
        if not some.any():
            return 0.0
        return float(np.mean((V[:, some].T @ (factor.T @ self.gradient)) ** 2 / values[some]))


def _consistent(scores: Sequence[Score], factor: FloatArray) -> int:
    """Return how many bands, from the lowest, agree with a posterior of covariance L Lᵀ."""
    for used, one in enumerate(scores):
        if one.contradiction(factor) > CONTRADICTION:
            return used
    return len(scores)


def _together(scores: Sequence[Score]) -> Score:
    """Return the score of several bands together."""
    return Score(
        np.sum([one.gradient for one in scores], axis=0),
        np.sum([one.slope for one in scores], axis=0),
        np.sum([one.covariance for one in scores], axis=0),
    )


def _bits(scores: Sequence[Score], factor: FloatArray, scale: FloatArray) -> float:
    """Return the information, bits, that bands add to a posterior of covariance L Lᵀ."""
    if not scores:
        return 0.0
    rows = _together(scores).measurements(np.zeros(len(factor)), scale).rows @ factor
    return float(np.sum(np.log2(np.hypot(1, np.linalg.svd(rows, compute_uv=False)))))


@dataclass(frozen=True)
class _FastMotion:
    """Rows in bands with the variances (c,) of the noise of their channels."""

    rows: tuple[FastRows, ...]
    bands: Bands
    variance: FloatArray

    @classmethod
    def of(cls, rows: tuple[FastRows, ...], solved: SolvedProblem) -> "_FastMotion":
        mean = solved.posterior.mean
        return cls(rows, rows[0].bands, noise_variances(rows, mean, _start(rows, solved)))

    def scores(self, phi: FloatArray, count: int) -> list[Score]:
        """Return the score of each of the lowest ``count`` bands near parameters φ (p,)."""
        found = [Score.zero(len(phi)) for _ in range(count)]
        m = self.rows[0].channels.motion
        corrections = np.zeros((count, m, len(phi)))
        for part in _parts(self.rows):
            responses = part.responses()
            slope, residuals = responses.of_residual(phi), part.residuals(phi)
            rng = np.random.default_rng(int(part.at.stamp[0]) % 2**63)
            for band in range(count):
                whitening, noise, left = self._noise(part, slope, residuals[:, band], band, rng)
                K = part.K[:, band] - _combined(noise, responses.K)
                white = np.einsum("wij,wj->wi", whitening, residuals[:, band])
                weighted = np.einsum("wij,wi->wj", whitening.conj(), white)
                total = _gram(whitening @ K)
                excess = _gram(whitening @ _combined(left, responses.K))
                gradient = np.einsum("wnp,wn->p", K.conj(), weighted, optimize=True).real
                found[band] = _together([found[band], Score(-gradient, total - excess, total)])
                towards = np.einsum("wmnp,wn->wmp", responses.K, weighted, optimize=True)
                corrections[band] += np.einsum("wm,wmp->mp", noise.conj(), towards).real
        share = 2 / INFLATION  # real and imaginary parts count
        return [
            Score(
                share * one.gradient,
                share * one.slope,
                share * one.covariance + (share * SPREAD) ** 2 * unsure.T @ unsure,
            )
            for one, unsure in zip(found, corrections, strict=True)
        ]

    def _noise(
        self,
        part: FastRows,
        slope: FloatArray,
        residuals: ComplexArray,
        band: int,
        rng: np.random.Generator,
    ) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return what whitens the residuals (N, n, n), and the noise of the motion (N, m).

        The noise of its derivatives is the most probable one, and a draw of what it lacks.
        """
        power, _ = self.bands.noise
        m, derivative = part.channels.motion, self.bands.derivative(part.channels, band)
        T, S = slope * derivative, power * self.variance
        root = np.linalg.cholesky(_covariance(T, S, part.valid))
        whitening = np.asarray(np.linalg.inv(root), dtype=np.complex128)
        white = np.einsum("wij,wj->wi", whitening, residuals)
        towards = whitening @ (T[:, :, :m] * S[:m])
        adjoint = towards.conj().transpose(0, 2, 1)
        found = np.einsum("wmn,wn->wm", adjoint, white)
        size, V = np.linalg.eigh(np.diag(S[:m]) - adjoint @ towards)
        draw = rng.standard_normal((len(part), m, 2)) @ (np.sqrt(0.5), 1j * np.sqrt(0.5))
        left = np.einsum("wmk,wk->wm", V, np.sqrt(np.maximum(size, 0.0)) * draw)
        return whitening, found * derivative[:m], left * derivative[:m]


def noise_variances(rows: Sequence[FastRows], phi: FloatArray, start: FloatArray) -> FloatArray:
    """Return the variances (c,) of the noise of all channels, per sample.

    Expectation maximisation at parameters φ (p,), from variances ``start`` (c,).
    """
    bands, channels = rows[0].bands, rows[0].channels
    share = max(1, sum(map(len, rows)) // MOST_WINDOWS)
    some = [one[::share] for one in rows]
    slope = np.concatenate([part.responses().of_residual(phi) for part in _parts(some)])
    valid = np.concatenate([one.valid for one in some])
    residuals = np.concatenate([one.residuals(phi) for one in some])
    power, S = bands.noise[0], bands.noise[0] * start
    for _ in range(MAXIMISATIONS):
        total = np.zeros(len(channels))
        for band in range(len(bands)):
            T = slope * bands.derivative(channels, band)
            towards = T.conj().transpose(0, 2, 1) @ np.linalg.inv(_covariance(T, S, valid))
            mean = np.einsum("wcn,wn->wc", towards, residuals[:, band])
            known = np.einsum("wcn,wnc->wc", towards, T).real
            total += np.mean(S * (np.abs(mean) ** 2 - known), axis=0)
        # Steps of EM are short where other channels imitate one.
        S = S * np.maximum(1 + total / len(bands), 0.1) ** RELAXATION
    return np.asarray(S / power)


def _start(rows: Sequence[FastRows], solved: SolvedProblem) -> FloatArray:
    """Return first guesses (c,) of the channels' variances.

    Motion fills the spectra of forces and accelerometers. The efforts' noise is at most that of
    slow rows, and the others are taken to exceed theirs as far.
    """
    channels = rows[0].channels
    largest = np.mean([one.noise for one in rows], axis=0)
    efforts = slice(channels.motion, channels.motion + channels.joints)
    ratio = _row_noise(solved, rows[0].bands.rate) / np.maximum(largest[efforts], 1e-300)
    is_direct = channels.order == 0
    return np.asarray(np.where(is_direct, min(np.median(ratio), 1.0), 1.0) * largest)


def _row_noise(solved: SolvedProblem, rate: float) -> FloatArray:
    """Return the variances (J,) that samples of the efforts have at most, from slow rows."""
    joints = len(solved.problem.parameters.model.joints)
    of_rows = solved.posterior.covariance.diagonal()[-joints:] / solved.chosen.inflation
    return np.asarray(of_rows * solved.chosen.window * rate / HANN)


def _covariance(T: ComplexArray, S: FloatArray, valid: BoolArray) -> ComplexArray:
    """Return T S Tᴴ (N, n, n), definite, for T (N, n, c) and S (c,)."""
    covariance: ComplexArray = (T * S) @ T.conj().transpose(0, 2, 1)
    diagonal = np.einsum("wii->wi", covariance)
    diagonal += np.where(valid, ROUNDING, UNUSED) * diagonal.real.mean(axis=1, keepdims=True)
    return covariance


def _combined(weights: ComplexArray, K: FloatArray) -> ComplexArray:
    """Return Σ_m of weights (N, m) times K (N, m, n, p)."""
    count, m, n, p = K.shape
    flat = K.reshape(count, m, n * p)
    total = weights.real[:, None] @ flat + 1j * (weights.imag[:, None] @ flat)
    return np.asarray(total.reshape(count, n, p))


def _gram(K: ComplexArray) -> FloatArray:
    """Return the real part of Σ Kᴴ K over windows and coordinates (N, n, p)."""
    flat = K.reshape(-1, K.shape[-1])
    both = np.concatenate([flat.real, flat.imag])
    gram: FloatArray = both.T @ both
    return gram


def _parts(rows: Sequence[FastRows]) -> Iterator[FastRows]:
    for one in rows:
        yield from one.parts()


def _fast_rows(solved: SolvedProblem, dataset: Dataset) -> Iterator[FastRows]:
    """Yield the rows of blocks with fast motion, at equal distances."""
    problem, segments = solved.problem, dataset.segments
    model, stamp = problem.parameters.model, dataset.samples.stamp
    if (
        not (model.floating and model.joints and len(stamp))
        or model.contacts is not None
        or model.wrist_sensors
        or problem.sensor_names
        or solved.chosen.window == 0
        or isinstance(segments, RemoteSegments)
    ):
        return
    parameters = replace(problem.parameters, candidates=False)
    used = ~_have_dry_friction(problem)
    # Where dry friction changes its sign, the effort jumps, which all frequencies contain.
    joints = used[6:]
    blocks = len(stamp) * float(np.median(np.diff(stamp, prepend=stamp[0] - BLOCK))) / BLOCK
    index = 0
    for segment in segments:
        bands = Bands(segment.rate)
        if not len(bands):
            continue
        noise = _row_noise(solved, segment.rate)
        size = 2 * BLOCK * 1e-9 / LENGTH * len(bands) * model.dof * len(parameters) * 8
        stride = int(np.ceil(blocks * size / MOST_KEPT))
        for block in cut_into_blocks(segment):
            index += 1
            if index % stride:
                continue
            power = effort_powers(block, bands)[joints]
            if joints.any() and np.mean(power / noise[joints]) > FAST:
                found = FastRows.of(block, parameters, bands)
                if found is not None:
                    yield replace(found, valid=found.valid & used)


def effort_powers(block: Segment, bands: Bands) -> FloatArray:
    """Return the variances (J,) of white noise that had the efforts' power in the bands.

    It is the median of the powers in parts of the block, so that one impact does not count.
    """
    effort = np.nan_to_num(block.effort - block.effort.mean(axis=0))
    window = np.hanning(len(block))
    spectrum = np.fft.rfft(window[:, None] * effort, axis=0)
    frequency = np.fft.rfftfreq(len(block), 1 / block.rate)
    some = np.abs(frequency - bands.frequencies.mean()) <= len(bands) * SPACING / 2
    fast = np.fft.irfft(np.where(some[:, None], spectrum, 0.0), len(block), axis=0)
    powers = [
        np.sum(part**2, axis=0) / np.sum(weight**2)
        for part, weight in zip(
            np.array_split(fast, PARTS), np.array_split(window, PARTS), strict=True
        )
    ]
    share: float = some.mean()
    return np.asarray(np.median(powers, axis=0) / share)


def _have_dry_friction(problem: Problem) -> BoolArray:
    """Return which coordinates (n,) have friction that changes its sign with the velocity."""
    parameters = problem.parameters
    model, found = parameters.model, np.zeros(parameters.model.dof, dtype=bool)
    joints = 6 * model.floating + np.array(parameters.joints, dtype=np.int64)
    std = problem.prior.std
    for term in SLIDING_TERMS:
        if term in parameters.term_columns:
            found[joints] |= std[parameters.term_columns[term]] > 0
        if term in parameters.known_terms:
            found[6 * model.floating :] |= parameters.known_terms[term] != 0
    return found
