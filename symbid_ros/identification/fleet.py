"""Results of several robots of one type, made comparable: equal columns, prior and windows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.estimation.fleet import Deviation, FleetEstimate, FleetMember, estimate_fleet
from symbid_ros.estimation.fleet_spread import LEAST_SPREAD
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.loaded_problem import load_information
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.predictor import load_result_robot
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.identification.stored_information import columns_of, with_constant_friction
from symbid_ros.json_documents import versioned
from symbid_ros.model.tree import RobotModel

FEWEST = 3  # robots of a fleet
ALIKE = "identify all robots with the same model, joint terms and sensors"


def fleet_of_results(folders: Sequence[Path]) -> FleetEstimate:
    """Compare the robots of saved results, each named by its folder.

    Raises
    ------
    SymbidError
        When there are fewer than three results, or a result is invalid or of another type of robot.
    """
    names = [folder.resolve().name for folder in folders]
    # With two robots, either may be the one that has changed.
    if len(set(names)) < max(len(names), FEWEST):
        raise EstimateError(
            f"a fleet needs the results of at least {FEWEST} robots, in folders with different "
            "names",
            "E960",
        )
    first = load_estimate(folders[0] / "estimate.json")
    for folder in folders[1:]:
        other = load_estimate(folder / "estimate.json")
        prior = dict(zip(other.names, other.prior.tolist(), strict=True))
        shared = [name for name in first.names if name in prior]
        expected = [first.prior[first.names.index(name)] for name in shared]
        found = [prior[name] for name in shared]
        if set(first.consistent) != set(other.consistent) or not np.allclose(
            found, expected, rtol=1e-6, atol=1e-12
        ):
            raise EstimateError(
                f"{folder}: was identified with another model than {folders[0]}: "
                f"{_difference_of_models(first, other)}; {ALIKE}",
                "E961",
            )
    robot = load_result_robot(folders[0], first)
    parameters = first.parameters_of(robot)
    data = {
        name: load_archive(folder / "information.npz")
        for name, folder in zip(names, folders, strict=True)
    }
    # The file of the result holds the identified values.
    prior = dict(zip(first.names, first.prior.tolist(), strict=True))
    model = parameters.apply(np.array([prior[name] for name in parameters.names]))
    return fleet(model, data)


def _difference_of_models(first: Estimate, other: Estimate) -> str:
    """Return a link or a value in which the models of two results differ."""
    for one, two in ((first, other), (other, first)):
        if links := [link for link in one.consistent if link not in two.consistent]:
            return f"only one of them has the link {links[0]}"
    known = dict(zip(first.names, first.prior.tolist(), strict=True))
    values = zip(other.names, other.units, other.prior.tolist(), strict=True)
    name, unit, value = next(
        each
        for each in values
        if each[0] in known and not np.isclose(each[2], known[each[0]], rtol=1e-6, atol=1e-12)
    )
    return f"{name} is {value:.5g} instead of {known[name]:.5g} {unit}"


def fleet(robot: RobotModel, data: Mapping[str, tuple[Observations, ...]]) -> FleetEstimate:
    """Compare robots of one type by the information of their logs.

    Joint terms, the prior's scale and the length of windows are chosen for all robots together.
    ``robot`` is the nominal model of all, and ``data`` has the name of each robot.

    Raises
    ------
    EstimateError
        When the robots' data have other columns, or no length of windows in common.
    """
    # A robot may run at the same time as another one, so seconds may be equal.
    data = {name: with_constant_friction(one) for name, one in data.items()}
    if scaled := [name for name, one in data.items() if _has_drive_gains(one)]:
        raise EstimateError(
            f"{', '.join(scaled)}: factors of efforts were identified, which belong to one log; "
            "identify these robots with `drive_gain` none, and give the factors as `effort_scale` "
            "if their efforts are not in Nm (N)",
            "E961",
        )
    first, *others = data
    together = data[first]
    for name in others:
        together = _merged(together, data[name], f"{name}, unlike {first}")
    if together[0].slipping is None:
        terms = columns_of(robot, together).terms
    else:
        chosen = load_information(robot, together, IdentifyOptions()).solved.problem.choice
        terms = () if chosen is None else chosen.terms
    options = IdentifyOptions(joint_terms=terms or ("none",))
    pooled = load_information(robot, together, options).solved
    members = []
    for name, observations in data.items():
        problem = load_information(robot, observations, options).solved.problem
        window = [one for one in problem.observations if one.window == pooled.chosen.window]
        if not window:
            raise EstimateError(
                f"{name}: has no rows over windows of {1e3 * pooled.chosen.window:g} ms; record "
                "all robots at one rate",
                "E961",
            )
        own = Problem(tuple(window), problem.parameters, pooled.posterior.prior)
        members.append(FleetMember(name, SolvedProblem.of(own).posterior))
    return estimate_fleet(members, pooled.problem.parameters)


def percent_with_std(value: float, std: float, sign: str = "") -> str:
    """Return a share and its standard deviation in percent, with a decimal or more.

    The standard deviation has at least one digit that is not zero.
    """
    value, std = 100 * value, 100 * std
    decimals = max(1, -math.floor(math.log10(std))) if std > 0 else 1
    value = round(value, decimals) + 0.0  # without the sign of a rounded zero
    return f"{value:{sign}.{decimals}f} ± {std:.{decimals}f} %".replace("-", "−")


def describe_deviation(found: Deviation) -> str:
    """Return a deviation as a clause, such as ``robot_3: forearm_link is 10.1 ± 0.4 % heavier``."""
    if found.relative is None or found.relative_std is None:
        text = f"{found.robot}: {found.place} has other friction or armature"
    else:
        word = "heavier" if found.relative > 0 else "lighter"
        change = percent_with_std(abs(found.relative), found.relative_std)
        text = f"{found.robot}: {found.place} is {change} {word}"
    if found.alternatives:
        text += f", or {' or '.join(found.alternatives)} has changed"
    return text


def fleet_verdict(found: FleetEstimate) -> str:
    """Return which robots differ, or what would have been named, in one sentence."""
    if not found.deviations:
        none = f"No robot differs from the others ({found.tests} links and joints tested)"
        return f"{none}; {_detectable(found)}"
    return "; ".join(map(describe_deviation, found.deviations))


def spread_sizes(found: FleetEstimate) -> dict[str, str]:
    """Return the spread of links and of each joint term, %; the least possible one as a bound."""
    return {
        name: f"{100 * size:.2g}" if size > LEAST_SPREAD else f"< {100 * LEAST_SPREAD:.2g}"
        for name, size in found.spread.items()
    }


def detectable_changes(found: FleetEstimate) -> dict[str, float | None]:
    """Return the smallest change of each link that would be named in any robot; None if none is."""
    changes: dict[str, float | None] = {}
    for link, robots in zip(
        found.parameters.link_names, zip(*found.link_changes, strict=True), strict=True
    ):
        seen = [one.detectable for one in robots if one is not None and one.is_shown]
        changes[link] = max(seen) if len(seen) == len(robots) else None
    return changes


def _detectable(found: FleetEstimate) -> str:
    changes = detectable_changes(found)
    seen = {link: value for link, value in changes.items() if value is not None}
    if not seen:
        return "these data would not show a change of any link"
    least, largest = min(seen, key=seen.__getitem__), max(seen, key=seen.__getitem__)
    text = f"a link would be named if it alone were {100 * seen[least]:.2g} % ({least})"
    if largest != least:
        text += f" to {100 * seen[largest]:.2g} % ({largest})"
    text += " heavier or lighter"
    hidden = [link for link in changes if link not in seen]
    return f"{text}; a change of {' or '.join(hidden)} would not show" if hidden else text


def fleet_document(found: FleetEstimate) -> dict[str, object]:
    """Return what ``symbid fleet --json`` prints."""
    names, units = found.parameters.names, found.parameters.units
    single = np.median(found.single_stds, axis=0)
    document = {
        "verdict": fleet_verdict(found),
        "model": found.parameters.model.name,
        "tests": found.tests,
        "deviations": [
            {
                "robot": one.robot,
                "place": one.place,
                "p_value": one.p_value,
                "evidence_nat": one.evidence,
                "relative": one.relative,
                "relative_std": one.relative_std,
                "alternatives": list(one.alternatives),
                "parameters": {
                    names[column]: {
                        "change": float(change),
                        "std": float(std),
                        "unit": units[column],
                    }
                    for column, change, std in zip(one.columns, one.change, one.std, strict=True)
                },
            }
            for one in found.deviations
        ],
        "link_changes": {
            link: {
                robot: None if one is None else asdict(one)
                for robot, one in zip(found.robots, robots, strict=True)
            }
            for link, robots in zip(
                found.parameters.link_names, zip(*found.link_changes, strict=True), strict=True
            )
        },
        "spread": found.spread,
        "parameters": {
            name: {
                "value": float(found.common[i]),
                "std": float(found.common_std[i]),
                "single_std": float(single[i]),
                "unit": units[i],
                "robots": {
                    robot: {"value": float(values[i]), "std": float(stds[i])}
                    for robot, values, stds in zip(
                        found.robots, found.values, found.stds, strict=True
                    )
                },
            }
            for i, name in enumerate(names)
        },
    }
    return versioned("fleet", document)


def _has_drive_gains(observations: tuple[Observations, ...]) -> bool:
    return any(
        name.endswith("/drive_gain") for one in observations for name in one.layout.parameters
    )


def _merged(
    one: tuple[Observations, ...], two: tuple[Observations, ...], which: str
) -> tuple[Observations, ...]:
    """Return the information of two robots, for each window length that both have."""
    known = {each.window: each for each in two}
    if not any(each.window in known for each in one):
        lengths = ", ".join(f"{1e3 * length:g}" for length in known)
        raise EstimateError(
            f"{which}, has windows of {lengths} ms, and none is common to all robots; {ALIKE}",
            "E961",
        )
    try:
        return tuple(each.merge(known[each.window]) for each in one if each.window in known)
    except DataError as error:
        raise EstimateError(
            f"{which}: {_difference(one[0], two[0]) or error}; {ALIKE}", "E961"
        ) from None


def _difference(one: Observations, two: Observations) -> str:
    """Return which parameters or coordinates only one of two logs has; empty if none."""
    for kind in ("parameters", "coordinates"):
        before, after = (getattr(each.layout, kind) for each in (one, two))
        for having, others, verb in ((after, before, "has"), (before, after, "lacks")):
            if names := [name for name in having if name not in others]:
                more = f" and {len(names) - 1} more" if len(names) > 1 else ""
                return f"it {verb} {names[0]}{more}"
    return ""
