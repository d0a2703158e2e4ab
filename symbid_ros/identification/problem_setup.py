"""Solves a log with the sensor errors, drive gains and joint terms that options ask for."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.calibration.drive_gains import (
    ConvertedSegments,
    InitialFactors,
    initial_factors,
    named_joints,
    with_measured_loads,
)
from symbid_ros.identification.calibration.extended_problem import (
    SensorErrorRequest,
    calibrate,
    with_fixed_gains,
    without_terms,
)
from symbid_ros.identification.calibration.gain_iteration import identify_gains
from symbid_ros.identification.calibration.shown_errors import biases_explain, shows_imu_bias
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.log_checks import NO_CHECKS, LogChecks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.prior_options import build_pseudo_measurements
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset, Processing, fold_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.stored_information import merged_observations, with_columns
from symbid_ros.identification.terms.choice import choose_terms
from symbid_ros.identification.terms.further_terms import (
    find_couplings,
    find_springs,
    find_warming,
)
from symbid_ros.identification.terms.priors import candidate_prior, named_term_prior
from symbid_ros.identification.terms.ripples import find_ripples
from symbid_ros.identification.terms.trial import with_plausible_prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import DRIVE_GAIN, IMU_BIAS, PLACE


@dataclass(frozen=True)
class ProblemSetup:
    """What a log is solved with, apart from its rows and their columns.

    Attributes
    ----------
    options : IdentifyOptions
    prior : Prior
    inputs : tuple of str
        Input files, recorded in the estimate.
    tares : mapping of str to Tare
        By frame of the wrench sensor.
    checks : LogChecks
        What the checks of the log found.
    """

    options: IdentifyOptions
    prior: Prior
    inputs: tuple[str, ...] = ()
    tares: Mapping[str, Tare] = field(default_factory=dict)
    checks: LogChecks = NO_CHECKS

    def solve(
        self, parameters: ParameterSet, dataset: Dataset, *, is_trial: bool = False
    ) -> SolvedProblem:
        """Solve a log whose rows have the columns ``parameters``."""
        options, prior = self.options, self.prior.for_columns(parameters)
        factors = first_factors(options, dataset, parameters, prior)
        problem = Problem(
            dataset.observations,
            parameters,
            prior,
            pseudo_measurements=build_pseudo_measurements(options, parameters, prior),
            is_empirical=options.is_empirical,
            inputs=self.inputs,
            allows_signed_drives=options.signed_drives,
            force_scale_std=options.force_scale,
        )
        if parameters.candidates or (parameters.terms and options.is_empirical):
            scale = None if factors is None else factors.values
            of_terms = candidate_prior if parameters.candidates else named_term_prior
            prior = of_terms(prior, parameters, dataset.observations[0], scale)
            problem = replace(problem, prior=prior)
        kinds: tuple[str, ...] = options.sensor_error_kinds
        first = next(iter(dataset.segments), None)
        is_assumed = options.assumes_imu_bias and not options.named_sensor_errors
        if is_assumed and (first is None or not first.imu_frames):
            kinds = ()
        kinds += (PLACE,) * bool(parameters.unplaced)
        if factors is not None and not kinds:
            solve = partial(_with_chosen_terms, is_trial=True)
            problem = identify_gains(problem, dataset, factors, solve)
            return SolvedProblem.of(problem, is_trial=is_trial)
        kinds += (DRIVE_GAIN,) * (factors is not None)
        if kinds:
            # What the user recorded for the purpose counts more than times in the air.
            tares = {**self.checks.tares, **self.tares}
            request = SensorErrorRequest(kinds, tares, self.checks.mountings, factors)
            problem = calibrate(problem, dataset, request)
            if kinds == (IMU_BIAS,) and not is_trial:  # later logs have other biases
                unbiased = _without_biases(problem, dataset, Processing.of(options))
                problem = replace(problem, stored=unbiased)
        if options.information is not None:
            earlier = with_columns(load_archive(options.information), parameters)
            both = merged_observations(problem.observations, earlier, str(options.information))
            problem = replace(problem, observations=both)
        gained = None if factors is None else dataset
        return _with_chosen_terms(problem, is_trial=is_trial, gained=gained)

    def with_found_biases(
        self, parameters: ParameterSet, dataset: Dataset
    ) -> "tuple[ProblemSetup, SolvedProblem]":
        """Solve a log, with biases of its IMUs if it shows them; return the setup that did."""
        solved = self.solve(parameters, dataset)
        if self.options.finds_imu_bias and shows_imu_bias(solved, dataset):
            setup = replace(self, options=replace(self.options, sensor_errors=(IMU_BIAS,)))
            biased = setup.solve(parameters, dataset)
            if biases_explain(biased, solved, dataset):
                return setup, biased
        return self, solved

    def with_found_terms(
        self, parameters: ParameterSet, dataset: Dataset, solved: SolvedProblem
    ) -> tuple[ParameterSet, Dataset, SolvedProblem]:
        """Solve a log with further terms that it shows; return their columns and rows as well."""
        options = self.options
        if parameters.model.floating and options.sensor_error_kinds:
            # Errors of IMUs and foot sensors leave residuals that joint terms would follow.
            return parameters, dataset, solved
        exact = self._with_exact_sensors(parameters, solved, dataset)
        for name, searches, find in (
            ("terms", options.searches, find_springs),
            ("couplings", options.finds_couplings, find_couplings),
            ("warming", options.searches, find_warming),
            ("ripples", options.finds_ripples, find_ripples),
        ):
            found = find(*exact) if searches else ()
            if not found:
                continue
            more: dict[str, Any] = {name: (*getattr(parameters, name), *found)}
            parameters, processing = replace(parameters, **more), Processing.of(options)
            dataset = fold_dataset(dataset.segments, dataset.source, parameters, processing)
            solved = self.solve(parameters, dataset)
            exact = self._with_exact_sensors(parameters, solved, dataset)
        return parameters, dataset, solved

    def _with_exact_sensors(
        self, parameters: ParameterSet, solved: SolvedProblem, dataset: Dataset
    ) -> tuple[SolvedProblem, Dataset]:
        """Return a solution without sensor errors, and its log with the drive gains found, if any.

        Further terms are searched for in its residuals.
        """
        build, options = solved.problem.calibrated_rows, self.options
        if not options.searches:
            return solved, dataset
        if build is None:
            return with_plausible_prior(solved), dataset
        if build.errors.gained:
            factors = np.ones(len(parameters.model.joints))
            factors[build.errors.gained_joints] = build.errors.of_kind(
                DRIVE_GAIN, build.linearization.theta
            )[:, 0]
            segments = ConvertedSegments(dataset.segments, factors)
            dataset = fold_dataset(segments, dataset.source, parameters, Processing.of(options))
        exact = replace(
            options, drive_gain=(), drive_gain_percent=None, sensor_errors=("none",), tare=()
        )
        return ProblemSetup(exact, self.prior).solve(parameters, dataset), dataset


@dataclass(frozen=True)
class _UnbiasedSegments:
    """Segments whose IMUs' biases (I, 6), rad/s and m/s², are removed."""

    segments: Iterable[Segment]
    biases: FloatArray

    def __iter__(self) -> Iterator[Segment]:
        for one in self.segments:
            yield replace(
                one,
                angular_velocity=one.angular_velocity - self.biases[:, :3],
                linear_acceleration=one.linear_acceleration - self.biases[:, 3:],
            )


