"""Priors of a live identification after the robot or one of its sensors has changed."""

from dataclasses import replace

import numpy as np

from symbid_ros.estimation.change import (
    LinkChange,
    prior_after_change,
    relaxed_prior,
    relaxed_sensor_prior,
)
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.change_monitor import Change
from symbid_ros.model.parameters import ParameterSet


class ChangedPriors:
    """Makes priors unknown where something changed, and remembers the first prior.

    Parameters
    ----------
    parameters : ParameterSet
        All columns of the data.
    remarks : tuple of str
        Remarks of an estimate without changes.
    """

    def __init__(self, parameters: ParameterSet, remarks: tuple[str, ...]) -> None:
        self._parameters, self._remarks = parameters, remarks
        self._relaxed: set[str] = set()
        # First mean and deviation by name, once an estimate has started anew.
        self._first: dict[str, tuple[float, float]] = {}

    @property
    def has_restarted(self) -> bool:
        """Whether the estimate has started anew after a change."""
        return bool(self._first)

    def clear(self) -> None:
        """Forget all changes."""
        self._relaxed.clear()
        self._first.clear()

    def relaxed(self, problem: Problem, change: Change | None) -> Problem:
        """Return a problem in which the links and sensor errors that may have changed are unknown.

        Each is relaxed once.
        """
        for suspect in () if change is None else change.suspects:
            if suspect.subject in self._relaxed:
                continue
            self._relaxed.add(suspect.subject)
            if isinstance(suspect, LinkChange):
                prior = relaxed_prior(problem.prior, self._parameters, suspect)
            else:
                prior = relaxed_sensor_prior(problem.prior, suspect.sensor)
            problem = replace(problem, prior=prior)
        return problem

    def restarted(
        self, problem: Problem, settled: tuple[Change, Posterior], terms: Prior
    ) -> Problem:
        """Return a problem for data since a change, from what was known before.

        Parameters
        ----------
        problem : Problem
            With the prior so far.
        settled : tuple of Change and Posterior
            The change and the posterior before it.
        terms : Prior
            Prior of all columns; what follows is too short to tell of what size joint terms are.
        """
        change, before = settled
        terms = replace(terms, assumed=())
        named = " or ".join(one.link for one in change.links)
        if not self._first:
            for prior in (terms, before.prior):
                numbers = zip(prior.names, prior.mean.tolist(), prior.std.tolist(), strict=True)
                self._first |= {name: (mean, std) for name, mean, std in numbers}
        return replace(
            problem,
            prior=prior_after_change(before, terms, self._parameters, change.links),
            # The posterior before the change contains them, and the sizes of its deviations.
            pseudo_measurements=None,
            is_empirical=False,
            remarks=(
                *self._remarks,
                f"{named} changed at {change.since * 1e-9:.1f} s; what was known before is the "
                "prior of later data",
            ),
        )

    def compared_with_the_first(self, found: Identification) -> Identification:
        """Return an estimate that states its first prior, if a change has given it a later one."""
        estimate = found.estimate
        if not self._first or estimate.std is None:
            return found
        first = np.array([self._first[name] for name in estimate.names])
        determined = np.asarray(estimate.std < DETERMINED * first[:, 1])
        return replace(found, estimate=replace(estimate, prior=first[:, 0], determined=determined))
