"""Solves a problem with any method: observations and a prior in, an estimate out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import Method
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.alarms import HEAVY_DEVIATIONS, alarms, heavy_link_alarms
from symbid_ros.estimation.change import discounted_pseudo_measurements
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.mass_scale import (
    FORCE_SCALE_STD,
    UNCHECKED,
    CommonGain,
    common_gain,
)
from symbid_ros.estimation.observations import Observations, whiteness
from symbid_ros.estimation.passive_drives import drive_bounds
from symbid_ros.estimation.physical_consistency import consistent_minimum
from symbid_ros.estimation.posterior import CONVERGED, Posterior, PseudoMeasurements, stacked
from symbid_ros.estimation.sandwich import with_correlated_residuals
from symbid_ros.estimation.truncated_svd import LeastSquares, informative_rank, select_rank
from symbid_ros.estimation.truncated_svd import Method as TruncatedMethod
from symbid_ros.estimation.unexplained import UnexplainedForce, unexplained_forces
from symbid_ros.estimation.verdict import assess
from symbid_ros.identification.contacts import total_mass_alarms
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.rows.window_comparison import (
    COMPARABLE,
    WindowComparison,
    solve_window,
)
from symbid_ros.identification.solution_estimate import estimate_of, payload_remarks, row_std
from symbid_ros.signals.sensor_errors import DRIVE_GAIN

# Mean square difference of two estimates, in deviations, above which the model is wrong. It is a
# few hundredths for logs that obey the model.
DISAGREEMENT = 1.0

# Change, in posterior standard deviations, at which a trial has converged.
TRIAL = 1e-3


@dataclass(frozen=True)
class SolvedProblem:
    """A problem and its posterior, from which every method starts.

    Attributes
    ----------
    problem : Problem
    chosen : Observations
        With the most informative window length.
    posterior : Posterior
        From these; its covariance allows for residuals that are correlated in time, and for other
        sets of joint terms that explain the data as well.
    """

    problem: Problem
    chosen: Observations
    posterior: Posterior

    @classmethod
    def of(
        cls, problem: Problem, *, is_trial: bool = False, window: float | None = None
    ) -> "SolvedProblem":
        """Compute the posterior of the most informative window length, or of a given one, s.

        If that one has no rows, all are compared. A trial, of which only the predictions are
        compared with data, needs fewer digits.
        """
        every = problem.observations
        usable = tuple(one for one in every if window in (None, one.window)) or every
        best, near = WindowComparison(replace(problem, observations=usable)).finish()
        start = None if near is None else near.mean
        tolerance = TRIAL if is_trial else CONVERGED
        found, best = _solve(problem, best, start, tolerance, approximate=is_trial)
        return cls(problem, best, _with_all_errors(problem, found, best))

    @classmethod
    def approximate(
        cls,
        problem: Problem,
        chosen: Observations,
        start: FloatArray | None,
        *,
        is_coupled: bool | None = None,
    ) -> "SolvedProblem":
        """Solve one window length to a hundredth of a standard deviation, from a near start.

        ``is_coupled`` says whether rows are weighted by covariances between coordinates, as tested
        by an earlier solution from nearly the same data; None tests it here.
        """
        if is_coupled is None:
            found, chosen = _solve(problem, chosen, start, COMPARABLE, approximate=True)
        else:
            chosen = replace(chosen, is_coupled=is_coupled)
            found = solve_window(problem, chosen, start, COMPARABLE, approximate=True)
        return cls(problem, chosen, _with_all_errors(problem, found, chosen))

    def with_measurements(self, more: PseudoMeasurements) -> "SolvedProblem":
        """Return the solution with further measurements of all unknowns."""
        problem = replace(
            self.problem,
            pseudo_measurements=stacked(self.problem.pseudo_measurements, more),
        )
        found = solve_window(problem, self.chosen, self.posterior.mean, CONVERGED)
        return replace(self, posterior=_with_all_errors(problem, found, self.chosen))

    @property
    def whiteness(self) -> float:
        """How far the residuals are from white noise; 0 with one window length only."""
        observations = self.problem.observations
        if len(observations) < 2:
            return 0.0
        return whiteness(observations[0], observations[-1], self.posterior.mean)

    @property
    def unexplained(self) -> tuple[UnexplainedForce, ...]:
        """Force of each coordinate beyond model and noise; empty with one window length only."""
        observations = self.problem.observations
        if len(observations) < 2:
            return ()
        problem, mean = self.problem, self.posterior.mean
        names = (*problem.parameters.names, *problem.sensor_names)
        factors = [index for index, name in enumerate(names) if name.endswith(f"/{DRIVE_GAIN}")]
        units = problem.parameters.model.coordinate_units
        return unexplained_forces(observations[0], observations[-1], mean, units, factors)

    def alarms(self, value: FloatArray) -> tuple[str, ...]:
        """Return the reasons not to trust an estimate (p + s,), one line each."""
        parameters = self.problem.parameters
        return (
            *self.problem.alarms,
            *self._mass_alarms(value),
            *self._heavy_link_alarms(value),
            *alarms(
                self.posterior,
                value,
                len(parameters),
                whiteness=self.whiteness,
                unexplained=self.unexplained,
                measurements=self._measurements,
                rows=float(self.chosen.counts.diagonal().sum()),
                sensors=(self.problem.sensor_names, self.problem.sensor_units),
            ),
        )

    def _mass_alarms(self, value: FloatArray) -> tuple[str, ...]:
        """Return the alarms about the total mass, unless the robot was weighed."""
        if self._weighing_std > 0:
            return ()
        masses = slice(0, self.problem.parameters.inertial, 10)
        before, after = self.problem.prior.mean[masses], value[masses]
        std = float(np.linalg.norm(self.posterior.deviation_factor[masses].sum(axis=0)))
        return total_mass_alarms(self.problem.parameters.model, before, after, std)

    def _heavy_link_alarms(self, value: FloatArray) -> tuple[str, ...]:
        """Return the alarm about links that weigh far more than the prior allows.

        A wrist sensor is there to weigh what the model lacks.
        """
        parameters = self.problem.parameters
        if parameters.model.wrist_sensors:
            return ()
        masses = slice(0, parameters.inertial, 10)
        std = np.linalg.norm(self.posterior.prior_factor[masses], axis=1)
        return heavy_link_alarms(
            parameters.link_names, self.problem.prior.mean[masses], value[masses], std
        )

    @property
    def _measurements(self) -> PseudoMeasurements | None:
        """The pseudo-measurements of the posterior."""
        return discounted_pseudo_measurements(self.problem.pseudo_measurements, self.chosen.kept)

    @property
    def _scaled_parameters(self) -> BoolArray:
        """(p,) which parameters' stated deviations contain that of the common gain."""
        parameters = self.problem.parameters
        is_scaled = np.ones(len(parameters), dtype=bool)
        if self.problem.force_scale_std is None:
            is_scaled[:] = False
            is_scaled[: parameters.inertial : 10] = True
        return is_scaled

    def _common_gain(self) -> CommonGain | None:
        """Return the gain that no residual shows; None if the user excludes it."""
        std = self._force_scale_std
        if std == 0:
            return None
        value = self.posterior.mean
        is_anchor = np.ones(len(value), dtype=bool)
        is_anchor[self.problem.parameters.inertial : len(self.problem.parameters)] = False
        return common_gain(self.posterior, value, self._measurements, std, is_anchor)

    def _mass_scale(self, gain: CommonGain | None) -> float:
        """Return the relative deviation of the masses' scale; 0 if a weighing checks it."""
        if gain is None:
            return 0.0
        is_checked = self._weighing_std > 0 and gain.std < UNCHECKED * self._force_scale_std
        return 0.0 if is_checked else gain.std

    @property
    def _weighing_std(self) -> float:
        """Deviation of the robot's weighing, kg; 0 without one."""
        measurements = self._measurements
        return 0.0 if measurements is None else measurements.weighing_std

    @property
    def _force_scale_std(self) -> float:
        stated = self.problem.force_scale_std
        return FORCE_SCALE_STD if stated is None else stated

    def map(self, *, with_verdict: bool = True) -> Identification:
        """Return the most probable parameters."""
        return self._gaussian("map", self.posterior.mean, with_verdict=with_verdict)

    def map_lmi(self, *, with_verdict: bool = True) -> Identification:
        """Return the most probable parameters of physically possible links."""
        return self._gaussian("map_lmi", self.consistent_unknowns(), with_verdict=with_verdict)

    def consistent_unknowns(self) -> FloatArray:
        """Return the most probable unknowns (p + s,) with physically possible links."""
        parameters, found = self.problem.parameters, self.posterior
        return consistent_minimum(
            found.factor,
            found.factor @ found.mean,
            found.prior.std,
            len(parameters.links),
            drive_bounds(parameters, self.chosen),
        ).value

    def _unexpected_change(self, value: FloatArray) -> FloatArray:
        """Return the change of each parameter (p,) that is undetermined and contradicts its prior.

        It is zero for others. The deviation of an undetermined parameter is the prior's, which is
        too small if the data or limits of possible links move the parameter by many of these: a
        link with a large first moment needs a mass, about which the data may show nothing else.
        """
        found, p = self.posterior, len(self.problem.parameters)
        change = np.abs(value - found.prior.mean)[:p]
        before = np.linalg.norm(found.prior_factor[:p], axis=1)
        is_unexpected = (change > HEAVY_DEVIATIONS * before) & (found.std[:p] > DETERMINED * before)
        is_unexpected[self.problem.parameters.inertial :] = False
        return np.where(is_unexpected, change, 0.0)

    def _gaussian(self, method: Method, value: FloatArray, *, with_verdict: bool) -> Identification:
        found, problem = self.posterior, self.problem
        p = len(problem.parameters)
        singular = np.linalg.svd(found.factor * found.prior.std, compute_uv=False)
        std, gain, change = found.std[:p], self._common_gain(), None
        if gain is not None:
            change = gain.std * gain.direction[:p]
            std = np.hypot(std, np.where(self._scaled_parameters, change, 0.0))
        std = np.hypot(std, self._unexpected_change(value))
        verdict = None
        if with_verdict:
            verdict = assess(
                found,
                value,
                problem.parameters,
                window=self.chosen.window,
                whiteness=self.whiteness,
                sensors=(problem.sensor_names, problem.sensor_units),
                unexplained=self.unexplained,
                alarms=self.alarms(value),
                mass_scale=self._mass_scale(gain),
                weighing_std=self._weighing_std,
                is_scale_stated=problem.force_scale_std is not None,
            )
        condition = float(singular[0] / singular[-1])
        estimate = estimate_of(self, method, value, std, condition=condition)
        remarks = (*estimate.remarks, *payload_remarks(self, value, change))
        noise = {} if verdict is None else row_std(self.chosen, value, verdict.effective)
        has_contacts = problem.parameters.model.contacts is not None
        correlation = self.chosen.residual_correlation(value) if has_contacts and noise else None
        return Identification(
            replace(estimate, verdict=verdict, row_std=noise, remarks=remarks),
            problem.data,
            found.deviation_factor,
            self.chosen.window,
            value,
            problem.row_builder,
            change,
            correlation,
        )

    def truncated(
        self,
        method: TruncatedMethod,
        truncation: Truncation,
        row_deviation: FloatArray | None = None,
    ) -> Identification:
        """Return the estimate of a truncated method of the thesis.

        Parameters
        ----------
        method : {"ols", "wls_r", "wls_c", "wls_rc"}
            Scaling of rows and columns.
        truncation : Truncation
            Choice of z.
        row_deviation : (n,) float64, optional
            σ of each coordinate; by default that of the OLS residual.

        Raises
        ------
        EstimateError
            When z exceeds the rank, or there are sensor errors or pseudo-measurements.
        """
        problem = self.problem
        if problem.sensor_names or problem.pseudo_measurements is not None:
            raise EstimateError(
                f"{method} supports neither `sensor_errors`, `tare`, `total_mass` nor `mirror`; "
                "use `method` map or map_lmi",
                "E503",
            )
        least_squares = LeastSquares(self.chosen.rows, row_deviation, self.chosen.counts.diagonal())
        scaled = least_squares.scaled(problem.prior, method)
        if truncation.rank is not None:
            z = truncation.rank
            if not 1 <= z <= scaled.rank:
                raise EstimateError(
                    f"`rank` {z} is not between 1 and {scaled.rank}, the rank of this log's "
                    "equations; choose another",
                    "E501",
                )
        elif truncation.validation:
            validation = _with_window(truncation.validation, self.chosen.window)
            z = select_rank(scaled, validation.rows, truncation.criterion)
        else:
            z = informative_rank(self.posterior, scaled.rank)
        value = scaled.solution(z)
        condition = float(scaled.singular_values[0] / scaled.singular_values[z - 1])
        std = scaled.std(z, problem.prior.std)
        estimate = estimate_of(self, method, value, std, condition=condition, rank=z)
        return Identification(
            estimate,
            problem.data,
            None,
            self.chosen.window,
            value,
            problem.row_builder,
        )


