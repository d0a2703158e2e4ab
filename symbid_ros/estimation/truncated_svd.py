"""Truncated least squares: the thesis's four methods, their row weights and choice of rank.

All methods solve W̃ φ̃ = ỹ with W̃ = G W H, ỹ = G (y - W γ) and φ = H φ̃ + γ by truncated SVD
(Eq. 15-27), where γ = φ̄ is the prior mean. They differ in the scalings G and H. For H = I this
is Eq. 21 with the null space of Eq. 23, since V_e α̂_e + V_n V_nᵀ φ̄ = φ̄ + V_e (α̂_e - V_eᵀ φ̄).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Criterion
from symbid_ros.dynamics.inertial_rows import generalised_force
from symbid_ros.dynamics.kinematics import joint_axes, link_poses
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.tree import RobotModel

Method = Literal["ols", "wls_r", "wls_c", "wls_rc"]
METHODS: tuple[Method, ...] = get_args(Method)

GRAVITY = 9.81

# The prediction error is flat over many z, while noise in the regressor makes the parameters worse
# with each. Among z with similar errors the smallest one is the safest.
TOLERANCE = 1.5

_NO_EXCITATION = "the log excites no parameter; record a log with motion"


@dataclass(frozen=True)
class ScaledProblem:
    """Singular value decomposition of the problem G W H φ̃ = G (y - W φ̄).

    Attributes
    ----------
    scale : (p,) float64
        Diagonal of H.
    prior : (p,) float64
        Prior mean φ̄.
    left : (p,) float64
        Data in the singular directions, Uᵀ ỹ.
    singular_values : (p,) float64
        Singular values, descending.
    directions : (p, p) float64
        Singular directions V of φ̃, one per column.
    unexplained : float
        Part of ‖ỹ‖² that no parameters explain.
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

        Like Eq. 33 the first part assumes white residuals of equal variance. Filtering and noise
        in the regressor make it optimistic. The second part assumes independent parameters.
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
    """The rows G [W y] of one log, for any prior and any scaling of columns.

    Attributes
    ----------
    factor : (p + 1, p + 1) float64
        Triangular factor of the rows.
    samples : float
        Number of samples N.
    """

    factor: FloatArray
    samples: float

    @classmethod
    def of(cls, information: Information, deviation: FloatArray | None = None) -> "ScaledRows":
        """Return the rows, divided by a standard deviation (n,) per coordinate if given."""
        n = len(information.layout.coordinates)
        G = np.eye(n) if deviation is None else np.diag(1.0 / deviation)
        return cls(information.whitened(G), information.samples)

    def problem(self, prior: FloatArray, scale: FloatArray | None = None) -> ScaledProblem:
        """Return the problem about a prior φ̄ (p,), with columns times ``scale`` (p,) if given."""
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
    """Least-squares problem of one log; computations independent of the prior are cached.

    Parameters
    ----------
    information : Information
        Information of the log.
    row_deviation : (n,) float64, optional
        Standard deviation σ per coordinate for the row-scaled methods, such as the sensors'
        (Eq. 28). That of the OLS residual by default (Eq. 29-30).
    counts : (n,) float64, optional
        Number of samples in which each coordinate is used; all by default.
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
        """Rows without weights."""
        return ScaledRows.of(self._information)

    @cached_property
    def row_deviation(self) -> FloatArray:
        """Standard deviations σ (n,) by which the row-scaled methods divide."""
        if self._given is not None:
            return self._given
        return residual_deviation(self._information, self.plain, self._counts)

    @cached_property
    def weighted(self) -> ScaledRows:
        """Rows divided by their standard deviations."""
        return ScaledRows.of(self._information, self.row_deviation)

    def scaled(self, prior: Prior, method: Method) -> ScaledProblem:
        """Return the problem with a method's scaling; φ̄ is γ, and H if columns are scaled."""
        rows = self.weighted if method in ("wls_r", "wls_rc") else self.plain
        scale = column_scale(prior) if method in ("wls_c", "wls_rc") else None
        return rows.problem(prior.mean, scale)


def column_scale(prior: Prior) -> FloatArray:
    """Return the diagonal of H: |φ̄|, or the prior's deviation where φ̄ is zero.

    A zero would fix the parameter.
    """
    return np.where(prior.mean != 0, np.abs(prior.mean), prior.std)


