"""All front ends offer the same options, which are checked in one place."""

import inspect
import math
from pathlib import Path

import pytest

from symbid_ros.choices import TERMS, TYPICAL_ERRORS
from symbid_ros.errors import OptionError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.dataset import Processing
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import options_of, spelled
from symbid_ros.signals.filters import LowPass, SavitzkyGolay
from symbid_ros.simulation.options import SimulateOptions

NAMES = {each.name for kind in (IdentifyOptions, LogOptions) for each in options_of(kind)}


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ({"method": "guess"}, ["method"]),
        ({"rank": 0, "method": "ols"}, ["rank"]),
        ({"rank": 1.5, "method": "ols"}, ["rank"]),
        ({"prior_percent": -1}, ["prior_percent"]),
        ({"prior_percent": math.nan}, ["prior_percent"]),
        ({"friction": "yes"}, ["friction"]),
        ({"sensor_std": (1.0, 2.0), "method": "ols"}, ["sensor_std"]),
        ({"window": 0.0}, ["window"]),
        ({"sensor_errors": "wrench_gain,encoder"}, ["sensor_errors"]),
        ({"sensor_errors": " ,"}, ["sensor_errors"]),
        ({"prior": "p.json", "prior_percent": 25}, ["prior", "prior_percent"]),
        ({"total_mass_std": 0.1}, ["total_mass_std", "total_mass"]),
        ({"rank": 3}, ["rank"]),
        ({"method": "ols", "rank": 3, "choose_truncation": "bag"}, ["rank", "choose_truncation"]),
        ({"method": "ols", "total_mass": 40}, ["total_mass"]),
        ({"method": "ols", "tare": "bag"}, ["tare"]),
        ({"cutoff": 20}, ["cutoff"]),
        ({"filter": "butterworth", "window": 0.1}, ["window"]),
        ({"filter": "butterworth", "sensor_errors": "typical"}, ["filter"]),
        ({"rank": math.inf, "method": "ols"}, ["rank"]),
        ({"contact": 1}, ["contact"]),
        ({"joint_terms": None}, ["joint_terms"]),
        ({"payload": [1.5]}, ["payload"]),
        ({"payload": [("bag", "tool0,1")]}, ["payload"]),
        ({"coupling": 1}, ["coupling"]),
        ({"ripple": [1.5]}, ["ripple"]),
        ({"tare": 1}, ["tare"]),
        ({"prior": 5}, ["prior"]),
        ({"information": 5}, ["information"]),
        ({"method": "ols", "choose_truncation": 3}, ["choose_truncation"]),
    ],
    ids=str,
)
def test_errors_name_the_invalid_fields(given, names) -> None:
    with pytest.raises(OptionError) as refusal:
        IdentifyOptions(**given)
    for name in names:
        assert f"`{name}`" in str(refusal.value)
    assert refusal.value.code.startswith("E50")


@pytest.mark.parametrize("given", [{"rename_joint": 3}, {"joint_topic": [3]}, {"pose_frame": 1}])
def test_names_in_a_log_are_texts(given) -> None:
    with pytest.raises(OptionError, match=f"`{next(iter(given))}`: .* give text"):
        LogOptions(**given)


def test_the_deprecated_name_of_an_option_is_understood(caplog) -> None:
    options = IdentifyOptions(method="ols", validate="bag")
    assert (options.choose_truncation, options.validate) == (Path("bag"), None)
    assert "`validate` is now called `choose_truncation`" in caplog.text
    assert options == IdentifyOptions(method="ols", choose_truncation="bag")
    with pytest.raises(OptionError, match="deprecated name"):
        IdentifyOptions(method="ols", validate="bag", choose_truncation="other")


def test_values_are_converted_to_the_type_of_their_field() -> None:
    options = IdentifyOptions(prior="p.json", tare="bag", sensor_errors="typical", mirror=1)
    assert options.prior == Path("p.json")
    assert options.tare == (Path("bag"),)
    assert isinstance(options.mirror, float)
    assert options.files == (Path("p.json"), Path("bag"))


def test_sensor_errors_are_named_or_all() -> None:
    assert IdentifyOptions().sensor_error_kinds == ()
    assert IdentifyOptions(tare="bag").sensor_error_kinds == TYPICAL_ERRORS
    assert IdentifyOptions(sensor_errors="typical").sensor_error_kinds == TYPICAL_ERRORS
    assert IdentifyOptions(sensor_errors="none").sensor_error_kinds == ()
    named = IdentifyOptions(sensor_errors=(" torque_gain, wrench_offset,",), tare="bag")
    assert named.sensor_error_kinds == ("wrench_offset", "torque_gain")


def test_terms_follow_from_three_options() -> None:
    assert IdentifyOptions(friction=True).terms == ("viscous", "coulomb")
    assert IdentifyOptions(armature=True, offset=True).terms == ("armature", "offset")
    assert IdentifyOptions(friction=True, armature=True, offset=True).terms == TERMS[:4]


@pytest.mark.parametrize("method", ["ols", "wls_r", "wls_c", "wls_rc"])
@pytest.mark.parametrize("given", [{"cutoff": 20.0}, {"cutoff": 0.0}, {"channels": "thesis"}])
def test_a_cutoff_selects_butterworth_for_truncated_methods(method, given) -> None:
    assert IdentifyOptions(method=method, **given).row_filter == "butterworth"
    assert IdentifyOptions(method=method).row_filter == "weak"


def test_options_determine_the_processing_of_rows() -> None:
    assert Processing.of(IdentifyOptions()) == Processing()
    assert Processing.of(IdentifyOptions(window=0.1)).windows == (0.1,)
    filtered = IdentifyOptions(method="ols", cutoff=20.0, channels="thesis")
    assert Processing.of(filtered).smoothing == LowPass(20.0, "thesis")
    polynomial = IdentifyOptions(filter="savitzky_golay", window=0.05)
    assert Processing.of(polynomial).smoothing == SavitzkyGolay(0.05)


def test_no_option_exists_in_one_front_end_only() -> None:
    from symbid_ros.cli.estimates import identify
    from symbid_ros.ros.identifier_parameters import PARAMETERS

    flags = set(inspect.signature(identify).parameters)
    parameters = {parameter.name for parameter in PARAMETERS}
    assert flags >= NAMES
    assert parameters >= NAMES
    # A node has `bag`, never overwrites, reads a robot file as its parameter file, and works on one
    # machine.
    only_the_command = {"bags", "overwrite", "robot", "dask", "context"}
    assert flags - NAMES - only_the_command <= parameters


def test_no_option_of_a_simulation_exists_in_one_front_end_only() -> None:
    from symbid_ros.cli.simulate import simulate
    from symbid_ros.ros.mujoco_bridge import PARAMETERS

    names = {each.name for each in options_of(SimulateOptions)}
    assert names <= set(inspect.signature(simulate).parameters)
    assert names <= {parameter.name for parameter in PARAMETERS}


def test_backquoted_names_are_spelled_by_the_front_end() -> None:
    assert (
        spelled("give `prior_percent`, not `/a/b`", str.upper) == "give PRIOR_PERCENT, not `/a/b`"
    )
    for each in (*options_of(IdentifyOptions), *options_of(LogOptions)):
        for text in (each.help, each.unset):
            spelled(text, lambda name: name if name in NAMES else pytest.fail(name))


def test_part_of_a_log() -> None:
    assert LogOptions().end == math.inf
    assert LogOptions(start=1, stop=2).end == 2.0
    with pytest.raises(OptionError, match="`stop`"):
        LogOptions(start=2, stop=1)
