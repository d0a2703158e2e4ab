"""Plans of studies: the schema of their YAML files, and how a file is read."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from symbid_ros.choices import GAUSSIAN, METHODS, Channels, Criterion, Method
from symbid_ros.errors import StudyError
from symbid_ros.estimation.prior import Kind
from symbid_ros.package_paths import config_file, share_directory
from symbid_ros.report.formatting import counted
from symbid_ros.study.scores import METRICS, REFERENCE
from symbid_ros.study.sensor_subsets import SensorSubset
from symbid_ros.user_files import load_yaml

Seed = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=1000)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$", max_length=40)]
Amount = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Frequency = Annotated[float, Field(ge=0, lt=500, allow_inf_nan=False)]

Metric = Literal["gen_force", "torque", "com", "momentum", "parameters"]
METRIC_KEYS: dict[Metric, str] = dict(zip(get_args(Metric), METRICS, strict=True))


class PlanEntry(BaseModel):
    """An entry of a plan; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class SimulatedLog(PlanEntry):
    """A log to simulate.

    Attributes
    ----------
    scenario : {"smooth", "wide", "vibrating", "squat", "one_leg", "stepping", "suspended"}
        The robot's motion.
    moves : int
        Number of moves, which sets the length of the log.
    motion_seed, noise_seed, error_seed : int
        Seeds of the motion, of the sensor noise and of the systematic errors.
    noise : float
        Factor on the standard deviations of `noise.yaml`; 0: ideal sensors.
    friction : bool
        Whether the joints have friction and armature.
    errors : str
        Systematic errors, as `symbid simulate --errors` takes them.
    """

    scenario: Literal[
        "smooth", "wide", "vibrating", "squat", "one_leg", "stepping", "suspended"
    ] = "smooth"
    moves: Count = 20
    motion_seed: Seed = 1
    noise_seed: Seed = 1
    noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    friction: bool = False
    errors: str = ""
    error_seed: Seed = 1

    @property
    def identity(self) -> str:
        """Name of its bag; equal logs have equal names and are simulated once."""
        parts = [f"{self.scenario} of {self.moves} moves {self.motion_seed}"]
        parts.append(f"noise {self.noise:g} x {self.noise_seed}" if self.noise else "no noise")
        parts += ["friction"] if self.friction else []
        parts += [f"{self.errors} {self.error_seed}"] if self.errors else []
        return ", ".join(parts)

    @property
    def description(self) -> str:
        """What the log contains, with the name of each seed, for readers."""
        moves = counted(self.moves, "move")
        parts = [f"{self.scenario}, {moves}, motion seed {self.motion_seed}"]
        parts.append(
            f"noise x {self.noise:g}, noise seed {self.noise_seed}" if self.noise else "no noise"
        )
        parts += ["friction"] if self.friction else []
        parts += [f"errors {self.errors}, error seed {self.error_seed}"] if self.errors else []
        return ", ".join(parts)


class DataSet(SimulatedLog):
    """A log to identify from.

    Attributes
    ----------
    sensors : {"all", "base_rows", "joint_rows", "no_plates"}
        The rows of the equation of motion that are used.
    cure : bool
        Whether `map` and `map_lmi` estimate the sensor errors, with a tare and a weighing.
    """

    sensors: SensorSubset = "all"
    cure: bool = False

    @model_validator(mode="after")
    def _check_usable(self) -> Self:
        if self.noise == 0:
            raise ValueError("data to identify from need noise; set noise above 0")
        if self.cure and self.sensors != "all":
            raise ValueError("cure needs all sensors; set sensors to all")
        return self


