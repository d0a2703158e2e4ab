"""Information of earlier logs: its columns, and its union with that of another log."""

from collections.abc import Sequence
from dataclasses import replace

from symbid_ros.choices import SLIDING_TERMS
from symbid_ros.dynamics.unmeasured_contacts import combined_coordinates
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.information import INCOMPATIBLE
from symbid_ros.estimation.observations import Observations, covered_seconds
from symbid_ros.identification.terms.choice import rows_of
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.warming import is_change
from symbid_ros.signals.sensor_errors import DRIVE_GAIN

# Names of differing parameters that an error lists.
MOST_NAMED = 3
ALIKE = "identify both with the same model, joint terms and sensor errors"


def merged_observations(
    first: tuple[Observations, ...],
    second: tuple[Observations, ...],
    named: str = "information",
) -> tuple[Observations, ...]:
    """Return the information of two runs together, for each window length that both have.

    Raises
    ------
    EstimateError
        When they differ in robot, parameters or windows, or share seconds of a log.
    """
    earlier = {one.window: one for one in second}
    if again := covered_seconds(first) & covered_seconds(second):
        raise EstimateError(
            f"{named}: {len(again)} s of this log are in it already and would be counted twice; "
            "leave `information` out, or name another log",
            "E506",
        )
    one, other = first[0].layout, second[0].layout
    _require_alike((one.coordinates, other.coordinates), (one.parameters, other.parameters), named)
    try:
        both = tuple(earlier[one.window].merge(one) for one in first if one.window in earlier)
    except DataError as error:
        raise EstimateError(f"{named}: {error}; {ALIKE}", "E505") from None
    if not both:
        raise EstimateError(
            f"{named}: its rows are averaged over other windows than those of this run; identify "
            "both with the same `filter` and `sensor_errors`",
            "E505",
        )
    return both


def _require_alike(
    coordinates: tuple[tuple[str, ...], ...], parameters: tuple[tuple[str, ...], ...], named: str
) -> None:
    """Raise an error that says which names only one of two runs has, if any."""
    for of_runs, difference in ((coordinates, "it is of another robot: "), (parameters, "")):
        one, other = map(set, of_runs)
        only = [name for names in of_runs for name in names if name in one ^ other]
        if not only:
            continue
        more = f" and {len(only) - MOST_NAMED} more" if len(only) > MOST_NAMED else ""
        has_gain = any(name.endswith(f"/{DRIVE_GAIN}") for name in only)
        advice = "give both runs the same `drive_gain`, such as none" if has_gain else ALIKE
        raise EstimateError(
            f"{named}: {difference}only one of both runs has {', '.join(only[:MOST_NAMED])}{more}; "
            f"{advice}",
            "E505",
        )


def require_constant_friction(*runs: tuple[Observations, ...]) -> None:
    """Raise an error if friction changed during the log of a run, in columns of its own."""
    for name in (name for run in runs for name in run[0].layout.parameters):
        if is_change(name):
            raise EstimateError(
                f"information: friction changed during one of the logs ({name}), which belongs to "
                "that log; identify both bags in one run, or the other log with this `information`",
                "E505",
            )


def with_constant_friction(observations: tuple[Observations, ...]) -> tuple[Observations, ...]:
    """Return data without the columns of friction that changed during the log."""
    names = tuple(one for one in observations[0].layout.parameters if not is_change(one))
    return tuple(
        replace(one.restricted(names), slipping=one.slipping and one.slipping.restricted(names))
        for one in observations
    )


def columns_of(
    robot: RobotModel, observations: Sequence[Observations], named: str = "information"
) -> ParameterSet:
    """Return the columns that observations have: those of candidate terms, or of given ones.

    Raises
    ------
    EstimateError
        When they are of another robot.
    """
    _require_alike((observations[0].layout.coordinates, robot.coordinates), ((), ()), named)
    if any(one.slipping is not None for one in observations):
        names = observations[0].layout.parameters
        return replace(ParameterSet.of_names(robot, names), candidates=True)
    return ParameterSet.of_names(robot, observations[0].layout.parameters)


def with_columns(
    observations: tuple[Observations, ...], parameters: ParameterSet
) -> tuple[Observations, ...]:
    """Return data of candidate terms for the terms that the user names; other data as they are."""
    named = parameters.names
    if parameters.candidates or any(
        one.slipping is None or not set(named) <= set(one.layout.parameters) for one in observations
    ):
        return observations
    slips = not SLIDING_TERMS.isdisjoint(parameters.terms)
    return tuple(one.restricted(named) for one in rows_of(observations, slips=slips))


def check_layout(
    observations: tuple[Observations, ...], parameters: ParameterSet, named: str
) -> None:
    """Raise an error if the data have other columns or rows than the parameters' robot."""
    p, coordinates = len(parameters), parameters.model.coordinates
    combined = combined_coordinates(parameters.model)
    for one in observations:
        if (one.layout.parameters[:p], one.layout.coordinates) != (parameters.names, coordinates):
            _require_alike(
                (one.layout.coordinates, coordinates),
                (one.layout.parameters[:p], parameters.names),
                named,
            )
            raise EstimateError(f"{named}: {INCOMPATIBLE}; {ALIKE}", "E505")
        if one.layout.combined != combined:
            raise EstimateError(
                f"{named}: its rows without contact forces are other combinations, of an earlier "
                "version or of other contacts; identify its log again",
                "E505",
            )
