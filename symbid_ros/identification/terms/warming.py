"""Finds friction that changes during a log, when the joints' terms leave residuals.

Drives warm up in minutes, and their friction falls. As for ripples, the change of a joint's viscous
or Coulomb friction must improve the prediction of rows that are left out.
"""

import logging
from collections.abc import Iterable
from dataclasses import replace
from itertools import product

from symbid_ros.choices import Term
from symbid_ros.estimation.group_moments import Grouping
from symbid_ros.estimation.term_evidence import changing_friction, predictive_effects
from symbid_ros.identification.rows.dataset import Dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.terms.trial import leaves_residuals, training_part, try_columns
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.warming import MOST_PARTS, WARMING_TERMS, Course, Warming, courses_of
from symbid_ros.signals.segments import Segment, stamp_spans

logger = logging.getLogger(__name__)

# Shorter logs, without their pauses, do not tell a drive that warms up from other effects, ns.
LEAST_WARMING = 50_000_000_000
# Shares of the square error of left-out rows of its joint that a change must remove. The drives of
# a robot warm up together: if one does, any improvement tells that the grease of another does.
LEAST_GAINS: tuple[tuple[float, tuple[Term, ...]], ...] = (
    (0.5, WARMING_TERMS),
    (0.0, ("viscous",)),
    (0.05, ("coulomb",)),
)


def is_too_short(courses: Iterable[Course]) -> bool:
    """Return whether parts of a log, without the pauses, do not tell whether drives warm up."""
    return sum(stop - start for start, stop in courses) < LEAST_WARMING


def find_warming(solved: SolvedProblem, dataset: Dataset) -> tuple[Warming, ...]:
    """Return the friction that changes during a log.

    Parameters
    ----------
    solved : SolvedProblem
        Of the log, with chosen joint terms and constant friction.
    dataset : Dataset
        The log.

    Returns
    -------
    tuple of Warming
        Empty if the residuals are white noise, or the log is short.
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
