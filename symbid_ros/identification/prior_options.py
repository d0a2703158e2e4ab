"""Parameters, prior and pseudo-measurements, as the options name them."""

import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from symbid_ros.choices import SPRING
from symbid_ros.errors import EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.constraints import mirror_rows, total_mass_row
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.estimation.prior import Prior, absolute_model_prior, default_prior, model_prior
from symbid_ros.estimation.prior_file import load_prior
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.stored_information import columns_of
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload
from symbid_ros.model.ripple import Ripple
from symbid_ros.model.tree import RobotModel

logger = logging.getLogger(__name__)

# Standard deviations between weighed mass and prior beyond which one of them must be wrong.
CONTRADICTION = 6.0


def load_parameters(robot: RobotModel, options: IdentifyOptions) -> ParameterSet:
    """Return the columns of the data, and warn about known joint terms of the model file."""
    robot = with_robot_options(robot, options)
    if options.chooses_terms and options.information is not None:
        parameters = columns_of(robot, load_archive(options.information), str(options.information))
    else:
        has_springs = any(joint.stiffness for joint in robot.joints)
        springs = (SPRING,) if options.chooses_terms and has_springs else ()
        parameters = ParameterSet(
            robot,
            (*options.terms, *springs),
            candidates=options.chooses_terms,
            couplings=tuple(Coupling.parse(one, robot) for one in options.couplings),
            ripples=tuple(Ripple.parse(one, robot) for one in options.ripples),
        )
    parameters = replace(
        parameters,
        link_side=_link_side(robot, options.effort_sides),
        payloads=tuple(Payload.parse(one, robot) for one in options.payloads),
    )
    for term, values in parameters.known_terms.items():
        stated = [
            name for name, value in zip(robot.joint_names, values, strict=True) if value != 0.0
        ]
        logger.warning(
            "%s states %s of %s, which is taken as known; add %s to `joint_terms` if it may be "
            "wrong",
            robot.source,
            f"{term} friction" if term in ("viscous", "coulomb") else term,
            ", ".join(stated),
            term,
        )
    return parameters


def _link_side(robot: RobotModel, sides: Mapping[str, str]) -> tuple[int, ...]:
    """Return the joints whose efforts are measured on the link's side."""
    for name in sides:
        if name and name not in robot.joint_names:
            raise OptionError(
                f"`effort_side`: {robot.source} has no joint {name!r}; name one of "
                f"{', '.join(robot.joint_names)}",
                "E501",
            )
    default = sides.get("", "motor")
    named = [sides.get(name, default) for name in robot.joint_names]
    return tuple(index for index, side in enumerate(named) if side == "link")


def choose_prior(options: IdentifyOptions, parameters: ParameterSet) -> Prior:
    """Return the prior that the options name.

    A warning names links of the model file, if it is the prior, that no body can be.

    Raises
    ------
    PriorError
        When the prior file is invalid or belongs to another robot.
    ModelError
        When the prior is relative to the model's inertias, which are zero.
    """
    if options.prior is not None:
        return load_prior(options.prior, parameters)
    if impossible := describe_impossible_links(parameters.model):
        logger.warning("%s", impossible)
    if options.prior_absolute is not None:
        return absolute_model_prior(parameters, options.prior_absolute)
    parameters.model.require_mass()
    if options.prior_percent is not None:
        return model_prior(parameters, options.prior_percent)
    return default_prior(parameters)


def describe_impossible_links(model: RobotModel) -> str:
    """Return a sentence that names moving links whose inertia no body has; empty if none.

    Massless links are possible.
    """
    moving = model.links[0 if model.floating else 1 :]
    names = [link.name for link in moving if not link.virtual and not is_consistent(link.phi)]
    if not names:
        return ""
    which = f"link {names[0]} is" if len(names) == 1 else f"links {', '.join(names)} are"
    return (
        f"{model.source}: {which} physically impossible: a principal moment of inertia is negative "
        "or exceeds the sum of the other two, or the mass is not positive; the prior is around "
        "these values, and `method` map_lmi identifies possible links near them; correct their "
        "<inertial>"
    )


def with_load_reference(
    parameters: ParameterSet, prior: Prior, options: IdentifyOptions
) -> ParameterSet:
    """Return the parameters with the joints' load from a prior file, if there is one."""
    if options.prior is None:
        return parameters
    return replace(parameters, reference=prior.mean[: parameters.inertial])


def build_pseudo_measurements(
    options: IdentifyOptions, parameters: ParameterSet, prior: Prior
) -> PseudoMeasurements | None:
    """Return the weighed mass and the symmetry of left and right as pseudo-measurements.

    Raises
    ------
    EstimateError
        When the weighed mass contradicts the prior.
    """
    rows, targets = [], []
    if options.weighing is not None:
        mass, std = options.weighing
        row, target = total_mass_row(parameters, mass, std)
        expected = row @ prior.mean * std
        spread = np.hypot(np.linalg.norm(row @ prior.covariance_factor()) * std, std)
        if abs(mass - expected) > CONTRADICTION * spread:
            raise EstimateError(
                f"a total mass of {mass:g} kg contradicts the prior, whose links weigh "
                f"{expected:.3g} ± {spread:.2g} kg together; check `total_mass` and the model",
                "E504",
            )
        rows.append(row[None])
        targets.append(np.array([target]))
    if options.mirror is not None:
        tied, zero = mirror_rows(parameters, prior.std, options.mirror)
        rows.append(tied)
        targets.append(zero)
    if not rows:
        return None
    is_weighed = options.weighing is not None
    return PseudoMeasurements(np.concatenate(rows), np.concatenate(targets), is_weighed)
