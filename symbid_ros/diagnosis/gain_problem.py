"""The least-squares problem of gains and delays of sensors, with uncertain inertias."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import JOINT_TERMS
from symbid_ros.diagnosis.effort_lags import LaggedRows
from symbid_ros.diagnosis.gain_rows import CoordinateRows, GainLayout
from symbid_ros.estimation.information import stacked_factor
from symbid_ros.estimation.prior_std import OFFSET_STD
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import COMPONENTS
from symbid_ros.signals.weak_form import INFLATION

# Residuals below this share of the load count as zero. Gains that shrink together with the inertias
# explain any log up to its noise, and such residuals must have no weight. For the same reason
# residuals below the white noise of the efforts have no weight.
FLOOR = 0.02
# Rough relative error of the model's loads, for the weights of the first solution.
LOAD_ERROR = 0.3
ITERATIONS = 3
# Prior standard deviations of g and of the elements of A and M, and of delays, s.
GAIN_STD, DELAY_STD = 2.0, 0.1
PINNED = 1e-6  # standard deviation of unknowns that are held at their prior
# Residuals below this share of the load are explained: friction near rest leaves as much.
SMALL_SHARE = 0.1
# Residuals below this share of the load are rounding errors.
LEAST = 1e-4
# Friction that is not modelled varies as slowly as the motion: so many rows count as one.
UNMODELLED = 10.0


@dataclass(frozen=True)
class GainProblem:
    """Rows of [K, -C] [φ; θ] = y and the prior of the unknowns.

    Attributes
    ----------
    rows : CoordinateRows
        Rows of n coordinates.
    mean, std : (p,) float64
        Prior of the parameters φ.
    gains : GainLayout
        Layout of the r unknowns θ that follow φ.
    links : int or None
        Number of inertial parameters, which come first in φ; None if φ has no others.
    lagged : LaggedRows or None
        The same rows with the efforts of other instants; None if delays are small.
    load_noise : (F, J) float64 or None
        Mean square of the load on each joint in these rows by white noise of each wrench; None if
        the wrenches have none.
    effort_noise : (J,) float64 or None
        Mean square of each joint's effort in these rows by white noise; None if they have none.
    """

    rows: CoordinateRows
    mean: FloatArray
    std: FloatArray
    gains: GainLayout
    links: int | None = None
    lagged: LaggedRows | None = None
    load_noise: FloatArray | None = None
    effort_noise: FloatArray | None = None

    @classmethod
    def of(
        cls,
        rows: CoordinateRows,
        parameters: ParameterSet,
        std: FloatArray,
        gains: GainLayout,
    ) -> "GainProblem":
        """Return the problem for given deviations of the inertias (p,) and small drive loads."""
        mean, links = parameters.values.copy(), len(std)
        std = np.concatenate([std, np.zeros(len(mean) - len(std))])
        first = parameters.model.dof - len(parameters.model.joints)
        of_links = np.append(mean[:links], np.zeros(len(mean) - links + len(gains)))
        load = loads(rows, of_links)[first:]
        std[parameters.sensor_offsets] = OFFSET_STD * len(parameters.model.wrist_sensors)
        joints = parameters.joints.tolist()
        for term, columns in parameters.term_columns.items():
            for joint, column in zip(joints, range(columns.start, columns.stop), strict=True):
                size = np.sqrt(rows.column_squares(first + joint, column))
                share = JOINT_TERMS[term].load_share
                std[column] = share * load[joint] / max(size, 1e-9) + PINNED
                if abs(mean[column]) * size > load[joint]:
                    mean[column] = 0.0  # a placeholder in the model file: no effort shows as much
        return cls(rows, mean, std, gains, links)

    def with_later_efforts(self, delay: float) -> "GainProblem":
        """Return the problem of the delays that remain if efforts are read so much later, s."""
        if self.lagged is None or delay == 0.0:
            return self
        return replace(self, rows=self.lagged.shifted(delay))

    @property
    def expected(self) -> FloatArray:
        """(p + r,) prior mean: the model's parameters and gains of one."""
        return np.append(self.mean, np.zeros(len(self.gains)))

    @property
    def noise(self) -> FloatArray:
        """(n,) mean square residuals that white noise of the efforts leaves with gains of one."""
        own = np.zeros(0) if self.effort_noise is None else self.effort_noise
        return np.append(np.zeros(len(self.rows.coordinates) - len(own)), own)

    @property
    def floor(self) -> FloatArray:
        """(n,) mean square residuals below which rows get no more weight."""
        return (FLOOR * loads(self.rows, self.expected)) ** 2 + self.noise

    def solve(
        self, std: FloatArray, left: FloatArray, mass_std: float = np.inf
    ) -> tuple[FloatArray, FloatArray]:
        """Return the most probable unknowns (p + r,) and L of their covariance L Lᵀ.

        Parameters
        ----------
        std : (r,) float64
            Prior deviations of the gains and delays.
        left : (n,) float64
            Mean square residual of each coordinate.
        mass_std : float
            Relative deviation of the total mass; infinite: that of independent links.
        """
        scale = np.append(self.std, std)
        mean, q = self.expected, len(scale)
        weight, total = 1 / (INFLATION * left), self._total_mass(q) / mass_std
        moment = self.rows.moment(weight)
        precision = moment[:q, :q] * np.outer(scale, scale) + np.eye(q) + np.outer(total, total)
        try:
            R = cholesky(precision)
        except np.linalg.LinAlgError:  # rounding exceeds the prior's information
            rows = self.rows.whitened(np.sqrt(INFLATION * left))
            R = stacked_factor(rows[:, :-1] * scale, np.eye(q), total[None])
        x = np.zeros(q)
        # The second step corrects the rounding of the moments (corrected seminormal equations:
        # Björck 1987, Linear Algebra and its Applications 88/89).
        for _ in range(2):
            pull = scale * self.rows.pull(mean + scale * x, weight) - x - total * (total @ x)
            x = x + cho_solve((R, False), pull)
        deviation: FloatArray = scale[:, None] * solve_triangular(R, np.eye(q))
        return mean + scale * x, deviation

    @property
    def number_of_inertias(self) -> int:
        """Number of inertial parameters, which come first in φ."""
        return len(self.mean) if self.links is None else self.links

    @property
    def _masses(self) -> slice:
        return slice(0, self.number_of_inertias, 10)

    def _total_mass(self, width: int) -> FloatArray:
        """Return the row of the relative error of the total mass, for scaled unknowns."""
        row = np.zeros(width)
        row[self._masses] = self.std[self._masses] / self._model_mass
        return row

    def mass_ratio(self, unknowns: FloatArray) -> float:
        """Return the total mass that the unknowns (p + r,) imply over the model's."""
        return max(abs(float(np.sum(unknowns[self._masses]))) / self._model_mass, LEAST)

    @property
    def _model_mass(self) -> float:
        return max(float(np.sum(self.mean[self._masses])), LEAST)