class PriorSpread(PlanEntry):
    """Half-width of the priors about the truth, in one of three forms (see `symbid prior`)."""

    percent: Amount | None = None
    absolute: Amount | None = None
    consistent: Amount | None = None

    @model_validator(mode="after")
    def _check_single(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise ValueError("give one of percent, absolute and consistent")
        return self

    @property
    def kind(self) -> Kind:
        """Which of the three forms it is."""
        return "percent" if self.percent else "absolute" if self.absolute else "consistent"

    @property
    def amount(self) -> float:
        """Half-width, % or SI units."""
        return self.percent or self.absolute or self.consistent or 0.0

    def __str__(self) -> str:
        """Return the label in tables."""
        unit = {"percent": " %", "absolute": "", "consistent": " % (possible links)"}[self.kind]
        return f"±{self.amount:g}{unit}"


class RankSelection(PlanEntry):
    """How the truncated methods choose z, the number of singular values.

    Attributes
    ----------
    by : {"gen_force", "torque", "com"}
        The prediction error to minimise.
    using : {"validation", "itself"}
        The ideal validation log, or the log itself, without validation data.
    """

    by: Criterion = "gen_force"
    using: Literal["validation", "itself"] = "validation"


class FigurePlan(PlanEntry):
    """Data and filters of the thesis's figures.

    Attributes
    ----------
    data : str
        The data set identified from.
    prior : PriorSpread
        The prior of Fig. 3 to 6.
    com, torque, momentum, links, parameters : float
        Cutoffs of the truncated methods' rows for Fig. 3, 4, 5 and 6 and Table D.1, Hz.
    """

    data: Name
    prior: PriorSpread
    com: Frequency
    torque: Frequency
    momentum: Frequency
    links: Frequency
    parameters: Frequency


class AccelerationPlan(PlanEntry):
    """Logs whose joint accelerations are compared with filtered ones (Eq. 4.2 and Fig. 4.3)."""

    cutoff: Annotated[float, Field(gt=0, lt=500)]
    logs: dict[Name, SimulatedLog]


class ClosedLoopPlan(PlanEntry):
    """Runs of the balance controller with priors, estimates and the true model.

    Attributes
    ----------
    data : str
        The data set identified from.
    priors : list of PriorSpread
    iterations : int
        Number of draws of each prior.
    filter : float
        Cutoff of the truncated methods' rows, Hz.
    moves, motion_seed : int
        The motion that the controller follows.
    """

    data: Name
    priors: list[PriorSpread]
    iterations: Count = 5
    filter: Frequency = 30.0
    moves: Count = 6
    motion_seed: Seed = 7


class Plan(PlanEntry):
    """The plan of one study.

    Attributes
    ----------
    title, about : str
        Heading and introduction of the page.
    thesis : bool
        Whether to show the thesis's values next to ours and to check its conclusions.
    data : dict of str to DataSet
        Logs to identify from.
    validation : SimulatedLog
        Ideal log of another motion, on which z is chosen and all estimates are evaluated.
    judged_every : float
        Interval between evaluated samples, s.
    priors : list of PriorSpread
    iterations : int
        Number of draws of each prior.
    prior_seed : int
        Seed of the first draw; the following draws count up from it.
    filters : list of float
        Cutoffs of the truncated methods' rows, Hz; 0: unfiltered.
    channels : {"all", "thesis"}
        Filtered channels.
    methods : list of str
        Methods to compare with the prior.
    z : RankSelection
    metrics : list of str
        Errors shown in tables and figures; all are computed.
    figures : FigurePlan or None
    accelerations : AccelerationPlan or None
    equation : SimulatedLog or None
        Motion on which the equation of motion is checked, with and without friction (Appendix B).
    closed_loop : ClosedLoopPlan or None
    """

    title: str
    about: str = ""
    thesis: bool = False
    data: dict[Name, DataSet] = Field(min_length=1)
    validation: SimulatedLog = SimulatedLog(motion_seed=2, noise=0.0)
    judged_every: Annotated[float, Field(ge=0.001, le=1.0)] = 0.01
    priors: list[PriorSpread] = Field(min_length=1)
    iterations: Count = 20
    prior_seed: Seed = 0
    filters: list[Frequency] = Field(default=[30.0], min_length=1)
    channels: Channels = "all"
    methods: list[Method] = Field(default=list(METHODS), min_length=1)
    z: RankSelection = RankSelection()
    metrics: list[Metric] = Field(default=list(METRIC_KEYS), min_length=1)
    figures: FigurePlan | None = None
    accelerations: AccelerationPlan | None = None
    equation: SimulatedLog | None = None
    closed_loop: ClosedLoopPlan | None = None

    @model_validator(mode="after")
    def _check_consistent(self) -> Self:
        for where, values in (
            ("priors", [str(spread) for spread in self.priors]),
            ("filters", self.filters),
            ("methods", self.methods),
            ("metrics", self.metrics),
        ):
            if len(set(values)) != len(values):
                raise ValueError(f"{where} repeat an entry; list each once")
        for where, log in (("validation", self.validation), ("equation", self.equation)):
            if log is not None and (log.noise or log.errors):
                raise ValueError(f"{where}: must be an ideal log; set noise to 0 and errors to ''")
        for where, part in (("figures", self.figures), ("closed_loop", self.closed_loop)):
            if part is not None and part.data not in self.data:
                raise ValueError(
                    f"{where}: unknown data set {part.data!r}{_did_you_mean(part.data, self.data)}"
                )
        if self.figures is not None:
            self._check_figures(self.figures)
        if self.closed_loop is not None:
            for spread in self.closed_loop.priors:
                self._check_included("closed_loop", spread, [self.closed_loop.filter])
            if self.closed_loop.iterations > self.iterations:
                raise ValueError(
                    f"closed_loop.iterations is more than the study's {self.iterations}; lower it"
                )
        return self

    def validation_log(self, data: str) -> SimulatedLog:
        """Return the ideal log on which estimates from a data set are evaluated."""
        return self.validation.model_copy(update={"friction": self.data[data].friction})

    def noisy_validation_log(self, data: str) -> SimulatedLog:
        """Return the same log with sensor noise."""
        return self.validation_log(data).model_copy(update={"noise": 1.0})

    @property
    def shown_metrics(self) -> tuple[str, ...]:
        """The metrics to show, by their names in `Scores`."""
        return tuple(METRIC_KEYS[name] for name in METRIC_KEYS if name in self.metrics)

    @property
    def compared(self) -> list[str]:
        """The prior, under its name in `Scores`, and all methods."""
        return [REFERENCE, *self.methods]

    @property
    def truncated_methods(self) -> list[Method]:
        """The thesis's methods among them, which truncate singular values."""
        return [method for method in self.methods if method not in GAUSSIAN]

    def _check_figures(self, figures: FigurePlan) -> None:
        cutoffs = [figures.com, figures.torque, figures.momentum, figures.links, figures.parameters]
        self._check_included("figures", figures.prior, cutoffs)
        if "wls_rc" not in self.methods:
            raise ValueError("figures show wls_rc, which is missing from methods; add it")

    def _check_included(self, where: str, spread: PriorSpread, cutoffs: list[float]) -> None:
        if spread not in self.priors:
            raise ValueError(f"{where}: prior {spread} is missing from priors; add it there")
        missing = [cutoff for cutoff in cutoffs if cutoff not in self.filters]
        if missing:
            raise ValueError(f"{where}: {missing[0]:g} Hz is missing from filters; add it there")


def _did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for a misspelt name, empty if no known name is similar."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def load_plan(name: str) -> tuple[Plan, Path]:
    """Read the plan of a study that ships with the package, by name, or of a file.

    Returns
    -------
    plan : Plan
    path : Path
        The file that was read.

    Raises
    ------
    StudyError
        If the study or file does not exist, or an entry is invalid. The message names the entry
        and suggests the most similar known name.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        known = {file.stem.removeprefix("study_"): file.name for file in shipped_studies()}
        if name not in known:
            raise StudyError(
                f"unknown study {name!r}{_did_you_mean(name, known)}; choose one of "
                f"{', '.join(sorted(known))}, or give a .yaml file",
                "E701",
            )
        path = config_file(known[name])
    try:
        content = load_yaml(path)
    except OSError as error:
        raise StudyError(
            f"{path}: cannot be read ({error.strerror}); give an existing file", "E701"
        ) from None
    except ValueError as error:
        raise StudyError(f"{path}: {error}", "E702") from None
    if not isinstance(content, dict):
        raise StudyError(f"{path}: not a study; give at least title, data and priors", "E702")
    try:
        return Plan.model_validate(content), path
    except ValidationError as error:
        # A key of the file may contain a line break.
        fault = " ".join(_first_fault(error).split())
        raise StudyError(f"{path}: {fault}", "E702") from None


def shipped_studies() -> list[Path]:
    """Return the files of the studies that ship with the package."""
    return sorted((share_directory() / "config").glob("study_*.yaml"))


def _first_fault(error: ValidationError) -> str:
    """Return the first fault: the entry, the reason and a suggestion."""
    faults = error.errors(include_url=False)
    # A misspelt key also makes the correct one missing, so it is reported first.
    fault = next((one for one in faults if one["type"] == "extra_forbidden"), faults[0])
    where = ".".join(str(step) for step in fault["loc"])
    if fault["type"] == "extra_forbidden":
        fields = _known_keys(fault["loc"][:-1])
        suggestion = _did_you_mean(str(fault["loc"][-1]), fields)
        return f"unknown key {where}{suggestion}; known keys are {', '.join(fields)}"
    # Pydantic prefixes the messages of our own validators with "Value error, ".
    message = str(fault.get("ctx", {}).get("error", fault["msg"]))
    return f"{where}: {message}" if where else message


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the entry at ``loc`` may have."""
    entries: dict[str, type[PlanEntry]] = {
        "data": DataSet,
        "validation": SimulatedLog,
        "equation": SimulatedLog,
        "logs": SimulatedLog,
        "priors": PriorSpread,
        "prior": PriorSpread,
        "z": RankSelection,
        "figures": FigurePlan,
        "accelerations": AccelerationPlan,
        "closed_loop": ClosedLoopPlan,
    }
    entry: type[PlanEntry] = Plan
    for step in loc:
        entry = entries.get(str(step), entry)
    return list(entry.model_fields)
