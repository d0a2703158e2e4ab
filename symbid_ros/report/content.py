"""Content of a report as data, without markup."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.predictions.intervals import IntervalSummary
from symbid_ros.identification.report_data import PredictedLog, ReportData
from symbid_ros.report.payloads import Payload
from symbid_ros.report.robot_summary import RobotSummary

if TYPE_CHECKING:
    # Loads libraries for meshes, which commands that only print a table do not need.
    from symbid_ros.report.robot_scene import RobotScene

PRIOR = "prior"
TRUTH = "truth"


@dataclass(frozen=True)
class Metric:
    """An error measure of estimates, with a title short enough for 80 columns and phones."""

    key: str  # field of the evaluation
    title: str
    unit: str


METRICS = (
    Metric("gen_force_rmse", "Gen. force", "N, Nm"),
    Metric("torque_rmse", "Torque", "Nm"),
    Metric("com_position_rmse_mm", "CoM", "mm"),
    Metric("com_momentum_rmse", "Momentum", "Ns, Nms"),
    Metric("parameter_error_pct", "Parameters", "%"),
)
REALISTIC_METRICS = (
    Metric("torque_rmse", "Torque", "Nm"),
    Metric("torque_from_wrenches_rmse", "By wrenches", "Nm"),
    Metric("contact_force_rmse", "Contact force", "N"),
    Metric("contact_moment_rmse", "Moment", "Nm"),
    Metric("com_position_rmse_mm", "CoM", "mm"),
    Metric("com_momentum_rmse", "Momentum", "Ns, Nms"),
)


def best_labels(
    rows: Mapping[str, Mapping[str, float]], metrics: Iterable[Metric]
) -> dict[str, frozenset[str]]:
    """Return the labels with the smallest value of each metric, by metric key.

    The truth is excluded. The prior is included, which reveals methods that are worse than it.
    """
    best = {}
    for metric in metrics:
        values = {
            label: row[metric.key]
            for label, row in rows.items()
            if metric.key in row and label != TRUTH
        }
        smallest = min(values.values(), default=0.0)
        best[metric.key] = frozenset(label for label, v in values.items() if v == smallest)
    return best


@dataclass(frozen=True)
class MethodResult:
    """One row in the comparison of methods."""

    label: str  # prior, truth or the title of the method, such as WLS-RC
    estimate: Estimate | None  # None for the prior and the truth
    metrics: dict[str, float] | None  # by Metric.key; None without ground truth
    summary: RobotSummary | None = None  # None for the prior and the truth
    log: ReportData | None = None  # what the result keeps of its log
    given: PredictedLog | None = None  # another log, shown instead

    @property
    def drawn(self) -> ReportData | None:
        """The log whose forces and motion are shown."""
        return self.log if self.given is None else self.given.data


@dataclass(frozen=True)
class JointLimits:
    """Position limits of a joint, rad or m; infinite where the model sets none."""

    lower: float
    upper: float
    is_prismatic: bool


@dataclass(frozen=True)
class ParameterCorrelation:
    """Correlations of the identified parameters.

    Attributes
    ----------
    names : tuple of str
        The q parameters that have a standard deviation.
    correlation : (q, q) float64
        From -1 to 1.
    prior_std : (p,) float64 or None
        Standard deviations of all parameters before the data; None if they are not saved.
    """

    names: tuple[str, ...]
    correlation: FloatArray
    prior_std: FloatArray | None = None


@dataclass(frozen=True)
class TruncationChoice:
    """One truncated method with z from one of two sources."""

    label: str  # title of the method
    chosen_by: str  # data that z was chosen from
    rank: int  # z, the number of singular values
    metrics: dict[str, float]  # by Metric.key


@dataclass(frozen=True)
class PredictionSeries:
    """Prediction of one parameter set along a validation motion.

    Attributes
    ----------
    label : str
        ``truth``, ``prior`` or the label of the method.
    time : (N,) float64
        Seconds.
    com : (N, 3) float64
        Centre of mass in the base frame, m.
    torque : (N, J) float64
        Joint torques, Nm.
    linear_momentum, angular_momentum : (N, 3) float64
        In world axes, Ns and Nms; angular momentum about the CoM.
    """

    label: str
    time: FloatArray
    com: FloatArray
    torque: FloatArray
    linear_momentum: FloatArray
    angular_momentum: FloatArray

    def __post_init__(self) -> None:
        samples = len(self.time)
        for name in ("com", "torque", "linear_momentum", "angular_momentum"):
            shape = getattr(self, name).shape
            columns = shape[-1] if name == "torque" else 3
            if shape != (samples, columns):
                raise EstimateError(
                    f"prediction {self.label!r}: {name} has shape {shape}, "
                    f"expected ({samples}, {columns}); give one row for each time",
                    "E751",
                )


@dataclass(frozen=True)
class LinkErrors:
    """Mean relative parameter error of each link, by parameter set.

    Attributes
    ----------
    links : tuple of str
        The L links, in the model's order.
    percent : dict of str to (L,) float64
        By label of the parameter set; NaN for a link without non-zero parameters.
    """

    links: tuple[str, ...]
    percent: dict[str, FloatArray]

    def __post_init__(self) -> None:
        for label, values in self.percent.items():
            if np.shape(values) != (len(self.links),):
                raise EstimateError(
                    f"link errors of {label!r}: {np.shape(values)} values for "
                    f"{len(self.links)} links; give one for each link",
                    "E751",
                )


@dataclass(frozen=True)
class ReportContent:
    """Content of one page; the page leaves out sections whose field is None or empty.

    Attributes
    ----------
    title, model : str
        Heading of the page and name of the robot model.
    metadata : dict of str to str
        Describes data and processing, in the order shown.
    methods : tuple of MethodResult
        Rows of the comparison, in the order shown.
    chosen : str
        Label of the method whose parameters and verdict are shown.
    joint_names : tuple of str
        Columns of ``PredictionSeries.torque``.
    predictions : tuple of PredictionSeries or None
        Truth, prior and the chosen method along one motion, at the same times;
        None without ground truth.
    link_errors : LinkErrors or None
        None without ground truth.
    intervals : IntervalSummary or None
        Intervals of the chosen method's predictions; None without ground truth or covariance.
    realistic : dict of str to dict of str to float
        By label, then by key of ``REALISTIC_METRICS``; empty without a noisy log.
    truncations : tuple of TruncationChoice
        z chosen without and with validation data, on the same rows.
    limits : dict of str to JointLimits
        Position limits of each joint that moves.
    spread : ParameterCorrelation or None
        Of the chosen method; None without covariance.
    robot : RobotScene or None
        The robot with the chosen method's parameters, in 3D.
    payloads : tuple of Payload
        What the chosen method found behind each wrist sensor.
    """

    title: str
    model: str
    methods: tuple[MethodResult, ...]
    chosen: str
    joint_names: tuple[str, ...]
    metadata: dict[str, str] = field(default_factory=dict)
    predictions: tuple[PredictionSeries, ...] | None = None
    link_errors: LinkErrors | None = None
    intervals: IntervalSummary | None = None
    realistic: dict[str, dict[str, float]] = field(default_factory=dict)
    truncations: tuple[TruncationChoice, ...] = ()
    limits: dict[str, JointLimits] = field(default_factory=dict)
    spread: ParameterCorrelation | None = None
    robot: "RobotScene | None" = None
    payloads: tuple[Payload, ...] = ()

    def __post_init__(self) -> None:
        labels = [method.label for method in self.methods]
        if len(set(labels)) != len(labels):
            raise EstimateError(
                f"report {self.title!r}: labels {labels} repeat; give each row its own label",
                "E752",
            )
        if not any(m.label == self.chosen and m.estimate is not None for m in self.methods):
            raise EstimateError(
                f"report {self.title!r}: no method {self.chosen!r} with an estimate "
                f"among {labels}; choose one of the given methods",
                "E752",
            )
        for series in self.predictions or ():
            if not np.array_equal(series.time, (self.predictions or ())[0].time):
                raise EstimateError(
                    f"prediction {series.label!r}: its times differ from those of the others; "
                    "predict all along the same motion",
                    "E751",
                )
            if series.torque.shape[1] != len(self.joint_names):
                raise EstimateError(
                    f"prediction {series.label!r}: {series.torque.shape[1]} torque columns for "
                    f"{len(self.joint_names)} joint names; give one name for each column",
                    "E751",
                )

    @property
    def estimate(self) -> Estimate:
        """The chosen method's estimate."""
        return next(
            m.estimate for m in self.methods if m.label == self.chosen and m.estimate is not None
        )

    @property
    def shown(self) -> MethodResult:
        """The chosen method."""
        return next(method for method in self.methods if method.label == self.chosen)

    @property
    def results(self) -> tuple[MethodResult, ...]:
        """Rows that are results, without prior and truth."""
        return tuple(method for method in self.methods if method.estimate is not None)

    def metrics_of(self, label: str) -> dict[str, float] | None:
        """Return the metrics of the row with this label, None if it has none."""
        return next((m.metrics for m in self.methods if m.label == label), None)
