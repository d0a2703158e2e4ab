"""What one or several logs say: the rows' information, and that of the noise in them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information, RowLayout
from symbid_ros.signals.weak_form import INFLATION, SampledRows, WindowedRows

# Fewer samples than this per coordinate give no covariance between coordinates worth having.
SAMPLES_PER_COORDINATE = 3
# Share of a coordinate's mean square that is rounding, and no residual.
LEAST = 1e-14
# Shares of its diagonal that make a moment positive definite in spite of rounding, tried in turn.
ROUNDING = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)
# So much more is the variance of a coordinate that has no say.
SILENT = 1e20
# Largest ratio of two estimates of one covariance that is taken for chance.
CHANCE = 2.0
# Independent rows that a coordinate must have, and more for each parameter that it alone feels.
FEWEST_ROWS = 5
ROWS_PER_OWN_PARAMETER = 3


@dataclass(frozen=True)
class Observations:
    """Rows averaged over windows of one length, folded.

    Attributes
    ----------
    rows : Information
        Of the rows.
    noise : Information
        Of the differences that as much noise again in the motion makes. As Σ ΔᵀΔ of [K y] it is
        what that noise adds, on average, to the rows' own moments.
    counts : (n, n) float64
        In how many samples two coordinates are both used.
    window : float
        s.
    inflation : float
        By how much overlapping windows make the rows look more than they are.
    kept : float
        Share of the first rows' weight that has not faded.
    seconds : frozenset of int
        Fingerprints of the seconds that the rows cover; none for rows of unknown origin.
    """

    rows: Information
    noise: Information
    counts: FloatArray
    window: float
    inflation: float = INFLATION
    kept: float = 1.0
    seconds: frozenset[int] = frozenset()

    @classmethod
    def empty(cls, layout: RowLayout, window: float) -> "Observations":
        """Return the state before any data."""
        n = len(layout.coordinates)
        nothing = Information.empty(layout)
        return cls(nothing, nothing, np.zeros((n, n)), window)

    @property
    def layout(self) -> RowLayout:
        """What the flat rows hold."""
        return self.rows.layout

    @classmethod
    def unwindowed(
        cls, layout: RowLayout, blocks: Iterable[SampledRows], inflation: float
    ) -> "Observations":
        """Fold rows taken at single instants, whose noise is taken as it comes.

        Coordinates that must not be used are left out.
        """
        n = len(layout.coordinates)
        counts = np.zeros((n, n))

        def used() -> Iterator[Rows]:
            nonlocal counts
            for block in blocks:
                valid = block.valid.astype(np.float64)
                counts = counts + valid.T @ valid
                yield Rows(block.rows.K * valid[..., None], block.rows.y * valid)

        rows = Information.empty(layout).fold(used())
        return cls(rows, Information.empty(layout), counts, 0.0, inflation)

    def fold(self, blocks: Iterable[WindowedRows]) -> "Observations":
        """Return the observations with more rows in them."""
        kept = list(blocks)
        if not kept:
            return self
        counts = self.counts
        noisy = [block.noise for block in kept if block.noise.K.any() or block.noise.y.any()]
        for block in kept:
            valid = block.valid.astype(np.float64)
            counts = counts + valid.T @ valid
        return replace(
            self,
            rows=self.rows.fold(block.mean for block in kept),
            noise=self.noise.fold(noisy) if noisy else self.noise,
            counts=counts,
        )

    def discounted(self, share: float) -> "Observations":
        """Return the observations with every row's weight times ``share``, from 0 to 1."""
        return replace(
            self,
            rows=self.rows.discounted(share),
            noise=self.noise.discounted(share),
            counts=share * self.counts,
            kept=share * self.kept,
        )

    def covering(self, seconds: frozenset[int]) -> "Observations":
        """Return the observations as covering these seconds, too."""
        return replace(self, seconds=self.seconds | seconds)

    def merge(self, other: "Observations") -> "Observations":
        """Return what both records say together.

        Raises
        ------
        DataError
            When the two are about different robots.
        EstimateError
            When their windows differ: their residuals are not alike.
        """
        if self.window != other.window:
            raise EstimateError(
                f"information over windows of {other.window:g} s cannot be added to information "
                f"over {self.window:g} s; choose one window for both"
            )
        return replace(
            self,
            rows=self.rows.merge(other.rows),
            noise=self.noise.merge(other.noise),
            counts=self.counts + other.counts,
            kept=min(self.kept, other.kept),
            seconds=self.seconds | other.seconds,
        )

    def residual_covariance(self, phi: FloatArray) -> FloatArray:
        """Return Σ (n, n) of one row's residual at φ (p,), overlap accounted for.

        Coordinates that are left out here and there are taken to be independent of the
        others: what a residual that was not there would have said of theirs is
        not known. So are all of a log too short to tell.

        Weights taken from the residuals they weigh look better than they are: of N independent
        rows of n coordinates by (N + n)/(N - n) in variance. That is made up for.
        """
        moment = self.rows.residual_moment(phi) / np.maximum(self.counts, 1)
        moment[~self._coupled] = 0.0
        # A coordinate without any residual is an ideal one; its weight must stay finite. One with
        # too few rows fits whatever they say, and has no say.
        floor = self._least_residual
        floor[self._scarce] = SILENT * floor.max()
        moment[np.diag_indices(len(moment))] = np.maximum(moment.diagonal(), floor) + floor
        coupled = int(np.sum(self._coupled.sum(axis=0) > 1))
        moment = _definite(moment)
        if coupled == 0:
            return self.inflation * moment
        independent = self.rows.samples / self.inflation
        return self.inflation * (independent + coupled) / (independent - coupled) * moment

    def plausible_noise(self, phi: FloatArray, covariance: FloatArray) -> float:
        """Return the share of the noise's moments that the residuals Σ (n, n) leave room for.

        Noise in K is in the residual at φ (p,) as well. Where it were more than all that is
        there, and than chance lets two estimates of one covariance differ, motion has been taken
        for noise.
        """
        moment = self.noise.approximate_residual_moment(phi) / np.maximum(self.counts, 1)
        moment[~self._coupled] = 0.0
        largest = eigh(self.inflation * moment, covariance, eigvals_only=True)[-1]
        return float(1 / max(largest / CHANCE, 1.0))

    @property
    def _coupled(self) -> BoolArray:
        """(n, n) pairs of coordinates seen together often enough to tell their covariance."""
        n = len(self.counts)
        # Counts that have faded are equal but for rounding.
        full = np.diag(self.counts) > (1 - 1e-9) * self.rows.samples
        full &= self.rows.samples > SAMPLES_PER_COORDINATE * n * self.inflation
        return np.asarray(np.outer(full, full) | np.eye(n, dtype=bool))

    @property
    def _least_residual(self) -> FloatArray:
        """(n,) variances below which a residual is rounding."""
        scale = self.rows.target_squares / np.maximum(self.counts.diagonal(), 1)
        largest = float(scale.max()) or 1.0
        return np.asarray(LEAST * scale + 1e-4 * LEAST * largest)

    @property
    def _scarce(self) -> BoolArray:
        """(n,) coordinates with too few rows for the parameters that only they feel."""
        structure = self.layout.structure
        own = structure[:, structure.sum(axis=0) == 1].sum(axis=1)
        needed = ROWS_PER_OWN_PARAMETER * own + FEWEST_ROWS
        return np.asarray(self.counts.diagonal() < needed * self.inflation)


