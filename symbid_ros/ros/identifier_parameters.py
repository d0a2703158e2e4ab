"""Parameters of the identifier: those of every front end, and those of a node."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from symbid_ros.choices import Base
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.ros.parameters import Parameter, ParameterError, options_from, parameters_of

PARAMETERS = (
    Parameter(
        "mode",
        "auto",
        "Identify from topics (online) or bags (offline); auto: from bags if any are given.",
        choices=("auto", "online", "offline"),
    ),
    Parameter("bag", [""], "Bags to identify from, in sequence."),
    Parameter("model", "", "Robot model, URDF or MJCF; empty: robot_description."),
    Parameter(
        "robot_description",
        "",
        "URDF as text, if there is no model; empty: the latched topic robot_description.",
    ),
    Parameter(
        "base",
        "auto",
        "Base of a URDF; auto: floating, unless the root link is named 'world'.",
        choices=("auto", "floating", "fixed"),
    ),
    *parameters_of(IdentifyOptions),
    *parameters_of(LogOptions),
    Parameter("imu_topics", [""], "Deprecated name of imu_topic."),
    Parameter("wrench_topics", [""], "Deprecated name of wrench_topic."),
    Parameter("out", "", "Folder for the estimate and the models; empty: none are written."),
    Parameter("overwrite", False, "Replace the result of an earlier run in out."),
    Parameter(
        "solve_period",
        1.0,
        "Online: seconds from one estimate to the next.",
        minimum=0.05,
        maximum=3600.0,
        live=True,
    ),
    Parameter(
        "memory",
        0.0,
        "Online: time constant of forgetting, s: older data lose weight, so that the estimate "
        "follows changes; 0: data are never forgotten.",
        minimum=0.0,
        live=True,
    ),
    Parameter(
        "lag",
        0.5,
        "Online: seconds that a topic may lag behind the joint states before a block is processed "
        "without it.",
        minimum=0.1,
        maximum=60.0,
    ),
    Parameter(
        "live_model",
        "",
        "Online: JSON file to which each estimate is written for controllers without ROS, such as "
        "`symbid udp-client --model-source`; empty: none.",
    ),
    Parameter("resume", "", "Online: information.npz of an earlier run to resume from."),
    Parameter(
        "settle",
        1.0,
        "Online: seconds without a new sensor topic before identification starts.",
        minimum=0.0,
        maximum=600.0,
    ),
    Parameter(
        "queue_depth", 5000, "Online: messages of each topic that may wait to be read.", minimum=100
    ),
    Parameter(
        "save_time",
        1.5,
        "Online: seconds that the last estimate may take at shutdown, because `ros2 launch` kills "
        "nodes that take a few seconds. If an exact one needs more, a faster one is saved.",
        minimum=0.0,
        maximum=600.0,
    ),
    Parameter(
        "row_share",
        0.15,
        "Online: share of a CPU core for building the equations of motion of complete blocks.",
        minimum=0.01,
        maximum=1.0,
    ),
)

# Values that meant "not given" in parameter files written before options could be left unset.
_FORMERLY_UNSET = {
    "prior_percent": 0.0,
    "prior_absolute": 0.0,
    "total_mass": 0.0,
    "mirror": 0.0,
    "filter": "weak",
    "window": 0.0,
    "cutoff": 30.0,
    "channels": "all",
    "rank": 0,
    "stop": 0.0,
}


def is_online(values: Mapping[str, Any]) -> bool:
    """Return whether to identify from topics; raise a ParameterError if bags contradict it."""
    has_bags = bool(given_texts(values["bag"]))
    mode = values["mode"]
    if mode == "offline" and not has_bags:
        raise ParameterError("parameter bag: empty; give -p bag:=[PATH], or mode:=online", "E801")
    if mode == "online" and has_bags:
        raise ParameterError(
            "parameter bag: not read online; leave it out, or give mode:=offline", "E801"
        )
    return not has_bags


def model_of(values: Mapping[str, Any]) -> tuple[Path, Base]:
    """Return the model file and whether its base may move."""
    if not values["model"]:
        raise ParameterError("parameter model: empty; give -p model:=PATH", "E801")
    return Path(values["model"]), values["base"]


def identify_options(values: Mapping[str, Any]) -> IdentifyOptions:
    """Return the options of an identification; raise a ParameterError if any contradict."""
    earlier = [name for name in ("information", "resume") if values[name]]
    if len(earlier) > 1 or (values["resume"] and not is_online(values)):
        raise ParameterError(
            "parameter resume: for topics only; give information for bags, resume for topics",
            "E801",
        )
    given = _without_unset(values) | {"information": values["information"] or values["resume"]}
    if given["total_mass"] is None:
        given["total_mass_std"] = None
    return options_from(IdentifyOptions, given)


def log_options(values: Mapping[str, Any]) -> LogOptions:
    """Return the topics and the part of a recording to read."""
    given = _without_unset(values)
    for name in ("imu_topic", "wrench_topic"):
        given[name] = given_texts(values[name]) or given_texts(values[f"{name}s"])
    return options_from(LogOptions, given).of_any_log()


def given_texts(texts: Sequence[str]) -> tuple[str, ...]:
    """Return texts that are not empty: ROS has no typed empty list, so [""] stands for it."""
    return tuple(text for text in texts if text)


def given_path(value: str) -> Path | None:
    """Return a path, None for the empty text that stands for none."""
    return Path(value) if value else None


def _without_unset(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values with None in place of those that meant "not given"."""
    return {
        name: None if name in _FORMERLY_UNSET and value == _FORMERLY_UNSET[name] else value
        for name, value in values.items()
    }
