"""From estimates and, where there is one, a true motion to a report's content."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from symbid_ros.arrays import FloatArray
from symbid_ros.bags import read_streams
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.identification.evaluation import (
    TrueMotion,
    environment_force,
    evaluate,
    link_errors,
    predict,
)
from symbid_ros.identification.intervals import IntervalSummary, summarise_intervals
from symbid_ros.identification.prediction import RealisticMotion, evaluate_realistic
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

METHOD_TITLES = {
    "ols": "OLS",
    "wls_r": "WLS-R",
    "wls_c": "WLS-C",
    "wls_rc": "WLS-RC",
    "map": "MAP",
    "map_lmi": "MAP-LMI",
}
# WLS-RC that found its own z, beside one that was given the best there is.
OWN_Z = "WLS-RC, own z"


@dataclass(frozen=True)
class GroundTruth:
    """What estimates are judged against.

    Attributes
    ----------
    motion : TrueMotion
        The true motion of a validation record.
    values : (p,) float64
        The true parameters.
    realistic : RealisticMotion or None
        A noisy record with ground truth, to predict as the robot itself could.
    """

    motion: TrueMotion
    values: FloatArray
    realistic: RealisticMotion | None = None


def compose(
    estimates: Mapping[str, Estimate],
    parameters: ParameterSet,
    *,
    chosen: str,
    facts: Mapping[str, str],
    ground_truth: GroundTruth | None = None,
    deviation_factor: FloatArray | None = None,
    truncations: Mapping[tuple[str, str], Estimate] | None = None,
) -> ReportContent:
    """Return the content of a page about several estimates of one robot.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        By the label people write, in the order shown; all from one prior.
    parameters : ParameterSet
        The robot's columns.
    chosen : str
        Label of the estimate that is shown in full.
    facts : mapping of str to str
        What was done to which data.
    ground_truth : GroundTruth, optional
        The truth; without it nothing is judged and no prediction drawn.
    deviation_factor : (p, r) float64, optional
        L of the chosen estimate's covariance L Lᵀ.
    truncations : mapping of (str, str) to Estimate, optional
        Truncated estimates from the same rows, by method and by what chose z; shown where
        there is a ground_truth.

    Raises
    ------
    EstimateError
        When the estimates are not all of these parameters.
    """
    model = parameters.model
    for label, estimate in estimates.items():
        if estimate.names != parameters.names:
            raise EstimateError(
                f"{label}: {len(estimate.names)} parameters are not the {len(parameters)} of "
                f"{chosen}; report on estimates of one robot with the same joint terms"
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
        facts=dict(facts),
    )
    if ground_truth is None:
        return content
    return _judged(
        content,
        parameters,
        vectors,
        ground_truth,
        truncations=truncations or {},
        deviation_factor=deviation_factor,
    )


def _judged(
    content: ReportContent,
    parameters: ParameterSet,
    vectors: Mapping[str, FloatArray],
    ground_truth: GroundTruth,
    *,
    truncations: Mapping[tuple[str, str], Estimate],
    deviation_factor: FloatArray | None,
) -> ReportContent:
    """Return the content with all that follows from the truth."""
    truth, motion = ground_truth.values, ground_truth.motion
    candidates = dict(vectors)
    candidates |= {" ".join(key): found.value for key, found in truncations.items()}
    judged = evaluate(parameters, candidates, truth, motion)
    shown = {label: vectors[label] for label in (TRUTH, PRIOR, content.chosen)}
    return replace(
        content,
        methods=tuple(
            replace(method, metrics=asdict(judged[method.label])) for method in content.methods
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
        intervals=_intervals(parameters, vectors[content.chosen], ground_truth, deviation_factor),
        realistic=_realistic(
            parameters,
            {label: vectors[label] for label in (PRIOR, content.chosen, TRUTH)},
            ground_truth,
        ),
        truncations=tuple(
            TruncationChoice(*key, found.rank, asdict(judged[" ".join(key)]))
            for key, found in truncations.items()
            if found.rank is not None
        ),
    )


def _intervals(
    parameters: ParameterSet,
    values: FloatArray,
    ground_truth: GroundTruth,
    factor: FloatArray | None,
) -> IntervalSummary | None:
    if factor is None:
        return None
    return summarise_intervals(parameters, values, factor, ground_truth.values, ground_truth.motion)


def _realistic(
    parameters: ParameterSet, vectors: Mapping[str, FloatArray], ground_truth: GroundTruth
) -> dict[str, dict[str, float]]:
    if ground_truth.realistic is None:
        return {}
    judged = evaluate_realistic(parameters, vectors, ground_truth.values, ground_truth.realistic)
    return {label: asdict(figures) for label, figures in judged.items()}


def prediction_series(
    label: str, parameters: ParameterSet, values: FloatArray, motion: TrueMotion
) -> PredictionSeries:
    """Return what the parameters (p,) predict along a true motion, to be drawn."""
    prediction = predict(parameters, values, motion)
    samples = motion.samples
    first_joint = 6 * parameters.model.floating
    # The environment's share of each joint's load is measured; the motors owe the rest.
    environment = environment_force(parameters.model, motion)[:, first_joint:]
    return PredictionSeries(
        label=label,
        time=(samples.stamp - samples.stamp[0]) * 1e-9,
        com=prediction.com,
        torque=prediction.gen_force[:, first_joint:] - environment,
        linear_momentum=prediction.momentum[:, 3:],
        angular_momentum=prediction.momentum[:, :3],
    )


def describe_bags(bags: Sequence[Path]) -> dict[str, str]:
    """Return what a bag holds, read from its sensor topics."""
    streams = read_streams(bags)
    stamp = streams.joints.stamp
    seconds = (stamp[-1] - stamp[0]) * 1e-9
    sensors = [streams.joints.topic]
    sensors += [imu.topic for imu in streams.imus] + [w.topic for w in streams.wrenches]
    return {
        "Bag": ", ".join(str(bag) for bag in bags),
        "Duration": f"{seconds:.1f} s, {len(stamp)} joint states",
        "Sensors": ", ".join(sensors),
    }


def describe_estimate(estimate: Estimate) -> dict[str, str]:
    """Return what an identification used."""
    cut = "" if estimate.rank is None else f"{estimate.rank} singular values, "
    return {
        "Rows": f"{estimate.samples} of each coordinate, {cut}condition {estimate.condition:.3g}",
        "Inputs": ", ".join(estimate.inputs),
        "Software": estimate.software,
    }
