"""Predictions over time: Fig. 3 to 5 of the thesis, and 4.1 and 4.2 from a robot's own sensors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.identification.predictions.realistic_prediction import (
    RealisticMotion,
    RealisticPrediction,
    predict_realistic,
)
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
from symbid_ros.report.compose import prediction_series
from symbid_ros.report.content import TRUTH, PredictionSeries
from symbid_ros.report.figures import (
    PredictedSignal,
    com_signals,
    draw,
    momentum_signals,
    torque_signals,
)
from symbid_ros.report.formatting import significant
from symbid_ros.signals.filters import CausalLowPass
from symbid_ros.study.draws import StudyResults
from symbid_ros.study.evidence import describe_filter
from symbid_ros.study.plan import FigurePlan
from symbid_ros.study.plotting import (
    CaptionedFigure,
    add_legend,
    label_styles,
    line_options,
    stacked_panels,
)
from symbid_ros.study.scores import REFERENCE
from symbid_ros.study.thesis import TITLES

TORQUES_SHOWN = 4
# Every STRIDE-th sample is plotted; a page has fewer pixels than a log has samples.
STRIDE = 10
# The prior, the best method of the thesis, and the method that this package proposes.
METHODS_SHOWN = (REFERENCE, "wls_rc", "map_lmi")


@dataclass(frozen=True)
class PredictedQuantity:
    """A quantity of which the thesis shows predictions, ideal and realistic ones.

    Attributes
    ----------
    ideal, realistic : tuple of 2 str
        Stem of the files and title of each figure.
    subject : str
        Start of the captions.
    realistic_input : str
        End of the realistic caption's list of inputs.
    unit, scope : str
        Unit of the error in the captions, and its components if they are not obvious.
    vector : callable
        Returns the predicted vector (N, d) in that unit.
    signals : callable
        Returns the plotted signals from all predictions and the joint names.
    """

    ideal: tuple[str, str]
    realistic: tuple[str, str]
    subject: str
    realistic_input: str
    unit: str
    scope: str
    vector: Callable[[PredictionSeries], FloatArray]
    signals: Callable[[Sequence[PredictionSeries], Sequence[str]], list[PredictedSignal]]


COM = PredictedQuantity(
    ("fig_3_com", "Fig. 3: CoM position prediction"),
    ("fig_4_1_com", "Fig. 4.1a: realistic CoM position prediction"),
    "Centre of mass in the base frame",
    "",
    "mm",
    "",
    lambda series: 1e3 * series.com,
    lambda predictions, _: com_signals(predictions),
)
TORQUE = PredictedQuantity(
    ("fig_4_torque", "Fig. 4: joint torque prediction"),
    ("fig_4_2_torque", "Fig. 4.2: realistic joint torque prediction"),
    "Torques of the most loaded joints",
    ", ideal desired accelerations, and contact forces predicted by Eq. 4.1",
    "Nm",
    " of all joints together",
    lambda series: series.torque,
    lambda predictions, joints: torque_signals(predictions, joints, TORQUES_SHOWN),
)
MOMENTUM = PredictedQuantity(
    ("fig_5_momentum", "Fig. 5: CoM momentum prediction"),
    ("fig_4_1_momentum", "Fig. 4.1b: realistic CoM momentum prediction"),
    "Linear momentum, and angular momentum about the centre of mass, in world axes",
    "",
    "Ns & Nms",
    " of all six together",
    lambda series: np.concatenate([series.linear_momentum, series.angular_momentum], axis=1),
    lambda predictions, _: momentum_signals(predictions),
)


def describe_estimates(data: str, prior: str, cutoff: float) -> str:
    """Return the caption's sentence on the prior, the data set and the filter."""
    return (
        f"Prior drawn within {prior}; estimates from data set {data}, rows of truncated methods "
        f"{describe_filter(cutoff)}."
    )


def prediction_figure(
    quantity: PredictedQuantity,
    predictions: Sequence[PredictionSeries],
    joint_names: Sequence[str],
    estimates: str,
    velocity_cutoff: float | None = None,
) -> CaptionedFigure:
    """Plot the predictions of one quantity over time.

    Parameters
    ----------
    quantity : PredictedQuantity
    predictions : sequence of PredictionSeries
        All at the same times; one of them is the truth.
    joint_names : sequence of str
        Names of the J joints.
    estimates : str
        The caption's sentence by :func:`describe_estimates`.
    velocity_cutoff : float, optional
        Cutoff of the causal velocity filter of realistic predictions, Hz; default: ideal ones.

    Raises
    ------
    StudyError
        If the truth is missing.
    """
    if velocity_cutoff is None:
        (name, title), source = quantity.ideal, "ideal signals along the validation motion"
    else:
        name, title = quantity.realistic
        source = (
            "measured joint positions, velocities from a causal Butterworth filter at "
            f"{velocity_cutoff:g} Hz{quantity.realistic_input}"
        )
    errors = ", ".join(
        f"{label} {significant(error)} {quantity.unit}"
        for label, error in _errors(predictions, quantity.vector).items()
    )
    signals = quantity.signals(predictions, joint_names)
    styles = label_styles(series.label for series in predictions)
    time = predictions[0].time
    with stacked_panels(len(signals), 1.2, other_height=0.5) as (figure, panels):
        for axes, signal in zip(panels, signals, strict=True):
            draw(axes, signal, predictions, styles)
            axes.set_xlim(time[0], time[-1])
            # A title above the panel is upright and takes no more height.
            axes.set_ylabel("")
            heading = f"{signal.title} {signal.kind} [{signal.unit}]"
            axes.set_title(heading, loc="left", fontsize="medium", pad=3)
        panels[-1].set_xlabel("time [s]")
        add_legend(figure, {label: line_options(style) for label, style in styles.items()})
    return CaptionedFigure(
        name,
        title,
        f"{quantity.subject}, predicted from {source}. {estimates} RMSE{quantity.scope}: {errors}.",
        figure,
        f"{title}: {signals[0].kind} over {time[-1] - time[0]:.3g} s "
        f"({', '.join(signal.title for signal in signals)}), a curve for each of "
        f"{', '.join(styles)}.",
    )


