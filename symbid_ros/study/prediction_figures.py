"""Predictions over time: the thesis's Fig. 3 to 5 and, as the robot itself would, 4.1 and 4.2."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.identification.realistic_prediction import (
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
from symbid_ros.study.plan import FigurePlan
from symbid_ros.study.plotting import LABELS, Drawing, curve, legend, looks, stack
from symbid_ros.study.scores import REFERENCE

TORQUES_SHOWN = 4


@dataclass(frozen=True)
class Setting:
    """Of what, and how, predictions are made.

    Attributes
    ----------
    data : str
        Name of the data set identified from.
    prior : str
        How the prior was drawn, such as "±25 %".
    cutoff : float
        Hz, of the truncated methods' rows; 0: unfiltered.
    velocity_cutoff : float or None
        Hz, of the causal filter of the velocities that realistic predictions use; 0: unfiltered.
        None when all that is not predicted is ideal.
    """

    data: str
    prior: str
    cutoff: float
    velocity_cutoff: float | None = None

    def __str__(self) -> str:
        """Return a caption's part about them."""
        rows = f"filtered at {self.cutoff:g} Hz" if self.cutoff else "unfiltered"
        return (
            f"Prior drawn within {self.prior}; estimates from data set {self.data}, truncated "
            f"ones with rows {rows}."
        )

    @property
    def realistic(self) -> str:
        """What a caption says of the predictions' input; empty when it is ideal."""
        if self.velocity_cutoff is None:
            return ""
        if self.velocity_cutoff:
            return (
                f"joint positions as measured, velocities from a causal Butterworth filter at "
                f"{self.velocity_cutoff:g} Hz"
            )
        return "joint positions as measured, velocities as differences of them, unfiltered"


def realistic_truth(
    parameters: ParameterSet, values: FloatArray, motion: RealisticMotion
) -> PredictionSeries:
    """Return what realistic predictions are judged by: true efforts, and the true model's motion.

    Parameters
    ----------
    parameters : ParameterSet
    values : (p,) float64
        The true ones.
    motion : RealisticMotion
    """
    series = prediction_series(TRUTH, parameters, values, motion.truth)
    return replace(series, torque=motion.truth.samples.effort)


def realistic_series(
    label: str, motion: RealisticMotion, prediction: RealisticPrediction
) -> PredictionSeries:
    """Return a realistic prediction as what is drawn here; its torques are those of Eq. 4.1.

    Parameters
    ----------
    label : str
        Of the parameter set.
    motion : RealisticMotion
    prediction : RealisticPrediction
        Of it.
    """
    stamp = motion.truth.samples.stamp
    return PredictionSeries(
        label=label,
        time=(stamp - stamp[0]) * 1e-9,
        com=prediction.com,
        torque=prediction.torque,
        linear_momentum=prediction.momentum[:, 3:],
        angular_momentum=prediction.momentum[:, :3],
    )


def com_drawing(predictions: Sequence[PredictionSeries], setting: Setting) -> Drawing:
    """Draw the centre of mass in the base frame (thesis, Fig. 3; realistic: Fig. 4.1).

    Parameters
    ----------
    predictions : sequence of PredictionSeries
        One of them the truth, all at the same times.
    setting : Setting

    Raises
    ------
    StudyError
        When there is no truth among them.
    """
    errors = _errors(predictions, lambda series: 1e3 * series.com)
    if setting.realistic:
        name, title = "fig_4_1_com", "Fig. 4.1a: realistic CoM position prediction"
        how = f"Centre of mass in the base frame; {setting.realistic}."
    else:
        name, title = "fig_3_com", "Fig. 3: CoM position prediction"
        how = "Centre of mass in the base frame along the validation motion."
    caption = f"{how} {setting} {_told(errors, 'mm')}"
    return _drawing(name, title, caption, com_signals(predictions), predictions)


def torque_drawing(
    predictions: Sequence[PredictionSeries], joint_names: Sequence[str], setting: Setting
) -> Drawing:
    """Draw the torques of the joints that carry most (thesis, Fig. 4; realistic: Fig. 4.2).

    Parameters
    ----------
    predictions : sequence of PredictionSeries
        One of them the truth, all at the same times.
    joint_names : sequence of str
        Of their J torques.
    setting : Setting

    Raises
    ------
    StudyError
        When there is no truth among them.
    """
    errors = _errors(predictions, lambda series: series.torque)
    if setting.realistic:
        name, title = "fig_4_2_torque", "Fig. 4.2: realistic joint torque prediction"
        how = (
            f"Torques of the joints that carry most; {setting.realistic}, desired accelerations "
            "ideal, contact forces predicted by Eq. 4.1."
        )
    else:
        name, title = "fig_4_torque", "Fig. 4: joint torque prediction"
        how = (
            "Torques of the joints that carry most along the validation motion, with perfect "
            "knowledge of the external forces."
        )
    caption = f"{how} {setting} {_told(errors, 'Nm', ' of all joints together')}"
    quantities = torque_signals(predictions, joint_names, TORQUES_SHOWN)
    return _drawing(name, title, caption, quantities, predictions)


