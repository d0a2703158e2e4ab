"""Composes the content of a report from estimates and, optionally, the ground truth."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.evaluation import (
    TrueMotion,
    environment_force,
    evaluate,
    link_errors,
    predict,
)
from symbid_ros.identification.intervals import summarise_intervals
from symbid_ros.identification.realistic_prediction import RealisticMotion, evaluate_realistic
from symbid_ros.identification.rigid_sensors import RigidSensors
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.content import (
    PRIOR,
    TRUTH,
    LinkErrors,
    MethodResult,
    PredictionSeries,
    ReportContent,
    TruncationChoice,
)
from symbid_ros.signals.log import Log

METHOD_TITLES = {
    "ols": "OLS",
    "wls_r": "WLS-R",
    "wls_c": "WLS-C",
    "wls_rc": "WLS-RC",
    "map": "MAP",
    "map_lmi": "MAP-LMI",
}
# WLS-RC with z chosen from the log, next to WLS-RC with z chosen from validation data.
OWN_Z = "WLS-RC, own z"


@dataclass(frozen=True)
class GroundTruth:
    """True motion and parameters, with which estimates are compared.

    Attributes
    ----------
    motion : TrueMotion
        True motion of a validation log.
    values : (p,) float64
        True parameters.
    realistic : RealisticMotion or None
        Noisy log with ground truth, for predictions from the robot's own sensors.
    """

    motion: TrueMotion
    values: FloatArray
    realistic: RealisticMotion | None = None


def compose(
    estimates: Mapping[str, Estimate],
    parameters: ParameterSet,
    *,
    chosen: str,
    metadata: Mapping[str, str],
    ground_truth: GroundTruth | None = None,
    deviation_factor: FloatArray | None = None,
    truncations: Mapping[tuple[str, str], Estimate] | None = None,
) -> ReportContent:
    """Return the content of a report on one or several estimates of one robot.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        By label, in the order shown; all from one prior.
    parameters : ParameterSet
        The robot's parameters.
    chosen : str
        Label of the estimate shown in detail.
    metadata : mapping of str to str
        Describes data and processing.
    ground_truth : GroundTruth, optional
        Without it the report has no errors and no predictions.
    deviation_factor : (p, r) float64, optional
        L of the chosen estimate's covariance L Lᵀ.
    truncations : mapping of (str, str) to Estimate, optional
        Truncated estimates from the same rows, by method and source of z; shown only with
        ground truth.

    Raises
    ------
    EstimateError
        When an estimate has other parameters.
    """
    model = parameters.model
    for label, estimate in estimates.items():
        if estimate.names != parameters.names:
            raise EstimateError(
                f"{label}: its {len(estimate.names)} parameters are not the {len(parameters)} of "
                f"{chosen}; report on estimates of one robot with the same joint terms",
                "E750",
            )
    vectors = {PRIOR: estimates[chosen].prior}
    vectors |= {label: estimate.value for label, estimate in estimates.items()}
    if ground_truth is not None:
        vectors[TRUTH] = ground_truth.values
    content = ReportContent(
        title=f"Identification of {model.name}",
        model=model.name,
        methods=tuple(MethodResult(label, estimates.get(label), None) for label in vectors),
        chosen=chosen,
        joint_names=model.joint_names,
        metadata=dict(metadata),
    )
    if ground_truth is None:
        return content
    return _add_evaluation(
        content,
        parameters,
        vectors,
        ground_truth,
        truncations=truncations or {},
        deviation_factor=deviation_factor,
    )


def _add_evaluation(
    content: ReportContent,
    parameters: ParameterSet,
    vectors: Mapping[str, FloatArray],
    ground_truth: GroundTruth,
    *,
    truncations: Mapping[tuple[str, str], Estimate],
    deviation_factor: FloatArray | None,
) -> ReportContent:
    """Return the content with errors, predictions and intervals against the ground truth."""
    # The ground truth has no wrench through wrist sensors.
    rigid = RigidSensors.of(parameters)
    parameters = rigid.parameters
    vectors = {label: rigid.matrix @ values for label, values in vectors.items()}
    if deviation_factor is not None:
        deviation_factor = rigid.matrix @ deviation_factor
    truth, motion = vectors[TRUTH], ground_truth.motion
    candidates = dict(vectors)
    candidates |= {
        " ".join(key): rigid.matrix @ estimate.value for key, estimate in truncations.items()
    }
    errors = evaluate(parameters, candidates, truth, motion)
    shown = {label: vectors[label] for label in (TRUTH, PRIOR, content.chosen)}
    intervals, realistic = None, {}
    if deviation_factor is not None:
        chosen = vectors[content.chosen]
        intervals = summarise_intervals(parameters, chosen, deviation_factor, truth, motion)
    if ground_truth.realistic is not None:
        compared = {label: vectors[label] for label in (PRIOR, content.chosen, TRUTH)}
        realistic = evaluate_realistic(parameters, compared, truth, ground_truth.realistic)
    return replace(
        content,
        joint_names=parameters.model.joint_names,
        methods=tuple(
            replace(method, metrics=asdict(errors[method.label])) for method in content.methods
        ),
        predictions=tuple(
            prediction_series(label, parameters, values, motion) for label, values in shown.items()
        ),
        link_errors=LinkErrors(
            parameters.link_names,
            {
                label: link_errors(parameters, values, truth)
                for label, values in vectors.items()
                if label != TRUTH
            },
        ),
        intervals=intervals,
        realistic={label: asdict(metrics) for label, metrics in realistic.items()},
        truncations=tuple(
            TruncationChoice(*key, estimate.rank, asdict(errors[" ".join(key)]))
            for key, estimate in truncations.items()
            if estimate.rank is not None
        ),
    )


def prediction_series(
    label: str, parameters: ParameterSet, values: FloatArray, motion: TrueMotion
) -> PredictionSeries:
    """Return the prediction of parameters (p,) along a true motion."""
    prediction = predict(parameters, values, motion)
    samples = motion.samples
    first_joint = 6 * parameters.model.floating
    # The environment's contribution to each joint's load is measured; the motors supply the rest.
    environment = environment_force(parameters.model, motion)[:, first_joint:]
    return PredictionSeries(
        label=label,
        time=(samples.stamp - samples.stamp[0]) * 1e-9,
        com=prediction.com,
        torque=prediction.gen_force[:, first_joint:] - environment,
        linear_momentum=prediction.momentum[:, 3:],
        angular_momentum=prediction.momentum[:, :3],
    )


def describe_log(log: Log) -> dict[str, str]:
    """Describe the duration and the sensors of a log."""
    streams = log.streams()
    stamp = streams.joints.stamp
    seconds = (stamp[-1] - stamp[0]) * 1e-9
    sensors = [streams.joints.topic]
    sensors += [imu.topic for imu in streams.imus] + [w.topic for w in streams.wrenches]
    return {
        "Bag": log.source,
        "Duration": f"{seconds:.1f} s, {len(stamp)} joint states",
        "Sensors": ", ".join(sensors),
    }


def describe_estimate(estimate: Estimate) -> dict[str, str]:
    """Describe the rows, inputs and software of an identification."""
    rank = "" if estimate.rank is None else f"{estimate.rank} singular values, "
    return {
        "Rows": f"{estimate.samples} of each coordinate, {rank}condition {estimate.condition:.3g}",
        "Inputs": ", ".join(estimate.inputs),
        "Software": estimate.software,
    }