def _errors(
    predictions: Sequence[PredictionSeries], vector: Callable[[PredictionSeries], FloatArray]
) -> dict[str, float]:
    """Return the RMS norm of each prediction's deviation from the truth, by label."""
    vectors = {series.label: vector(series) for series in predictions}
    if TRUTH not in vectors:
        raise StudyError(
            f"predictions of {', '.join(vectors) or 'nothing'}: {TRUTH!r} is missing; add the "
            "prediction of the true parameters",
            "E709",
        )
    truth = vectors.pop(TRUTH)
    return {
        label: float(np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))))
        for label, found in vectors.items()
    }


def realistic_truth(
    parameters: ParameterSet, values: FloatArray, motion: RealisticMotion
) -> PredictionSeries:
    """Return true efforts, CoM and momentum, given the true parameters ``values`` (p,)."""
    series = prediction_series(TRUTH, parameters, values, motion.truth)
    return replace(series, torque=motion.truth.samples.effort)


def realistic_series(
    label: str, motion: RealisticMotion, prediction: RealisticPrediction
) -> PredictionSeries:
    """Return a realistic prediction for plotting; its torques are those of Eq. 4.1."""
    stamp = motion.truth.samples.stamp
    return PredictionSeries(
        label=label,
        time=(stamp - stamp[0]) * 1e-9,
        com=prediction.com,
        torque=prediction.torque,
        linear_momentum=prediction.momentum[:, 3:],
        angular_momentum=prediction.momentum[:, :3],
    )


def ideal_figures(results: StudyResults, plan: FigurePlan) -> tuple[CaptionedFigure, ...]:
    """Plot predictions along the ideal validation motion."""
    parameters = results.true_parameters(plan.data)
    ideal = results.folder.log(results.plan.validation_log(plan.data))
    motion = read_true_motion([ideal], parameters.model)[::STRIDE]

    def predict(values: Mapping[str, FloatArray]) -> list[PredictionSeries]:
        return [prediction_series(label, parameters, v, motion) for label, v in values.items()]

    return _figures(results, plan, predict, None)


def realistic_figures(results: StudyResults, plan: FigurePlan) -> tuple[CaptionedFigure, ...]:
    """Plot predictions from the noisy sensors of the robot along the same motion."""
    parameters = results.true_parameters(plan.data)
    low_pass = CausalLowPass()
    log = results.folder.log(results.plan.noisy_validation_log(plan.data))
    full = read_realistic_motion([log], parameters.model, low_pass)
    motion = RealisticMotion(full.measured[::STRIDE], full.truth[::STRIDE])

    def predict(values: Mapping[str, FloatArray]) -> list[PredictionSeries]:
        return [
            realistic_truth(parameters, v, motion)
            if label == TRUTH
            else realistic_series(label, motion, predict_realistic(parameters, v, motion))
            for label, v in values.items()
        ]

    return _figures(results, plan, predict, low_pass.cutoff)


def _figures(
    results: StudyResults,
    plan: FigurePlan,
    predict: Callable[[Mapping[str, FloatArray]], list[PredictionSeries]],
    velocity_cutoff: float | None,
) -> tuple[CaptionedFigure, ...]:
    """Plot each quantity for the truth, the first draw's prior and estimates from it."""
    true = results.true_parameters(plan.data)
    figures = []
    for quantity, cutoff in ((COM, plan.com), (TORQUE, plan.torque), (MOMENTUM, plan.momentum)):
        values = {TRUTH: true.values} | {
            TITLES[method]: results.estimate(plan.data, plan.prior, method, cutoff)
            for method in METHODS_SHOWN
            if method in results.plan.compared
        }
        estimates = describe_estimates(plan.data, str(plan.prior), cutoff)
        joints = true.model.joint_names
        figures.append(
            prediction_figure(quantity, predict(values), joints, estimates, velocity_cutoff)
        )
    return tuple(figures)