def residual_deviation(
    information: Information, rows: ScaledRows, counts: FloatArray
) -> FloatArray:
    """Return the standard deviation (n,) of the OLS residual per coordinate (Eq. 29-30).

    A coordinate's degrees of freedom are its samples minus its share of the rank, the trace of
    its block of the hat matrix, instead of N - p in Eq. 30. The residual is that of full rank,
    which does not depend on a prior.
    """
    problem = rows.problem(np.zeros(len(information.layout.parameters)))
    m = problem.rank
    squares = np.diag(information.residual_moment(problem.solution(m)))
    weights = problem.directions[:, :m] / problem.singular_values[:m]
    factors = zip(information.coordinate_factors, information.layout.columns, strict=True)
    share = np.array(
        [np.sum((factor[:, :-1] @ weights[columns]) ** 2) for factor, columns in factors]
    )
    freedom = counts - share
    if np.any((freedom < 1) & (counts > 0)):
        raise EstimateError(
            f"{int(counts[counts > 0].min())} samples are too few for {m} parameters; record a "
            "longer log",
            "E420",
        )
    deviation = np.sqrt(squares / np.maximum(freedom, 1))
    # A coordinate without motion and load has no residual; its weight must stay finite.
    largest = float(deviation.max())
    floored: FloatArray = np.maximum(deviation, 1e-9 * (largest if largest > 1e-150 else 1.0))
    return floored


def informative_rank(posterior: Posterior, rank: int) -> int:
    """Return the rank z chosen without validation data, at most ``rank``.

    It is the number of directions about which the data say more than the prior: singular values
    above one of rows whitened by their residuals and columns scaled by the prior's deviations.

    Raises
    ------
    EstimateError
        When the training data excite no parameter.
    """
    if rank == 0:
        raise EstimateError(_NO_EXCITATION, "E420")
    scaled = posterior.factor @ posterior.prior.covariance_factor()
    information = np.linalg.svd(scaled, compute_uv=False) ** 2 - 1
    return int(np.clip(np.sum(information > 1), 1, rank))


def select_rank(
    problem: ScaledProblem, validation: Information, criterion: Criterion = "gen_force"
) -> int:
    """Return the smallest z that predicts the validation data about as well as the best.

    "About as well" is an error of at most ``TOLERANCE`` times the least one.

    Parameters
    ----------
    problem : ScaledProblem
        Problem of the method on the training data.
    validation : Information
        Rows of another log, ideally noise-free.
    criterion : {"gen_force", "torque", "com"}
        Root mean square of the prediction error of all coordinates ("gen_force"), of the joints
        ("torque") or of the base's moment divided by the robot's weight ("com"). The last is the
        error of the centre of mass that would explain the moment.

    Raises
    ------
    EstimateError
        When the training data excite no parameter, or "com" is requested for a fixed base.
    """
    if problem.rank == 0:
        raise EstimateError(_NO_EXCITATION, "E420")
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
            for factor, columns in zip(
                validation.coordinate_factors, validation.layout.columns, strict=True
            )
        ]
    )
    if criterion == "gen_force":
        used = squares
    elif criterion == "torque":
        used = squares[6 * floating :]
    else:
        if not floating:
            raise EstimateError(
                "select_by com needs a floating base; select by torque or gen_force", "E421"
            )
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
        """Reject a deviation that would give a row infinite weight."""
        if not all(each > 0 for each in (self.effort, self.force, self.moment)):
            raise EstimateError(
                f"standard deviations {self.effort}, {self.force}, {self.moment} of sensors must "
                "all be positive; correct `sensor_std`",
                "E422",
            )


def sensor_row_std(model: RobotModel, samples: Samples, sensors: SensorNoise) -> FloatArray:
    """Return σ (n,) of the generalised force from sensor noise, Eq. 28.

    It is a root mean square over the samples. y is linear in efforts and wrenches, so its variance
    is the sum of the contributions of each component.
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
            "the base has no wrench sensor, so `sensor_std` cannot weight its rows; weight "
            "them by residuals",
            "E422",
        )
    deviation: FloatArray = np.sqrt(variance)
    return deviation
