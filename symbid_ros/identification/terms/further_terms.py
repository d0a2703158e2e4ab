"""Finds springs, coupled drives and friction that changes, when the joints' terms leave residuals.

Each must improve the prediction of rows that are left out. The searches take a solution of the log
with chosen joint terms, of which none is of the kind that is searched for. They find nothing if the
residuals are white noise or the log is short.
"""

import logging
from collections.abc import Iterable
from dataclasses import replace
from itertools import product

from symbid_ros.choices import SPRING, Term
from symbid_ros.estimation.group_moments import Grouping
from symbid_ros.estimation.term_evidence import (
    changing_friction,
    coupled_drives,
    predictive_effects,
    spring_torques,
)
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.resting_joints import motionless_joints
from symbid_ros.identification.terms.trial import (
    leaves_clear_forces,
    leaves_residuals,
    training_part,
    try_columns,
)
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.warming import MOST_PARTS, WARMING_TERMS, Course, Warming, courses_of
from symbid_ros.signals.segments import Segment, stamp_spans

logger = logging.getLogger(__name__)

# Joints of a robot above which couplings are not searched for: the candidates would be too many.
MOST_JOINTS = 10
# Shorter logs, ns without their pauses, do not separate a drive that warms up from other effects.
LEAST_WARMING = 50_000_000_000
# Shares of the square error of left-out rows of its joint that a change must remove. The drives of
# a robot warm up together: if one does, any improvement is evidence for another.
LEAST_GAINS: tuple[tuple[float, tuple[Term, ...]], ...] = (
    (0.5, WARMING_TERMS),
    (0.0, ("viscous",)),
    (0.05, ("coulomb",)),
)


def find_springs(solved: SolvedProblem, dataset: Dataset) -> tuple[Term, ...]:
    """Return the term of springs if a log shows any, and log a warning that names their joints.

    Cables, hoses and springs add a torque in proportion to the angle of a joint.
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
    logger.warning(
        "%s: springs act on %s, and are identified as well; a live run needs `joint_terms` that "
        "name stiffness",
        dataset.source,
        ", ".join(parameters.model.joint_names[joint] for joint in sorted(joints)),
    )
    return (SPRING,)


def find_couplings(solved: SolvedProblem, dataset: Dataset) -> tuple[Coupling, ...]:
    """Return the drives that neighbouring joints of an arm share, and log a warning for each.

    The sum and the difference of the joints' speeds are tried. The terms of all these drives are
    candidates beside those of the joints.
    """
    choice = solved.problem.choice
    if choice is None or choice.parameters.couplings or not leaves_clear_forces(solved):
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


def is_too_short(courses: Iterable[Course]) -> bool:
    """Return whether parts of a log, without the pauses, are too short to see drives warm up."""
    return sum(stop - start for start, stop in courses) < LEAST_WARMING


def find_warming(solved: SolvedProblem, dataset: Dataset) -> tuple[Warming, ...]:
    """Return the viscous and Coulomb friction that changes during a log, and log a warning.

    Drives warm up in minutes, and their friction falls.
    """
    choice = solved.problem.choice
    if choice is None or choice.parameters.warming or not leaves_residuals(solved):
        return ()
    courses = courses_of(stamp_spans(dataset.segments))
    if is_too_short(courses):
        return ()
    if len(courses) > MOST_PARTS:
        logger.info(
            "%s: pauses of a minute and more divide it into %d parts, and friction that changes is "
            "searched for in at most %d; identify fewer bags in one run",
            dataset.source,
            len(courses),
            MOST_PARTS,
        )
        return ()
    training = training_part(solved, dataset)
    model = choice.parameters.model
    sensors = {
        joint
        for place in model.wrist_sensors.values()
        for joint in range(*place.indices(len(model.joints)))
    }
    joints = sorted(set(choice.parameters.joints.tolist()) - set(model.followers) - sensors)
    tried = tuple(Warming(joint, term, courses) for joint, term in product(joints, WARMING_TERMS))
    parameters = during(replace(choice.parameters, warming=tried), training)
    # A course in time would predict seconds that are left out from their neighbours, of whatever
    # slow error: it has to predict parts of the log that are long compared with that.
    grouping = Grouping.contiguous(stamp_spans(training))
    trial = try_columns(
        solved, training, dataset.source, parameters, slips=choice.slips, grouping=grouping
    )
    if trial is None:
        return ()
    effects, free = changing_friction(parameters), trial.free.copy()
    found: tuple[Warming, ...] = ()
    for least, terms in LEAST_GAINS:
        others = {
            one: effect for one, effect in effects.items() if one.term in terms and one not in found
        }
        found += predictive_effects(trial.found, trial.chosen, others, free, least)
        if not found:
            return ()
        for one in found:
            free[parameters.warming_columns[one]] = True
    places = sorted((one.joint, one.term) for one in found)
    logger.warning(
        "%s: friction changes during the log (%s), as in drives that warm up, and is identified as "
        "well; the model has that at the end of the log. Live runs take friction as constant",
        dataset.source,
        ", ".join(f"{term} of {model.joint_names[joint]}" for joint, term in places),
    )
    return tuple(Warming(joint, term, courses) for joint, term in places)


def during(parameters: ParameterSet, segments: Iterable[Segment]) -> ParameterSet:
    """Return the parameters with friction that changes during these segments and not later."""
    if not parameters.warming or parameters.warming[0].is_of_another_log:
        return parameters
    courses = courses_of(stamp_spans(segments))
    changed = tuple(replace(one, courses=courses) for one in parameters.warming)
    return replace(parameters, warming=changed)
