"""Finds joints that share a drive, when the joints' own terms leave residuals.

Neighbouring joints of an arm are tried, with the sum and with the difference of their speeds. The
terms of all these drives are candidates beside those of the joints, on the first three quarters of
the log, so that the check on its end stays fair. Couplings that improve the prediction of rows
that are left out are added one by one.
"""

import logging
from dataclasses import replace

import numpy as np

from symbid_ros.errors import SymbidError
from symbid_ros.estimation.term_evidence import predictive_couplings
from symbid_ros.estimation.verdict import SUSPICIOUS_WHITENESS
from symbid_ros.identification.dataset import Dataset, Processing, fold_dataset
from symbid_ros.identification.joint_terms import candidate_posterior
from symbid_ros.identification.solver import Solver
from symbid_ros.identification.term_priors import candidate_prior
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.segments import split
from symbid_ros.signals.weak_form import WINDOWS

logger = logging.getLogger(__name__)

# Joints of a robot above which couplings are not searched for: the candidates would be too many.
MOST_JOINTS = 10


def find_couplings(solver: Solver, dataset: Dataset) -> tuple[Coupling, ...]:
    """Return the couplings of neighbouring joints that a log shows.

    Parameters
    ----------
    solver : Solver
        Of the log, with chosen joint terms and without couplings.
    dataset : Dataset
        The log.

    Returns
    -------
    tuple of Coupling
        Empty if the residuals are white noise, the base floats or there are many joints.
    """
    problem = solver.problem
    choice = problem.choice
    if choice is None or choice.parameters.couplings or solver.whiteness < SUSPICIOUS_WHITENESS:
        return ()
    pairs = neighbours(choice.parameters)
    if not pairs:
        return ()
    window = solver.chosen.window
    try:
        training, _ = split(dataset.segments, max(window, *WINDOWS), dataset.source)
        parameters = replace(choice.parameters, couplings=pairs)
        trial = fold_dataset(training, dataset.source, parameters, Processing(windows=(window,)))
    except SymbidError:  # too short
        return ()
    # The prior of the links, with the scale that the evidence gave it.
    prior = solver.posterior.prior.for_columns(parameters)
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
    candidates = np.ones(len(parameters), bool)
    found, chosen = candidate_posterior(everything, candidates, slips=True)
    free = np.ones(len(parameters), bool)
    first = parameters.first_coupled
    free[:first] = choice.free[:first]
    free[first : parameters.sensor_offsets.start] = False
    couplings = predictive_couplings(found, chosen, parameters, free)
    for one in couplings:
        logger.warning(
            "%s: %s share a drive: friction or armature acts on %s, which is identified as well; "
            "a live run needs `coupling` %s",
            dataset.source,
            " and ".join(parameters.model.joint_names[joint] for joint in one.joints),
            one.label,
            one.label,
        )
    return couplings


def neighbours(parameters: ParameterSet) -> tuple[Coupling, ...]:
    """Return the couplings of each revolute joint with the next one, by sum and by difference."""
    model = parameters.model
    if model.floating or len(model.joints) > MOST_JOINTS:
        return ()
    pairs = [
        (joint.parent - 1, index)
        for index, joint in enumerate(model.joints)
        if joint.parent > 0
        and not {index, joint.parent - 1} & {*model.followers, *parameters.link_side}
    ]
    return tuple(
        Coupling.of(model, pair, (1.0, ratio))
        for pair in pairs
        if all(model.joints[joint].kind == "revolute" for joint in pair)
        and set(pair) <= set(model.moving_joints)
        for ratio in (1.0, -1.0)
    )