def _without_biases(
    problem: Problem, dataset: Dataset, processing: Processing
) -> tuple[Observations, ...]:
    """Return the rows of a log without the biases that were found."""
    build = problem.calibrated_rows
    assert build is not None
    biases = build.errors.of_kind(IMU_BIAS, build.linearization.theta)
    segments = _UnbiasedSegments(dataset.segments, biases)
    return fold_dataset(segments, dataset.source, problem.parameters, processing).observations


def first_factors(
    options: IdentifyOptions, dataset: Dataset, parameters: ParameterSet, prior: Prior
) -> InitialFactors | None:
    """Return first guesses of the factors of efforts, if any is unknown."""
    joints = named_joints(options.drive_gains, parameters.model)
    if not joints:
        return None
    if options.drive_gain_percent is not None:
        spread = options.drive_gain_percent / 100
        return InitialFactors.near_one(joints, len(parameters.model.joints), spread)
    mean = prior.mean
    if parameters.model.wrist_sensors:
        mean = with_measured_loads(mean, dataset.observations[0], parameters)
    return initial_factors(dataset.segments, parameters, mean, joints)


def _with_chosen_terms(
    problem: Problem, *, is_trial: bool, gained: Dataset | None = None
) -> SolvedProblem:
    """Solve a problem, with the terms that its data ask for if they are candidates.

    ``gained`` is the log of a problem with drive gains as unknowns.
    """
    if not problem.parameters.candidates:
        return SolvedProblem.of(problem, is_trial=is_trial)

    def with_terms(window: float | None = None) -> Problem:
        """Return the problem with the terms that all rows ask for, or those of one window."""
        rows = tuple(one for one in problem.observations if window in (None, one.window))
        some = replace(problem, observations=rows)
        choice = choose_terms(some if gained is None else with_fixed_gains(some))
        rest = problem if gained is None else without_terms(problem, gained, choice.free)
        return replace(choice.applied(rest), choice=choice)

    solved = SolvedProblem.of(with_terms(), is_trial=is_trial)
    choice = solved.problem.choice
    if choice is None or choice.window in (None, solved.chosen.window):
        return solved
    # Noise may spoil the rows of short windows for all candidates together, and not for the chosen
    # ones. Rows that are used choose the terms as well.
    window = solved.chosen.window
    again = replace(with_terms(window), stored=solved.problem.stored)
    return SolvedProblem.of(again, is_trial=is_trial, window=window)
