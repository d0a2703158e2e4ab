"""Parameters of the identifier, and the job that they ask for."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from symbid_ros.identification.dataset import processing
from symbid_ros.identification.prior_information import Facts, PriorChoice
from symbid_ros.identification.problem import METHODS
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.parameters import joint_terms
from symbid_ros.offline.job import Job, chosen_filter
from symbid_ros.ros.parameters import Parameter, ParameterError
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sensor_errors import parse_kinds
from symbid_ros.signals.streams import TimeRange

CUTOFF = LowPass().cutoff

PARAMETERS = (
    Parameter(
        "mode",
        "auto",
        "Identify from topics, or from bags; auto: from bags if there are any.",
        choices=("auto", "online", "offline"),
    ),
    Parameter("bag", [""], "Bags to identify from, in sequence."),
    Parameter(
        "start", 0.0, "Of a bag: seconds after its first joint state to leave out.", minimum=0.0
    ),
    Parameter(
        "stop",
        0.0,
        "Of a bag: seconds after its first joint state to end at; 0: at its end.",
        minimum=0.0,
    ),
    Parameter("model", "", "Robot model, URDF or MJCF; empty: robot_description."),
    Parameter(
        "robot_description",
        "",
        "URDF as text, where no model is named; empty for the latched topic robot_description.",
    ),
    Parameter(
        "base",
        "auto",
        "Whether a URDF's base may move.",
        choices=("auto", "floating", "fixed"),
    ),
    Parameter("prior", "", "prior.json; empty for the model's own values."),
    Parameter("prior_percent", 0.0, "Trust the model's values to ± this many %; 0: not given."),
    Parameter("prior_absolute", 0.0, "Trust the model's values to ± this, SI units; 0: not given."),
    Parameter(
        "method",
        "map_lmi",
        "Most probable of all possible robots, most probable, or truncated least squares.",
        choices=METHODS,
    ),
    Parameter("total_mass", 0.0, "What the whole robot weighs, kg; 0: unknown.", minimum=0.0),
    Parameter("total_mass_std", 0.05, "Standard deviation of total_mass, kg.", minimum=0.0),
    Parameter(
        "mirror",
        0.0,
        "How far left and right may differ, in standard deviations of the prior; 0: freely.",
        minimum=0.0,
    ),
    Parameter("tare", [""], "Bags recorded with nothing touching the wrench sensors."),
    Parameter("sensor_errors", "", "Sensor errors to identify: typical, or names with commas."),
    Parameter("information", "", "information.npz of an earlier run, to add its data."),
    Parameter(
        "filter",
        "weak",
        "Average the equation over windows, or filter the signals and take single instants; weak "
        "becomes butterworth where one of the thesis's methods is given a cutoff or channels.",
        choices=("weak", "butterworth", "savitzky_golay"),
    ),
    Parameter("window", 0.0, "Length of the windows, s; 0: chosen by the data.", minimum=0.0),
    Parameter("cutoff", CUTOFF, "Of the Butterworth filter, Hz; 0: no filter.", minimum=0.0),
    Parameter(
        "channels",
        "all",
        "Butterworth-filter all channels, or the thesis's choice of them.",
        choices=("all", "thesis"),
    ),
    Parameter(
        "rank",
        0,
        "Number of singular values to use; 0: chosen by the data, or on a bag.",
        minimum=0,
    ),
    Parameter("validate", "", "Bag on which to choose the number of singular values."),
    Parameter(
        "select_by",
        "gen_force",
        "Prediction error that chooses it.",
        choices=("gen_force", "torque", "com"),
    ),
    Parameter("friction", False, "Identify viscous and Coulomb friction as well."),
    Parameter(
        "armature", False, "Identify the drives' inertias, as the joints feel them, as well."
    ),
    Parameter("offset", False, "Identify a constant torque of every joint as well."),
    Parameter(
        "joint_topic",
        [""],
        "JointState topic, or several whose joints are merged by stamp; empty for joint_states.",
    ),
    Parameter("imu_topics", [""], "Imu topics; empty for all."),
    Parameter("wrench_topics", [""], "WrenchStamped topics; empty for all named wrench."),
    Parameter(
        "frame_prefix",
        "",
        "What the sensors' frames begin with and the model's do not, such as robot1/.",
    ),
    Parameter("unchecked", False, "Go on with data that contradict the model (docs/diagnosis.md)."),
    Parameter("out", "", "Folder for the estimate and the models; empty for none."),
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
        "Online: seconds in which data lose all but 1/e of their weight, so that changes are "
        "followed; 0 for never.",
        minimum=0.0,
        live=True,
    ),
    Parameter(
        "lag",
        0.5,
        "Online: seconds that a topic may lag behind the joint states before a block is worked on "
        "without it.",
        minimum=0.1,
        maximum=60.0,
    ),
    Parameter("resume", "", "Online: information.npz of an earlier run to go on from."),
    Parameter(
        "settle",
        1.0,
        "Online: seconds for which no further sensor topic must turn up before the start.",
        minimum=0.0,
        maximum=600.0,
    ),
    Parameter("queue_depth", 5000, "Online: messages each topic may wait to be read.", minimum=100),
    Parameter(
        "row_share",
        0.15,
        "Online: share of a core for the rows of whole blocks.",
        minimum=0.01,
        maximum=1.0,
    ),
)


def is_online(values: dict[str, Any]) -> bool:
    """Tell whether topics are to be identified from.

    Raises
    ------
    ParameterError
        When the mode and the bags contradict each other.
    """
    has_bags = bool(_given(values["bag"]))
    mode = values["mode"]
    if mode == "offline" and not has_bags:
        raise ParameterError("parameter bag: empty; give -p bag:=[PATH], or mode:=online")
    if mode == "online" and has_bags:
        raise ParameterError("parameter bag: not read online; leave it out, or give mode:=offline")
    return not has_bags


def _part(values: dict[str, Any]) -> TimeRange:
    return TimeRange(values["start"], values["stop"] or float("inf"))


def job_from(values: dict[str, Any]) -> Job:
    """Return the job that the node's parameters ask for.

    Raises
    ------
    ParameterError
        When no model is named, or what is known earlier is given twice.
    """
    bags = _given(values["bag"])
    if not values["model"]:
        raise ParameterError("parameter model: empty; give -p model:=PATH")
    earlier = [name for name in ("information", "resume") if values[name]]
    if len(earlier) > 1 or (bags and values["resume"]):
        raise ParameterError(
            "parameter resume: for topics alone; give bags an information file, topics resume"
        )
    topics = TopicSelection(
        joints=_given(values["joint_topic"]) or None,
        imus=_given(values["imu_topics"]) or None,
        wrenches=_given(values["wrench_topics"]) or None,
        frame_prefix=values["frame_prefix"],
    )
    window, mass, mirror = values["window"], values["total_mass"], values["mirror"]
    # A parameter always has a value: its default counts as not given.
    cutoff = None if values["cutoff"] == CUTOFF else values["cutoff"]
    channels = None if values["channels"] == "all" else values["channels"]
    named = None if values["filter"] == "weak" else values["filter"]
    row_filter = chosen_filter(named, values["method"], cutoff, channels)
    return Job(
        bags=tuple(map(Path, bags)),
        model=Path(values["model"]),
        base=values["base"],
        prior=PriorChoice(
            given_path(values["prior"]),
            values["prior_percent"] or None,
            values["prior_absolute"] or None,
        ),
        method=values["method"],
        terms=joint_terms(values["friction"], values["armature"], values["offset"]),
        processing=processing(row_filter, window or None, cutoff, channels),
        topics=topics,
        part=_part(values),
        facts=Facts(
            total_mass=(mass, values["total_mass_std"]) if mass else None,
            mirror=mirror or None,
            tare=tuple(map(Path, _given(values["tare"]))),
            sensor_errors=parse_kinds(errors) if (errors := values["sensor_errors"]) else (),
        ),
        information=given_path(values["information"] or values["resume"]),
        rank=values["rank"] or None,
        validation=given_path(values["validate"]),
        criterion=values["select_by"],
        unchecked=values["unchecked"],
    )


def _given(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names that say something: ROS has no typed empty list, so [""] stands for it."""
    return tuple(name for name in names if name)


def given_path(value: str) -> Path | None:
    """Return a path, None for the empty text that stands for none."""
    return Path(value) if value else None
