"""What a study compares, checked entry by entry."""

import difflib
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from symbid_ros.choices import GAUSSIAN, METHODS, Channels, Criterion, Method
from symbid_ros.estimation.prior import Kind
from symbid_ros.study.scores import METRICS
from symbid_ros.study.sensor_subsets import Sensing

Seed = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=1000)]


class Part(BaseModel):
    """An entry of the file; what it does not know is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Log(Part):
    """A simulated log.

    Attributes
    ----------
    scenario : {"smooth", "vibrating", "squat", "suspended"}
        What the robot does.
    moves : int
        Number of moves: the log's length.
    motion_seed, noise_seed, error_seed : int
        Of the motion, the sensors' noise, and their systematic errors.
    noise : float
        Factor on the deviations of noise.yaml; 0 leaves ideal sensors.
    friction : bool
        Whether the joints have friction and armature.
    errors : str
        Systematic errors, as `symbid simulate --errors` takes them.
    """

    scenario: Literal["smooth", "vibrating", "squat", "suspended"] = "smooth"
    moves: Count = 20
    motion_seed: Seed = 1
    noise_seed: Seed = 1
    noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    friction: bool = False
    errors: str = ""
    error_seed: Seed = 1

    @property
    def identity(self) -> str:
        """What tells its bag from other logs': equal logs are one."""
        parts = [f"{self.scenario} of {self.moves} moves {self.motion_seed}"]
        parts.append(f"noise {self.noise:g} x {self.noise_seed}" if self.noise else "no noise")
        parts += ["friction"] if self.friction else []
        parts += [f"{self.errors} {self.error_seed}"] if self.errors else []
        return ", ".join(parts)


class DataSet(Log):
    """A log to identify from.

    Attributes
    ----------
    sensors : {"all", "base_rows", "joint_rows", "no_plates"}
        Which rows of the equation of motion there are.
    cure : bool
        Let `map` and `map_lmi` find the sensors' errors, with a tare and a weighing.
    """

    sensors: Sensing = "all"
    cure: bool = False

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.noise == 0:
            raise ValueError("data without any noise decide everything; give noise above 0")
        if self.cure and self.sensors != "all":
            raise ValueError("cure needs all sensors")
        return self


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]*$", max_length=40)]
Amount = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Frequency = Annotated[float, Field(ge=0, lt=500, allow_inf_nan=False)]

Metric = Literal["gen_force", "torque", "com", "momentum", "parameters"]
METRIC_KEYS: dict[Metric, str] = dict(zip(get_args(Metric), METRICS, strict=True))


class Spread(Part):
    """How priors are drawn about the truth: one of three ways (see `symbid prior`)."""

    percent: Amount | None = None
    absolute: Amount | None = None
    consistent: Amount | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if len(self.model_fields_set) != 1:
            raise ValueError("give one of percent, absolute and consistent")
        return self

    @property
    def kind(self) -> Kind:
        """Which of the three it is."""
        return "percent" if self.percent else "absolute" if self.absolute else "consistent"

    @property
    def amount(self) -> float:
        """Half-width, % or SI units."""
        return self.percent or self.absolute or self.consistent or 0.0

    def __str__(self) -> str:
        """Return what a table says of it."""
        unit = {"percent": " %", "absolute": "", "consistent": " % (possible links)"}[self.kind]
        return f"±{self.amount:g}{unit}"


class Selection(Part):
    """How the truncated methods choose z.

    Attributes
    ----------
    by : {"gen_force", "torque", "com"}
        What to predict well.
    using : {"validation", "itself"}
        The ideal validation log, or the log itself: no data kept apart.
    """

    by: Criterion = "gen_force"
    using: Literal["validation", "itself"] = "validation"


class Figures(Part):
    """What the thesis's figures are drawn of.

    Attributes
    ----------
    data : str
        The data set identified from.
    prior : Spread
        Of Fig. 3 to 6.
    com, torque, momentum : float
        Hz, cutoffs of the WLS-RC estimates in Fig. 3, 4 and 5.
    links, parameters : float
        Hz, those of Fig. 6 and of Table D.1.
    """

    data: Name
    prior: Spread
    com: Frequency
    torque: Frequency
    momentum: Frequency
    links: Frequency
    parameters: Frequency


class Accelerations(Part):
    """What a filter does to joint accelerations (thesis, Eq. 4.2 and Fig. 4.3)."""

    cutoff: Annotated[float, Field(gt=0, lt=500)]
    logs: dict[Name, Log]


class ClosedLoop(Part):
    """The balance controller at work with priors, estimates and the truth.

    Attributes
    ----------
    priors : list of Spread
    iterations : int
        Priors of each kind.
    data : str
        The data set identified from.
    filter : float
        Hz, of the truncated methods' rows.
    moves, motion_seed : int
        The motion the controller is to follow.
    """

    data: Name
    priors: list[Spread]
    iterations: Count = 5
    filter: Frequency = 30.0
    moves: Count = 6
    motion_seed: Seed = 7


