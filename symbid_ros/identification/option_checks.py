"""Options of an identification that contradict each other or have no effect together."""

from typing import TYPE_CHECKING

from symbid_ros.choices import (
    GAUSSIAN,
    KINEMATIC_ERRORS,
    SENSOR_ERROR_KINDS,
    TERMS,
    UNSEEN_WITH_CONTACTS,
)
from symbid_ros.errors import OptionError
from symbid_ros.options import refuse_unused

if TYPE_CHECKING:
    from symbid_ros.identification.options import IdentifyOptions


def check_options(options: "IdentifyOptions") -> None:
    """Raise OptionError if a value is invalid, or options exclude each other."""
    _check_rows(options)
    _check_joint_terms(options)
    _check_sensor_errors(options)
    _check_contacts(options)
    _check_prior(options)
    _check_method(options)
    _check_further_unknowns(options)


def _check_rows(options: "IdentifyOptions") -> None:
    if options.row_filter == "butterworth":
        if options.window is not None:
            raise OptionError("butterworth has no `window`; give `cutoff` instead", "E503")
    elif options.cutoff is not None or options.channels is not None:
        raise OptionError(
            f"{options.row_filter} has neither `cutoff` nor `channels`; leave them out, or use "
            "`filter` butterworth",
            "E503",
        )
    if options.full_rate and options.row_filter != "weak":
        raise OptionError(
            f"{options.row_filter} has no `full_rate`; leave it out, or use `filter` weak", "E503"
        )


def _check_joint_terms(options: "IdentifyOptions") -> None:
    for name in options.named_terms:
        if name not in ("auto", "none", *TERMS):
            raise OptionError(
                f"`joint_terms`: {name!r} is not known; give auto, none or any of "
                f"{', '.join(TERMS)}",
                "E501",
            )
    for name in ("auto", "none"):
        others = [*options.named_flags, *(one for one in options.named_terms if one != name)]
        if name in options.named_terms and others:
            raise OptionError(
                f"`joint_terms` {name} contradicts {others[0]}; give one of them", "E502"
            )
    if (
        options.effort_sides == {"": "link"}
        and not options.chooses_terms
        and "armature" in options.terms
    ):
        raise OptionError(
            "efforts on the link's side contain no armature; leave armature or `effort_side` out",
            "E502",
        )
    if options.couplings and not set(options.terms) - {"offset"}:
        raise OptionError(
            "`coupling` needs joint terms that act on it; leave `joint_terms` out, or name "
            "viscous, coulomb, armature or stribeck",
            "E503",
        )
    if options.named_terms == ["auto"] and not (
        options.method in GAUSSIAN and options.row_filter == "weak"
    ):
        raise OptionError(
            "`joint_terms` auto needs `method` map or map_lmi and rows averaged over windows; "
            "name the terms",
            "E503",
        )


def _check_sensor_errors(options: "IdentifyOptions") -> None:
    if options.export_kinematics and set(KINEMATIC_ERRORS).isdisjoint(options.sensor_error_kinds):
        raise OptionError(
            "`export_kinematics` needs joint placements to export; add link_length or "
            "joint_axis to `sensor_errors`",
            "E503",
        )
    known = "typical", "none", *SENSOR_ERROR_KINDS
    if options.sensor_errors and not options.named_sensor_errors:
        raise OptionError(f"`sensor_errors` is empty; give {' or '.join(known)}", "E501")
    for name in options.named_sensor_errors:
        if name not in known:
            raise OptionError(
                f"`sensor_errors`: {name!r} is not known; give typical, none or any of "
                f"{', '.join(SENSOR_ERROR_KINDS)}",
                "E501",
            )


def _check_contacts(options: "IdentifyOptions") -> None:
    if not options.contacts:
        return
    unknowable = [kind for kind in UNSEEN_WITH_CONTACTS if kind in options.sensor_error_kinds]
    if unknowable:
        raise OptionError(
            f"`contact` leaves {', '.join(unknowable)} unknown; leave it out of `sensor_errors`",
            "E503",
        )
    if options.drive_gains:
        raise OptionError(
            "`drive_gain` needs the wrenches of contacts, which `contact` eliminates; give "
            "`effort_scale` instead",
            "E503",
        )
    if options.tare:
        raise OptionError("`tare` is of foot sensors; leave it or `contact` out", "E503")
    if options.has_unplaced_payload:
        raise OptionError("`contact` needs the place of a `payload`; give LINK,MASS,X,Y,Z", "E503")
    if "load" in options.named_terms:
        raise OptionError(
            "`joint_terms` load needs the wrenches of contacts, which `contact` eliminates; "
            "name other terms",
            "E503",
        )


def _check_prior(options: "IdentifyOptions") -> None:
    sources = options.prior, options.prior_percent, options.prior_absolute
    if sum(source is not None for source in sources) + options.keep_prior > 1:
        raise OptionError(
            "give only one of `prior`, `prior_percent`, `prior_absolute` and `keep_prior`", "E502"
        )
    if options.total_mass_std is not None and options.total_mass is None:
        raise OptionError("`total_mass_std` has no effect without `total_mass`; give both", "E503")


def _check_method(options: "IdentifyOptions") -> None:
    if options.rank is not None and options.choose_truncation is not None:
        raise OptionError(
            "`rank` and `choose_truncation` both choose the singular values; give one", "E502"
        )
    if options.choose_truncation is None:
        refuse_unused(options, "without `choose_truncation`; give both", ("select_by",))
    if options.method in GAUSSIAN:
        unused = options.rank, options.choose_truncation, options.sensor_std
        if any(one is not None for one in unused):
            raise OptionError(
                f"{options.method} truncates no singular values and weights rows by their "
                "residuals; leave `rank`, `choose_truncation` and `sensor_std` out, or use "
                "`method` wls_rc",
                "E503",
            )
    elif (
        options.has_further_unknowns or options.total_mass is not None or options.mirror is not None
    ):
        raise OptionError(
            f"{options.method} supports neither `sensor_errors`, `tare`, `drive_gain`, `payload` "
            "without place, `total_mass` nor `mirror`; use `method` map or map_lmi",
            "E503",
        )


def _check_further_unknowns(options: "IdentifyOptions") -> None:
    if options.drive_gain_percent is not None and not options.drive_gains:
        raise OptionError(
            "`drive_gain_percent` has no effect without `drive_gain`; name the joints", "E503"
        )
    if options.drive_gains and options.information is not None:
        raise OptionError(
            "`information` of earlier logs has efforts in Nm and cannot be added to a log with "
            "`drive_gain`; leave one of them out, or give all bags together",
            "E503",
        )
    if options.drive_gains and options.has_unplaced_payload_in_log:
        raise OptionError(
            "`drive_gain` with a `payload` of unknown place needs a bag without payload too: "
            "give that as the log, and the other as `payload` BAG:LINK,MASS",
            "E503",
        )
    if options.has_further_unknowns and options.row_filter != "weak":
        raise OptionError(
            "sensor errors need rows averaged over windows, and so does a `payload` without "
            "place; leave `filter` out",
            "E503",
        )
