"""States a solution as an estimate: values, deviations, residuals and remarks."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Method
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.estimation.estimate import Estimate, mass_text
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.terms.remarks import held_remarks, joints_without_rows
from symbid_ros.model.held_joints import held_positions
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import links_beyond, sensor_names
from symbid_ros.package_paths import package_version

if TYPE_CHECKING:
    from symbid_ros.identification.solved_problem import SolvedProblem

SOFTWARE = f"symbid_ros {package_version()}"
# Parameters of a link that all move by less than this share of their prior deviation stay.
UNMOVED = 1e-6


def estimate_of(
    solved: "SolvedProblem",
    method: Method,
    unknowns: FloatArray,
    std: FloatArray,
    *,
    condition: float,
    rank: int | None = None,
) -> Estimate:
    """Return the estimate of the unknowns (p + s,) that a method found.

    ``std`` (p,) are the parameters' standard deviations, ``condition`` and ``rank`` those of the
    method's equations.
    """
    problem, chosen = solved.problem, solved.chosen
    parameters, prior, choice = problem.parameters, solved.posterior.prior, problem.choice
    p, inertial, model = len(parameters), parameters.inertial, parameters.model
    value = unknowns[:p]
    before = np.linalg.norm(solved.posterior.prior_factor[:p], axis=1)
    determined = np.asarray(std < DETERMINED * before)
    # After the data widen the prior far, even half its variance may exceed the stated one.
    determined[:inertial] &= std[:inertial] <= problem.prior.std[:inertial]
    if choice is not None:
        # Fixed terms are exactly at their value; the solution is so to rounding.
        freed = {f"{one}/{term}" for one, terms in choice.by_joint.items() for term in terms}
        fixed = np.array([name not in freed for name in parameters.names])
        fixed[:inertial] = False
        fixed[parameters.sensor_offsets] = False
        value = np.where(fixed, prior.mean[:p], value)
        std = np.where(fixed, 0.0, std)
    # The same holds of links that the log does not show, to the solver's tolerance.
    is_moved = np.abs(value - prior.mean[:p]) > UNMOVED * before
    is_moved[:inertial] = np.repeat(is_moved[:inertial].reshape(-1, 10).any(axis=1), 10)
    is_moved[inertial:] = True
    value = np.where(is_moved, value, prior.mean[:p])
    return Estimate(
        method=method,
        model=model.name,
        names=parameters.names,
        units=parameters.units,
        value=value,
        prior=prior.mean[:p],
        std=std,
        determined=determined,
        rank=rank,
        condition=condition,
        samples=round(chosen.rows.samples),
        residual_rmse=_residuals(chosen, unknowns),
        consistent={
            link: is_consistent(phi)
            for link, phi in zip(parameters.link_names, parameters.link_phi(value), strict=True)
        },
        inputs=problem.inputs,
        software=SOFTWARE,
        known=parameters.known_values,
        joint_terms=None if choice is None else dict(choice.by_joint),
        remarks=(*problem.remarks, *held_remarks(model), *_term_remarks(solved)),
        wrist_sensors=sensor_names(model),
        load_reference=_load_reference(parameters),
        courses=tuple(one for one in parameters.courses if one[0] >= 0),  # of this log
        contacts=() if model.contacts is None else model.contacts.names,
        force_only=model.force_only,
        end_stops=model.end_stops,
        gravity=None if model.floating else tuple(model.gravity.tolist()),
        held_joints=held_positions(model),
    )


def payload_remarks(
    solved: "SolvedProblem", value: FloatArray, change: FloatArray | None
) -> Iterator[str]:
    """Yield the mass behind each wrist sensor that carries moving links, such as fingers.

    ``value`` (p + s,) are the unknowns, and ``change`` (p,) is theirs by one deviation of the gain
    that all sensors have in common.
    """
    parameters = solved.problem.parameters
    column = {int(link): 10 * place for place, link in enumerate(parameters.links)}
    for frame in parameters.model.wrist_sensors:
        own, *moving = links_beyond(parameters.model, frame)
        masses = [column[link] for link in (own, *moving) if link in column]
        if not moving:
            continue
        std = np.linalg.norm(solved.posterior.deviation_factor[masses].sum(axis=0))
        if change is not None:
            std = np.hypot(std, change[masses].sum())
        names = ", ".join(parameters.model.link_names[link] for link in moving)
        yield (
            f"beyond {frame}: {mass_text(float(value[masses].sum()), float(std))} kg together "
            f"with the moving {names}; the report states their common centre of mass"
        )


def row_std(chosen: Observations, value: FloatArray, effective: float) -> dict[str, float]:
    """Return the standard deviation of a row's residual, of each coordinate with enough rows.

    The residuals are smaller than the noise, because parameters were fitted to them: by the
    share of the independent rows that the effective parameters use up.
    """
    squares = chosen.rows.residual_moment(value).diagonal()
    rows = chosen.counts.diagonal()
    used = max(int(np.count_nonzero(rows)), 1)
    left = rows - chosen.inflation * effective / used
    return {
        name: float(np.sqrt(square / number))
        for name, square, number in zip(chosen.layout.coordinates, squares, left, strict=True)
        if number > 0
    }


def _residuals(chosen: Observations, value: FloatArray) -> dict[str, float]:
    """Return the RMS residual of each coordinate that has rows."""
    residuals = chosen.rows.residual_rmse(value)
    used = chosen.counts.diagonal() > 0
    return {
        name: rmse
        for (name, rmse), has_rows in zip(residuals.items(), used, strict=True)
        if has_rows
    }


def _load_reference(parameters: ParameterSet) -> dict[str, float]:
    """Return the link parameters that give the joints' load, if any term needs them."""
    if "load" not in parameters.terms:
        return {}
    reference = parameters.load_reference.tolist()
    return dict(zip(parameters.names[: parameters.inertial], reference, strict=True))


def _term_remarks(solved: "SolvedProblem") -> tuple[str, ...]:
    problem = solved.problem
    if problem.choice is not None:
        return problem.choice.remarks
    return joints_without_rows(solved.chosen, problem.parameters)
