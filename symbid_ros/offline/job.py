"""One offline identification as a user asks for it; command and node both run this."""

from dataclasses import dataclass, field
from pathlib import Path

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.prior import Prior, load_prior, model_prior
from symbid_ros.estimation.row_weights import SensorDeviation, sensor_row_deviation
from symbid_ros.estimation.thesis import METHODS, Method
from symbid_ros.estimation.truncation import Criterion
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet, Term
from symbid_ros.model.urdf import Base
from symbid_ros.offline.identification import Truncation, identify
from symbid_ros.offline.record import Processing, Record, check_weight, read_record


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
    prior : Path or None
        prior.json; None takes the model file's inertias.
    method : {"ols", "wls_r", "wls_c", "wls_rc"}
        Which of the thesis's methods.
    terms : tuple of {"viscous", "coulomb", "armature", "offset"}
        What of the joints is identified too.
    processing : Processing
        Topics and filter.
    rank : int or None
        Number of singular values.
    validation : Path or None
        Bag on which to choose the number of singular values.
    criterion : {"gen_force", "torque", "com"}
        What to choose it by.
    sensors : SensorDeviation or None
        Weigh rows by sensor noise (Eq. 28) instead of residuals (Eq. 29).
    """

    bags: tuple[Path, ...]
    model: Path
    base: Base = "auto"
    prior: Path | None = None
    method: Method = "wls_rc"
    terms: tuple[Term, ...] = ()
    processing: Processing = field(default_factory=Processing)
    rank: int | None = None
    validation: Path | None = None
    criterion: Criterion = "gen_force"
    sensors: SensorDeviation | None = None

    @property
    def inputs(self) -> tuple[str, ...]:
        """The files that the estimate came from."""
        files = [*self.bags, self.model, self.prior, self.validation]
        return tuple(str(file) for file in files if file is not None)


@dataclass(frozen=True)
class Prepared:
    """A job's files, read; any method can be solved on them."""

    job: Job
    parameters: ParameterSet
    prior: Prior
    record: Record
    validation: Record | None

    def solve(self, method: Method) -> Estimate:
        """Identify with one method."""
        deviation = None
        if self.job.sensors is not None:
            model, samples = self.parameters.model, self.record.samples
            deviation = sensor_row_deviation(model, samples, self.job.sensors)
        return identify(
            self.record,
            self.parameters,
            self.prior,
            method,
            Truncation(self.job.rank, self.validation, self.job.criterion),
            row_deviation=deviation,
            inputs=self.job.inputs,
        )


def prepare(job: Job) -> Prepared:
    """Read and check all of a job's files.

    Raises
    ------
    SymbidError
        When a file, its data or the job itself does not serve.
    """
    if job.method not in METHODS:
        raise EstimateError(f"no method {job.method!r}; choose one of {', '.join(METHODS)}")
    if (job.rank is None) == (job.validation is None):
        raise EstimateError(
            f"{job.method} needs either a rank (--rank N) or a validation bag (--validate BAG) to "
            "choose it on"
        )
    parameters = ParameterSet(load_model(job.model, job.base), job.terms)
    prior = model_prior(parameters) if job.prior is None else load_prior(job.prior, parameters)
    record = read_record(job.bags, parameters, job.processing)
    validation = None
    if job.validation is not None:
        validation = read_record([job.validation], parameters, job.processing)
    if job.processing.topics.wrenches is None:
        for one in filter(None, (record, validation)):
            check_weight(one, parameters, prior)
    return Prepared(job, parameters, prior, record, validation)
