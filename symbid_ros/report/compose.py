"""Composes the content of a report from estimates and, optionally, the ground truth."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.calibration.rigid_sensors import RigidSensors
from symbid_ros.identification.predictions.comparison import describe_difference
from symbid_ros.identification.predictions.evaluation import (
    Metrics,
    TrueMotion,
    environment_force,
    evaluate,
    link_errors,
    predict,
)
from symbid_ros.identification.predictions.intervals import summarise_intervals
from symbid_ros.identification.predictions.realistic_prediction import (
    RealisticMotion,
    evaluate_realistic,
)
from symbid_ros.model.held_joints import with_held_joints
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import with_wrist_sensors
from symbid_ros.report.content import (
    PRIOR,
    TRUTH,
    JointLimits,
    LinkErrors,
    MethodResult,
    ParameterCorrelation,
    PredictionSeries,
    ReportContent,
    TruncationChoice,
)
from symbid_ros.report.formatting import counted
from symbid_ros.report.payloads import payloads
from symbid_ros.report.robot_scene import robot_scene
from symbid_ros.report.saved_results import ReportedResult
from symbid_ros.signals.log import Log

# WLS-RC with z chosen from the log, next to WLS-RC with z chosen from validation data.
OWN_Z = "WLS-RC, own z"
ROUNDING = 1e-9  # of errors, in their units


@dataclass(frozen=True)
class GroundTruth:
    """True motion and robot, with which estimates are compared.

    Attributes
    ----------
    motion : TrueMotion
        True motion of a validation log.
    model : RobotModel
        The true robot.
    realistic : RealisticMotion or None
        Noisy log with ground truth, for predictions from the robot's own sensors.
    """

    motion: TrueMotion
    model: RobotModel
    realistic: RealisticMotion | None = None

    def values(self, result: ReportedResult) -> FloatArray:
        """Return the true values (p,) of a result's parameters."""
        model = with_held_joints(self.model, result.estimate.held_joints)
        model = with_wrist_sensors(model, result.estimate.wrist_sensors)
        true = replace(result.parameters, model=model)
        if true.names != result.parameters.names:
            raise EstimateError(
                f"{self.model.source}: its parameters are not those of the estimate; give the true "
                "model of this robot",
                "E512",
            )
        return true.values


def compose(
    results: Mapping[str, ReportedResult],
    *,
    chosen: str,
    metadata: Mapping[str, str],
    ground_truth: GroundTruth | None = None,
    truncations: Mapping[tuple[str, str], Estimate] | None = None,
) -> ReportContent:
    """Return the content of a report on one or several results of one robot.

    Parameters
    ----------
    results : mapping of str to ReportedResult
        By label, in the order shown. Their joint terms may differ.
    chosen : str
        Label of the result shown in detail.
    metadata : mapping of str to str
        Describes data and processing.
    ground_truth : GroundTruth, optional
        Without it the report has no errors against a truth.
    truncations : mapping of (str, str) to Estimate, optional
        Truncated estimates from the same rows, by method and source of z; shown only with
        ground truth.

    Raises
    ------
    EstimateError
        When the results are of different robots, or the ground truth is of another one.
    """
    shown = results[chosen]
    model = shown.parameters.model
    for label, one in results.items():
        if one.parameters.model.coordinates != model.coordinates:
            raise EstimateError(
                f"{label}: its {describe_difference(one.parameters.model, model)} of {chosen}; "
                "report results of one robot",
                "E512",
            )
    methods = [MethodResult(PRIOR, None, None)]
    methods += [
        MethodResult(label, one.estimate, None, one.summary, one.log, one.given)
        for label, one in results.items()
    ]
    if ground_truth is not None:
        methods.append(MethodResult(TRUTH, None, None))
    content = ReportContent(
        title=f"Identification of {model.name}",
        model=model.name,
        methods=tuple(methods),
        chosen=chosen,
        joint_names=model.joint_names,
        metadata=dict(metadata),
        limits=joint_limits(model),
        robot=robot_scene(
            shown.parameters,
            shown.estimate,
            shown.summary.posture if shown.summary.is_mean_posture else None,
            deviation_factor=shown.deviations,
        ),
        # The gain that no residual shows would make nearly all pairs look correlated.
        spread=parameter_spread(shown.estimate, shown.free_deviations, shown.prior_std),
        payloads=payloads(
            shown.estimate,
            shown.deviations,
            shown.parameters,
            shown.summary.posture if shown.summary.is_mean_posture else None,
        ),
    )
    if ground_truth is None:
        return content
    return _add_evaluation(content, results, ground_truth, truncations=truncations or {})


