"""Finds springs beside the drives, when the joints' terms leave residuals.

Cables, hoses and springs add a torque in proportion to the angle of a joint. As for ripples, it
must improve the prediction of rows that are left out.
"""

import logging
from dataclasses import replace

from symbid_ros.choices import SPRING, Term
from symbid_ros.estimation.term_evidence import predictive_effects, spring_torques
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.resting_joints import motionless_joints
from symbid_ros.identification.terms.trial import leaves_residuals, training_part, try_columns

logger = logging.getLogger(__name__)


def find_springs(solved: SolvedProblem, dataset: Dataset) -> tuple[Term, ...]:
    """Return the term of springs if a log shows any, and log a warning that names their joints.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log, with chosen joint terms and without springs.
    dataset : Dataset
        The log.

    Returns
    -------
    tuple of str
        Empty if the residuals are white noise, or springs do not explain them.
    """
    choice = solved.problem.choice
    if choice is None or SPRING in choice.parameters.terms or not leaves_residuals(solved):
        return ()
    parameters = replace(choice.parameters, terms=(*choice.parameters.terms, SPRING))
    training = training_part(solved, dataset)
    trial = try_columns(solved, training, dataset.source, parameters, slips=choice.slips)
    if trial is None:
        return ()
    # Where a joint rests, a spring is a constant torque, and noise of the encoder bends it.
    is_resting = motionless_joints(dataset.samples.position, parameters.model)
    springs = {
        joint: effect
        for joint, effect in spring_torques(parameters).items()
        if not is_resting[joint]
    }
    joints = predictive_effects(trial.found, trial.chosen, springs, trial.free)
    if not joints:
        return ()
    named = (parameters.model.joint_names[joint] for joint in sorted(joints))
    logger.warning(
        "%s: springs act on %s, and are identified as well; a live run needs `joint_terms` that "
        "name stiffness",
        dataset.source,
        ", ".join(named),
    )
    return (SPRING,)
