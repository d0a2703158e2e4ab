"""What single estimates of a study predict, drawn: the thesis's Fig. 3 to 5, 4.1 and 4.2."""

from collections.abc import Callable, Sequence

from symbid_ros.arrays import FloatArray
from symbid_ros.identification.prediction import RealisticMotion, predict_realistic
from symbid_ros.offline.truth import read_realistic_motion, read_true_motion
from symbid_ros.report.compose import prediction_series
from symbid_ros.report.content import TRUTH, PredictionSeries
from symbid_ros.signals.causal import CausalLowPass
from symbid_ros.study.drawing import LABELS, Drawing
from symbid_ros.study.plan import Figures
from symbid_ros.study.results import Results
from symbid_ros.study.scores import REFERENCE
from symbid_ros.study.series import (
    Setting,
    com_drawing,
    momentum_drawing,
    realistic_series,
    realistic_truth,
    torque_drawing,
)

# One instant in so many is drawn: more than a page has pixels.
STRIDE = 10
# Beside the prior and the thesis's best, what this package proposes.
SHOWN = (REFERENCE, "wls_rc", "map_lmi")


def ideal_drawings(results: Results, figures: Figures) -> tuple[Drawing, ...]:
    """Draw predictions along the ideal validation motion."""
    parameters = results.parameters(figures.data)
    ideal = results.space.log(results.plan.validation_of(figures.data))
    motion = read_true_motion([ideal], parameters.model)[::STRIDE]

    def series(cutoff: float) -> list[PredictionSeries]:
        return [
            prediction_series(label, parameters, values, motion)
            for label, values in _shown(results, figures, cutoff).items()
        ]

    return _drawings(figures, parameters.model.joint_names, series, None)


def realistic_drawings(results: Results, figures: Figures) -> tuple[Drawing, ...]:
    """Draw the same as the robot itself could have predicted it from noisy sensors."""
    parameters = results.parameters(figures.data)
    low_pass = CausalLowPass()
    log = results.space.log(results.plan.realistic_of(figures.data))
    whole = read_realistic_motion([log], parameters.model, low_pass)
    motion = RealisticMotion(whole.known[::STRIDE], whole.truth[::STRIDE])

    def series(cutoff: float) -> list[PredictionSeries]:
        shown = _shown(results, figures, cutoff)
        true = realistic_truth(parameters, shown.pop(TRUTH), motion)
        return [true] + [
            realistic_series(label, motion, predict_realistic(parameters, values, motion))
            for label, values in shown.items()
        ]

    return _drawings(figures, parameters.model.joint_names, series, low_pass.cutoff)


def _drawings(
    figures: Figures,
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


def _shown(results: Results, figures: Figures, cutoff: float) -> dict[str, FloatArray]:
    """Return the truth and what the first draw's prior and estimates are, by label."""
    values = {TRUTH: results.parameters(figures.data).values}
    for method in SHOWN:
        if method == REFERENCE or method in results.plan.methods:
            values[LABELS[method]] = results.values(figures.data, figures.prior, method, cutoff)
    return values