def _definite(moment: FloatArray) -> FloatArray:
    """Return a moment (n, n) that is positive definite in floating point.

    Residuals without noise may depend on one another exactly, as those of efforts that are always
    zero: rounding then leaves eigenvalues below zero.
    """
    own = np.diag(np.diag(moment))
    # Whoever factors a multiple of it rounds otherwise.
    margin = 4 * len(moment) * np.finfo(float).eps * own
    for share in ROUNDING:
        definite = moment if share == 0 else moment + share * own
        try:
            np.linalg.cholesky(definite - margin)
        except np.linalg.LinAlgError:
            continue
        return definite
    return own


def whiteness(short: Observations, long: Observations, phi: FloatArray) -> float:
    """Return how much less the residual at φ (p,) shrinks in longer windows than noise would.

    White noise loses variance as windows gain length; what lasts, as an error of the model or of
    a sensor's calibration does, loses none. It may show in few combinations of coordinates, so
    the one that lasts longest counts: its variance in long windows over what noise would have
    left, at most the ratio of the windows' lengths, and over what chance makes of the largest of
    n (Marchenko and Pastur 1967). Noise gives 1 or less.
    """
    together = short._coupled & long._coupled
    before, after = (
        np.where(together, one.inflation * one.rows.residual_moment(phi), 0.0)
        / np.maximum(one.counts, 1)
        for one in (short, long)
    )
    # What is rounding is noise.
    rounding = np.diag(short._least_residual)
    before, after = before + rounding, after + rounding * short.window / long.window
    used = np.flatnonzero(~(short._scarce | long._scarce))
    if len(used) == 0:
        return 1.0
    some = np.ix_(used, used)
    kept = float(eigh(after[some], _definite(before[some]), eigvals_only=True)[-1])
    independent = float(long.counts.diagonal()[used].min()) / long.inflation
    chance = (1 + float(np.sqrt(len(used) / independent))) ** 2
    return kept * long.window / short.window / chance
