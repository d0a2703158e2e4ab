"""Sentences and figures about the errors of two models."""

from collections.abc import Iterable, Mapping, Sequence

from symbid_ros.identification.predictions.force_errors import (
    SENSOR_PARTS,
    ForceError,
    differ_relevantly,
)

ALL_JOINTS, SLOW_STRETCHES = "all joints", "slow stretches"
BASE_MOMENT, BASE_FORCE, WRIST_SENSORS = "base moment", "base force", "wrist sensors"


def describe_change(error: ForceError) -> str:
    """Describe an error before and after, in percent if anything was measured."""
    if error.percent_before is None or error.percent_after is None:
        return f"{error.rmse_before:.3g} → {error.rmse_after:.3g} {error.unit} ({error.name})"
    forces = {
        BASE_MOMENT: "moment on the base",
        BASE_FORCE: "force on the base",
        WRIST_SENSORS: "wrist forces",
    }
    groups = ALL_JOINTS, SLOW_STRETCHES
    what = forces.get(error.name, "torque" if error.name in groups else f"effort of {error.name}")
    if error.name.startswith(tuple(f"{kind} at " for kind in SENSOR_PARTS)):
        what = error.name
    change = percent_change(error.percent_before, error.percent_after)
    return f"{change} of the measured {what}"


def describe_files(percents: Mapping[str, float], after: float | None) -> str:
    """Return the errors of all model files if one predicts worse than the identified model."""
    if after is None:
        return ""
    lacking = [
        name
        for name, value in percents.items()
        if value > after and differ_relevantly(after, value)
    ]
    if not lacking:
        return ""
    others = [name for name in percents if name not in lacking]

    def errors(names: Sequence[str]) -> str:
        return ", ".join(f"error of {name} alone {percent(percents[name])}" for name in names)

    which = "it" if len(lacking) == 1 else "they"
    text = f"{errors(lacking)}: {which} cannot contain all joint terms"
    # A file without a larger error may lack terms too, which a trial did not identify.
    return f"{text}; {errors(others)}" if others else text


def enumerate_words(words: Iterable[str]) -> str:
    """Return words as "A, B and C"."""
    items = list(words)
    return f"{', '.join(items[:-1])} and {items[-1]}" if len(items) > 1 else "".join(items)


def percent_change(before: float, after: float) -> str:
    """Format two percentages, with a third digit where two do not show the difference."""
    pair = f"{percent(before)} → {percent(after)}"
    return pair if percent(before) != percent(after) else f"{before:.3g} % → {after:.3g} %"


def percent(value: float | None) -> str:
    """Format a percentage with two or three digits, or a dash for None."""
    if value is None:
        return "–"
    return f"{value:.0f} %" if value >= 100 else f"{value:.{3 if value >= 10 else 2}g} %"