class Plan(Part):
    """One study.

    Attributes
    ----------
    title, about : str
        What the page says at its head.
    thesis : bool
        Whether the thesis's own figures stand beside ours, and its conclusions are examined.
    data : dict of str to DataSet
        What to identify from.
    validation : Log
        Ideal, of other moves: z is chosen and all are judged by it.
    judged_every : float
        s, between the instants at which predictions are judged.
    priors : list of Spread
    iterations : int
        Priors drawn of each.
    prior_seed : int
        Of the first draw; the others follow.
    filters : list of float
        Hz, cutoffs of the rows of the truncated methods; 0: unfiltered.
    channels : {"all", "thesis"}
        Which channels are filtered.
    methods : list of str
        Beside the prior itself.
    z : Selection
    metrics : list of str
        What tables and figures show; all of them are worked out.
    figures : Figures or None
    accelerations : Accelerations or None
    equation : Log or None
        Motion on which the equation of motion is checked, with friction and without (Appendix B).
    closed_loop : ClosedLoop or None
    """

    title: str
    about: str = ""
    thesis: bool = False
    data: dict[Name, DataSet] = Field(min_length=1)
    validation: Log = Log(motion_seed=2, noise=0.0)
    judged_every: Annotated[float, Field(ge=0.001, le=1.0)] = 0.01
    priors: list[Spread] = Field(min_length=1)
    iterations: Count = 20
    prior_seed: Seed = 0
    filters: list[Frequency] = Field(default=[30.0], min_length=1)
    channels: Channels = "all"
    methods: list[Method] = Field(default=list(METHODS), min_length=1)
    z: Selection = Selection()
    metrics: list[Metric] = Field(default=list(METRIC_KEYS), min_length=1)
    figures: Figures | None = None
    accelerations: Accelerations | None = None
    equation: Log | None = None
    closed_loop: ClosedLoop | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for where, repeated in (
            ("priors", [str(spread) for spread in self.priors]),
            ("filters", self.filters),
            ("methods", self.methods),
            ("metrics", self.metrics),
        ):
            if len(set(repeated)) != len(repeated):
                raise ValueError(f"{where} repeat; name each once")
        for where, log in (("validation", self.validation), ("equation", self.equation)):
            if log is not None and (log.noise or log.errors):
                raise ValueError(f"{where}: what others are judged by is ideal; noise 0, no errors")
        for where, part in (("figures", self.figures), ("closed_loop", self.closed_loop)):
            if part is not None and part.data not in self.data:
                raise ValueError(
                    f"{where}: no data set {part.data!r}{nearest(part.data, self.data)}"
                )
        if self.figures is not None:
            self._drawn(self.figures)
        if self.closed_loop is not None:
            for spread in self.closed_loop.priors:
                self._included("closed_loop", spread, [self.closed_loop.filter])
            if self.closed_loop.iterations > self.iterations:
                raise ValueError("closed_loop has more iterations than the study; lower them")
        return self

    def validation_of(self, data: str) -> Log:
        """Return the ideal log by which estimates from one data set are judged."""
        return self.validation.model_copy(update={"friction": self.data[data].friction})

    def realistic_of(self, data: str) -> Log:
        """Return the same log seen through noisy sensors, as a robot would."""
        return self.validation_of(data).model_copy(update={"noise": 1.0})

    @property
    def shown(self) -> tuple[str, ...]:
        """The metrics shown, by their names in scores."""
        return tuple(METRIC_KEYS[name] for name in METRIC_KEYS if name in self.metrics)

    @property
    def truncated(self) -> list[Method]:
        """The thesis's methods among those compared."""
        return [method for method in self.methods if method not in GAUSSIAN]

    def _drawn(self, figures: Figures) -> None:
        cutoffs = [figures.com, figures.torque, figures.momentum, figures.links, figures.parameters]
        self._included("figures", figures.prior, cutoffs)
        if "wls_rc" not in self.methods:
            raise ValueError("figures show wls_rc, which is not among the methods; add it")

    def _included(self, where: str, spread: Spread, cutoffs: list[float]) -> None:
        if spread not in self.priors:
            raise ValueError(f"{where}: a prior of {spread} is not among priors; add it there")
        missing = [cutoff for cutoff in cutoffs if cutoff not in self.filters]
        if missing:
            raise ValueError(f"{where}: {missing[0]:g} Hz is not among filters; add it there")


def nearest(name: str, known: Any) -> str:
    """Return a suggestion for a misspelt name, empty where nothing comes near."""
    close = difflib.get_close_matches(str(name), [str(one) for one in known], n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