@dataclass(frozen=True)
class GainEstimate:
    """Most probable gains and delays.

    Attributes
    ----------
    sensors : GainLayout
        Layout of the unknowns.
    mean : (r,) float64
        Each unknown minus its nominal value.
    covariance : (r, r) float64
        Covariance of the unknowns, marginalized over the inertias.
    left : (n,) float64
        Mean square residual of each coordinate.
    before, after : float
        Root mean square residual of the base's force, N, with all gains at one and with the
        estimated gains.
    reversed_wrenches : float
        The same with all wrenches reversed.
    hidden_loads : mapping of int to float
        Driven joints whose efforts hardly show their load, although their gains differ from one,
        with the share of the effort that the load explains.
    mass_ratio : float
        Total mass that explains the log with all gains at one, over the model's.
    """

    sensors: GainLayout
    mean: FloatArray
    covariance: FloatArray
    left: FloatArray
    before: float
    after: float
    reversed_wrenches: float = np.inf
    hidden_loads: Mapping[int, float] = field(default_factory=dict)
    mass_ratio: float = 1.0

    def matrix(self, place: slice) -> tuple[FloatArray, FloatArray]:
        """Return A or M (3, 3) of a sensor and the covariance (9, 9) of its rows."""
        return self.mean[place].reshape(3, 3) + np.eye(3), self.covariance[place, place]

    def delay(self, place: int) -> tuple[float, float]:
        """Return the delay of a sensor and its standard deviation, s."""
        return float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))

    def effort(self, index: int) -> tuple[float, float]:
        """Return g of a driven joint, and the relative standard deviation of the ratio 1/g.

        That is also the deviation by which g differs from one.
        """
        place = self.sensors.efforts.start + index
        return 1 + float(self.mean[place]), float(np.sqrt(self.covariance[place, place]))


def estimate_of(
    problem: GainProblem, at: FloatArray, deviation: FloatArray, left: FloatArray
) -> GainEstimate:
    """Return an estimate from the unknowns (p + r,), L of their covariance, and the residuals."""
    p = len(problem.mean)
    forces = [name.startswith("base/force") for name in problem.rows.coordinates]
    reversed_gains = problem.expected
    for index in range(len(problem.gains.wrench_frames)):
        reversed_gains[p:][problem.gains.wrench(index)] = -2 * np.eye(3).ravel()
    before, backwards = map(problem.rows.residual_squares, (problem.expected, reversed_gains))
    return GainEstimate(
        problem.gains,
        at[p:],
        deviation[p:] @ deviation[p:].T,
        left,
        float(np.sqrt(before[forces].sum())),
        float(np.sqrt(left[forces].sum())),
        float(np.sqrt(backwards[forces].sum())),
    )


def loads(rows: CoordinateRows, expected: FloatArray) -> FloatArray:
    """Return the largest root mean square load (n,) among coordinates of the same kind.

    Joints are of two kinds, revolute and prismatic. The load is the measured one, or the one that
    the unknowns (q,) imply if that is larger, because a force may lack a sensor.
    """
    kinds = np.array(
        [
            name.rpartition("_")[0] if name.rpartition("/")[2] in COMPONENTS else unit
            for name, unit in zip(rows.coordinates, rows.units, strict=True)
        ]
    )
    squares = np.maximum(rows.target_squares, rows.residual_squares(expected))
    largest = np.array([squares[kinds == kind].max() for kind in kinds])
    mean = np.maximum(largest, LEAST**2 * largest.max())
    return np.sqrt(mean) if mean.any() else np.ones(len(mean))
