"""Initial state of an online identification: model, prior and data of an earlier run."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from symbid_ros.choices import KINEMATIC_ERRORS
from symbid_ros.errors import DataError, EstimateError, OptionError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.provenance import InputFile, digest, list_inputs
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.prior_options import (
    build_pseudo_measurements,
    choose_prior,
    load_parameters,
    with_load_reference,
)
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Processing
from symbid_ros.messages.log_options import PART, LogOptions
from symbid_ros.model.load import model_files
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import changed

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class InitialState:
    """Options, model, prior and data, read and checked before the first message.

    Attributes
    ----------
    options : IdentifyOptions
    problem : Problem
        The problem without observations.
    layout : RowLayout
        Layout of the rows.
    observations : tuple of Observations
        Data of an earlier run, for each window length.
    files : tuple of InputFile
        The model and the files that options name, with checksums.
    tares : mapping of str to Tare
        By frame of the wrench sensor.
    """

    options: IdentifyOptions
    problem: Problem
    layout: RowLayout
    observations: tuple[Observations, ...]
    files: tuple[InputFile, ...]
    tares: Mapping[str, Tare] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        options: IdentifyOptions,
        tares: Mapping[str, Tare] | None = None,
    ) -> "InitialState":
        """Read the files that the options name; the caller reads their tares.

        Raises
        ------
        SymbidError
            When a file is invalid, or an option is not supported online.
        """
        _check_online(options)
        options = replace(options, drive_gain=(), drive_gain_percent=None)
        if options.assumes_imu_bias and not options.named_sensor_errors:
            # `resume` could not continue it.
            options = replace(options, sensor_errors=("none",))
        parameters = load_parameters(robot, options)
        prior = choose_prior(options, parameters)
        parameters = with_load_reference(parameters, prior, options)
        problem = Problem(
            (),
            parameters,
            prior,
            pseudo_measurements=build_pseudo_measurements(options, parameters, prior),
            is_empirical=options.is_empirical,
            inputs=tuple(map(str, (robot.source, *options.files))),
            allows_signed_drives=options.signed_drives,
            force_scale_std=options.force_scale,
        )
        layout = RowLayout.of(parameters)
        windows = Processing.of(options).windows
        no_observations = tuple(
            Observations.empty(layout, window, candidates=parameters.candidates)
            for window in windows
        )
        observations = (
            no_observations
            if options.information is None
            else _load_earlier(options.information, no_observations)
        )
        files = tuple(map(digest, list_inputs((*model_files(Path(robot.source)), *options.files))))
        return cls(options, problem, layout, observations, files, tares or {})

    @property
    def no_observations(self) -> tuple[Observations, ...]:
        """Empty observations, one for each window length."""
        return tuple(
            Observations.empty(
                self.layout, one.window, candidates=self.problem.parameters.candidates
            )
            for one in self.observations
        )


def unused_live(options: IdentifyOptions, log: LogOptions) -> dict[str, str]:
    """Return what to say of each option that differs from its default and has no effect live."""
    of_logs = {"no_holdout", "full_rate", "jobs"}
    given = {**changed(options, of_logs), **changed(log, PART)}
    return {
        name: f"`{name}` has no effect live, where messages are used as they arrive"
        for name in given
    }


def _check_online(options: IdentifyOptions) -> None:
    """Raise an error for options that need a complete log."""
    if options.row_filter != "weak":
        raise OptionError(
            "`filter` is not supported online, where rows are averaged over windows; remove it",
            "E503",
        )
    kinds = options.sensor_error_kinds
    if not set(KINEMATIC_ERRORS).isdisjoint(kinds):
        raise OptionError(
            "`sensor_errors` link_length and joint_axis need a complete log; leave them out, or "
            "record a bag and run `symbid identify`",
            "E503",
        )
    if kinds and options.information is not None:
        raise OptionError(
            "sensor errors belong to one run; leave `resume` out, or `sensor_errors` and `tare`",
            "E503",
        )
    if options.drive_gains:  # a robot file may name it, for logs
        logger.warning(
            "`drive_gain` needs several passes over a log and has no effect live, where efforts "
            "are taken as `effort_scale` converts them"
        )
    if options.loaded_logs:
        raise OptionError(
            "`payload` with a bag needs `symbid identify`; give the payload that the robot carries "
            "now, without a bag",
            "E503",
        )
    if options.has_unplaced_payload:
        raise OptionError(
            "the place of a `payload` is identified from a complete log; give LINK,MASS,X,Y,Z",
            "E503",
        )
    if options.choose_truncation is not None or options.sensor_std is not None:
        raise OptionError(
            "`choose_truncation` and `sensor_std` need a complete log; remove them", "E503"
        )


def _load_earlier(
    archive: Path, no_observations: tuple[Observations, ...]
) -> tuple[Observations, ...]:
    """Return the data of an earlier run, for each window of this one."""
    earlier = {one.window: one for one in load_archive(archive)}
    try:
        observations = tuple(
            earlier[one.window].merge(one) for one in no_observations if one.window in earlier
        )
    except DataError:
        observations = ()
    if not observations:
        raise EstimateError(
            f"{archive}: was written with another model, other parameters or other windows; resume "
            "with the model and the options of that run",
            "E505",
        )
    return observations
