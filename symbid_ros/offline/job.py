"""What to identify, from what, and how: the options of one identification."""

import logging
from dataclasses import dataclass, field
from pathlib import Path

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.truncated_svd import Criterion, SensorNoise
from symbid_ros.identification.dataset import Filter, Processing
from symbid_ros.identification.prior_information import Facts, PriorChoice
from symbid_ros.identification.problem import GAUSSIAN, METHODS, Method
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet, Term
from symbid_ros.model.urdf import Base
from symbid_ros.signals.filters import Channels
from symbid_ros.signals.streams import ALL_OF_IT, TimeRange

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """What to identify, from what, and how.

    Attributes
    ----------
    bags : tuple of Path
        Bags that continue one another.
    model : Path
        URDF or MJCF; only its kinematics are used when there is a prior.
    base : {"auto", "floating", "fixed"}
        Whether a URDF's base may move.
    prior : PriorChoice
        Where the prior comes from.
    method : {"map_lmi", "map", "ols", "wls_r", "wls_c", "wls_rc"}
        Estimator.
    terms : tuple of {"viscous", "coulomb", "armature", "offset"}
        What is identified of every joint beside the links.
    processing : Processing
        How the log becomes rows.
    topics : TopicSelection
        Which topics of the bags are the robot's sensors.
    part : TimeRange
        Which part of the log.
    facts : Facts
        What else is known.
    information : Path or None
        information.npz of a run to go on from.
    rank : int or None
        Number of singular values, for the truncated methods.
    validation : Path or None
        Bag on which to choose the number of singular values.
    criterion : {"gen_force", "torque", "com"}
        What to choose it by.
    sensors : SensorNoise or None
        Weigh rows of the truncated methods by sensor noise (Eq. 28), not residuals (Eq. 29).
    unchecked : bool
        Do not hold the data against the model before they are believed.
    """

    bags: tuple[Path, ...]
    model: Path
    base: Base = "auto"
    prior: PriorChoice = field(default_factory=PriorChoice)
    method: Method = "map_lmi"
    terms: tuple[Term, ...] = ()
    processing: Processing = field(default_factory=Processing)
    topics: TopicSelection = field(default_factory=TopicSelection)
    part: TimeRange = ALL_OF_IT
    facts: Facts = field(default_factory=Facts)
    information: Path | None = None
    rank: int | None = None
    validation: Path | None = None
    criterion: Criterion = "gen_force"
    sensors: SensorNoise | None = None
    unchecked: bool = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """The files that the estimate came from."""
        files = [
            *self.bags,
            self.model,
            self.prior.file,
            *self.facts.tare,
            self.information,
            self.validation,
        ]
        return tuple(str(file) for file in files if file is not None)


def load_parameters(job: Job) -> ParameterSet:
    """Return the columns of a job's robot, and say what its file states beside them.

    Raises
    ------
    ModelError
        When the file does not serve.
    """
    parameters = ParameterSet(load_model(job.model, job.base), job.terms)
    names = parameters.model.joint_names
    for term, values in parameters.known_terms.items():
        stated = [name for name, value in zip(names, values, strict=True) if value != 0.0]
        option = "armature" if term == "armature" else "friction"
        logger.warning(
            "%s states %s of %s, which is taken as known; identify it with --%s if it may be wrong",
            job.model,
            f"{term} friction" if option == "friction" else term,
            ", ".join(stated),
            option,
        )
    return parameters


def chosen_filter(
    named: Filter | None, method: Method, cutoff: float | None, channels: Channels | None
) -> Filter:
    """Return the filter of the rows: the one named, or the one that the other options imply.

    The thesis's methods were published with Butterworth-filtered rows, so a cutoff or channels
    given with one of them ask for that filter.
    """
    if named is not None:
        return named
    is_butterworth = method not in GAUSSIAN and not (cutoff is None and channels is None)
    return "butterworth" if is_butterworth else "weak"


def check(job: Job) -> None:
    """Refuse what the method cannot take: an option without effect is a misunderstanding.

    Raises
    ------
    EstimateError
        When an option is of no use with another.
    """
    if job.method not in METHODS:
        raise EstimateError(f"no method {job.method!r}; choose one of {', '.join(METHODS)}")
    if job.rank is not None and job.validation is not None:
        raise EstimateError("--rank and --validate both choose the singular values; give one")
    facts = job.facts
    if job.method in GAUSSIAN:
        if job.rank is not None or job.validation is not None or job.sensors is not None:
            raise EstimateError(
                f"{job.method} cuts off no singular values and weighs rows by their residuals; "
                "leave --rank, --validate and --sensor-std out, or use wls_rc"
            )
    elif facts.kinds or facts.rows_wanted:
        raise EstimateError(
            f"{job.method} takes neither sensor errors, a tare nor a total mass; use map or map_lmi"
        )
    if facts.kinds and job.processing.smoothing is not None:
        raise EstimateError("sensor errors need rows averaged over windows; leave --filter out")
