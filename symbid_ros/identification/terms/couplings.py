"""Finds joints that share a drive, when the joints' own terms leave residuals.

Neighbouring joints of an arm are tried, with the sum and with the difference of their speeds. The
terms of all these drives are candidates beside those of the joints. Couplings that improve the
prediction of rows that are left out are added one by one.
"""

import logging
from dataclasses import replace

from symbid_ros.estimation.term_evidence import coupled_drives, predictive_effects
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.trial import leaves_residuals, training_part, try_columns
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet

logger = logging.getLogger(__name__)

# Joints of a robot above which couplings are not searched for: the candidates would be too many.
MOST_JOINTS = 10


def find_couplings(solved: SolvedProblem, dataset: Dataset) -> tuple[Coupling, ...]:
    """Return the couplings of neighbouring joints that a log shows.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log, with chosen joint terms and without couplings.
    dataset : Dataset
        The log.

    Returns
    -------
    tuple of Coupling
        Empty if the residuals are white noise, the base floats or there are many joints.
    """
    choice = solved.problem.choice
    if choice is None or choice.parameters.couplings or not leaves_residuals(solved):
        return ()
    pairs = neighbours(choice.parameters)
    if not pairs:
        return ()
    parameters = replace(choice.parameters, couplings=pairs)
    training = training_part(solved, dataset)
    trial = try_columns(solved, training, dataset.source, parameters, slips=True)
    if trial is None:
        return ()
    effects = coupled_drives(parameters)
    couplings = predictive_effects(trial.found, trial.chosen, effects, trial.free)
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