def momentum_drawing(predictions: Sequence[PredictionSeries], setting: Setting) -> Drawing:
    """Draw linear and angular momentum about the CoM (thesis, Fig. 5; realistic: Fig. 4.1).

    Parameters
    ----------
    predictions : sequence of PredictionSeries
        One of them the truth, all at the same times.
    setting : Setting

    Raises
    ------
    StudyError
        When there is no truth among them.
    """
    errors = _errors(
        predictions,
        lambda series: np.concatenate([series.linear_momentum, series.angular_momentum], axis=1),
    )
    how = "Linear momentum, and angular momentum about the centre of mass, in world axes"
    if setting.realistic:
        name, title = "fig_4_1_momentum", "Fig. 4.1b: realistic CoM momentum prediction"
        how = f"{how}; {setting.realistic}."
    else:
        name, title = "fig_5_momentum", "Fig. 5: CoM momentum prediction"
        how = f"{how}, along the validation motion."
    caption = f"{how} {setting} {_told(errors, 'Ns & Nms', ' of all six together')}"
    return _drawing(name, title, caption, momentum_signals(predictions), predictions)


def _drawing(
    name: str,
    title: str,
    caption: str,
    quantities: Sequence[PredictedSignal],
    predictions: Sequence[PredictionSeries],
) -> Drawing:
    styles = looks(series.label for series in predictions)
    with stack(len(quantities), 1.2, other_height=0.5) as (figure, panels):
        for axes, quantity in zip(panels, quantities, strict=True):
            draw(axes, quantity, predictions, styles)
            axes.set_xlim(predictions[0].time[0], predictions[0].time[-1])
            # Above the panel it needs no more height than there is, and no turning of the head.
            axes.set_ylabel("")
            heading = f"{quantity.title} {quantity.kind} [{quantity.unit}]"
            axes.set_title(heading, loc="left", fontsize="medium", pad=3)
        panels[-1].set_xlabel("time [s]")
        legend(figure, {label: curve(style) for label, style in styles.items()})
    shown = ", ".join(quantity.title for quantity in quantities)
    duration = predictions[0].time[-1] - predictions[0].time[0]
    return Drawing(
        name,
        title,
        caption,
        figure,
        f"{title}: {quantities[0].kind} over {duration:.3g} s ({shown}), "
        f"a curve each for {', '.join(styles)}.",
    )


def _errors(
    predictions: Sequence[PredictionSeries], vector: Callable[[PredictionSeries], FloatArray]
) -> dict[str, float]:
    """Return how far each is from the truth, root mean square of the vector's norm."""
    vectors = {series.label: vector(series) for series in predictions}
    if TRUTH not in vectors:
        raise StudyError(
            f"predictions of {', '.join(vectors) or 'nothing'}: no {TRUTH!r} among them; add the "
            "true parameters' to compare with",
            "E709",
        )
    truth = vectors.pop(TRUTH)
    return {
        label: float(np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))))
        for label, found in vectors.items()
    }


def _told(errors: Mapping[str, float], unit: str, of: str = "") -> str:
    figures = ", ".join(f"{label} {significant(error)} {unit}" for label, error in errors.items())
    return f"RMSE{of}: {figures}."


# One instant in so many is drawn: more than a page has pixels.
STRIDE = 10
# Beside the prior and the thesis's best, what this package proposes.
SHOWN = (REFERENCE, "wls_rc", "map_lmi")


def ideal_drawings(results: StudyResults, figures: FigurePlan) -> tuple[Drawing, ...]:
    """Draw predictions along the ideal validation motion."""
    parameters = results.true_parameters(figures.data)
    ideal = results.folder.log(results.plan.validation_log(figures.data))
    motion = read_true_motion([ideal], parameters.model)[::STRIDE]

    def series(cutoff: float) -> list[PredictionSeries]:
        return [
            prediction_series(label, parameters, values, motion)
            for label, values in _shown(results, figures, cutoff).items()
        ]

    return _drawings(figures, parameters.model.joint_names, series, None)


def realistic_drawings(results: StudyResults, figures: FigurePlan) -> tuple[Drawing, ...]:
    """Draw the same as the robot itself could have predicted it from noisy sensors."""
    parameters = results.true_parameters(figures.data)
    low_pass = CausalLowPass()
    log = results.folder.log(results.plan.noisy_validation_log(figures.data))
    whole = read_realistic_motion([log], parameters.model, low_pass)
    motion = RealisticMotion(whole.measured[::STRIDE], whole.truth[::STRIDE])

    def series(cutoff: float) -> list[PredictionSeries]:
        shown = _shown(results, figures, cutoff)
        true = realistic_truth(parameters, shown.pop(TRUTH), motion)
        return [true] + [
            realistic_series(label, motion, predict_realistic(parameters, values, motion))
            for label, values in shown.items()
        ]

    return _drawings(figures, parameters.model.joint_names, series, low_pass.cutoff)


def _drawings(
    figures: FigurePlan,
    joint_names: Sequence[str],
    series: Callable[[float], list[PredictionSeries]],
    velocity_cutoff: float | None,
) -> tuple[Drawing, ...]:
    def setting(cutoff: float) -> Setting:
        return Setting(figures.data, str(figures.prior), cutoff, velocity_cutoff)

    return (
        com_drawing(series(figures.com), setting(figures.com)),
        torque_drawing(series(figures.torque), joint_names, setting(figures.torque)),
        momentum_drawing(series(figures.momentum), setting(figures.momentum)),
    )


def _shown(results: StudyResults, figures: FigurePlan, cutoff: float) -> dict[str, FloatArray]:
    """Return the truth and what the first draw's prior and estimates are, by label."""
    values = {TRUTH: results.true_parameters(figures.data).values}
    for method in SHOWN:
        if method == REFERENCE or method in results.plan.methods:
            values[LABELS[method]] = results.estimate(figures.data, figures.prior, method, cutoff)
    return values
