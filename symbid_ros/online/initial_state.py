"""What an online identification begins with: the robot, the prior, what an earlier run knew."""

from dataclasses import dataclass
from pathlib import Path

from symbid_ros.errors import DataError, EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.information import RowLayout
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.dataset import Processing
from symbid_ros.identification.loaded_problem import (
    build_pseudo_measurements,
    choose_prior,
    load_parameters,
)
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.problem import Problem
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class InitialState:
    """Everything that is read and checked before the first message.

    Attributes
    ----------
    options : IdentifyOptions
    problem : Problem
        Everything but observations.
    layout : RowLayout
        Layout of the rows.
    observations : tuple of Observations
        Data of an earlier run, for each window length.
    """

    options: IdentifyOptions
    problem: Problem
    layout: RowLayout
    observations: tuple[Observations, ...]

    @classmethod
    def of(cls, robot: RobotModel, options: IdentifyOptions) -> "InitialState":
        """Read what the options name.

        Raises
        ------
        SymbidError
            When a file is invalid, or an option is not supported online.
        """
        _check_online(options)
        parameters = load_parameters(robot, options)
        prior = choose_prior(options, parameters)
        problem = Problem(
            (),
            parameters,
            prior,
            pseudo_measurements=build_pseudo_measurements(options, parameters, prior),
            is_empirical=options.is_empirical,
            inputs=tuple(map(str, (robot.source, *options.files))),
        )
        layout = RowLayout.of(parameters)
        windows = Processing.of(options).windows
        nothing = tuple(Observations.empty(layout, window) for window in windows)
        known = nothing if options.information is None else _resumed(options.information, nothing)
        return cls(options, problem, layout, known)

    @property
    def nothing(self) -> tuple[Observations, ...]:
        """Observations of no rows."""
        return tuple(Observations.empty(self.layout, one.window) for one in self.observations)


def _check_online(options: IdentifyOptions) -> None:
    """Refuse options that need a whole log."""
    if options.row_filter != "weak":
        raise OptionError("online, rows are averaged over windows; leave `filter` out", "E503")
    if options.sensor_error_kinds:
        raise OptionError(
            "`tare` and `sensor_errors` need several passes over a log; record one and identify "
            "offline",
            "E503",
        )
    if options.validate is not None or options.sensor_std is not None:
        raise OptionError(
            "`validate` and `sensor_std` need a whole log; leave them out online", "E503"
        )


def _resumed(archive: Path, nothing: tuple[Observations, ...]) -> tuple[Observations, ...]:
    """Return what an earlier run knew, window by window; other windows are not used."""
    earlier = {one.window: one for one in load_archive(archive)}
    try:
        known = tuple(earlier[one.window].merge(one) for one in nothing if one.window in earlier)
    except DataError:
        known = ()
    if not known:
        raise EstimateError(
            f"{archive}: of another robot, other columns or other windows; resume with the model "
            "and the options it was written with",
            "E505",
        )
    return known
