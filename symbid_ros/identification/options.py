"""Options of one identification, the same for the Python API, the command and the node."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symbid_ros.choices import (
    GAUSSIAN,
    SENSOR_ERROR_KINDS,
    SPRING,
    TERMS,
    TYPICAL_ERRORS,
    Channels,
    Criterion,
    Filter,
    Method,
    SensorErrorKind,
    Term,
)
from symbid_ros.errors import OptionError
from symbid_ros.identification.option_checks import check_options
from symbid_ros.identification.robot_options import RobotOptions, names
from symbid_ros.options import option

if TYPE_CHECKING:
    from symbid_ros.signals.log import Log

    # Path of a bag, or a log.
    Source = Path | Log
    # Payload of the whole log, or of a further log: "BAG:LINK,MASS,X,Y,Z" or (Log, "LINK,...").
    PayloadSource = str | tuple[Log, str]
    # Path of a prior.json, or what it holds.
    PriorSource = Path | Mapping[str, Any]
else:
    Source, PayloadSource = Path, str  # the help of a command does not load NumPy
    PriorSource = Path

logger = logging.getLogger(__name__)

KNOWN = "Prior knowledge"
JOINTS = "Parameters to identify in addition to the links"
ROWS = "Rows of the equation of motion"
TRUNCATED = "For ols, wls_r, wls_c and wls_rc only"

# Options of earlier versions, each for some terms.
FLAGS: dict[str, tuple[Term, ...]] = {
    "friction": ("viscous", "coulomb"),
    "armature": ("armature",),
    "offset": ("offset",),
}

EFFORT_SIDES = "motor", "link"
WEIGHING_STD = 0.05  # kg; what a good floor scale does


def _is_log(value: Any) -> bool:
    from symbid_ros.signals.log import Log  # noqa: PLC0415 - loads NumPy, which no command's help needs

    return isinstance(value, Log)


def _is_loaded_log(value: Any) -> bool:
    is_pair = isinstance(value, tuple) and len(value) == 2
    return is_pair and _is_log(value[0]) and isinstance(value[1], str)


def _is_mapping(value: Any) -> bool:
    return isinstance(value, Mapping)


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions(RobotOptions):
    """Options of an identification; the defaults suit most logs.

    Raises
    ------
    OptionError
        When a value is invalid, or two options contradict each other.
    """

    method: Method = option(
        "map_lmi",
        "Estimator. map_lmi: most probable parameters of physically possible links; map: most "
        "probable parameters; ols, wls_r, wls_c, wls_rc: truncated least squares, rows (r) or "
        "columns (c) scaled.",
        metavar="METHOD",
    )
    prior: PriorSource | None = option(
        None,
        "Prior file (prior.json).",
        accepts=_is_mapping,
        group=KNOWN,
        unset="values of the model; the data decide how far to trust them",
    )
    prior_percent: float | None = option(
        None,
        "Half-width of a uniform prior of each value of the model, in percent of the value.",
        unit="%",
        positive=True,
        group=KNOWN,
    )
    prior_absolute: float | None = option(
        None,
        "Half-width of a uniform prior of each value of the model, in SI units.",
        positive=True,
        group=KNOWN,
    )
    keep_prior: bool = option(
        False,
        "Keep the prior of the model's values at ±25 %. By default its width is estimated from "
        "the data, unless ±25 % predicts the last quarter of the log better.",
        group=KNOWN,
    )
    total_mass: float | None = option(
        None, "Weighed mass of the whole robot.", unit="kg", positive=True, group=KNOWN
    )
    total_mass_std: float | None = option(
        None,
        "Standard deviation of `total_mass`.",
        unit="kg",
        positive=True,
        group=KNOWN,
        unset="0.05",
    )
    force_scale_std: float | None = option(
        None,
        "Standard deviation of a common gain error of all force and effort sensors, which no log "
        "can show. The standard deviations of all parameters then contain it; 0: no error.",
        unit="%",
        minimum=0.0,
        maximum=100.0,
        group=KNOWN,
        unset="1, contained in the standard deviations of the masses only",
    )
    mirror: float | None = option(
        None,
        "Standard deviation of the difference between left and right links, as a multiple of the "
        "prior's, such as 0.1.",
        positive=True,
        group=KNOWN,
        unset="left and right are independent",
    )
    tare: tuple[Source, ...] = option(
        (),
        "Bag recorded with unloaded wrench sensors; sensor errors are then identified as well.",
        accepts=_is_log,
        group=KNOWN,
    )
    payload: tuple[PayloadSource, ...] = option(
        (),
        "Known payload that the robot carries: LINK,MASS,X,Y,Z (kg; m in the link's axes), such "
        "as tool0,2.5,0,0,0.06. BAG:LINK,... is the payload of a further bag, which is "
        "identified together with the others. Without X,Y,Z the position is identified too.",
        accepts=_is_loaded_log,
        group=KNOWN,
        metavar="PAYLOAD",
    )
    information: Path | None = option(
        None,
        "Folder of an earlier identification, or its information.npz, whose data are added.",
        group=KNOWN,
    )
    joint_terms: tuple[str, ...] = option(
        (),
        f"Joint terms to identify: auto (the data choose those of each joint), none, or a "
        f"comma-separated list of {', '.join(TERMS)} for all joints.",
        group=JOINTS,
        unset="auto; none with `filter` butterworth or savitzky_golay and with ols, wls_r, wls_c "
        "and wls_rc",
    )
    friction: bool = option(
        False,
        "The same as `joint_terms` viscous,coulomb; adds to armature and offset.",
        group=JOINTS,
    )
    armature: bool = option(
        False,
        "The same as `joint_terms` armature: the reflected inertia of every drive.",
        group=JOINTS,
    )
    offset: bool = option(
        False, "The same as `joint_terms` offset: a constant torque of every joint.", group=JOINTS
    )
    signed_drives: bool = option(
        False,
        "Let armature and viscous friction be negative where the efforts contradict positive ones, "
        "as those of torque sensors with crosstalk do. By default only if this predicts the last "
        "quarter of the log better.",
        group=JOINTS,
    )
    drive_gain: tuple[str, ...] = option(
        (),
        "Joints whose efforts have an unknown unit or sign, such as motor currents: all, none, or "
        "a comma-separated list. A factor of each of these efforts is identified.",
        group=JOINTS,
        unset="for arms, joints whose efforts clearly have a wrong factor; otherwise none",
    )
    drive_gain_percent: float | None = option(
        None,
        "Standard deviation of the factors of `drive_gain` about 1, such as 20 for efforts that "
        "were computed with the torque constants of data sheets.",
        unit="%",
        positive=True,
        group=JOINTS,
        unset="the unit and the sign are unknown",
    )
    effort_side: tuple[str, ...] = option(
        (),
        "Where efforts are measured: motor (before the gear, or from currents), link (behind the "
        "gear, which excludes the armature), or a list such as joint_1=link,joint_2=motor.",
        group=JOINTS,
        unset="motor",
    )
    coupling: tuple[str, ...] = option(
        (),
        "Drives whose speed is a sum of joint speeds, such as joint_5+joint_6 or "
        "joint_2-0.5*joint_3: friction and armature then act on this sum as well.",
        group=JOINTS,
        unset="found from logs of arms",
    )
    ripple: tuple[str, ...] = option(
        (),
        "Torque ripple of sensors, motors or gears: JOINT:PERIODS in a turn of the joint, such as "
        "joint_6:4.",
        group=JOINTS,
        unset="found from logs",
    )
    sensor_errors: tuple[str, ...] = option(
        (),
        f"Sensor errors to identify: typical (those that remain after calibration), none, or a "
        f"comma-separated list of {', '.join(SENSOR_ERROR_KINDS)}. compliance: "
        "elastic joints; link_length, joint_axis: errors of the model's geometry.",
        group=JOINTS,
        unset="compliance (arms) or imu_bias (robots with foot sensors) if the log shows it, "
        "imu_bias always with `contact`, otherwise none",
    )
    filter: Filter | None = option(
        None,
        "weak: average the equation of motion over short windows; butterworth, savitzky_golay: "
        "filter the signals and use single instants.",
        group=ROWS,
        metavar="FILTER",
        unset="weak, or butterworth if a truncated method is used with `cutoff` or `channels`",
    )
    window: float | None = option(
        None,
        "Length of the windows.",
        unit="s",
        positive=True,
        group=ROWS,
        unset="weak: the most informative of 0.081, 0.161 and 0.321, longer below 75 Hz; "
        "savitzky_golay: 0.081",
    )
    cutoff: float | None = option(
        None,
        "Cutoff frequency of butterworth; 0 for no filter.",
        unit="Hz",
        minimum=0.0,
        group=ROWS,
        unset="30",
    )
    channels: Channels | None = option(
        None,
        "Signals that butterworth filters: all, or the thesis's choice.",
        group=ROWS,
        unset="all",
    )
    full_rate: bool = option(
        False,
        "Build the equation of motion at every sample before averaging. By default fast logs are "
        "first reduced to the rate that the averaging windows need.",
        group=ROWS,
    )
    rank: int | None = option(
        None,
        "Number of singular values to use.",
        minimum=1,
        group=TRUNCATED,
        unset="number of directions that the data determine better than the prior",
    )
    choose_truncation: Source | None = option(
        None,
        "Bag on which to choose the number of singular values.",
        accepts=_is_log,
        group=TRUNCATED,
    )
    validate: Source | None = option(
        None, "Deprecated name of `choose_truncation`.", accepts=_is_log, group=TRUNCATED
    )
    select_by: Criterion = option(
        "gen_force", "Prediction error that is minimised on `choose_truncation`.", group=TRUNCATED
    )
    sensor_std: tuple[float, float, float] | None = option(
        None,
        "Standard deviations of effort, force and moment readings (Nm, N, Nm), to weight rows.",
        minimum=0.0,
        group=TRUNCATED,
        metavar="EFFORT FORCE MOMENT",
        unset="those of the residuals",
    )
    jobs: int | None = option(
        None,
        "Number of cores to use. The result is the same for any number.",
        minimum=1,
        unset="one per CPU core",
    )
    no_holdout: bool = option(
        False, "Skip the check of the result by a trial that predicts the last quarter of the log."
    )
    export_kinematics: bool = option(
        False,
        "Also write calibrated.urdf and calibrated.xml: the identified robot with the joint "
        "placements estimated by `sensor_errors` link_length and joint_axis.",
    )
    unchecked: bool = option(
        False,
        "Skip the checks of the log (`symbid bag doctor`). Live: skip the check that the forces "
        "carry the weight.",
    )

    def __post_init__(self) -> None:
        """Check for options that contradict each other or have no effect with this method."""
        super().__post_init__()
        self._rename_deprecated()
        if self.information is not None and self.information.is_dir():
            object.__setattr__(self, "information", self.information / "information.npz")
        check_options(self)

    def _rename_deprecated(self) -> None:
        """Move the value of `validate` to `choose_truncation`, its new name."""
        if self.validate is None:
            return
        if self.choose_truncation is not None:
            raise OptionError(
                "`validate` is the deprecated name of `choose_truncation`; give only the latter",
                "E502",
            )
        logger.warning("`validate` is now called `choose_truncation`; use the new name")
        object.__setattr__(self, "choose_truncation", self.validate)
        object.__setattr__(self, "validate", None)

    @cached_property
    def terms(self) -> tuple[Term, ...]:
        """Joint terms to identify, or the candidates if the data choose."""
        if self.chooses_terms:
            # Friction that depends on the load needs the wrenches of contacts.
            left_out = {SPRING} | ({"load"} if self.contacts else set())
            return tuple(term for term in TERMS if term not in left_out)
        named = set(self.named_terms) | {term for flag in self.named_flags for term in FLAGS[flag]}
        return tuple(term for term in TERMS if term in named)

    @cached_property
    def chooses_terms(self) -> bool:
        """Whether the data choose the terms of each joint."""
        if self.named_terms or self.named_flags:
            return self.named_terms == ["auto"]
        return self.has_gaussian_rows

    @property
    def has_gaussian_rows(self) -> bool:
        """Whether rows are averaged over windows and weighed against a prior.

        Only then candidates can be compared.
        """
        return self.method in GAUSSIAN and self.row_filter == "weak"

    @property
    def named_terms(self) -> list[str]:
        """The terms of `joint_terms`, or auto or none."""
        return names(self.joint_terms)

    @cached_property
    def effort_sides(self) -> dict[str, str]:
        """Side of the effort of each named joint; that of all others under the empty name."""
        sides = {}
        for part in names(self.effort_side):
            joint, _, side = part.rpartition("=")
            if side not in EFFORT_SIDES or joint in sides:
                raise OptionError(
                    f"`effort_side`: {part!r} is not valid; give motor, link, or each joint once, "
                    "as in joint_1=link,joint_2=motor",
                    "E501",
                )
            sides[joint] = side
        return sides

    @cached_property
    def payloads(self) -> tuple[str, ...]:
        """Payloads that the robot carries in the log itself."""
        return tuple(one for one in self.payload if isinstance(one, str) and ":" not in one)

    @cached_property
    def loaded_logs(self) -> tuple[tuple[Source, str], ...]:
        """Further logs, with the payload of each."""
        return tuple(
            (Path(one.rpartition(":")[0]), one.rpartition(":")[2]) if isinstance(one, str) else one
            for one in self.payload
            if not isinstance(one, str) or ":" in one
        )

    @property
    def has_unplaced_payload_in_log(self) -> bool:
        """Whether the place of a payload in the log itself is not given."""
        return any(map(_lacks_place, self.payloads))

    @property
    def has_unplaced_payload(self) -> bool:
        """Whether the place of a payload is not given."""
        further = any(_lacks_place(text) for _, text in self.loaded_logs)
        return further or self.has_unplaced_payload_in_log

    @property
    def has_further_unknowns(self) -> bool:
        """Whether anything but the robot's parameters is identified from rows linearised in it."""
        return bool(self.sensor_error_kinds or self.drive_gains or self.has_unplaced_payload)

    @property
    def drive_gains(self) -> list[str]:
        """Joints whose efforts have an unknown unit; ``all`` for all of them."""
        return [name for name in names(self.drive_gain) if name != "none"]

    @property
    def has_known_units(self) -> bool:
        """Whether all efforts have the unit and the sign of torques and forces."""
        return not self.drive_gains or self.drive_gain_percent is not None

    @property
    def finds_drive_gains(self) -> bool:
        """Whether efforts with wrong factors are searched for in the log."""
        return not self.drive_gain and not self.has_further_unknowns and self.searches

    @property
    def couplings(self) -> list[str]:
        """The named couplings, one sum of joints each."""
        return names(self.coupling)

    @property
    def ripples(self) -> list[str]:
        """The named ripples, a joint and its periods in a turn each."""
        return names(self.ripple)

    @property
    def finds_couplings(self) -> bool:
        """Whether couplings of joints are searched for in the log."""
        return not self.couplings and self.searches

    @property
    def finds_ripples(self) -> bool:
        """Whether torques that repeat in a turn are searched for in the log."""
        return not self.ripples and self.searches

    @property
    def finds_compliance(self) -> bool:
        """Whether elasticity of joints is searched for in the log."""
        named = self.named_sensor_errors or self.sensor_error_kinds or self.drive_gains
        return not named and self.searches

    @property
    def finds_imu_bias(self) -> bool:
        """Whether biases of IMUs are searched for in logs of robots with foot sensors."""
        named = self.named_sensor_errors, self.has_further_unknowns, self.information
        return self.has_gaussian_rows and not any(named)

    @property
    def searches(self) -> bool:
        """Whether springs and other terms that are not candidates are searched for in the log."""
        added = self.has_unplaced_payload, self.information, self.contacts
        return self.chooses_terms and not any(added)

    @cached_property
    def sensor_error_kinds(self) -> tuple[SensorErrorKind, ...]:
        """Kinds of sensor errors to identify: those named, or all if there is a tare."""
        named = set(self.named_sensor_errors)
        if not named and self.tare:
            named = {"typical"}
        if self.assumes_imu_bias:
            named.add("imu_bias")
        if "typical" in named:
            named |= set(TYPICAL_ERRORS)
        return tuple(kind for kind in SENSOR_ERROR_KINDS if kind in named)

    @property
    def assumes_imu_bias(self) -> bool:
        """Whether biases of IMUs are identified even if they are not named.

        Without foot sensors they look like forces: 2 mg shift centres of mass by many standard
        deviations. Information of several logs has no columns of one log's biases.
        """
        is_excluded = "none" in self.named_sensor_errors or self.information is not None
        return bool(self.contacts) and not is_excluded and self.has_gaussian_rows

    @property
    def named_flags(self) -> list[str]:
        """The options of earlier versions that name terms."""
        return [flag for flag in FLAGS if getattr(self, flag)]

    @property
    def named_sensor_errors(self) -> list[str]:
        """The kinds of `sensor_errors`, or typical or none."""
        return names(self.sensor_errors)

    @property
    def weighing(self) -> tuple[float, float] | None:
        """Mass of the robot and its standard deviation, kg."""
        if self.total_mass is None:
            return None
        return self.total_mass, WEIGHING_STD if self.total_mass_std is None else self.total_mass_std

    @property
    def force_scale(self) -> float | None:
        """Relative deviation of the common gain; None if it is not given."""
        return None if self.force_scale_std is None else self.force_scale_std / 100

    @property
    def is_empirical(self) -> bool:
        """Whether the evidence sets the scale of the prior."""
        sources = self.prior, self.prior_percent, self.prior_absolute
        return not self.keep_prior and all(source is None for source in sources)

    @property
    def files(self) -> tuple[Path, ...]:
        """Input files other than the log and the model."""
        logs = [
            *(log for log, _ in self.loaded_logs),
            self.prior if isinstance(self.prior, Path) else None,
            *self.tare,
            self.information,
            self.choose_truncation,
        ]
        named = [(one,) if isinstance(one, Path) else one.files for one in logs if one is not None]
        return tuple(path for paths in named for path in paths)

    @property
    def row_filter(self) -> Filter:
        """Filter of the rows: the one named, or the one that other options imply."""
        if self.filter is not None:
            return self.filter
        # The thesis's methods were published with Butterworth-filtered rows.
        wants_butterworth = self.cutoff is not None or self.channels is not None
        return "butterworth" if self.method not in GAUSSIAN and wants_butterworth else "weak"


def _lacks_place(payload: str) -> bool:
    """Return whether a payload is given as LINK,MASS."""
    return payload.count(",") == 1
