"""The thesis's four methods: one least-squares problem, scaled four ways, truncated.

All of them solve W̃ φ̃ = ỹ with W̃ = G W H, ỹ = G (y - W γ), φ = H φ̃ + γ by truncated
SVD (Eq. 15-27), where γ = φ̄ is the prior mean. For H = I that is Eq. 21 with
the nullspace of Eq. 23, since V_e α̂_e + V_n V_nᵀ φ̄ = φ̄ + V_e (α̂_e - V_eᵀ φ̄).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Criterion
from symbid_ros.dynamics.kinematics import joint_axes, link_poses
from symbid_ros.dynamics.regressor import generalised_force
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.tree import RobotModel

Method = Literal["ols", "wls_r", "wls_c", "wls_rc"]
METHODS: tuple[Method, ...] = get_args(Method)


GRAVITY = 9.81

# The error is flat over many z while noise in the regressor carries the parameters ever further
# off: among z that predict about equally well, the one that leaves most to the prior is the safest.
TOLERANCE = 1.5


@dataclass(frozen=True)
class ScaledProblem:
    """G W H φ̃ = G (y - W φ̄), decomposed.

    Attributes
    ----------
    scale : (p,) float64
        Diagonal of H.
    prior : (p,) float64
        φ̄.
    left : (p,) float64
        Uᵀ ỹ, the data in the singular directions.
    singular_values : (p,) float64
        Descending.
    directions : (p, p) float64
        V, one singular direction of φ̃ per column.
    unexplained : float
        ‖ỹ‖² that no parameters can explain.
    samples : float
        Number of samples N.
    """

    scale: FloatArray
    prior: FloatArray
    left: FloatArray
    singular_values: FloatArray
    directions: FloatArray
    unexplained: float
    samples: float

    @cached_property
    def rank(self) -> int:
        """Numerical rank m: singular values above the rounding of the largest."""
        values = self.singular_values
        if values[0] == 0:
            return 0
        return int(np.sum(values > 1e-11 * values[0]))

    def solutions(self) -> FloatArray:
        """Return φ̂ (p, m) for every truncation z = 1 ... m, one per column."""
        m = self.rank
        steps = self.directions[:, :m] * (self.left[:m] / self.singular_values[:m])
        return self.prior[:, None] + self.scale[:, None] * np.cumsum(steps, axis=1)

    def solution(self, z: int) -> FloatArray:
        """Return φ̂ (p,) with the z largest singular values."""
        steps = self.directions[:, :z] @ (self.left[:z] / self.singular_values[:z])
        return self.prior + self.scale * steps

    def std(self, z: int, prior_std: FloatArray) -> FloatArray:
        """Return the standard deviation (p,) of φ̂: Eq. 33-34 plus the prior's where truncated.

        The data's part assumes white residuals of equal size, as Eq. 33 does, and the
        prior's part independent parameters; filtering and noise in the regressor
        make the first optimistic.
        """
        squares = self.unexplained + np.sum(self.left[z:] ** 2)
        variance = squares / max(self.samples - z, 1)
        used, unused = self.directions[:, :z], self.directions[:, z:]
        data = np.sum((used / self.singular_values[:z]) ** 2, axis=1) * variance
        remaining = self.scale[:, None] * (unused @ unused.T) * (prior_std / self.scale)
        std: FloatArray = np.sqrt(self.scale**2 * data + np.sum(remaining**2, axis=1))
        return std


@dataclass(frozen=True)
class ScaledRows:
    """The rows G [W y] of one record, ready for any prior and any scaling of columns.

    Attributes
    ----------
    factor : (p + 1, p + 1) float64
        Their triangular factor.
    samples : float
        Number of samples N.
    """

    factor: FloatArray
    samples: float

    @classmethod
    def of(cls, information: Information, deviation: FloatArray | None = None) -> "ScaledRows":
        """Return rows divided by a deviation (n,) of each coordinate, or as they are."""
        n = len(information.layout.coordinates)
        G = np.eye(n) if deviation is None else np.diag(1.0 / deviation)
        return cls(information.whitened(G), information.samples)

    def problem(self, prior: FloatArray, scale: FloatArray | None = None) -> ScaledProblem:
        """Decompose the problem about a prior φ̄ (p,), columns times ``scale`` (p,) or as are."""
        A, b = self.factor[:, :-1], self.factor[:, -1]
        if scale is None:
            U, values, Vt = self._plain
            scale = np.ones(len(prior))
        else:
            U, values, Vt = np.linalg.svd(A * scale, full_matrices=False)
        target = b - A @ prior
        left = U.T @ target
        unexplained = max(float(target @ target - left @ left), 0.0)
        return ScaledProblem(scale, prior, left, values, Vt.T, unexplained, self.samples)

    @cached_property
    def _plain(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        U, values, Vt = np.linalg.svd(self.factor[:, :-1], full_matrices=False)
        return U, values, Vt


class LeastSquares:
    """One record's least-squares problem; what does not depend on the prior is worked out once.

    Parameters
    ----------
    information : Information
        The data.
    row_deviation : (n,) float64, optional
        σ per coordinate for the row-scaled methods, such as the sensors' (Eq. 28).
        By default that of the OLS residual (Eq. 29-30).
    counts : (n,) float64, optional
        In how many samples each coordinate is used; all of them by default.
    """

    def __init__(
        self,
        information: Information,
        row_deviation: FloatArray | None = None,
        counts: FloatArray | None = None,
    ) -> None:
        self._information, self._given = information, row_deviation
        n = len(information.layout.coordinates)
        self._counts = np.full(n, information.samples) if counts is None else counts

    @cached_property
    def plain(self) -> ScaledRows:
        """The rows as they are."""
        return ScaledRows.of(self._information)

    @cached_property
    def row_deviation(self) -> FloatArray:
        """σ (n,) by which the row-scaled methods divide."""
        if self._given is not None:
            return self._given
        return residual_deviation(self._information, self.plain, self._counts)

    @cached_property
    def weighed(self) -> ScaledRows:
        """The rows over their deviations."""
        return ScaledRows.of(self._information, self.row_deviation)

    def scaled(self, prior: Prior, method: Method) -> ScaledProblem:
        """Return the problem as one method scales it; φ̄ is γ, and H where columns are scaled."""
        rows = self.weighed if method in ("wls_r", "wls_rc") else self.plain
        scale = column_scale(prior) if method in ("wls_c", "wls_rc") else None
        return rows.problem(prior.mean, scale)


def column_scale(prior: Prior) -> FloatArray:
    """Return H's diagonal: |φ̄|, and the prior's deviation where φ̄ is zero.

    A zero would forbid the parameter ever to move.
    """
    return np.where(prior.mean != 0, np.abs(prior.mean), prior.std)


def residual_deviation(
    information: Information, rows: ScaledRows, counts: FloatArray
) -> FloatArray:
    """Return the deviation (n,) of the OLS residual in each coordinate (Eq. 29-30).

    Each coordinate's degrees of freedom are its samples less its share of the rank, the
    trace of its block of the hat matrix, instead of Eq. 30's N - p. The residual
    is that of full rank, which no prior changes.
    """
    problem = rows.problem(np.zeros(len(information.layout.parameters)))
    m = problem.rank
    squares = np.diag(information.residual_moment(problem.solution(m)))
    weights = problem.directions[:, :m] / problem.singular_values[:m]
    share = np.array(
        [
            np.sum((information.coordinate_factor(i)[:, :-1] @ weights[columns]) ** 2)
            for i, columns in enumerate(information.layout.columns)
        ]
    )
    freedom = counts - share
    if np.any((freedom < 1) & (counts > 0)):
        raise EstimateError(
            f"{int(counts[counts > 0].min())} samples are too few for {m} parameters; record longer"
        )
    deviation = np.sqrt(squares / np.maximum(freedom, 1))
    # A coordinate that nothing moves or loads has no residual; its weight must stay finite.
    largest = float(deviation.max())
    floored: FloatArray = np.maximum(deviation, 1e-9 * (largest if largest > 1e-150 else 1.0))
    return floored


def informative_rank(posterior: Posterior, rank: int) -> int:
    """Return the z for which no validation data are needed, at most ``rank``.

    It is the number of directions of which the data say more than the prior: singular values
    above one of rows whitened by their residuals and columns scaled by the prior's deviations.

    Raises
    ------
    EstimateError
        When the training data excite nothing.
    """
    if rank == 0:
        raise EstimateError("the log excites no parameter at all; record a motion")
    scaled = posterior.factor @ posterior.prior.covariance_factor()
    told = np.linalg.svd(scaled, compute_uv=False) ** 2 - 1
    return int(np.clip(np.sum(told > 1), 1, rank))


def select_rank(
    problem: ScaledProblem, validation: Information, criterion: Criterion = "gen_force"
) -> int:
    """Return the smallest z that predicts the validation data about as well as the best.

    "About as well" is an error of at most ``TOLERANCE`` times the least one.

    Parameters
    ----------
    problem : ScaledProblem
        The method's problem on the training data.
    validation : Information
        Rows of another record, ideally noise-free.
    criterion : {"gen_force", "torque", "com"}
        Root mean square of the prediction error of all coordinates, of the joints,
        or of the base's moment over the robot's weight: the distance by which the
        centre of mass would have to be wrong to explain it.

    Raises
    ------
    EstimateError
        When the training data excite nothing, or "com" is asked of a fixed base.
    """
    if problem.rank == 0:
        raise EstimateError("the log excites no parameter at all; record a motion")
    errors = prediction_errors(validation, problem.solutions(), criterion)
    return int(np.argmax(errors <= TOLERANCE * errors.min())) + 1


def prediction_errors(
    validation: Information, solutions: FloatArray, criterion: Criterion
) -> FloatArray:
    """Return the criterion (k,) for k parameter vectors (p, k)."""
    coordinates = validation.layout.coordinates
    floating = coordinates[0].startswith("base/")
    squares = np.array(
        [
            np.sum((factor[:, :-1] @ solutions[columns] - factor[:, -1:]) ** 2, axis=0)
            for factor, columns in (
                (validation.coordinate_factor(i), validation.layout.columns[i])
                for i in range(len(coordinates))
            )
        ]
    )
    if criterion == "gen_force":
        used = squares
    elif criterion == "torque":
        used = squares[6 * floating :]
    else:
        if not floating:
            raise EstimateError("z by centre of mass needs a floating base; select by torque")
        masses = [i for i, name in enumerate(validation.layout.parameters) if name.endswith("/m")]
        weight = GRAVITY * np.abs(solutions[masses].sum(axis=0))
        used = squares[:3] / np.maximum(weight, 1e-9) ** 2
    errors: FloatArray = np.sqrt(used.sum(axis=0) / max(validation.samples, 1))
    return errors


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the force sensors' white noise.

    Attributes
    ----------
    effort : float
        Joint torque or force, Nm or N.
    force, moment : float
        Wrench sensors, N and Nm per axis.
    """

    effort: float
    force: float
    moment: float

    def __post_init__(self) -> None:
        """Refuse a deviation that would give a row infinite weight."""
        if not min(self.effort, self.force, self.moment) > 0:
            raise EstimateError(
                f"sensor deviations {self.effort}, {self.force}, {self.moment} must all be positive"
            )


def sensor_row_std(model: RobotModel, samples: Samples, sensors: SensorNoise) -> FloatArray:
    """Return σ (n,) of the generalised force, root mean square over the samples.

    y is linear in efforts and wrenches, so its variance is the sum of the responses
    to each component alone.
    """
    probe = samples[:: max(1, len(samples) // 500)]
    poses = link_poses(model, probe.position)
    axes = joint_axes(model, poses)
    variance = np.zeros(model.dof)
    variance[6 * model.floating :] = sensors.effort**2
    wrench_std = np.repeat([sensors.moment, sensors.force], 3)
    for sensor in range(len(samples.wrench_frames)):
        for component, std in enumerate(wrench_std):
            alone = np.zeros_like(probe.wrenches)
            alone[:, sensor, component] = std
            unit = replace(probe, effort=np.zeros_like(probe.effort), wrenches=alone)
            variance += np.mean(generalised_force(model, unit, poses, axes) ** 2, axis=0)
    if np.any(variance == 0):
        raise EstimateError(
            "the base has no wrench sensor, so sensor deviations give its rows no weight; weigh by "
            "residuals instead"
        )
    deviation: FloatArray = np.sqrt(variance)
    return deviation
