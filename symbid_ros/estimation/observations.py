"""Observations of one or several logs: information of windowed rows and of their noise."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.regressor import Rows
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.group_moments import BY_SECONDS, Grouping, GroupMoments
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.estimation.unfolded_rows import UnfoldedRows
from symbid_ros.signals.sampled_rows import SampledRows
from symbid_ros.signals.weak_form import INFLATION, WindowedRows

# Independent samples per coordinate below which covariances between coordinates are not estimated.
SAMPLES_PER_COORDINATE = 3
# Variance added to each residual, as a share of the coordinate's mean square force and of the
# largest one. Simulation and interpolation have errors of this size. Without it, a log without
# noise would give them large weights, which bias the estimate.
LEAST_OWN, LEAST_OF_ALL = 1e-10, 1e-14
# The same of a coordinate without a measured force, as a share of the mean square load that is
# expected there: it is known to one percent at best.
LEAST_UNFORCED = 1e-4
# Multiples of the diagonal that make a moment positive definite despite rounding, tried in turn.
REGULARIZATIONS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8)
# Factor on the variance of a coordinate that gets no weight.
NO_WEIGHT = 1e20
# Largest ratio of two estimates of one covariance that chance explains.
CHANCE = 2.0
# Independent rows that a coordinate needs, and additional rows per parameter of its own.
FEWEST_ROWS = 5
ROWS_PER_OWN_PARAMETER = 3


@dataclass(frozen=True)
class Observations:
    """Information of rows averaged over windows of one length.

    Attributes
    ----------
    rows : Information
        Information of the rows.
    noise : Information
        Information of the changes Δ of [K y] when the motion's noise is added once more. ΣΔᵀΔ is
        the mean contribution of noise to the rows' moments.
    counts : (n, n) float64
        Number of samples in which two coordinates are both used.
    window : float
        Length of the windows, s.
    inflation : float
        Number of overlapping rows per independent row.
    kept : float
        Share of the first rows' weight that is left after discounting.
    seconds : frozenset of int
        Fingerprints of the seconds that the rows cover; empty for rows of unknown origin.
    groups : GroupMoments or None
        Moments of each coordinate's rows, by groups of seconds; None in archives of earlier
        versions.
    slipping : Observations or None
        Of candidate terms: the same windows without the rows of joints that may stick.
    is_coupled : bool
        Whether residuals of different coordinates may be correlated.
    """

    rows: Information
    noise: Information
    counts: FloatArray
    window: float
    inflation: float = INFLATION
    kept: float = 1.0
    seconds: frozenset[int] = frozenset()
    groups: GroupMoments | None = None
    slipping: "Observations | None" = None
    is_coupled: bool = True

    @classmethod
    def empty(
        cls,
        layout: RowLayout,
        window: float,
        *,
        candidates: bool = False,
        grouping: Grouping = BY_SECONDS,
    ) -> "Observations":
        """Return the observations of no data; of joint terms to be chosen with ``candidates``."""
        n = len(layout.coordinates)
        nothing = Information.empty(layout)
        groups = GroupMoments.empty(layout, candidates=candidates, grouping=grouping)
        one = cls(nothing, nothing, np.zeros((n, n)), window, groups=groups)
        return replace(one, slipping=one) if candidates else one

    @property
    def layout(self) -> RowLayout:
        """Layout of the flat rows."""
        return self.rows.layout

    @classmethod
    def unwindowed(
        cls, layout: RowLayout, blocks: Iterable[SampledRows], inflation: float
    ) -> "Observations":
        """Return the observations of rows at single instants, without information of their noise.

        Invalid coordinates are omitted.
        """
        n = len(layout.coordinates)
        counts = np.zeros((n, n))
        groups = GroupMoments.empty(layout)

        def used() -> Iterator[Rows]:
            nonlocal counts, groups
            for block in blocks:
                valid = block.valid.astype(np.float64)
                counts = counts + valid.T @ valid
                rows = Rows(block.rows.K * valid[..., None], block.rows.y * valid)
                groups = groups.fold_flat(layout.flatten([rows]), block.valid, block.stamp)
                yield rows

        rows = Information.empty(layout).fold(used())
        return cls(rows, Information.empty(layout), counts, 0.0, inflation, groups=groups)

    def fold(self, blocks: Iterable[WindowedRows]) -> "Observations":
        """Return the observations with more rows."""
        kept = list(blocks)
        if not kept:
            return self
        layout, stamp = self.layout, np.concatenate([block.stamp for block in kept])
        noisy = [block for block in kept if block.noise is not None]
        flat = layout.flatten([block.mean for block in kept])
        noise = layout.flatten([block.noise for block in noisy if block.noise is not None])
        valid = np.concatenate([one.valid for one in kept])
        found = self._fold_flat(flat, noise, valid, stamp)
        if self.slipping is None:
            return found
        slips = _slipping_coordinates(kept)
        flat *= layout.spread(slips)
        if noisy:
            noise *= layout.spread(_slipping_coordinates(noisy))
        return replace(found, slipping=self.slipping._fold_flat(flat, noise, slips, stamp))

    def with_few(self, blocks: Iterable[WindowedRows]) -> "Observations":
        """Return the observations with a few more rows, of which groups and noise are not known.

        It takes a fraction of the time of :meth:`fold`.
        """
        kept = list(blocks)
        if not kept:
            return self
        flat = self.layout.flatten([block.mean for block in kept])

        def extended(one: Observations, valid: BoolArray) -> Observations:
            used = valid.astype(np.float64)
            rows = UnfoldedRows.added(one.rows, flat * self.layout.spread(valid))
            return replace(one, rows=rows, counts=one.counts + used.T @ used)

        found = extended(self, np.concatenate([one.valid for one in kept]))
        if self.slipping is None:
            return found
        return replace(found, slipping=extended(self.slipping, _slipping_coordinates(kept)))

    def _fold_flat(
        self, flat: FloatArray, noise: FloatArray, valid: BoolArray, stamp: IntArray
    ) -> "Observations":
        """Return the observations with more flat rows (N, w), and with noise (M, w) of some."""
        used = valid.astype(np.float64)
        return replace(
            self,
            rows=self.rows.fold_flat(flat),
            noise=self.noise.fold_flat(noise) if len(noise) else self.noise,
            counts=self.counts + used.T @ used,
            groups=self.groups and self.groups.fold_flat(flat, valid, stamp),
        )

    def discounted(self, share: float) -> "Observations":
        """Return the observations with every row's weight times ``share``, from 0 to 1."""
        return replace(
            self,
            rows=self.rows.discounted(share),
            noise=self.noise.discounted(share),
            counts=share * self.counts,
            kept=share * self.kept,
            groups=self.groups and self.groups.discounted(share),
            slipping=self.slipping and self.slipping.discounted(share),
        )

    def covering(self, seconds: frozenset[int]) -> "Observations":
        """Return the observations, marked as covering these seconds too."""
        return replace(self, seconds=self.seconds | seconds)

    def merge(self, other: "Observations") -> "Observations":
        """Return the observations of both logs.

        Raises
        ------
        DataError
            When they are about different robots or parameters.
        EstimateError
            When their windows differ, as their residuals then have different variances.
        """
        if self.window != other.window:
            raise EstimateError(
                f"information over windows of {other.window:g} s cannot be added to information "
                f"over {self.window:g} s; give both the same `window`",
                "E412",
            )
        return replace(
            self,
            rows=self.rows.merge(other.rows),
            noise=self.noise.merge(other.noise),
            counts=self.counts + other.counts,
            kept=min(self.kept, other.kept),
            seconds=self.seconds | other.seconds,
            groups=self.groups and other.groups and self.groups.merge(other.groups),
            slipping=self.slipping and other.slipping and self.slipping.merge(other.slipping),
        )

    def restricted(self, parameters: tuple[str, ...]) -> "Observations":
        """Return the observations of some parameters if the others are zero."""
        if parameters == self.layout.parameters:
            return replace(self, slipping=None)
        rows = self.rows.restricted(parameters)
        return replace(
            self,
            rows=rows,
            noise=self.noise.restricted(parameters),
            groups=self.groups and self.groups.restricted(rows.layout),
            slipping=None,
        )

    def correlation(self, phi: FloatArray) -> FloatArray:
        """Return by how much residuals at φ (p,) vary more than independent ones, (n,) from 1."""
        if self.groups is None:
            return np.ones(len(self.counts))
        variance = self.rows.residual_moment(phi).diagonal()
        return self.groups.correlation(phi, variance / np.maximum(self.counts.diagonal(), 1))

    def joint_correlation(self, phi: FloatArray) -> FloatArray:
        """Return :meth:`correlation` for joints with candidate terms, and 1 for the others."""
        ratios = np.ones(len(self.counts))
        if self.groups is not None:
            joints = [part.coordinate for part in self.groups.complete]
            ratios[joints] = self.correlation(phi)[joints]
        return ratios

    def residual_covariance(self, phi: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the covariance Σ (n, n) of a row's residual at φ (p,), corrected for overlap.

        Rows without a measured force, as those of a joint without a drive, leave no residual if all
        inertias vanish. It counts as a share of the load of the ``expected`` parameters (p,) at
        least.

        Coordinates with invalid samples are treated as independent of the others, because the
        missing residuals are unknown. In a short log all coordinates are treated as independent.
        Orthonormal combinations have equal variances. They are coordinates of one space, whose
        axes are arbitrary, and weights from the residuals would favour those axes that a wrong
        model happens to explain well.

        Weights from the residuals that they weight are optimistic. With N independent rows of n
        coordinates the variance is corrected by (N + n)/(N - n).
        """
        moment = self.rows.residual_moment(phi) / np.maximum(self.counts, 1)
        moment[~self._coupled] = 0.0
        alike = self._alike
        moment[alike, alike] = self._common_variance(phi)
        # A coordinate without residual must keep a finite weight. A coordinate with too few rows
        # fits them exactly, so it gets no weight.
        floor = self._least_residual
        unforced = self.rows.target_squares == 0.0
        if unforced.any():
            load = self.rows.residual_moment(expected) / np.maximum(self.counts, 1)
            floor = np.maximum(floor, LEAST_UNFORCED * unforced * load.diagonal())
        floor[self.scarce] = NO_WEIGHT * floor.max()
        moment[np.diag_indices(len(moment))] = np.maximum(moment.diagonal(), floor) + floor
        coupled = int(np.sum(self._coupled.sum(axis=0) > 1))
        moment = definite(moment)
        if coupled == 0:
            return self.inflation * moment
        independent = self.rows.samples / self.inflation
        return self.inflation * (independent + coupled) / (independent - coupled) * moment

    def residual_correlation(self, phi: FloatArray) -> FloatArray:
        """Return the correlation (n, n) of the residuals of a row's coordinates at φ (p,).

        In samples in which one of two residuals is unknown, they count as independent.
        """
        moment = self.rows.residual_moment(phi)
        size = np.sqrt(moment.diagonal())
        scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
        correlation: FloatArray = moment * np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    def variance_ratio(self, phi: FloatArray) -> FloatArray:
        """Return each coordinate's mean square residual over the variance (n,) that Σ has for it.

        It is 1 but for orthonormal combinations, which have a common variance.
        """
        ratio, alike = np.ones(len(self.counts)), self._alike
        if len(alike):
            own = self.rows.residual_moment(phi).diagonal() / np.maximum(self.counts.diagonal(), 1)
            common = self._common_variance(phi)
            ratio[alike] = own[alike] / common if common > 0 else 1.0
        return ratio

    def _common_variance(self, phi: FloatArray) -> float:
        """Return the mean square residual of orthonormal combinations."""
        alike = self._alike
        if not len(alike):
            return 0.0
        squares = self.rows.residual_moment(phi).diagonal()[alike].sum()
        return float(squares / self.counts.diagonal()[alike].sum())

    @property
    def _alike(self) -> IntArray:
        """Coordinates with rows that are orthonormal combinations."""
        combined = np.array(self.layout.combined, dtype=np.int64)
        return np.asarray(combined[self.counts.diagonal()[combined] > 0])

    def plausible_noise(self, phi: FloatArray, covariance: FloatArray) -> float:
        """Return the share of the noise's moments that is plausible given the residuals Σ (n, n).

        Noise in K is part of the residual at φ (p,). If its moment exceeds the residual's by more
        than chance explains, some motion was mistaken for noise.
        """
        moment = self.noise.approximate_residual_moment(phi) / np.maximum(self.counts, 1)
        moment[~self._coupled] = 0.0
        largest = eigh(self.inflation * moment, covariance, eigvals_only=True)[-1]
        return float(1 / max(largest / CHANCE, 1.0))

    def fitted_share(self, variances: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the share (n,) of each coordinate's independent rows that the parameters fit.

        It is the trace of the coordinate's part of the hat matrix (Hoaglin and Welsch 1978, Amer.
        Statist. 32(1)) over the number of its rows: 1 if parameters fit all of them exactly.
        ``variances`` (p, p) is the covariance of the parameters, ``covariance`` (n, n) that of a
        row's residual.
        """
        moment = self.rows.quadratic_moment(np.pad(variances, (0, 1)))
        fitted = np.sum(np.linalg.inv(covariance) * moment, axis=1)
        rows = self.counts.diagonal() / self.inflation
        return np.asarray(np.where(rows > 0, fitted / np.maximum(rows, 1.0), 0.0))

    @property
    def has_coupled_rows(self) -> bool:
        """Whether covariances between coordinates are estimated."""
        return bool(np.any(self._coupled.sum(axis=0) > 1))

    @property
    def _coupled(self) -> BoolArray:
        """(n, n) pairs of coordinates with enough common samples to estimate their covariance."""
        n = len(self.counts)
        if not self.is_coupled:
            return np.eye(n, dtype=bool)
        # Discounted counts are equal except for rounding.
        full = np.diag(self.counts) > (1 - 1e-9) * self.rows.samples
        full &= self.rows.samples > SAMPLES_PER_COORDINATE * n * self.inflation
        full[list(self.layout.combined)] = False
        return np.asarray(np.outer(full, full) | np.eye(n, dtype=bool))

    @property
    def _least_residual(self) -> FloatArray:
        """(n,) variances that are always added to those of the residuals."""
        scale = self.rows.target_squares / np.maximum(self.counts.diagonal(), 1)
        largest = float(scale.max()) or 1.0
        return np.asarray(LEAST_OWN * scale + LEAST_OF_ALL * largest)

    @property
    def needed_rows(self) -> FloatArray:
        """(n,) rows without which a coordinate gets no weight, by its number of own parameters."""
        structure = self.layout.structure
        own = structure[:, structure.sum(axis=0) == 1].sum(axis=1)
        return np.asarray((ROWS_PER_OWN_PARAMETER * own + FEWEST_ROWS) * self.inflation)

    @property
    def scarce(self) -> BoolArray:
        """(n,) coordinates with too few rows for the parameters that affect no other."""
        return np.asarray(self.counts.diagonal() < self.needed_rows)


def covered_seconds(observations: Iterable[Observations]) -> frozenset[int]:
    """Return the fingerprints of all seconds that the rows cover."""
    return frozenset[int]().union(*(one.seconds for one in observations))


def _slipping_coordinates(blocks: Iterable[WindowedRows]) -> BoolArray:
    """Return at which coordinates (N, n) of all blocks' rows no joint may stick."""
    return np.concatenate([one.valid if one.slips is None else one.slips for one in blocks])


def definite(moment: FloatArray) -> FloatArray:
    """Return a moment (n, n) that is positive definite in floating point.

    Residuals without noise may be linearly dependent, as those of efforts that are always zero.
    Rounding then makes eigenvalues negative.
    """
    own = np.diag(np.diag(moment))
    # The margin covers different rounding when a multiple of the moment is factored.
    margin = 4 * len(moment) * np.finfo(float).eps * own
    for share in REGULARIZATIONS:
        definite = moment if share == 0 else moment + share * own
        try:
            np.linalg.cholesky(definite - margin)
        except np.linalg.LinAlgError:
            continue
        return definite
    return own


def whiteness(short: Observations, long: Observations, phi: FloatArray) -> float:
    """Return how slowly the residual at φ (p,) shrinks with window length, compared to white noise.

    The variance of white noise falls as windows get longer. A lasting error, of the model or of a
    sensor's calibration, keeps its variance. The error may appear in few combinations of
    coordinates, so the combination that keeps most is used. The result is its variance in long
    windows over that of white noise, divided by the value that chance gives the largest of n
    (Marchenko and Pastur 1967). It is at most about 1 for white noise, and at most the ratio of
    the windows' lengths.
    """
    together = short._coupled & long._coupled
    before, after = (
        np.where(together, one.inflation * one.rows.residual_moment(phi), 0.0)
        / np.maximum(one.counts, 1)
        for one in (short, long)
    )
    # Rounding counts as white noise.
    rounding = np.diag(short._least_residual)
    before, after = before + rounding, after + rounding * short.window / long.window
    used = np.flatnonzero(~(short.scarce | long.scarce))
    if len(used) == 0:
        return 1.0
    some = np.ix_(used, used)
    # A coordinate with few rows may keep more by chance. Its residual alone is divided by that.
    independent = long.counts.diagonal()[used] / long.inflation
    chance = 1 + np.sqrt(len(used) / independent)
    after = after[some] / np.outer(chance, chance)
    kept = float(eigh(after, definite(before[some]), eigvals_only=True)[-1])
    return kept * long.window / short.window
