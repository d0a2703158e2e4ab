"""Trial of further columns on the first three quarters of a log.

The end of the log is left out, so that the check on it stays fair.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray
from symbid_ros.choices import SIMULATED_TERMS
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.alarms import SUSPICIOUS_SCALE, SUSPICIOUS_WHITENESS
from symbid_ros.estimation.group_moments import BY_SECONDS, Grouping
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.unexplained import CHANCE
from symbid_ros.identification.rows.dataset import Dataset, Processing, fold_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.choice import candidate_posterior
from symbid_ros.identification.terms.priors import candidate_prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.segments import Segment, split
from symbid_ros.signals.weak_form import WINDOWS

# Share of a joint's force that is left unexplained, from which a coupled drive may be the cause.
# The rotor that two joints of a Stäubli TX40 share leaves .29 to .69 of the force of one of them.
CLEAR_SHARE = 0.1


@dataclass(frozen=True)
class Trial:
    """The posterior with all columns free.

    Attributes
    ----------
    found : Posterior
    chosen : Observations
        The rows that it is from.
    free : (p,) bool
        Parameters of the links, and the terms that were chosen without the further columns.
    """

    found: Posterior
    chosen: Observations
    free: BoolArray


def leaves_residuals(solved: SolvedProblem) -> bool:
    """Return whether the chosen terms leave correlated residuals, so that drives may have others.

    Without measured efforts it is False.
    """
    choice = solved.problem.choice
    if choice is None or not choice.measured.any():
        return False
    return solved.whiteness >= SUSPICIOUS_WHITENESS


def leaves_clear_forces(solved: SolvedProblem) -> bool:
    """Return whether the chosen terms leave a clear part of some joint's force unexplained.

    A log that is too short for a test of all residuals together shows this as well.
    """
    return leaves_residuals(solved) or any(
        one.own_share > CLEAR_SHARE and one.deviations > CHANCE for one in solved.unexplained
    )


def with_plausible_prior(solved: SolvedProblem) -> SolvedProblem:
    """Return a solved problem in whose residuals further terms and errors can be searched for.

    If the data contradict a stated prior, its residuals are those of wrong links, which a ripple or
    a spring would resemble. The data set the scale of the prior then.
    """
    problem = solved.problem
    is_contradicted = solved.posterior.prior_scale > SUSPICIOUS_SCALE
    if problem.is_empirical or problem.calibrated_rows is not None or not is_contradicted:
        return solved
    return SolvedProblem.of(replace(problem, is_empirical=True))


def training_part(solved: SolvedProblem, dataset: Dataset) -> Iterable[Segment]:
    """Return the segments of the first three quarters of a log; none if it is too short."""
    try:
        training, _ = split(dataset.segments, max(solved.chosen.window, *WINDOWS), dataset.source)
    except SymbidError:
        return ()
    return training


def try_columns(
    solved: SolvedProblem,
    training: Iterable[Segment],
    source: str,
    parameters: ParameterSet,
    *,
    slips: bool,
    grouping: Grouping = BY_SECONDS,
) -> Trial | None:
    """Return the posterior with further columns; None if the log is too short.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log, with chosen joint terms and without the columns.
    training : iterable of Segment
        From a log named ``source``.
    source : str
    parameters : ParameterSet
        All candidate terms, and the further columns.
    slips, grouping
        Whether only rows of slipping joints are used, and which rows are left out together.
    """
    problem, window = solved.problem, solved.chosen.window
    choice = problem.choice
    assert choice is not None
    processing = Processing(windows=(window,), grouping=grouping)
    try:
        trial = fold_dataset(training, source, parameters, processing)
    except SymbidError:
        return None
    # The prior of the links, with the scale that the evidence gave it.
    prior = solved.posterior.prior.for_columns(parameters)
    prior = candidate_prior(prior, parameters, trial.observations[0])
    everything = replace(
        problem,
        observations=trial.observations,
        parameters=parameters,
        prior=prior,
        pseudo_measurements=None,
        choice=None,
        term_deviations=None,
        stored=None,
    )
    names = choice.parameters.names
    chosen_before = {name for name, free in zip(names, choice.free, strict=True) if free}
    free = np.array([name in chosen_before for name in parameters.names])
    candidates = free | ~parameters.of_terms(SIMULATED_TERMS)
    found, chosen = candidate_posterior(everything, candidates, slips=slips)
    return Trial(found, chosen, free)