def _with_all_errors(problem: Problem, found: Posterior, chosen: Observations) -> Posterior:
    """Return the posterior with the covariance of all errors that the data show."""
    found = with_correlated_residuals(found, chosen)
    deviations, choice = problem.term_deviations, problem.choice
    if deviations is not None and choice is not None and not choice.slips:
        # Viscous friction of joints that moved too little takes the place of Coulomb friction.
        unjudged = {f"{joint}/viscous" for joint in choice.unjudged}
        columns = [name in unjudged for name in problem.prior.names]
        # The posterior may know factors of drives as well, which have no rows here.
        whole = np.diag(found.mean)[: len(deviations), columns]
        deviations = np.hstack([deviations, whole])
    return replace(found, other_models=deviations)


def _solve(
    problem: Problem,
    chosen: Observations,
    start: FloatArray | None,
    tolerance: float,
    *,
    approximate: bool = False,
) -> tuple[Posterior, Observations]:
    """Return the posterior, and the rows with the weights that it is from.

    The covariance of residuals between coordinates is their best weight if the residuals are noise.
    If they are errors of the model, it favours the combinations that the model explains worst. The
    estimates with and without these covariances then differ by more than their deviations (Hausman
    1978, Econometrica 46(6)), and those without are used.
    """
    found = solve_window(problem, chosen, start, tolerance, approximate=approximate)
    if not chosen.has_coupled_rows:
        return found, chosen
    apart = replace(chosen, is_coupled=False)
    simple = solve_window(problem, apart, found.mean, COMPARABLE, approximate=True)
    difference = simple.factor @ (found.mean - simple.mean)
    if difference @ difference < DISAGREEMENT * len(difference):
        return found, chosen
    if not approximate:
        simple = solve_window(problem, apart, simple.mean, tolerance)
    return simple, apart


def _with_window(candidates: Sequence[Observations], window: float) -> Observations:
    for one in candidates:
        if one.window == window:
            return one
    raise EstimateError(
        f"the validation log is too short for windows of {1e3 * window:g} ms; give a longer one to "
        "`choose_truncation`",
        "E516",
    )
