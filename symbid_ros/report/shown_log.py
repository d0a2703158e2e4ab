"""Names of the log that a result was identified from, and of another one that is shown instead."""

from collections.abc import Mapping
from typing import Any

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.report_data import PredictedLog
from symbid_ros.report.content import MethodResult
from symbid_ros.report.formatting import significant


def given_options(estimate: Estimate) -> Mapping[str, Any]:
    """Return the options of an identification; empty if they are unknown."""
    return {} if estimate.provenance is None else estimate.provenance.options


def describe_identified_log(result: MethodResult) -> str:
    """Return the log of an identification, the part that was read, and earlier information."""
    assert result.estimate is not None
    assert result.log is not None
    coverage, options = result.log.coverage, given_options(result.estimate)
    text = coverage.log
    if options.get("start"):
        text += f" from {options['start']:g} s"
    if options.get("stop"):
        text += f" until {options['stop']:g} s"
    text += f", {significant(coverage.seconds)} s used"
    earlier = options.get("information")
    return f"{text}, after the logs in {earlier}" if earlier else text


def describe_given(given: PredictedLog) -> str:
    """Return the log that a report was given, and how much of it the identification used."""
    name, used = given.data.coverage.log, given.seconds_used
    if used <= 0:
        return f"{name}, which the identification did not use"
    if used < given.seconds - 1:
        return f"{name}, of which the identification used {used:.0f} of {given.seconds:.0f} s"
    return f"{name}, which the identification used"