def joint_limits(model: RobotModel) -> dict[str, JointLimits]:
    """Return the position limits of the joints that move."""
    return {
        joint.name: JointLimits(joint.lower, joint.upper, joint.kind == "prismatic")
        for joint in (model.joints[index] for index in model.moving_joints)
    }


def parameter_spread(
    estimate: Estimate, deviations: FloatArray | None, prior_std: FloatArray | None
) -> ParameterCorrelation | None:
    """Return correlations of the parameters that were identified; None without covariance."""
    if deviations is None or estimate.std is None:
        return None
    std = np.linalg.norm(deviations, axis=1)
    kept = np.flatnonzero(std > 0)
    scaled = deviations[kept] / std[kept, None]
    return ParameterCorrelation(
        tuple(estimate.names[index] for index in kept.tolist()),
        np.clip(scaled @ scaled.T, -1.0, 1.0),
        None if prior_std is None else prior_std,
    )


def _add_evaluation(
    content: ReportContent,
    results: Mapping[str, ReportedResult],
    ground_truth: GroundTruth,
    *,
    truncations: Mapping[tuple[str, str], Estimate],
) -> ReportContent:
    """Return the content with errors, predictions and intervals against the ground truth."""
    motion, shown = ground_truth.motion, results[content.chosen]
    errors: dict[str, Metrics] = {}
    by_link: dict[str, FloatArray] = {}
    # Results with equal parameters share the matrices of the motion.
    for names in dict.fromkeys(one.estimate.names for one in results.values()):
        alike = {label: one for label, one in results.items() if one.estimate.names == names}
        first = next(iter(alike.values()))
        own, true = RigidSensors.of(first.parameters), ground_truth.values(first)
        candidates = {label: one.estimate.value for label, one in alike.items()}
        if content.chosen in alike:
            candidates |= {PRIOR: shown.estimate.prior, TRUTH: true}
            candidates |= {" ".join(key): one.value for key, one in truncations.items()}
        # The ground truth has no wrench through wrist sensors.
        candidates = {label: own.matrix @ values for label, values in candidates.items()}
        true = own.matrix @ true
        errors |= evaluate(own.parameters, candidates, true, motion)
        by_link |= {
            label: link_errors(own.parameters, one, true) for label, one in candidates.items()
        }
    rigid = RigidSensors.of(shown.parameters)
    parameters, truth = rigid.parameters, rigid.matrix @ ground_truth.values(shown)
    vectors = {
        PRIOR: rigid.matrix @ shown.estimate.prior,
        content.chosen: rigid.matrix @ shown.estimate.value,
        TRUTH: truth,
    }
    labels = [method.label for method in content.methods]
    intervals, realistic = None, {}
    if shown.deviation_factor is not None:
        factor = rigid.matrix @ shown.deviation_factor
        intervals = summarise_intervals(parameters, vectors[content.chosen], factor, truth, motion)
    if ground_truth.realistic is not None:
        compared = {label: vectors[label] for label in (PRIOR, content.chosen, TRUTH)}
        realistic = evaluate_realistic(parameters, compared, truth, ground_truth.realistic)
    return replace(
        content,
        joint_names=parameters.model.joint_names,
        methods=tuple(
            replace(method, metrics=_without_rounding(errors[method.label]))
            for method in content.methods
        ),
        predictions=tuple(
            prediction_series(label, parameters, vectors[label], motion)
            for label in (TRUTH, PRIOR, content.chosen)
        ),
        link_errors=LinkErrors(
            parameters.link_names,
            {label: by_link[label] for label in labels if label != TRUTH},
        ),
        intervals=intervals,
        realistic={label: asdict(metrics) for label, metrics in realistic.items()},
        truncations=tuple(
            TruncationChoice(*key, estimate.rank, _without_rounding(errors[" ".join(key)]))
            for key, estimate in truncations.items()
            if estimate.rank is not None
        ),
    )


def _without_rounding(errors: Metrics) -> dict[str, float]:
    """Return errors in which those of the order of rounding are zero, as the truth's are."""
    return {name: 0.0 if value < ROUNDING else value for name, value in asdict(errors).items()}


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


def describe_given(log: Log) -> dict[str, str]:
    """Describe a log that a report was given beside the one of the identification."""
    titles = {"Bag": "Given bag", "Duration": "Its duration", "Sensors": "Its sensors"}
    return {titles[name]: text for name, text in describe_log(log).items()}


def describe_estimate(estimate: Estimate) -> dict[str, str]:
    """Describe the rows, inputs and software of an identification."""
    rank = "" if estimate.rank is None else f"{counted(estimate.rank, 'singular value')}, "
    return {
        "Rows": f"{estimate.samples} of each coordinate, {rank}condition {estimate.condition:.3g}",
        "Inputs": ", ".join(estimate.inputs),
        "Software": estimate.software,
    }
